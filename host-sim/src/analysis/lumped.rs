//! `chi_bar_max`, the size of the lumped uncertainty along a run, which `rho` must not be below.
//!
//! With the samples of [`LumpedSamples`],
//!
//! ```text
//! chi_bar_max = min over |W_0| <= radius   max over t   |r(t)|,
//! r_i(t) = C_i^T C_i W_0^T sigma_i(t) + g_i(t),   stacked over the agents
//! ```
//!
//! is a convex problem. Lawson's algorithm solves it: least squares with weights on the samples,
//! which grow where the residual is large. Every `W_0` gives an upper bound on the smallest
//! maximum, and every set of weights a lower one (a weighted mean of squares is at most their
//! maximum), so the gap is known. The ball, of radius `omega_bar - beta`, is the one in which the
//! projection's inequality holds.
//!
//! The result is an estimate: it covers only the sampled steps of this run.
//!
//! Cost: `S N L (L + n)` operations per iteration for `S` samples, and `(L n)^3 / 6` per solution.

use pulp::Arch;

use super::block_matrix::dot;
use super::lumped_samples::LumpedSamples;
use crate::scenario::Scenario;
use crate::training::cholesky::Cholesky;

const ITERATIONS_MAX: u64 = 80;
/// Limit for the number of operations, after which the best result so far is returned.
const OPERATIONS_MAX: u64 = 400_000_000;
/// Relative gap between the bounds at which the search ends.
const TOLERANCE: f64 = 0.01;

/// Size of the lumped uncertainty.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LumpedUncertainty {
    /// `chi_bar_max` for the best constant `W_0` found, an upper bound on the optimum. \[state
    /// unit/s\]
    pub estimate: f64,
    /// Lower bound on the optimum. \[state unit/s\]
    pub at_least: f64,
    /// Largest `|d|`, stacked over all agents. \[state unit/s\]
    pub disturbance: f64,
    /// Number of sampled steps.
    pub samples: usize,
}

impl LumpedUncertainty {
    /// Computes it from the samples of a run of `scenario`.
    #[must_use]
    pub fn new(scenario: &Scenario, samples: &LumpedSamples) -> Self {
        let (mut estimate, mut at_least) = (f64::INFINITY, 0.0f64);
        match &scenario.network {
            Some(network) if samples.samples() > 0 && samples.features > 0 => {
                let radius = network.outer_law.bound - network.outer_law.boundary_layer;
                let mut search = Search::new(samples, radius);
                for _ in 0..search.iterations() {
                    let Some(lower) = search.solve() else { break };
                    at_least = at_least.max(lower);
                    estimate = estimate.min(search.weigh());
                    if estimate - at_least <= TOLERANCE * estimate {
                        break;
                    }
                }
            }
            _ => {}
        }
        if !estimate.is_finite() {
            // Without a network, whether the scenario has none or the method leaves it out, or with
            // uninformative features: W_0 = 0.
            let size = samples.kind.len() * samples.dimension;
            let largest = samples.rest.chunks(size.max(1)).map(|g| dot(g, g));
            estimate = largest.fold(0.0, f64::max).sqrt();
            if samples.features == 0 {
                at_least = estimate;
            }
        }
        let disturbance = samples.disturbance_max;
        Self { estimate, at_least: at_least.min(estimate), disturbance, samples: samples.samples() }
    }
}

/// Lawson's iteration.
struct Search<'s> {
    samples: &'s LumpedSamples,
    radius: f64,
    /// One weight per sample; they add up to 1.
    weights: Vec<f64>,
    /// `W_0`, row by row, shape `[L, n]`.
    solution: Vec<f64>,
    cholesky: Cholesky,
}

impl<'s> Search<'s> {
    fn new(samples: &'s LumpedSamples, radius: f64) -> Self {
        let (count, unknowns) = (samples.samples(), samples.features * samples.dimension);
        Self {
            samples,
            radius,
            weights: vec![1.0 / count as f64; count],
            solution: vec![0.0; unknowns],
            cholesky: Cholesky::new(unknowns, Arch::new()),
        }
    }

    fn iterations(&self) -> u64 {
        let LumpedSamples { features, dimension, kind, measured, .. } = self.samples;
        let unknowns = (features * dimension) as u64;
        let each = (kind.len() * features * (features + 2 * dimension)) as u64;
        let kinds = measured.len() as u64 * unknowns * unknowns;
        let cost = self.weights.len() as u64 * each + kinds + unknowns * unknowns * unknowns / 6;
        (OPERATIONS_MAX / cost.max(1)).clamp(2, ITERATIONS_MAX)
    }

    /// Finds the best `W_0` in the ball for these weights; returns a lower bound of `chi_bar_max`,
    /// or `None` if there is no solution.
    fn solve(&mut self) -> Option<f64> {
        let unknowns = self.solution.len();
        let (matrix, right, constant) = self.normal_equations();
        let trace = (0..unknowns).fold(0.0, |sum, k| sum + matrix[k * unknowns + k]);
        if !(trace > 0.0 && trace.is_finite()) {
            return None;
        }
        // Small enough to be negligible, large enough for linearly dependent features.
        let (mut outside, mut inside) = (0.0f64, 1e-11 * trace);
        while !self.damped(&matrix, &right, inside) {
            outside = inside;
            inside *= 16.0;
            if !inside.is_finite() {
                return None;
            }
        }
        // Move to the edge of the ball if the solution lies there.
        for _ in 0..if outside > 0.0 { 12 } else { 0 } {
            let between = (outside * inside).sqrt();
            if self.damped(&matrix, &right, between) { inside = between } else { outside = between }
        }
        if outside > 0.0 {
            self.damped(&matrix, &right, inside);
        }
        let damping = inside;
        // min (w^T H w - 2 w^T b + c + mu |w|^2) = c - w^T b for (H + mu I) w = b; inside the ball,
        // the mu term is at most mu radius^2.
        let least = constant - dot(&self.solution, &right) - damping * self.radius * self.radius;
        Some(least.max(0.0).sqrt())
    }

    /// Solves with this damping; returns whether there is a solution inside the ball.
    fn damped(&mut self, matrix: &[f64], right: &[f64], damping: f64) -> bool {
        self.solution.copy_from_slice(right);
        self.cholesky.solve(matrix, damping, &mut self.solution, &|| false)
            && dot(&self.solution, &self.solution).sqrt() <= self.radius
    }

    /// Returns the normal matrix, row by row, the right side, and the residual for `W_0 = 0`.
    fn normal_equations(&self) -> (Vec<f64>, Vec<f64>, f64) {
        let LumpedSamples { features: l, dimension: n, kind, measured, .. } = self.samples;
        let (l, n, unknowns) = (*l, *n, self.solution.len());
        // For each kind of agent: weighted sums of sigma sigma^T and of sigma g^T.
        let mut grams = vec![vec![0.0; l * l]; measured.len()];
        let mut products = vec![vec![0.0; l * n]; measured.len()];
        let mut constant = 0.0;
        self.each(|sample, index, sigma, rest| {
            let weight = self.weights[sample];
            let (gram, product) = (&mut grams[kind[index]], &mut products[kind[index]]);
            for (a, &left) in sigma.iter().enumerate() {
                let left = weight * left;
                for (sum, right) in gram[a * l..][..l].iter_mut().zip(sigma) {
                    *sum += left * right;
                }
                for (sum, right) in product[a * n..][..n].iter_mut().zip(rest) {
                    *sum += left * right;
                }
            }
            constant += weight * dot(rest, rest);
        });
        let (mut matrix, mut right) = (vec![0.0; unknowns * unknowns], vec![0.0; unknowns]);
        for ((measured, gram), product) in measured.iter().zip(&grams).zip(&products) {
            for i in 0..n {
                for j in 0..n {
                    let squared = (0..n).fold(0.0, |s, k| s + measured[(i, k)] * measured[(k, j)]);
                    for a in 0..l {
                        right[a * n + i] -= measured[(i, j)] * product[a * n + j];
                        if squared == 0.0 {
                            continue;
                        }
                        for b in 0..l {
                            matrix[(a * n + i) * unknowns + b * n + j] += squared * gram[a * l + b];
                        }
                    }
                }
            }
        }
        (matrix, right, constant)
    }

    /// Moves weight to samples with a large residual; returns the largest residual.
    fn weigh(&mut self) -> f64 {
        let n = self.samples.dimension;
        let mut squared = vec![0.0; self.weights.len()];
        let mut output = vec![0.0; n];
        self.each(|sample, index, sigma, rest| {
            output.fill(0.0);
            for (&s, row) in sigma.iter().zip(self.solution.chunks_exact(n)) {
                output.iter_mut().zip(row).for_each(|(sum, w)| *sum += s * w);
            }
            let measured = &self.samples.measured[self.samples.kind[index]];
            for (row, rest) in rest.iter().enumerate() {
                let seen = (0..n).fold(*rest, |sum, c| sum + measured[(row, c)] * output[c]);
                squared[sample] += seen * seen;
            }
        });
        let largest = squared.iter().copied().fold(0.0, f64::max);
        // Bounded from below, so that a weight can grow again.
        let least = 1e-9 / self.weights.len() as f64;
        for (weight, squared) in self.weights.iter_mut().zip(&squared) {
            *weight = (*weight * squared.sqrt()).max(least * largest.sqrt());
        }
        let sum = self.weights.iter().fold(0.0, |sum, weight| sum + weight);
        if sum > 0.0 {
            self.weights.iter_mut().for_each(|weight| *weight /= sum);
        }
        largest.sqrt()
    }

    /// Passes each sample's and agent's `sigma_i` and `g_i` to `visit`, in order.
    fn each(&self, mut visit: impl FnMut(usize, usize, &[f64], &[f64])) {
        let LumpedSamples { features, dimension, kind, sigma, rest, .. } = self.samples;
        let parts = sigma.chunks_exact(*features).zip(rest.chunks_exact(*dimension));
        for (part, (sigma, rest)) in parts.enumerate() {
            visit(part / kind.len(), part % kind.len(), sigma, rest);
        }
    }
}
