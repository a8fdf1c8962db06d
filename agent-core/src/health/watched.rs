//! A step of an agent with health monitoring: the single place that defines the order in which
//! [`Inbox`], [`AgentState`] and [`Health`] work together on a node, in the simulator, and in the
//! on-target tests.
//!
//! A frame must be in the plausible region, and every refusal is counted. A step uses the network
//! unless [`Health`] has fallen back, [`Health`] observes the outcome, and an agent whose estimate
//! is unusable is restarted; the restart's frame then replaces the step's.
//!
//! [`WatchedAgent`] borrows its parts, because they are stored in different places: parameters in
//! flash or on the heap, the state in a `static`. It consists of five references and is created for
//! one step.
//!
//! Cost: the sum of the parts'. No memory.

use super::{Advice, Health, HealthParams};
use crate::Tick;
use crate::agent::capture::Sample;
use crate::agent::hold::HoldSlots;
use crate::agent::inbox::Inbox;
use crate::agent::{AgentParams, AgentState, StepError, StepOutput};
use crate::observer::features::Features;
use crate::wire::frame::{Frame, FrameError};

/// An agent and its health monitoring, borrowed for one step.
#[derive(Debug)]
pub struct WatchedAgent<'a, const N: usize, const FEATURES: usize, S, I> {
    /// Parameters of the agent.
    pub params: &'a AgentParams<'a, N>,
    /// Parameters of the health monitoring.
    pub health_params: &'a HealthParams<N>,
    /// State of the agent.
    pub state: &'a mut AgentState<N, FEATURES, S>,
    /// Frames pending for the next step.
    pub inbox: &'a mut Inbox<N, I>,
    /// The health record.
    pub health: &'a mut Health,
}

/// Outcome of an attempted step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum WatchedStep<const N: usize> {
    /// The step was taken.
    Taken(StepOutput<N>),
    /// The step was refused; the state is unchanged.
    Refused(StepError),
    /// The estimate was unusable and the agent has been restarted. There is no sample, because the
    /// data that led to a restart is not useful for training.
    Restarted(Frame<N>),
}

impl<const N: usize> WatchedStep<N> {
    /// Returns the frame to broadcast, if any.
    #[inline]
    #[must_use]
    pub fn broadcast(&self) -> Option<&Frame<N>> {
        match self {
            Self::Taken(output) => output.broadcast.as_ref(),
            Self::Refused(_) => None,
            Self::Restarted(frame) => Some(frame),
        }
    }

    /// Returns estimate and derivative for training, if the step was taken.
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
    /// Keeps a received frame for the next step if its estimate is plausible.
    ///
    /// # Errors
    /// Same as for [`Inbox::accept_within`]; the refusal is counted.
    #[inline]
    pub fn receive(&mut self, bytes: &[u8]) -> Result<(), FrameError> {
        let region = self.health_params.plausible_region();
        self.inbox
            .accept_within(self.params.neighbours(), region, bytes)
            .inspect_err(|error| self.health.frame_refused(error))
    }

    /// Like [`Self::receive`], with a frame that has been decoded before, for another receiver.
    ///
    /// # Errors
    /// Same as for [`Inbox::accept_decoded_within`]; the refusal is counted.
    #[inline]
    pub fn receive_decoded(&mut self, frame: &Frame<N>) -> Result<(), FrameError> {
        let region = self.health_params.plausible_region();
        self.inbox
            .accept_decoded_within(self.params.neighbours(), region, frame)
            .inspect_err(|error| self.health.frame_refused(error))
    }

    /// Keeps for the next step a frame that [`Trust`](crate::agent::trust::Trust) believes, if its
    /// estimate is plausible.
    ///
    /// # Errors
    /// Same as for [`Inbox::accept_believed`]; the refusal is counted.
    #[cfg(feature = "authentic-frames")]
    #[inline]
    pub fn receive_believed(&mut self, frame: &Frame<N>) -> Result<(), FrameError> {
        let region = self.health_params.plausible_region();
        self.inbox
            .accept_believed(self.params.neighbours(), region, frame)
            .inspect_err(|error| self.health.frame_refused(error))
    }

    /// Attempts the step at `tick` with `measurement`, shape `[m]`. `network` is the package's
    /// network, which is not used during a fallback; `outer_weights` are the package's, row by row,
    /// shape `[L, N]`, for a restart.
    ///
    /// If a restart is due and `outer_weights` are invalid, the outcome is that of the step.
    #[inline]
    pub fn step<F: Features>(
        &mut self,
        network: Option<&F>,
        outer_weights: &[f32],
        tick: Tick,
        measurement: &[f32],
    ) -> WatchedStep<N> {
        self.step_observed(network, outer_weights, tick, measurement, |_, _| ())
    }

    /// Like [`Self::step`], but continues without a measurement if there is none:
    /// [`AgentState::attempt`].
    #[inline]
    pub fn attempt<F: Features>(
        &mut self,
        network: Option<&F>,
        outer_weights: &[f32],
        tick: Tick,
        measurement: Option<&[f32]>,
    ) -> WatchedStep<N> {
        self.attempt_observed(network, outer_weights, tick, measurement, |_, _| ())
    }

    /// Like [`Self::step`], but calls `observe` with the resulting state and the step's output
    /// before a restart can replace them.
    #[inline]
    pub fn step_observed<F: Features>(
        &mut self,
        network: Option<&F>,
        outer_weights: &[f32],
        tick: Tick,
        measurement: &[f32],
        observe: impl FnOnce(&AgentState<N, FEATURES, S>, &StepOutput<N>),
    ) -> WatchedStep<N> {
        self.attempt_observed(network, outer_weights, tick, Some(measurement), observe)
    }

    /// Like [`Self::attempt`], but calls `observe` as [`Self::step_observed`] does.
    #[inline]
    pub fn attempt_observed<F: Features>(
        &mut self,
        network: Option<&F>,
        outer_weights: &[f32],
        tick: Tick,
        measurement: Option<&[f32]>,
        observe: impl FnOnce(&AgentState<N, FEATURES, S>, &StepOutput<N>),
    ) -> WatchedStep<N> {
        let Self { params, health_params, state, inbox, health } = self;
        let network = network.filter(|_| health.network_in_use());
        let attempt = state.attempt(params, network, tick, measurement, inbox);
        if let Ok(output) = &attempt {
            observe(state, output);
        }
        if attempt == Err(StepError::Diverged) {
            // A sample that led to it must not stay to do it again.
            inbox.discard_outside(&health_params.harmless);
            state.forget_neighbours_outside(&health_params.harmless);
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
