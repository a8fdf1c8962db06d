//! What makes a node an agent, taken from a scenario and rounded to the core's precision.

use agent_core::AgentId;
use agent_core::math::symmetric::SymmetricMatrix;
use agent_core::observer::outer_law::OuterLawParams;
use agent_core::observer::projection::ProjectionParams;
use agent_core::observer::trigger::TriggerParams;
use agent_core::package::{AgentConfig, NeighbourIds};
use nalgebra::DMatrix;

use crate::analysis::TriggerConstants;
use crate::scenario::{self, Scenario};

/// Stands in where there is no network, and so no outer weights to adapt.
const RESTING_PROJECTION: ProjectionParams =
    ProjectionParams { radius: 1.0, boundary_layer: 1.0, smoothing: 1.0, smoothness: 0 };

/// The numbers of a [`AgentConfig`], owned.
#[derive(Clone, Debug, PartialEq)]
pub struct OwnedAgentConfig {
    agent: AgentId,
    output_matrix: Vec<f32>,
    gain: OwnedSymmetric,
    neighbours: Vec<u8>,
    edge_weights: Vec<f32>,
    outer_gain: OwnedSymmetric,
    projection: ProjectionParams,
    trigger: TriggerParams,
    step_size: f32,
}

#[derive(Clone, Debug, PartialEq)]
enum OwnedSymmetric {
    Scalar(f32),
    Diagonal(Vec<f32>),
    Full(Vec<f32>),
}

impl OwnedSymmetric {
    /// The shortest form of `matrix`.
    fn shortest(matrix: &DMatrix<f64>) -> Self {
        let n = matrix.nrows();
        let diagonal: Vec<f32> = matrix.diagonal().iter().map(|&entry| entry as f32).collect();
        let off_diagonal = (0..n).flat_map(|row| (0..row).map(move |column| matrix[(row, column)]));
        if off_diagonal.into_iter().any(|entry| entry as f32 != 0.0) {
            Self::Full(row_major(matrix))
        } else if diagonal.iter().all(|entry| *entry == diagonal[0]) {
            Self::Scalar(diagonal[0])
        } else {
            Self::Diagonal(diagonal)
        }
    }

    fn of_outer(gain: &scenario::OuterGain) -> Self {
        match gain {
            scenario::OuterGain::Scalar(gain) => Self::Scalar(*gain as f32),
            scenario::OuterGain::Diagonal(gain) => {
                Self::Diagonal(gain.iter().map(|&entry| entry as f32).collect())
            }
            scenario::OuterGain::Full(gain) => Self::Full(row_major(gain)),
        }
    }

    fn borrow(&self) -> SymmetricMatrix<'_> {
        match self {
            Self::Scalar(entry) => SymmetricMatrix::Scalar(*entry),
            Self::Diagonal(entries) => SymmetricMatrix::Diagonal(entries),
            Self::Full(entries) => SymmetricMatrix::Full(entries),
        }
    }
}

impl OwnedAgentConfig {
    /// Agent `index` (from 0) of a scenario, whose trigger has these constants.
    #[must_use]
    pub fn new(scenario: &Scenario, trigger: &TriggerConstants, index: usize) -> Self {
        let edges = scenario.graph.neighbours(index);
        let law = scenario.network.as_ref().map(|network| &network.outer_law);
        Self {
            agent: agent_id(index),
            output_matrix: row_major(&scenario.agents[index].output_matrix),
            gain: OwnedSymmetric::shortest(&scenario.design.gain),
            neighbours: edges.iter().flat_map(|edge| agent_id(edge.agent).to_le_bytes()).collect(),
            edge_weights: edges.iter().map(|edge| edge.weight as f32).collect(),
            outer_gain: law
                .map_or(OwnedSymmetric::Scalar(1.0), |law| OwnedSymmetric::of_outer(&law.gain)),
            projection: law.map_or(RESTING_PROJECTION, |law| ProjectionParams {
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
        }
    }

    /// The first number, if any, that is not finite in single precision, by the scenario's keys.
    #[must_use]
    pub fn not_finite(&self) -> Option<&'static str> {
        let finite = |numbers: &[f32]| numbers.iter().all(|number| number.is_finite());
        let trigger = &self.trigger;
        let (projection, gain) = (&self.projection, self.outer_gain.borrow());
        let checked = [
            ("agents.output_matrix", finite(&self.output_matrix)),
            ("design.gain", finite(self.gain.borrow().entries())),
            ("a weight of an edge in [graph]", finite(&self.edge_weights)),
            ("outer_law.gain", finite(gain.entries())),
            ("outer_law.bound", projection.radius.is_finite()),
            ("outer_law.boundary_layer", projection.boundary_layer.is_finite()),
            ("outer_law.smoothing", projection.smoothing.is_finite()),
            (
                "phi_1, which grows with the square of design.gain,",
                trigger.hold_error_weight.is_finite(),
            ),
            ("phi_2, which grows with design.gain,", trigger.consensus_weight.is_finite()),
            ("design.epsilon by the number of agents", trigger.threshold.is_finite()),
            ("time.step", self.step_size.is_finite()),
        ];
        checked.iter().find(|(_, finite)| !finite).map(|(what, _)| *what)
    }

    /// Takes a copy of what `node` borrows.
    #[must_use]
    pub fn copy(node: &AgentConfig<'_>) -> Self {
        let owned = |matrix: SymmetricMatrix<'_>| match matrix {
            SymmetricMatrix::Scalar(entry) => OwnedSymmetric::Scalar(entry),
            SymmetricMatrix::Diagonal(entries) => OwnedSymmetric::Diagonal(entries.to_vec()),
            SymmetricMatrix::Full(entries) => OwnedSymmetric::Full(entries.to_vec()),
        };
        Self {
            agent: node.agent,
            output_matrix: node.output_matrix.to_vec(),
            gain: owned(node.gain),
            neighbours: node.neighbours.iter().flat_map(AgentId::to_le_bytes).collect(),
            edge_weights: node.edge_weights.to_vec(),
            outer_gain: owned(node.outer_law.gain),
            projection: node.outer_law.projection,
            trigger: node.trigger,
            step_size: node.step_size,
        }
    }

    /// The first parameter, if any, in which a node differs from this one.
    #[must_use]
    pub fn first_difference(&self, node: &AgentConfig<'_>) -> Option<&'static str> {
        let other = Self::copy(node);
        let same = [
            ("agent number", self.agent == other.agent),
            ("output matrix", self.output_matrix == other.output_matrix),
            ("gain K1", self.gain == other.gain),
            ("list of neighbours", self.neighbours == other.neighbours),
            ("edge weight", self.edge_weights == other.edge_weights),
            ("gain of the outer law", self.outer_gain == other.outer_gain),
            ("projection", self.projection == other.projection),
            ("trigger", self.trigger == other.trigger),
            ("step", self.step_size == other.step_size),
        ];
        same.iter().find(|(_, same)| !same).map(|(name, _)| *name)
    }

    /// The content as a package holds it.
    ///
    /// # Panics
    /// Never: every neighbour has two bytes.
    #[must_use]
    pub fn node(&self) -> AgentConfig<'_> {
        AgentConfig {
            agent: self.agent,
            output_matrix: &self.output_matrix,
            gain: self.gain.borrow(),
            neighbours: NeighbourIds::new(&self.neighbours).expect("two bytes a neighbour"),
            edge_weights: &self.edge_weights,
            outer_law: OuterLawParams {
                gain: self.outer_gain.borrow(),
                projection: self.projection,
            },
            trigger: self.trigger,
            step_size: self.step_size,
        }
    }
}

/// The number by which agent `index` (from 0) goes on the air.
///
/// # Panics
/// If there is no such number; a scenario has at most 1,000 agents.
#[must_use]
pub fn agent_id(index: usize) -> AgentId {
    AgentId::try_from(index + 1).expect("a scenario has at most 1,000 agents")
}

fn row_major(matrix: &DMatrix<f64>) -> Vec<f32> {
    matrix.transpose().iter().map(|&entry| entry as f32).collect()
}
