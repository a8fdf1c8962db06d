//! An agent's configuration from a scenario, rounded to the core's precision.

use agent_core::AgentId;
use agent_core::observer::projection::ProjectionParams;
use agent_core::observer::trigger::TriggerParams;

use crate::analysis::TriggerConstants;
use crate::packages::OwnedAgentConfig;
use crate::packages::node::{OwnedSymmetric, row_major};
use crate::scenario::{OuterGain, Scenario};

/// Placeholder for agents without a network, which have no outer weights to adapt.
const UNUSED_PROJECTION: ProjectionParams =
    ProjectionParams { radius: 1.0, boundary_layer: 1.0, smoothing: 1.0, smoothness: 0 };

/// Returns the configuration of agent `index`, from 0, with these trigger constants.
#[must_use]
pub fn agent_config(
    scenario: &Scenario,
    trigger: &TriggerConstants,
    index: usize,
) -> OwnedAgentConfig {
    let edges = scenario.graph.neighbours(index);
    let law = scenario.network.as_ref().map(|network| &network.outer_law);
    OwnedAgentConfig {
        agent: agent_id(index),
        output_matrix: row_major(&scenario.agents[index].output_matrix),
        gain: OwnedSymmetric::shortest(&scenario.design.gain),
        neighbours: edges.iter().map(|edge| agent_id(edge.agent)).collect(),
        edge_weights: edges.iter().map(|edge| edge.weight as f32).collect(),
        outer_gain: law.map_or(OwnedSymmetric::scalar(1.0), |law| outer_gain(&law.gain)),
        projection: law.map_or(UNUSED_PROJECTION, |law| ProjectionParams {
            radius: (law.bound - law.boundary_layer) as f32,
            boundary_layer: law.boundary_layer as f32,
            smoothing: law.smoothing as f32,
            smoothness: law.smoothness,
        }),
        trigger: TriggerParams {
            hold_error_weight: trigger.phi1 as f32,
            consensus_weight: trigger.phi2 as f32,
            threshold: trigger.threshold as f32,
        },
        step_size: scenario.time.step_size as f32,
        exchange: scenario.exchange,
        field: Vec::new(),
    }
}

fn outer_gain(gain: &OuterGain) -> OwnedSymmetric {
    match gain {
        OuterGain::Scalar(gain) => OwnedSymmetric::scalar(*gain as f32),
        OuterGain::Diagonal(gain) => {
            OwnedSymmetric::diagonal(gain.iter().map(|&entry| entry as f32).collect())
        }
        OuterGain::Full(gain) => OwnedSymmetric::full(gain),
    }
}

/// Returns the identifier of agent `index`, from 0, in messages.
///
/// # Panics
/// If the index does not fit; a scenario has at most 100,000 agents.
#[must_use]
pub fn agent_id(index: usize) -> AgentId {
    AgentId::try_from(index + 1).expect("a scenario has at most 100,000 agents")
}
