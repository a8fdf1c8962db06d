//! Samples of the lumped uncertainty along a run.
//!
//! Theorem 1 wants `rho >= chi_bar_max`, a bound of `|chi_bar(t)|`, all agents stacked, with
//!
//! ```text
//! chi_bar_i = chi_i - (I - C_i^T C_i) W_tilde_i^T sigma_i,     W_tilde_i = W_0 - W_hat_i,
//! chi_i     = W_0^T (sigma_i - sigma(Phi(x_0))) - epsilon(x_0) - d,
//! f(x_0)    = W_0^T sigma(Phi(x_0)) + epsilon(x_0)
//! ```
//!
//! of which the simulator knows `f`, `d`, `sigma_i = sigma(Phi_hat_i(x_hat_i))` and `W_hat_i`. The
//! ideal inner network and the error that it leaves enter through `f` only, so
//!
//! ```text
//! chi_bar_i = C_i^T C_i W_0^T sigma_i + (I - C_i^T C_i) W_hat_i^T sigma_i - f(x_0) - d
//!           = C_i^T C_i W_0^T sigma_i + g_i
//! ```
//!
//! where only the constant `W_0` is unknown. The theorem holds for any `W_0`, so the best one counts
//! ([`crate::analysis::LumpedUncertainty`] searches for it). Without a network, or while
//! an agent leaves its network out, `chi_bar_i = -f(x_0) - d`.
//!
//! `sigma_i` and `g_i` are kept for some steps: all of the first ones, where the estimates still
//! move fast, and from there on evenly spaced ones, [`POINTS`] at most and fewer in large networks.

use super::gram;
use crate::scenario::Scenario;
use nalgebra::DMatrix;

/// Most steps that are sampled evenly over the run.
const POINTS: u64 = 1024;
/// Smallest number of points, however large the network of agents.
const POINTS_MIN: u64 = 64;
/// Numbers that may be kept before there are fewer points. 32 MB.
const NUMBERS_MAX: u64 = 4_000_000;

/// What is known of `chi_bar` at some steps.
#[derive(Clone, Debug, PartialEq)]
pub struct LumpedSamples {
    /// `C_i^T C_i`, those that differ.
    pub(crate) measured: Vec<DMatrix<f64>>,
    /// Which of them is that of each agent.
    pub(crate) kind: Vec<usize>,
    /// `L`; 0 without a network.
    pub(crate) features: usize,
    /// `n`.
    pub(crate) dimension: usize,
    /// `sigma_i` of each sample and agent, `L` numbers each.
    pub(crate) sigma: Vec<f64>,
    /// `g_i` of each sample and agent, `n` numbers each.
    pub(crate) rest: Vec<f64>,
    /// Largest `|d|`, stacked over all agents. \[state unit/s\]
    pub(crate) disturbance_max: f64,
    first: u64,
    stride: u64,
}

impl LumpedSamples {
    pub(crate) fn new(scenario: &Scenario) -> Self {
        let (mut measured, mut kind) = (Vec::<DMatrix<f64>>::new(), Vec::new());
        for agent in &scenario.agents {
            let block = gram(&agent.output_matrix);
            kind.push(measured.iter().position(|known| *known == block).unwrap_or(measured.len()));
            if kind.last() == Some(&measured.len()) {
                measured.push(block);
            }
        }
        let dimension = scenario.dimension();
        // A package from outside may have more features than the scenario's network.
        let own = scenario.network.iter().map(|network| network.architecture.features());
        let packages = scenario.agents.iter().filter_map(|agent| agent.package.as_ref());
        let features = own.chain(packages.map(|package| package.architecture().features()));
        let features = features.max().unwrap_or(0);
        let each = (scenario.agents.len() * (features + dimension)) as u64;
        let points = (NUMBERS_MAX / each.max(1)).clamp(POINTS_MIN, POINTS);
        Self {
            measured,
            kind,
            features,
            dimension,
            sigma: Vec::new(),
            rest: Vec::new(),
            disturbance_max: 0.0,
            first: points / 4,
            stride: scenario.steps().div_ceil(points).max(1),
        }
    }

    /// Whether there is to be a sample of `tick`.
    #[inline]
    pub(crate) fn is_due(&self, tick: u64) -> bool {
        tick < self.first || tick.is_multiple_of(self.stride)
    }

    /// Takes `d`, shape `[n]`, at one sample.
    pub(crate) fn disturbance(&mut self, d: &[f64]) {
        let agents = self.kind.len() as f64;
        let size = d.iter().fold(0.0, |sum, d| sum + d * d);
        self.disturbance_max = self.disturbance_max.max((agents * size).sqrt());
    }

    /// Takes one agent's part of a sample; agents in ascending order. `rate` is `f + d`, shape
    /// `[n]`; `network` holds `sigma_i`, shape `[L]`, and `W_hat_i`, shape `[L, n]` row by row,
    /// of an agent that uses its network.
    pub(crate) fn agent(&mut self, index: usize, rate: &[f64], network: Option<(&[f32], &[f32])>) {
        let n = self.dimension;
        let start = self.rest.len();
        self.rest.extend(rate.iter().map(|rate| -rate));
        let sigma = network.map_or(&[][..], |(sigma, _)| sigma);
        self.sigma.extend(sigma.iter().map(|&s| f64::from(s)));
        self.sigma.resize(start / n * self.features + self.features, 0.0);
        let Some((sigma, weights)) = network else { return };
        let output: Vec<f64> = (0..n)
            .map(|c| {
                let rows = sigma.iter().zip(weights.chunks_exact(n));
                rows.fold(0.0, |sum, (&s, row)| sum + f64::from(s) * f64::from(row[c]))
            })
            .collect();
        let measured = &self.measured[self.kind[index]];
        for (row, rest) in self.rest[start..].iter_mut().enumerate() {
            let seen = (0..n).fold(0.0, |sum, c| sum + measured[(row, c)] * output[c]);
            *rest += output[row] - seen;
        }
    }

    /// How many samples there are.
    #[must_use]
    pub fn samples(&self) -> usize {
        self.rest.len() / (self.dimension * self.kind.len()).max(1)
    }
}
