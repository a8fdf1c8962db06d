//! Chooses `K_1` and the constants of Theorem 1.
//!
//! ```text
//! minimise  tr K_1  or  |K_1|   subject to   M(K_1) >= k_1 I,   M of `BMI`
//! ```
//!
//! `M` is linear and homogeneous in `K_1`: the problem is solved for `k_1 = 1` and its solution
//! multiplied by `k_1`. The fastest decay, the largest `lambda_min(M)` with `|K_1|` given, is the
//! solution of smallest norm, multiplied to that norm.
//!
//! * [`DesignedGain`]: solves the problem
//! * [`Certificate`]: `k_2`, `kappa`, `delta`, `epsilon` of the tightest bound for a gain
//! * [`Unseen`]: why there is no solution
//!
//! `K_1 = k I` is a solution for a large enough `k` if the agents together measure the whole state
//! and the graph is connected; otherwise there is none ([`GainCertificate`]).
//!
//! The gain is rounded to nine digits, because matrix products of the solver may differ in their
//! last bits between processors. What is returned satisfies [`GainCertificate`], which shares
//! nothing with the solver but the matrix.

mod certificate;
mod interior_point;
mod pencil;
mod subspace;
mod unseen;

use nalgebra::DMatrix;

use super::gain::GainCertificate;
use super::jacobi::Eigen;
use crate::scenario::Scenario;

pub use certificate::{Certificate, Knee, Plan};
pub use unseen::Unseen;

/// What the gain is chosen for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Objective {
    /// Smallest trace.
    Trace,
    /// Smallest spectral norm.
    Norm,
    /// Largest `lambda_min` with the spectral norm of the scenario's gain.
    Decay,
}

/// Which entries of the gain may differ from zero.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shape {
    /// The diagonal.
    Diagonal,
    /// All, symmetric.
    Full,
}

/// A gain that certainly solves `BMI`.
#[derive(Clone, Debug, PartialEq)]
pub struct DesignedGain {
    /// `K_1`, shape `[n, n]`. \[1/s\]
    pub gain: DMatrix<f64>,
    /// `lambda_min(M)` and its error bound, found by the scenario's check.
    pub certificate: GainCertificate,
    /// Relative distance of the objective from the bound below which no gain can be.
    pub gap: f64,
}

/// Why there is no gain.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum DesignError {
    /// No agent measures part of the state.
    #[error(transparent)]
    Unseen(#[from] Unseen),
    /// Rounding hides whether a gain is a solution.
    #[error(
        "together the agents measure {direction} so weakly that rounding hides whether a gain is a \
         solution; give it a larger entry in the output_matrix of an agent"
    )]
    Hidden {
        /// The combination of the state.
        direction: String,
    },
}

/// Receives the solver's progress: the number of rounds so far, and the relative gap.
pub type Report<'r> = &'r (dyn Fn(usize, f64) + Sync);

/// Digits of a gain's entries.
const DIGITS: i32 = 9;
/// Most factors that make up for rounding, each ten times further from 1.
const FACTORS: i32 = 6;

impl DesignedGain {
    /// Solves the problem for a scenario. `k1` is the smallest `lambda_min(M)` \[1/s\]; the
    /// objective [`Objective::Decay`] does not use it.
    ///
    /// # Errors
    /// If no gain is a solution, or none certainly.
    pub fn new(
        scenario: &Scenario,
        objective: Objective,
        shape: Shape,
        k1: f64,
        report: Report<'_>,
    ) -> Result<Self, DesignError> {
        if let Some(unseen) = Unseen::find(scenario) {
            return Err(unseen.into());
        }
        let hidden = || DesignError::Hidden { direction: unseen::weakest(scenario) };
        let problem = pencil::Problem::new(scenario, shape, objective != Objective::Trace);
        let found = subspace::solve(&problem, report).ok_or_else(hidden)?;
        let size = match objective {
            Objective::Decay => norm(&scenario.design.gain) / norm(&found.gain),
            Objective::Trace | Objective::Norm => k1 / found.eigenvalue_min,
        };
        let own = norm(&scenario.design.gain) * (1.0 + 1e-14);
        for attempt in 0..=FACTORS {
            // The first margin is that of rounding to nine digits.
            let margin = libm::pow(10.0, f64::from(attempt - 1 - DIGITS));
            let margin = if attempt > 0 { margin } else { 0.0 };
            let towards = if objective == Objective::Decay { -margin } else { margin };
            let gain = rounded(&(&found.gain * (size * (1.0 + towards))));
            let certificate = certify(scenario, &gain, k1);
            let reached = match objective {
                Objective::Decay => {
                    certificate.eigenvalue_min > certificate.uncertainty && norm(&gain) <= own
                }
                Objective::Trace | Objective::Norm => certificate.holds(),
            };
            if reached {
                return Ok(Self { gain, certificate, gap: found.gap });
            }
        }
        Err(hidden())
    }

    /// Returns the largest `k_1` for which the gain certainly is a solution. \[1/s\]
    #[must_use]
    pub fn k1(&self) -> f64 {
        let GainCertificate { eigenvalue_min, uncertainty, .. } = self.certificate;
        // The product of both rounding errors is far below the margin.
        (eigenvalue_min - uncertainty) * (1.0 - 1e-12)
    }

    /// Returns `tr K_1`. \[1/s\]
    #[must_use]
    pub fn trace(&self) -> f64 {
        self.gain.trace()
    }

    /// Returns `|K_1|`. \[1/s\]
    #[must_use]
    pub fn norm(&self) -> f64 {
        norm(&self.gain)
    }
}

/// Checks whether `gain` solves `BMI` with this `k1`.
fn certify(scenario: &Scenario, gain: &DMatrix<f64>, k1: f64) -> GainCertificate {
    let mut changed = scenario.clone();
    changed.design.gain = gain.clone();
    // k_1 = k_2 + rho^2 / delta without the second term.
    (changed.design.k2, changed.design.rho) = (k1, 0.0);
    GainCertificate::new(&changed)
}

/// Returns the largest eigenvalue of a positive definite matrix.
fn norm(gain: &DMatrix<f64>) -> f64 {
    Eigen::new(gain).values.last().copied().unwrap_or(0.0)
}

fn rounded(gain: &DMatrix<f64>) -> DMatrix<f64> {
    let digits = DIGITS as usize - 1;
    let largest = gain.amax();
    gain.map(|x| {
        // Entries that rounding alone makes differ from zero.
        if x.abs() < 1e-10 * largest { 0.0 } else { format!("{x:.digits$e}").parse().unwrap_or(x) }
    })
}

#[cfg(test)]
mod tests;
