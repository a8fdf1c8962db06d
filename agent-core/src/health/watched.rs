//! A step of an agent that is watched: the one order in which [`Inbox`], [`AgentState`] and
//! [`Health`] work together, on a node, in the simulator, and in the on-target tests.
//!
//! A frame goes through the plausible region, and a refusal is counted. A step is taken with the
//! network unless [`Health`] has left it out, [`Health`] hears what came of it, and an agent whose
//! estimate is unusable is restarted; what it broadcasts is then the frame of the restart.
//!
//! [`WatchedAgent`] borrows its parts, because they live in different places: parameters in flash
//! or on the heap, the state in a `static`. It is five references, made for one step.
//!
//! Cost: that of the parts. No memory.

use super::{Advice, Health, HealthParams};
use crate::Tick;
use crate::agent::capture::Sample;
use crate::agent::hold::HoldSlots;
use crate::agent::inbox::Inbox;
use crate::agent::{AgentParams, AgentState, StepError, StepOutput};
use crate::observer::network::InnerNetwork;
use crate::wire::frame::{Frame, FrameError};

/// An agent and its watch, for as long as one step takes.
#[derive(Debug)]
pub struct WatchedAgent<'a, const N: usize, const FEATURES: usize, S, I> {
    /// What does not change about the agent.
    pub params: &'a AgentParams<'a, N>,
    /// What does not change about the watch.
    pub health_params: &'a HealthParams<N>,
    /// What the steps change.
    pub state: &'a mut AgentState<N, FEATURES, S>,
    /// The frames that wait for the next step.
    pub inbox: &'a mut Inbox<N, I>,
    /// What the watch has noticed.
    pub health: &'a mut Health,
}

/// What an attempt at a step led to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum WatchedStep<const N: usize> {
    /// The step was taken.
    Taken(StepOutput<N>),
    /// The step was refused; the state is as it was before.
    Refused(StepError),
    /// The agent was lost and has been restarted. There is nothing to learn from what led there,
    /// so there is no sample.
    Restarted(Frame<N>),
}

impl<const N: usize> WatchedStep<N> {
    /// The frame to broadcast, if there is one.
    #[inline]
    #[must_use]
    pub fn broadcast(&self) -> Option<&Frame<N>> {
        match self {
            Self::Taken(output) => output.broadcast.as_ref(),
            Self::Refused(_) => None,
            Self::Restarted(frame) => Some(frame),
        }
    }

    /// Estimate and derivative for training, if the step was taken.
    #[inline]
    #[must_use]
    pub fn sample(&self) -> Option<&Sample<N>> {
        match self {
            Self::Taken(output) => Some(&output.sample),
            Self::Refused(_) | Self::Restarted(_) => None,
        }
    }
}

impl<const N: usize, const FEATURES: usize, S: HoldSlots<N>, I: HoldSlots<N>>
    WatchedAgent<'_, N, FEATURES, S, I>
{
    /// Keeps a received frame for the next step, if its estimate is plausible.
    ///
    /// # Errors
    /// As for [`Inbox::accept_within`]; the refusal has been counted.
    #[inline]
    pub fn receive(&mut self, bytes: &[u8]) -> Result<(), FrameError> {
        let region = self.health_params.plausible_region();
        self.inbox
            .accept_within(self.params.neighbours(), region, bytes)
            .inspect_err(|error| self.health.frame_refused(error))
    }

    /// Attempts the step at `tick` with `measurement`, shape `[m]`. `network` is the one in the
    /// package, which is left out while [`Health`] says so; `outer_weights` are the package's, row by
    /// row, shape `[L, N]`, for a restart.
    ///
    /// If a restart is due and `outer_weights` do not fit, the outcome is that of the step.
    #[inline]
    pub fn step<P: AsRef<[f32]>>(
        &mut self,
        network: Option<&InnerNetwork<P>>,
        outer_weights: &[f32],
        tick: Tick,
        measurement: &[f32],
    ) -> WatchedStep<N> {
        self.step_observed(network, outer_weights, tick, measurement, |_, _| ())
    }

    /// Like [`Self::step`]; calls `observe` with the state that a step left and with the step's
    /// output, before a restart can replace it.
    #[inline]
    pub fn step_observed<P: AsRef<[f32]>>(
        &mut self,
        network: Option<&InnerNetwork<P>>,
        outer_weights: &[f32],
        tick: Tick,
        measurement: &[f32],
        observe: impl FnOnce(&AgentState<N, FEATURES, S>, &StepOutput<N>),
    ) -> WatchedStep<N> {
        let Self { params, health_params, state, inbox, health } = self;
        let network = network.filter(|_| health.network_in_use());
        let attempt = state.step(params, network, tick, measurement, inbox);
        if let Ok(output) = &attempt {
            observe(state, output);
        }
        if health.observe(health_params, tick, &attempt, state) == Advice::Restart
            && let Ok(frame) =
                health.restart(health_params, params, state, inbox, tick, outer_weights)
        {
            return WatchedStep::Restarted(frame);
        }
        match attempt {
            Ok(output) => WatchedStep::Taken(output),
            Err(error) => WatchedStep::Refused(error),
        }
    }
}
