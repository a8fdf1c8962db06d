//! The whole network of agents in double precision, written from the paper's equations in the
//! stacked form of its analysis, with Kronecker products and block-diagonal matrices:
//!
//! `z = -(L (x) I_n) x_tilde`                                          (`z Ensemble`)
//! `d/dt x_hat = W_hat^T sigma(Phi_hat(x_hat)) + (I_N (x) K_1)(z - C^T e_3)` (`Observer i`)
//! `e_3 = C x_hat - y`, `C = diag(C_1, ..., C_N)`                       (`e3i`, `BMI`)
//! `d/dt omega_i = proj(mu_i, omega_i)`                                 (`What_i Dot`)
//!
//! (`z Ensemble` is stated for `e_1 + e_2 = x_tilde - 1_N (x) x_0`; the Laplacian removes the
//! constant.) Nothing is shared with the code under test: data structures, order of summation and
//! precision differ, and the functions are the standard library's.

pub(crate) mod inner_network;
pub(crate) mod projection;
pub(crate) mod rounding;

use nalgebra::{DMatrix, DVector};

use inner_network::InnerNetwork;
use projection::Projection;

/// The part of an agent that differs from the others.
#[derive(Clone, Debug)]
pub(crate) struct Agent {
    /// `C_i`, shape `[m, n]`.
    pub(crate) output_matrix: DMatrix<f64>,
    /// `Phi_hat_i` and the activations after it.
    pub(crate) inner_network: InnerNetwork,
    /// `Gamma_i`, shape `[L, L]`.
    pub(crate) outer_gain: DMatrix<f64>,
    /// `proj` with its constants.
    pub(crate) projection: Projection,
}

/// A network of `N` agents that estimate `n` components.
#[derive(Clone, Debug)]
pub(crate) struct Network {
    /// The agents.
    pub(crate) agents: Vec<Agent>,
    /// `n`.
    pub(crate) dimension: usize,
    /// `L (x) I_n`, shape `[n N, n N]`.
    pub(crate) coupling: DMatrix<f64>,
    /// `I_N (x) K_1`, shape `[n N, n N]`.
    pub(crate) gain: DMatrix<f64>,
    /// `C`, shape `[sum of m_i, n N]`.
    pub(crate) output_matrix: DMatrix<f64>,
    /// `Gamma`, shape `[sum of L_i, sum of L_i]`.
    pub(crate) outer_gain: DMatrix<f64>,
}

/// The state of all agents, stacked.
#[derive(Clone, Debug)]
pub(crate) struct State {
    /// `x_hat`, shape `[n N]`.
    pub(crate) estimates: DVector<f64>,
    /// `x_tilde`, shape `[n N]`.
    pub(crate) held: DVector<f64>,
    /// `W_hat_i` of each agent, shape `[L, n]`.
    pub(crate) outer_weights: Vec<DMatrix<f64>>,
}

/// The results of the equations for a state and a measurement.
#[derive(Clone, Debug)]
pub(crate) struct Rates {
    /// `z`, shape `[n N]`.
    pub(crate) consensus: DVector<f64>,
    /// `e_3`, shape `[sum of m_i]`.
    pub(crate) output_errors: DVector<f64>,
    /// `C^T e_3`, shape `[n N]`.
    pub(crate) innovation: DVector<f64>,
    /// `sigma(Phi_hat(x_hat))`, shape `[sum of L_i]`.
    pub(crate) features: DVector<f64>,
    /// `d/dt x_hat`, shape `[n N]`.
    pub(crate) estimates: DVector<f64>,
    /// `mu_i` of each agent, shape `[L n]`.
    pub(crate) directions: Vec<DVector<f64>>,
    /// `d/dt omega_i` of each agent, shape `[L n]`.
    pub(crate) outer_weights: Vec<DVector<f64>>,
}

/// `L = Delta - A`, from the weighted adjacency matrix.
pub(crate) fn laplacian(adjacency: &DMatrix<f64>) -> DMatrix<f64> {
    let degrees = adjacency * DVector::repeat(adjacency.ncols(), 1.0);
    DMatrix::from_diagonal(&degrees) - adjacency
}

/// `diag(B_1, ..., B_N)`.
pub(crate) fn block_diagonal<'b>(
    blocks: impl Iterator<Item = &'b DMatrix<f64>> + Clone,
) -> DMatrix<f64> {
    let (rows, columns) =
        blocks.clone().fold((0, 0), |(rows, columns), b| (rows + b.nrows(), columns + b.ncols()));
    let mut matrix = DMatrix::zeros(rows, columns);
    let (mut row, mut column) = (0, 0);
    for block in blocks {
        matrix.view_mut((row, column), block.shape()).copy_from(block);
        row += block.nrows();
        column += block.ncols();
    }
    matrix
}

/// `vec(M)`: the columns, one below the other.
pub(crate) fn vectorised(matrix: &DMatrix<f64>) -> DVector<f64> {
    DVector::from_iterator(
        matrix.len(),
        (0..matrix.ncols())
            .flat_map(|c| (0..matrix.nrows()).map(move |r| (r, c)))
            .map(|index| matrix[index]),
    )
}

/// The induced 2-norm: the largest singular value.
fn spectral_norm(matrix: &DMatrix<f64>) -> f64 {
    matrix.singular_values().max()
}

impl Network {
    /// Creates the network of these agents on the graph `adjacency` with `K_1 = gain`.
    pub(crate) fn new(agents: Vec<Agent>, adjacency: &DMatrix<f64>, gain: &DMatrix<f64>) -> Self {
        let dimension = gain.nrows();
        Self {
            dimension,
            coupling: laplacian(adjacency).kronecker(&DMatrix::identity(dimension, dimension)),
            gain: DMatrix::identity(agents.len(), agents.len()).kronecker(gain),
            output_matrix: block_diagonal(agents.iter().map(|agent| &agent.output_matrix)),
            outer_gain: block_diagonal(agents.iter().map(|agent| &agent.outer_gain)),
            agents,
        }
    }

    /// `sigma(Phi_hat(x_hat))`, the agents' features stacked.
    fn features(&self, estimates: &DVector<f64>) -> DVector<f64> {
        let features = self.agents.iter().enumerate().flat_map(|(index, agent)| {
            let estimate = estimates.rows(index * self.dimension, self.dimension).into_owned();
            agent.inner_network.features(&estimate).data.as_vec().clone()
        });
        DVector::from_vec(features.collect())
    }

    /// The equations `Observer i`, `e3i`, `z Ensemble` and `What_i Dot` with the stacked
    /// measurement `y`, shape `[sum of m_i]`.
    pub(crate) fn rates(&self, state: &State, measurement: &DVector<f64>) -> Rates {
        let consensus = -(&self.coupling * &state.held);
        let output_errors = &self.output_matrix * &state.estimates - measurement;
        let innovation = self.output_matrix.transpose() * &output_errors;
        let features = self.features(&state.estimates);
        let outer_weights = block_diagonal(state.outer_weights.iter());
        let estimates =
            outer_weights.transpose() * &features + &self.gain * (&consensus - &innovation);

        // -Gamma sigma e_3^T C of the whole network; its diagonal blocks belong to the agents.
        let directions = -(&self.outer_gain * &features) * innovation.transpose();
        let (mut first, mut blocks, mut rates) = (0, Vec::new(), Vec::new());
        for (index, (agent, weights)) in self.agents.iter().zip(&state.outer_weights).enumerate() {
            let corner = (first, index * self.dimension);
            let block = directions.view(corner, weights.shape()).into_owned();
            let direction = vectorised(&block);
            rates.push(agent.projection.apply(&direction, &vectorised(weights)));
            blocks.push(direction);
            first += weights.nrows();
        }
        Rates {
            consensus,
            output_errors,
            innovation,
            features,
            estimates,
            directions: blocks,
            outer_weights: rates,
        }
    }
}

/// The event-trigger mechanism (`Trigger`).
#[derive(Clone, Copy, Debug)]
pub(crate) struct Trigger {
    /// `phi_1 = k_2 / 2 + kappa / 2 |L (x) K_1|^2`.
    pub(crate) phi_1: f64,
    /// `phi_2 = k_2 / (4 |L (x) I_n|^2)`.
    pub(crate) phi_2: f64,
    /// `epsilon / N`.
    pub(crate) threshold: f64,
}

impl Trigger {
    /// Creates the constants for a graph and a gain.
    pub(crate) fn new(
        adjacency: &DMatrix<f64>,
        gain: &DMatrix<f64>,
        k_2: f64,
        kappa: f64,
        epsilon: f64,
    ) -> Self {
        let (agents, dimension) = (adjacency.nrows(), gain.nrows());
        let laplacian = laplacian(adjacency);
        let with_gain = spectral_norm(&laplacian.kronecker(gain));
        let alone = spectral_norm(&laplacian.kronecker(&DMatrix::identity(dimension, dimension)));
        Self {
            phi_1: k_2 / 2.0 + kappa / 2.0 * with_gain.powi(2),
            phi_2: k_2 / (4.0 * alone.powi(2)),
            threshold: epsilon / agents as f64,
        }
    }

    /// `phi_1 |e_2i|^2 - phi_2 |z_i|^2 - epsilon / N`: the agent broadcasts if this is not
    /// negative.
    pub(crate) fn margin(&self, hold_error: &DVector<f64>, consensus: &DVector<f64>) -> f64 {
        self.phi_1 * hold_error.norm_squared()
            - self.phi_2 * consensus.norm_squared()
            - self.threshold
    }
}
