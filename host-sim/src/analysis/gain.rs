//! Is `K_1` a solution of `BMI`, as the theorems require?
//!
//! ```text
//! M = (1/2) (I (x) K_1) C^T C + (1/2) C^T C (I (x) K_1) + L (x) K_1 >= k_1 I,
//! k_1 = k_2 + rho^2 / delta
//! ```
//!
//! `M` is linear in `K_1`: where its smallest eigenvalue is above zero, a multiple of `K_1` is a
//! solution. With `K_1 = k I` it is `k (C^T C + L (x) I)`, which is positive definite if and only
//! if the agents together measure the whole state and the graph is connected; without that no gain
//! is a solution, as `v = (u, .., u)` with all `C_i u = 0` makes `v^T M v` zero.

use nalgebra::DMatrix;

use super::block_cholesky::BlockCholesky;
use super::block_matrix::{BlockMatrix, UNIT_ROUNDOFF};
use super::jacobi::Eigen;
use super::smallest::Smallest;
use crate::number::significant;
use crate::scenario::{Design, Scenario};

/// Whether `K_1` solves `BMI`, as the theorems require.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GainCertificate {
    /// Smallest eigenvalue of the left side of `BMI`. \[1/s\]
    pub eigenvalue_min: f64,
    /// The true one is certain to lie this near, rounding included. \[1/s\]
    pub uncertainty: f64,
    /// `k_1 = k_2 + rho^2 / delta`, which it must reach. \[1/s\]
    pub k1: f64,
    /// Whether it does.
    pub verdict: GainVerdict,
}

/// What is known of `BMI`, and what would help.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum GainVerdict {
    /// `K_1` is a solution.
    Solution,
    /// Too near to tell: within rounding of `k_1`. This factor makes it a solution.
    Open {
        /// What to multiply `K_1` by.
        factor: f64,
    },
    /// `K_1` is not a solution, but this multiple of it is.
    Multiply {
        /// What to multiply `K_1` by, rounded up.
        factor: f64,
    },
    /// No multiple of `K_1` is a solution, but this multiple of the identity is.
    Identity {
        /// `K_1 = gain I`, rounded up. \[1/s\]
        gain: f64,
    },
    /// The agents together do not measure the whole state, so no gain is a solution.
    StateNotCovered,
    /// They measure all of it, but some of it so weakly that rounding hides whether any gain is.
    Hidden,
}

impl GainCertificate {
    /// Examines this scenario's gain.
    #[must_use]
    pub fn new(scenario: &Scenario) -> Self {
        let Design { k2, rho, delta, ref gain, .. } = scenario.design;
        let k1 = k2 + rho * rho / delta;
        let matrix = left_side(scenario, gain);
        let structure = BlockCholesky::new(&matrix);
        let found = Smallest::new(&matrix, &structure);
        let covered = outputs_determine_state(scenario);
        // Its own three roundings.
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

    /// Whether `K_1` is a solution of `BMI` with this `k_1`, for certain.
    #[must_use]
    pub fn holds(&self) -> bool {
        self.verdict == GainVerdict::Solution
    }

    /// What is wrong and what to do; `None` for a solution.
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
                "NOT a solution, and no multiple of design.gain helps; write design.gain = {}, a \
                 multiple of the identity",
                significant(gain, 3)
            ),
            GainVerdict::StateNotCovered => "NOT a solution, and no gain helps: together the \
                                             agents do not measure the whole state; let some \
                                             agent measure what is missing"
                .to_owned(),
            GainVerdict::Hidden => {
                "not certain to be a solution, and no multiple is: together the \
                                    agents measure some combination of the state so weakly that \
                                    rounding hides it; let some agent measure it more strongly"
                    .to_owned()
            }
        })
    }

    /// By how much `K_1` would have to grow to be a solution, if a multiple of it can be one.
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

/// The left side of `BMI` for the gain `gain`.
fn left_side<'s>(scenario: &'s Scenario, gain: &DMatrix<f64>) -> BlockMatrix<'s> {
    let n = scenario.dimension();
    let blocks = scenario.agents.iter().map(|agent| {
        let measured = gram(&agent.output_matrix);
        DMatrix::from_fn(n, n, |row, column| {
            (0..n).fold(0.0, |sum, k| {
                sum + 0.5 * (gain[(row, k)] * measured[(k, column)])
                    + 0.5 * (measured[(row, k)] * gain[(k, column)])
            })
        })
    });
    // The order of the sums makes entries (i, j) and (j, i) differ by rounding: make them equal.
    let blocks =
        blocks.map(|b: DMatrix<f64>| DMatrix::from_fn(n, n, |i, j| b[(i.max(j), i.min(j))]));
    BlockMatrix { diagonal: blocks.collect(), coupling: gain.clone(), graph: &scenario.graph }
}

/// `C^T C`.
pub(crate) fn gram(output_matrix: &DMatrix<f64>) -> DMatrix<f64> {
    let n = output_matrix.ncols();
    DMatrix::from_fn(n, n, |row, column| {
        output_matrix.row_iter().fold(0.0, |sum, output| sum + output[row] * output[column])
    })
}

/// Whether the agents together see the whole state: the sum of all `C_i^T C_i` is positive
/// definite. Without that no gain solves `BMI`.
#[must_use]
pub fn outputs_determine_state(scenario: &Scenario) -> bool {
    let n = scenario.dimension();
    let mut seen = DMatrix::zeros(n, n);
    for agent in &scenario.agents {
        seen += gram(&agent.output_matrix);
    }
    if (0..n).any(|i| seen[(i, i)] <= 0.0) {
        return false;
    }
    // In units in which every component is seen equally well.
    let scaled = DMatrix::from_fn(n, n, |i, j| seen[(i, j)] / (seen[(i, i)] * seen[(j, j)]).sqrt());
    // Rounding of the sums, with room to spare.
    Eigen::new(&scaled).values[0] > 1e-12
}

/// The next number above `x` that three digits can write.
fn round_up(x: f64) -> f64 {
    let rounded = |x: f64| format!("{x:.2e}").parse::<f64>().unwrap_or(x);
    // So that rounding to the nearest is rounding up, and the scaled gain is a solution beyond
    // doubt.
    let exponent = libm::floor(libm::log10(x));
    let unit = libm::pow(10.0, exponent - 2.0);
    let near = rounded(x);
    if near >= x * (1.0 + 1e-6) { near } else { rounded(near + unit) }
}

#[cfg(test)]
#[path = "gain_tests.rs"]
mod tests;
