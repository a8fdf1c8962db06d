//! An agent's configuration in the core's precision, owned.

use agent_core::AgentId;
use agent_core::agent::exchange::ExchangeParams;
use agent_core::math::symmetric::{MatrixForm, SymmetricMatrix};
use agent_core::observer::outer_law::OuterLawParams;
use agent_core::observer::projection::ProjectionParams;
use agent_core::observer::trigger::TriggerParams;
use agent_core::package::{AgentConfig, NeighbourIds};
use nalgebra::DMatrix;

/// The numbers of an [`AgentConfig`], owned.
#[derive(Clone, Debug, PartialEq)]
pub struct OwnedAgentConfig {
    pub(crate) agent: AgentId,
    pub(crate) output_matrix: Vec<f32>,
    pub(crate) gain: OwnedSymmetric,
    pub(crate) neighbours: Vec<AgentId>,
    pub(crate) edge_weights: Vec<f32>,
    pub(crate) outer_gain: OwnedSymmetric,
    pub(crate) projection: ProjectionParams,
    pub(crate) trigger: TriggerParams,
    pub(crate) step_size: f32,
    pub(crate) exchange: ExchangeParams,
    /// Words of the field observer's parameters; empty for the paper's observer.
    pub(crate) field: Vec<f32>,
}

/// A symmetric matrix in one of the forms of the package.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct OwnedSymmetric {
    form: MatrixForm,
    entries: Vec<f32>,
}

impl OwnedSymmetric {
    pub(crate) fn scalar(entry: f32) -> Self {
        Self { form: MatrixForm::Scalar, entries: vec![entry] }
    }

    pub(crate) fn diagonal(entries: Vec<f32>) -> Self {
        Self { form: MatrixForm::Diagonal, entries }
    }

    pub(crate) fn full(matrix: &DMatrix<f64>) -> Self {
        Self { form: MatrixForm::Full, entries: row_major(matrix) }
    }

    /// The shortest form of `matrix`.
    pub(crate) fn shortest(matrix: &DMatrix<f64>) -> Self {
        let n = matrix.nrows();
        let diagonal: Vec<f32> = matrix.diagonal().iter().map(|&entry| entry as f32).collect();
        let off_diagonal = (0..n).flat_map(|row| (0..row).map(move |column| matrix[(row, column)]));
        if off_diagonal.into_iter().any(|entry| entry as f32 != 0.0) {
            Self::full(matrix)
        } else if diagonal.iter().all(|entry| *entry == diagonal[0]) {
            Self::scalar(diagonal[0])
        } else {
            Self::diagonal(diagonal)
        }
    }

    fn borrow(&self) -> SymmetricMatrix<'_> {
        self.form.matrix(&self.entries)
    }
}

impl OwnedAgentConfig {
    /// Returns the scenario key of the first number that is not finite in single precision, if any.
    #[must_use]
    pub fn not_finite(&self) -> Option<&'static str> {
        let finite = |numbers: &[f32]| numbers.iter().all(|number| number.is_finite());
        let trigger = &self.trigger;
        let (projection, gain) = (&self.projection, self.outer_gain.borrow());
        let checked = [
            ("agents.output_matrix", finite(&self.output_matrix)),
            ("design.gain", finite(self.gain.borrow().entries())),
            ("an edge weight in [graph]", finite(&self.edge_weights)),
            ("outer_law.gain", finite(gain.entries())),
            ("outer_law.bound", projection.radius.is_finite()),
            ("outer_law.boundary_layer", projection.boundary_layer.is_finite()),
            ("outer_law.smoothing", projection.smoothing.is_finite()),
            (
                "phi_1 (which grows with the square of design.gain)",
                trigger.hold_error_weight.is_finite(),
            ),
            ("phi_2 (which grows with design.gain)", trigger.consensus_weight.is_finite()),
            ("design.epsilon divided by the number of agents", trigger.threshold.is_finite()),
            ("time.step", self.step_size.is_finite()),
        ];
        checked.iter().find(|(_, finite)| !finite).map(|(what, _)| *what)
    }

    /// Copies the configuration that `node` borrows.
    #[must_use]
    pub fn copy(node: &AgentConfig<'_>) -> Self {
        let owned = |matrix: SymmetricMatrix<'_>| OwnedSymmetric {
            form: matrix.form(),
            entries: matrix.entries().to_vec(),
        };
        Self {
            agent: node.agent,
            output_matrix: node.output_matrix.to_vec(),
            gain: owned(node.gain),
            neighbours: node.neighbours.iter().collect(),
            edge_weights: node.edge_weights.to_vec(),
            outer_gain: owned(node.outer_law.gain),
            projection: node.outer_law.projection,
            trigger: node.trigger,
            step_size: node.step_size,
            exchange: node.exchange,
            field: node.field.to_vec(),
        }
    }

    /// Returns the first parameter that differs from `node`'s, if any.
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
            ("exchange with the neighbours", self.exchange == other.exchange),
        ];
        same.iter().find(|(_, same)| !same).map(|(name, _)| *name)
    }

    /// Returns the borrowed form used in packages.
    #[must_use]
    pub fn node(&self) -> AgentConfig<'_> {
        AgentConfig {
            agent: self.agent,
            output_matrix: &self.output_matrix,
            gain: self.gain.borrow(),
            neighbours: NeighbourIds::new(&self.neighbours),
            edge_weights: &self.edge_weights,
            outer_law: OuterLawParams {
                gain: self.outer_gain.borrow(),
                projection: self.projection,
            },
            trigger: self.trigger,
            step_size: self.step_size,
            exchange: self.exchange,
            field: &self.field,
        }
    }
}

/// Returns the entries of `matrix`, row-major, in single precision.
pub(crate) fn row_major(matrix: &DMatrix<f64>) -> Vec<f32> {
    matrix.transpose().iter().map(|&entry| entry as f32).collect()
}
