//! The built-in agent that runs until a package arrives.

use agent_core::agent::exchange::ExchangeParams;
use agent_core::math::symmetric::SymmetricMatrix;
use agent_core::observer::outer_law::OuterLawParams;
use agent_core::observer::projection::ProjectionParams;
use agent_core::observer::trigger::TriggerParams;
use agent_core::package::{AgentConfig, NeighbourIds};

/// Agent 1 of the paper, which measures the first state component and receives from agents 2 and 3.
/// The numbers are those of host-sim's scenario `paper`.
pub(crate) fn fallback() -> Option<AgentConfig<'static>> {
    Some(AgentConfig {
        agent: 1,
        output_matrix: &[1.0, 0.0, 0.0],
        gain: SymmetricMatrix::Diagonal(&[134.86, 263.23, 263.23]),
        neighbours: NeighbourIds::new(&[2, 3]),
        edge_weights: &[1.0, 1.0],
        // Without a network, no outer weights are adapted.
        outer_law: OuterLawParams {
            gain: SymmetricMatrix::Scalar(3.0),
            projection: ProjectionParams {
                radius: 20.0,
                boundary_layer: 1.0,
                smoothing: 0.1,
                smoothness: 1,
            },
        },
        trigger: TriggerParams {
            hold_error_weight: 311_810.16,
            consensus_weight: 0.277_777_8,
            threshold: 1_000.0,
        },
        step_size: 1e-3,
        exchange: ExchangeParams::PAPER,
        field: &[],
    })
}
