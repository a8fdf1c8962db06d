//! The watch over one agent, as a node's firmware keeps it: [`agent_core::health`].

use agent_core::agent::hold::HoldSlots;
use agent_core::agent::inbox::Inbox;
use agent_core::agent::{AgentParams, AgentState, StepError};
use agent_core::health::{Health, HealthCounters, HealthParams, HealthSettings, WatchedAgent};
use agent_core::math::parameter::ParameterError;
use agent_core::observer::trigger::Trigger;
use agent_core::package::Package;

/// What watches over an agent from its first package on.
#[derive(Clone, Debug)]
pub(super) struct Watch<const N: usize> {
    params: HealthParams<N>,
    /// The outer weights of the package in use, row by row, shape `[L, N]`: those of a restart.
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
        // Theorem 2 bounds the intervals of the event trigger only.
        let by_event = matches!(agent.trigger(), Trigger::Event(_));
        let interval = if by_event { package.broadcast_interval_min } else { 0.0 };
        Ok(Self {
            params: HealthParams::new(agent, &package.trained_box, interval, settings)?,
            outer_weights: package.outer_weights.to_vec(),
            health: before.map_or_else(Health::new, |before| before.health.clone()),
        })
    }

    /// The agent with these parts, watched, and the outer weights of a restart.
    pub(super) fn agent<'a, const FEATURES: usize, S: HoldSlots<N>, I: HoldSlots<N>>(
        &'a mut self,
        params: &'a AgentParams<'a, N>,
        state: &'a mut AgentState<N, FEATURES, S>,
        inbox: &'a mut Inbox<N, I>,
    ) -> (WatchedAgent<'a, N, FEATURES, S, I>, &'a [f32]) {
        let Self { params: health_params, outer_weights, health } = self;
        (WatchedAgent { params, health_params, state, inbox, health }, outer_weights)
    }

    pub(super) fn network_in_use(&self) -> bool {
        self.health.network_in_use()
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
