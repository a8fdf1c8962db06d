//! The watch over one agent, as a node's firmware keeps it: [`agent_core::health`].

use agent_core::Tick;
use agent_core::agent::{AgentParams, StepError, StepOutput};
use agent_core::health::{Advice, Health, HealthCounters, HealthParams, HealthSettings};
use agent_core::math::parameter::ParameterError;
use agent_core::package::Package;
use agent_core::wire::frame::{Frame, FrameError};

use super::agents::{SimulatedInbox, SimulatedState};

/// What watches over an agent from its first package on.
#[derive(Clone, Debug)]
pub(super) struct Watch<const N: usize> {
    params: HealthParams<N>,
    /// The outer weights of the package in use, row by row, shape `[L, N]`: those to begin anew with.
    outer_weights: Vec<f32>,
    health: Health,
}

impl<const N: usize> Watch<N> {
    /// The watch over an agent that uses `package`; goes on from the one `before`.
    pub(super) fn new(
        agent: &AgentParams<'_, N>,
        package: &Package<'_>,
        settings: &HealthSettings,
        before: Option<&Self>,
    ) -> Result<Self, ParameterError> {
        let interval = package.broadcast_interval_min;
        Ok(Self {
            params: HealthParams::new(agent, &package.trained_box, interval, settings)?,
            outer_weights: package.outer_weights.to_vec(),
            health: before.map_or_else(Health::new, |before| before.health.clone()),
        })
    }

    /// Takes delivery of a frame, unless it cannot be true.
    pub(super) fn accept(
        &mut self,
        agent: &AgentParams<'_, N>,
        inbox: &mut SimulatedInbox<N>,
        bytes: &[u8],
    ) -> Result<(), FrameError> {
        let region = self.params.plausible_region();
        inbox
            .accept_within(agent.neighbours(), region, bytes)
            .inspect_err(|error| self.health.frame_refused(error))
    }

    pub(super) fn network_in_use(&self) -> bool {
        self.health.network_in_use()
    }

    /// Takes notice of the attempt at a step. If the agent is lost, it begins anew; returns the frame to
    /// broadcast in place of the step's.
    ///
    /// # Panics
    /// Never: outer weights of an accepted package fit the agent.
    pub(super) fn observe(
        &mut self,
        agent: &AgentParams<'_, N>,
        state: &mut SimulatedState<N>,
        inbox: &mut SimulatedInbox<N>,
        tick: Tick,
        outcome: &Result<StepOutput<N>, StepError>,
    ) -> Option<Frame<N>> {
        match self.health.observe(&self.params, tick, outcome, state) {
            Advice::Continue => None,
            Advice::Restart => {
                let weights = &self.outer_weights;
                let frame = self.health.restart(&self.params, agent, state, inbox, tick, weights);
                Some(frame.expect("outer weights of an accepted package"))
            }
        }
    }

    pub(super) fn counters(&self) -> HealthCounters {
        *self.health.counters()
    }
}

/// Whether a watched agent goes on after a step that was refused for this reason: it is in the
/// numbers, not in how the agent was set up.
pub(super) fn is_recoverable(error: StepError) -> bool {
    matches!(error, StepError::MeasurementNotFinite { .. } | StepError::Diverged)
}
