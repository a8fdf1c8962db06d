//! Guarantees of the paper's analysis for a scenario, computed before the run and compared with the
//! run's measurements.
//!
//! * [`GainCertificate`]: whether `K_1` is a solution of `BMI`
//! * [`StepCheck`]: whether the step is short enough for the observer
//! * [`TriggerConstants`]: `phi_1`, `phi_2` and the hold error at which the trigger fires.
//! * [`UltimateBound`]: Theorem 1's bound on `|e_1(t)|^2` (equation `UUB Bound`).
//! * [`LumpedUncertainty`]: the required size of `rho`.
//! * [`design`]: chooses the gain and the constants.
//! * [`minimum_interval`]: Theorem 2's bound on the time between broadcasts (`Zeno Bound`).

mod block_cholesky;
mod block_kernels;
mod block_matrix;
pub mod design;
mod elimination;
mod gain;
mod jacobi;
mod lanczos;
mod lumped;
pub(crate) mod lumped_samples;
mod smallest;
mod step;

use nalgebra::DMatrix;

use crate::graph::Graph;
use crate::scenario::{Design, OuterGain, Scenario};
pub(crate) use gain::gram;
pub use gain::{GainCertificate, GainVerdict, outputs_determine_state};
use lanczos::spectrum;
pub use lumped::LumpedUncertainty;
pub use lumped_samples::LumpedSamples;
pub use step::StepCheck;

/// Returns `|A|`, the largest singular value.
#[must_use]
pub fn spectral_norm(matrix: &DMatrix<f64>) -> f64 {
    let (rows, columns) = matrix.shape();
    let mut image = vec![0.0; rows];
    let gram = spectrum(columns, |v, result| {
        for (row, image) in image.iter_mut().enumerate() {
            *image = (0..columns).fold(0.0, |sum, column| sum + matrix[(row, column)] * v[column]);
        }
        for (column, result) in result.iter_mut().enumerate() {
            *result = (0..rows).fold(0.0, |sum, row| sum + matrix[(row, column)] * image[row]);
        }
    });
    gram.max.max(0.0).sqrt()
}

/// Returns `lambda_max(L)` of the graph's Laplacian, which equals `|L (x) I_n|`.
#[must_use]
pub fn laplacian_norm(graph: &Graph) -> f64 {
    spectrum(graph.agents(), |v, result| {
        for (i, result) in result.iter_mut().enumerate() {
            *result = 0.0;
            for edge in graph.neighbours(i) {
                *result += edge.weight * (v[i] - v[edge.agent]);
            }
        }
    })
    .max
}

/// Returns `|A|`, the largest magnitude of an eigenvalue of the graph's adjacency matrix.
#[must_use]
pub fn adjacency_norm(graph: &Graph) -> f64 {
    let spectrum = spectrum(graph.agents(), |v, result| {
        for (i, result) in result.iter_mut().enumerate() {
            *result = graph.neighbours(i).iter().fold(0.0, |sum, e| sum + e.weight * v[e.agent]);
        }
    });
    spectrum.max.abs().max(spectrum.min.abs())
}

/// The constants of `Trigger`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TriggerConstants {
    /// `phi_1 = k_2/2 + kappa/2 |L (x) K_1|^2`. \[1/s\]
    pub phi1: f64,
    /// `phi_2 = k_2 / (4 |L (x) I_n|^2)`; 0 for a single agent, which has no neighbours. \[1/s\]
    pub phi2: f64,
    /// `epsilon / N`. \[squared state unit/s\]
    pub threshold: f64,
}

impl TriggerConstants {
    /// Computes the constants for this scenario's graph, gain and design.
    #[must_use]
    pub fn new(scenario: &Scenario) -> Self {
        let Design { gain, k2, kappa, epsilon, .. } = &scenario.design;
        let laplacian = laplacian_norm(&scenario.graph);
        let coupling = laplacian * spectral_norm(gain);
        Self {
            phi1: 0.5 * k2 + 0.5 * kappa * coupling * coupling,
            phi2: if laplacian > 0.0 { 0.25 * k2 / (laplacian * laplacian) } else { 0.0 },
            threshold: epsilon / scenario.agents.len() as f64,
        }
    }

    /// Returns the hold error at which the trigger fires while the consensus term is zero. \[state
    /// unit\]
    #[must_use]
    pub fn radius(&self) -> f64 {
        (self.threshold / self.phi1).sqrt()
    }
}

/// Theorem 1's bound on `|e_1(t)|^2`, stacked over all agents.
///
/// The ideal outer weights are unknown; with `|W_0| <= omega_bar` the weight errors are at most `2
/// omega_bar`, which bounds `tr(W_tilde^T Gamma^-1 W_tilde)` at all times.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UltimateBound {
    /// `|e_1(0)|^2`.
    pub initial_error_squared: f64,
    /// The bound on `tr(W_tilde^T Gamma^-1 W_tilde)`, twice the paper's `W_tilde_max`.
    pub weight_error: f64,
    /// `alpha = k_2 - 1/kappa`. \[1/s\]
    pub alpha: f64,
    /// `delta + epsilon`. \[squared state unit/s\]
    pub delta_bar: f64,
}

impl UltimateBound {
    /// Computes the bound for this scenario; `None` where the theorem does not apply: if `alpha <= 0`,
    /// or with a trigger other than the event trigger.
    #[must_use]
    pub fn new(scenario: &Scenario) -> Option<Self> {
        let Design { k2, kappa, delta, epsilon, .. } = scenario.design;
        let alpha = k2 - 1.0 / kappa;
        let initial_error_squared = scenario
            .agents
            .iter()
            .flat_map(|agent| agent.initial_estimate.iter().zip(&scenario.initial_state))
            .fold(0.0, |sum, (estimate, truth)| sum + (estimate - truth) * (estimate - truth));
        let weight_error = scenario.network.as_ref().map_or(0.0, |network| {
            let largest = 2.0 * network.outer_law.bound;
            scenario.agents.len() as f64 * largest * largest / gain_min(&network.outer_law.gain)
        });
        let applies = alpha > 0.0
            && scenario.trigger.departure().is_none()
            && scenario.departures().is_empty();
        applies.then_some(Self {
            initial_error_squared,
            weight_error,
            alpha,
            delta_bar: delta + epsilon,
        })
    }

    /// Returns the bound at `time` \[s\].
    #[must_use]
    pub fn at(&self, time: f64) -> f64 {
        let decay = libm::exp(-self.alpha * time);
        (self.initial_error_squared + self.weight_error) * decay + self.ultimate() * (1.0 - decay)
    }

    /// Returns the limit of the bound for large times.
    #[must_use]
    pub fn ultimate(&self) -> f64 {
        self.weight_error + 2.0 * self.delta_bar / self.alpha
    }
}

/// Returns `lambda_min(Gamma)`.
fn gain_min(gain: &OuterGain) -> f64 {
    match gain {
        OuterGain::Scalar(gain) => *gain,
        OuterGain::Diagonal(diagonal) => diagonal.iter().copied().fold(f64::INFINITY, f64::min),
        OuterGain::Full(matrix) => {
            let size = matrix.nrows();
            let image = |v: &[f64], result: &mut [f64]| {
                for (row, result) in result.iter_mut().enumerate() {
                    *result = (0..size).fold(0.0, |sum, c| sum + matrix[(row, c)] * v[c]);
                }
            };
            spectrum(size, image).min
        }
    }
}

/// Returns Theorem 2's lower bound on the time between two broadcasts of an agent whose hold error
/// grows no faster than `rate` \[state unit/s\]: `sqrt(epsilon / (N phi_1)) / rate`. \[s\]
#[must_use]
pub fn minimum_interval(trigger: &TriggerConstants, rate: f64) -> f64 {
    trigger.radius() / rate
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::{PAPER, Scenario};

    /// Compares with an independent implementation in double precision.
    #[test]
    fn constants_of_the_paper() {
        let scenario = Scenario::parse("paper.toml", PAPER).unwrap();
        let trigger = TriggerConstants::new(&scenario);
        assert!((trigger.phi1 - 311_810.148).abs() < 1e-3, "{}", trigger.phi1);
        assert!((trigger.phi2 - 0.277_778).abs() < 1e-6, "{}", trigger.phi2);
        assert!((trigger.radius() - 0.056_631_1).abs() < 1e-7, "{}", trigger.radius());
        let certificate = GainCertificate::new(&scenario);
        assert!((certificate.eigenvalue_min - 36.1356).abs() < 1e-4, "{certificate:?}");
        assert!((certificate.k1 - 23.3333).abs() < 1e-4);
        assert!(certificate.holds());
    }

    #[test]
    fn spectral_norm_of_a_rectangular_matrix() {
        // The singular values of [3 0; 4 5] are 3 sqrt(5) and sqrt(5).
        let matrix = DMatrix::from_row_slice(2, 2, &[3.0, 0.0, 4.0, 5.0]);
        assert!((spectral_norm(&matrix) - 45f64.sqrt()).abs() < 1e-12);
        assert!((spectral_norm(&matrix.columns(0, 1).into_owned()) - 5.0).abs() < 1e-12);
    }

    #[test]
    fn ultimate_bound_decays_from_initial_to_ultimate_value() {
        let bound = UltimateBound::new(&Scenario::parse("paper.toml", PAPER).unwrap()).unwrap();
        // |x_0(0)|^2 = 25 + 49 + 64 for each of three agents that start at zero.
        assert_eq!(bound.initial_error_squared, 3.0 * 138.0);
        assert_eq!(bound.at(0.0), bound.initial_error_squared + bound.weight_error);
        assert!((bound.at(40.0) - bound.ultimate()).abs() < 1e-9);
    }
}
