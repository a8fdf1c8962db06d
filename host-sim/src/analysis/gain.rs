//! Decides whether `K_1` is a solution of `BMI`, as the theorems require.
//!
//! ```text
//! M = (1/2) (I (x) K_1) C^T C + (1/2) C^T C (I (x) K_1) + L (x) K_1 >= k_1 I,
//! k_1 = k_2 + rho^2 / delta
//! ```
//!
//! `M` is linear in `K_1`: if its smallest eigenvalue is positive, a multiple of `K_1` is a
//! solution. With `K_1 = k I` it is `k (C^T C + L (x) I)`, which is positive definite if and only
//! if the agents together measure the whole state and the graph is connected. Otherwise no gain is
//! a solution, because `v = (u, .., u)` with all `C_i u = 0` gives `v^T M v = 0`.

use nalgebra::DMatrix;

use super::block_cholesky::BlockCholesky;
use super::block_matrix::{BlockMatrix, UNIT_ROUNDOFF};
use super::jacobi::Eigen;
use super::smallest::Smallest;
use crate::number::significant;
use crate::scenario::{Design, Scenario};

/// Result of the check whether `K_1` solves `BMI`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GainCertificate {
    /// Smallest eigenvalue of the left side of `BMI`. \[1/s\]
    pub eigenvalue_min: f64,
    /// Bound on its error, including rounding. \[1/s\]
    pub uncertainty: f64,
    /// `k_1 = k_2 + rho^2 / delta`, the required value. \[1/s\]
    pub k1: f64,
    /// The result.
    pub verdict: GainVerdict,
}

/// The result for `BMI`, with a remedy.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum GainVerdict {
    /// `K_1` is a solution.
    Solution,
    /// Undecided: within rounding of `k_1`. This factor makes it a solution.
    Open {
        /// Factor for `K_1`.
        factor: f64,
    },
    /// `K_1` is not a solution, but this multiple of it is.
    Multiply {
        /// Factor for `K_1`, rounded up.
        factor: f64,
    },
    /// No multiple of `K_1` is a solution, but this multiple of the identity is.
    Identity {
        /// `K_1 = gain I`, rounded up. \[1/s\]
        gain: f64,
    },
    /// The agents together do not measure the whole state, so no gain is a solution.
    StateNotCovered,
    /// They measure the whole state, but part of it so weakly that rounding hides whether any gain
    /// is a solution.
    Hidden,
}

impl GainCertificate {
    /// Checks the gain of a scenario.
    #[must_use]
    pub fn new(scenario: &Scenario) -> Self {
        let Design { k2, rho, delta, ref gain, .. } = scenario.design;
        let k1 = k2 + rho * rho / delta;
        let matrix = left_side(scenario, gain);
        let structure = BlockCholesky::new(&matrix);
        let found = Smallest::new(&matrix, &structure);
        let covered = outputs_determine_state(scenario);
        // Rounding errors of k1 itself.
        let k1_high = k1 * (1.0 + 4.0 * UNIT_ROUNDOFF);
        let reached = covered
            && (found.lower >= k1_high
                || (found.upper >= k1 && certain_from(&structure, k1_high, found.upper)));
        let verdict = if reached {
            GainVerdict::Solution
        } else if !covered {
            GainVerdict::StateNotCovered
        } else if found.lower > 0.0 {
            let factor = round_up(k1 / found.lower);
            if found.upper < k1 {
                GainVerdict::Multiply { factor }
            } else {
                GainVerdict::Open { factor }
            }
        } else {
            let n = scenario.dimension();
            let matrix = left_side(scenario, &DMatrix::identity(n, n));
            let lower = Smallest::new(&matrix, &BlockCholesky::new(&matrix)).lower;
            if lower > 0.0 {
                GainVerdict::Identity { gain: round_up(k1 / lower) }
            } else {
                GainVerdict::Hidden
            }
        };
        let uncertainty = (found.upper - found.estimate).max(found.estimate - found.lower);
        Self { eigenvalue_min: found.estimate, uncertainty, k1, verdict }
    }

    /// Whether `K_1` is a solution of `BMI` with this `k_1`, with certainty.
    #[must_use]
    pub fn holds(&self) -> bool {
        self.verdict == GainVerdict::Solution
    }

    /// Returns what is wrong and what to do; `None` for a solution.
    #[must_use]
    pub fn advice(&self) -> Option<String> {
        Some(match self.verdict {
            GainVerdict::Solution => return None,
            GainVerdict::Open { factor } => format!(
                "too close to k1 to be certain; multiply design.gain by {}",
                significant(factor, 3)
            ),
            GainVerdict::Multiply { factor } => {
                format!("NOT a solution; multiply design.gain by {}", significant(factor, 3))
            }
            GainVerdict::Identity { gain } => format!(
                "NOT a solution, and no multiple of design.gain helps; set design.gain = {}, a \
                 multiple of the identity",
                significant(gain, 3)
            ),
            GainVerdict::StateNotCovered => "NOT a solution, and no gain helps: together the \
                                             agents do not measure the whole state; let an \
                                             agent measure the missing part"
                .to_owned(),
            GainVerdict::Hidden => "cannot be verified, and neither can a multiple: together the \
                                    agents measure some combination of the state so weakly that \
                                    rounding hides it; let an agent measure it with a larger weight"
                .to_owned(),
        })
    }

    /// Returns the factor by which `K_1` must grow to be a solution, if a multiple of it can be
    /// one.
    #[must_use]
    pub fn factor(&self) -> Option<f64> {
        match self.verdict {
            GainVerdict::Open { factor } | GainVerdict::Multiply { factor } => Some(factor),
            _ => None,
        }
    }
}

/// Whether a factor of `M - s I` with `s` between `k1` and `upper` proves `lambda_min >= k1`.
fn certain_from(structure: &BlockCholesky<'_>, k1: f64, upper: f64) -> bool {
    let Some(at) = structure.factor(k1) else { return false };
    let above = k1 + 1.01 * at.error;
    above <= upper && structure.factor(above).is_some_and(|factor| factor.lower >= k1)
}

/// Returns the left side of `BMI` for the gain `gain`.
fn left_side<'s>(scenario: &'s Scenario, gain: &DMatrix<f64>) -> BlockMatrix<'s> {
    let blocks =
        scenario.agents.iter().map(|agent| half_products(gain, &gram(&agent.output_matrix)));
    BlockMatrix { diagonal: blocks.collect(), coupling: gain.clone(), graph: &scenario.graph }
}

/// Returns `(1/2) K_1 C^T C + (1/2) C^T C K_1`.
pub(super) fn half_products(gain: &DMatrix<f64>, measured: &DMatrix<f64>) -> DMatrix<f64> {
    let n = gain.nrows();
    let block = DMatrix::from_fn(n, n, |row, column| {
        (0..n).fold(0.0, |sum, k| {
            sum + 0.5 * (gain[(row, k)] * measured[(k, column)])
                + 0.5 * (measured[(row, k)] * gain[(k, column)])
        })
    });
    // Rounding makes entries (i, j) and (j, i) differ; make them equal.
    DMatrix::from_fn(n, n, |i, j| block[(i.max(j), i.min(j))])
}

/// Returns `C^T C`.
pub(crate) fn gram(output_matrix: &DMatrix<f64>) -> DMatrix<f64> {
    let n = output_matrix.ncols();
    DMatrix::from_fn(n, n, |row, column| {
        output_matrix.row_iter().fold(0.0, |sum, output| sum + output[row] * output[column])
    })
}

/// Whether the agents together measure the whole state: the sum of all `C_i^T C_i` is positive
/// definite. Otherwise no gain solves `BMI`.
#[must_use]
pub fn outputs_determine_state(scenario: &Scenario) -> bool {
    let (n, seen) = (scenario.dimension(), seen(scenario));
    if (0..n).any(|i| seen[(i, i)] <= 0.0) {
        return false;
    }
    // In units in which every component has the same weight.
    let scaled = DMatrix::from_fn(n, n, |i, j| seen[(i, j)] / (seen[(i, i)] * seen[(j, j)]).sqrt());
    // Rounding of the sums, with a margin.
    Eigen::new(&scaled).values[0] > 1e-12
}

/// Returns the sum of all `C_i^T C_i`.
pub(super) fn seen(scenario: &Scenario) -> DMatrix<f64> {
    let n = scenario.dimension();
    let mut seen = DMatrix::zeros(n, n);
    for agent in &scenario.agents {
        seen += gram(&agent.output_matrix);
    }
    seen
}

/// Returns the next number above `x` with three digits.
fn round_up(x: f64) -> f64 {
    let rounded = |x: f64| format!("{x:.2e}").parse::<f64>().unwrap_or(x);
    // Add half a unit, so that rounding to nearest rounds up and the scaled gain is certain to be a
    // solution.
    let exponent = libm::floor(libm::log10(x));
    let unit = libm::pow(10.0, exponent - 2.0);
    let near = rounded(x);
    if near >= x * (1.0 + 1e-6) { near } else { rounded(near + unit) }
}

#[cfg(test)]
#[path = "gain_tests.rs"]
mod tests;
