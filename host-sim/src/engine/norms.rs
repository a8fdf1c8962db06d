//! Norms that the theorems bound, after each step of an agent.

use agent_core::agent::capture::Sample;
use agent_core::agent::hold::HoldSlots;
use agent_core::agent::{AgentParams, AgentState};
use agent_core::observer::features::Features;
use agent_core::observer::network::Scratch;

/// Norms for Theorem 2's bounding constant.
#[derive(Clone, Copy, Debug)]
pub(super) struct GainNorms {
    /// `|K_1|`.
    pub(super) gain: f64,
    /// `|K_1 C_i^T|`.
    pub(super) gain_output: f64,
}

/// Norms after a step, for the theorems' bounds; 0 if not requested.
#[derive(Default)]
pub(super) struct Norms {
    /// `e_2i_max` of Theorem 2.
    pub(super) hold_error_rate: f64,
    pub(super) outer_weights_norm: f64,
}

impl Norms {
    pub(super) fn of<const N: usize, const FEATURES: usize, S: HoldSlots<N>>(
        params: &AgentParams<'_, N>,
        network: Option<&impl Features>,
        state: &AgentState<N, FEATURES, S>,
        sample: &Sample<N>,
        norms: &mut Option<(GainNorms, Box<Scratch>)>,
    ) -> Self {
        let Some((norms, scratch)) = norms else { return Self::default() };
        let features = network.and_then(|network| {
            let features = network.features(sample.estimate.as_slice(), scratch)?;
            Some(norm(features))
        });
        let outer_weights_norm = f64::from(state.outer_weights().norm_squared()).sqrt();
        let hold_error_rate = outer_weights_norm * features.unwrap_or(0.0)
            + norms.gain * norm(state.consensus_term().as_slice())
            + norms.gain_output * norm(state.output_error(params));
        Self { hold_error_rate, outer_weights_norm }
    }
}

fn norm(values: &[f32]) -> f64 {
    values.iter().fold(0.0, |sum, &v| sum + f64::from(v) * f64::from(v)).sqrt()
}
