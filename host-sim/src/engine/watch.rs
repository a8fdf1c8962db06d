//! Health monitoring of an agent, as in a node's firmware: [`agent_core::health`].

use agent_core::agent::hold::HoldSlots;
use agent_core::agent::inbox::Inbox;
use agent_core::agent::{AgentParams, AgentState, StepError};
use agent_core::health::{Health, HealthCounters, HealthParams, HealthSettings, WatchedAgent};
use agent_core::math::parameter::ParameterError;
use agent_core::observer::trigger::Trigger;
use agent_core::package::Package;

/// The health monitor of an agent, from its first package on.
#[derive(Clone, Debug)]
pub(super) struct Watch<const N: usize> {
    params: HealthParams<N>,
    /// The outer weights of the package in use, row-major, shape `[L, N]`, used by restarts.
    outer_weights: Vec<f32>,
    health: Health,
}

impl<const N: usize> Watch<N> {
    /// Creates the monitor of an agent that uses `package`, continuing the counters of `before`.
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
            params: HealthParams::new(agent, &package.trained_states(), interval, settings)?,
            outer_weights: package.outer_weights.to_vec(),
            health: before.map_or_else(Health::new, |before| before.health.clone()),
        })
    }

    /// Returns the agent with its monitor, and the outer weights used by restarts.
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

/// Returns whether a monitored agent continues after this error: it was caused by the data, not by
/// the configuration.
pub(super) fn is_recoverable(error: StepError) -> bool {
    matches!(error, StepError::MeasurementNotFinite { .. } | StepError::Diverged)
}
