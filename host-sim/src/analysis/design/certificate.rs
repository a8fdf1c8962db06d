//! Chooses `k_2`, `kappa`, `delta` and `epsilon` for the tightest ultimate bound of Theorem 1.
//!
//! For given `K_1` with `lambda = lambda_min(M)`, `rho`, and radius `r` (the hold error at which
//! the trigger fires while the consensus term is zero), `k_1 = lambda` and
//!
//! ```text
//! delta   = rho^2 / (lambda - k_2)
//! epsilon = N phi_1 r^2,   phi_1 = k_2/2 + kappa/2 |L (x) K_1|^2
//! bound^2 = 2 (delta + epsilon) / (k_2 - 1/kappa)
//! ```
//!
//! apart from the weight error, which depends on none of them. For a given `k_2` this is
//! `2 (P kappa + Q kappa^2) / (k_2 kappa - 1)` with `P = delta + N r^2 k_2 / 2` and
//! `Q = N r^2 |L (x) K_1|^2 / 2`, smallest at
//!
//! ```text
//! kappa = (1 + sqrt(1 + k_2 P / Q)) / k_2
//! ```
//!
//! and `k_2` between 0 and `lambda` follows from a search by golden section.
//!
//! With a vanishing radius the bound is `8 rho^2 / lambda^2`, whatever the gain's norm: the
//! uncertainty alone. The [`Knee`] is the radius at which the square of the bound is twice that: a
//! smaller one costs broadcasts and gains little.

use serde::Serialize;

use crate::analysis::{laplacian_norm, spectral_norm};
use crate::number::significant;
use crate::scenario::Scenario;

/// `kappa k_2` without neighbours, whose hold errors do not matter.
const ALONE: f64 = 1e3;
/// Digits of the chosen constants.
const DIGITS: usize = 6;

/// What the choice depends on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plan {
    /// `lambda`, which `k_1` may not exceed. \[1/s\]
    pub eigenvalue_min: f64,
    /// `|L (x) K_1|`. \[1/s\]
    pub coupling: f64,
    /// `|L (x) I_n|`.
    pub laplacian: f64,
    /// `N`.
    pub agents: usize,
}

/// Constants of Theorem 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Certificate {
    /// `rho`. \[state unit/s\]
    pub rho: f64,
    /// The trigger's radius. \[state unit\]
    pub radius: f64,
    /// `k_1 = k_2 + rho^2 / delta`. \[1/s\]
    pub k1: f64,
    /// `k_2`. \[1/s\]
    pub k2: f64,
    /// `kappa`. \[s\]
    pub kappa: f64,
    /// `delta`. \[squared state unit/s\]
    pub delta: f64,
    /// `epsilon`. \[squared state unit/s\]
    pub epsilon: f64,
    /// `phi_1`. \[1/s\]
    pub phi1: f64,
    /// `phi_2`. \[1/s\]
    pub phi2: f64,
    /// The ultimate bound of `|e_1|`, all agents stacked, without the weight error. \[state unit\]
    pub bound: f64,
}

/// The radius below which the bound hardly falls.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Knee {
    /// The radius. \[state unit\]
    pub radius: f64,
    /// Its `epsilon`. \[squared state unit/s\]
    pub epsilon: f64,
    /// Its bound. \[state unit\]
    pub bound: f64,
}

impl Plan {
    /// Creates the plan for the gain of a scenario, with `lambda_min(M)` of at least
    /// `eigenvalue_min`.
    #[must_use]
    pub fn new(scenario: &Scenario, eigenvalue_min: f64) -> Self {
        let laplacian = laplacian_norm(&scenario.graph);
        Self {
            eigenvalue_min,
            coupling: laplacian * spectral_norm(&scenario.design.gain),
            laplacian,
            agents: scenario.agents.len(),
        }
    }

    /// Returns the constants with the smallest bound for this `rho` \[state unit/s\] and `radius`
    /// \[state unit\].
    #[must_use]
    pub fn certificate(&self, rho: f64, radius: f64) -> Certificate {
        let bound = |k2: f64| self.bound_squared(k2, self.kappa(k2, rho, radius), rho, radius);
        let (mut low, mut high) = (0.0, self.eigenvalue_min);
        let ratio = 0.5 * (5f64.sqrt() - 1.0);
        let inner = |low: f64, high: f64| (high - ratio * (high - low), low + ratio * (high - low));
        for _ in 0..100 {
            let (left, right) = inner(low, high);
            if bound(left) < bound(right) { high = right } else { low = left }
        }
        let k2 = round(0.5 * (low + high), Rounding::Nearest);
        // Down if rounding would leave nothing for delta.
        let k2 = if k2 < self.eigenvalue_min { k2 } else { 0.5 * (low + high) };
        let kappa = round(self.kappa(k2, rho, radius), Rounding::Nearest);
        // Up, so that k_1 does not exceed lambda.
        let delta = round(rho * rho / (self.eigenvalue_min - k2), Rounding::Up);
        let phi1 = self.phi1(k2, kappa);
        let epsilon = round(self.agents as f64 * phi1 * radius * radius, Rounding::Nearest);
        let laplacian = self.laplacian;
        Certificate {
            rho,
            radius,
            k1: k2 + rho * rho / delta,
            k2,
            kappa,
            delta,
            epsilon,
            phi1,
            phi2: if laplacian > 0.0 { 0.25 * k2 / (laplacian * laplacian) } else { 0.0 },
            bound: (2.0 * (delta + epsilon) / (k2 - 1.0 / kappa)).sqrt(),
        }
    }

    /// Returns the knee for this `rho`.
    #[must_use]
    pub fn knee(&self, rho: f64) -> Knee {
        let wanted = 4.0 * rho / self.eigenvalue_min;
        // The bound grows with the radius; without neighbours it is that of k_2 alone.
        let (mut low, mut high) = (1e-12 * wanted, wanted);
        for _ in 0..100 {
            let middle = (low * high).sqrt();
            if self.certificate(rho, middle).bound < wanted { low = middle } else { high = middle }
        }
        let Certificate { radius, epsilon, bound, .. } = self.certificate(rho, low);
        Knee { radius, epsilon, bound }
    }

    fn phi1(&self, k2: f64, kappa: f64) -> f64 {
        0.5 * k2 + 0.5 * kappa * self.coupling * self.coupling
    }

    fn kappa(&self, k2: f64, rho: f64, radius: f64) -> f64 {
        let held = 0.5 * self.agents as f64 * radius * radius;
        let p = rho * rho / (self.eigenvalue_min - k2) + held * k2;
        let q = held * self.coupling * self.coupling;
        let best = if q > 0.0 { 1.0 + (1.0 + k2 * p / q).sqrt() } else { ALONE };
        best / k2
    }

    fn bound_squared(&self, k2: f64, kappa: f64, rho: f64, radius: f64) -> f64 {
        let delta = rho * rho / (self.eigenvalue_min - k2);
        let epsilon = self.agents as f64 * self.phi1(k2, kappa) * radius * radius;
        2.0 * (delta + epsilon) / (k2 - 1.0 / kappa)
    }
}

#[derive(Clone, Copy)]
enum Rounding {
    Nearest,
    Up,
}

fn round(x: f64, rounding: Rounding) -> f64 {
    let rounded = |x: f64| significant(x, DIGITS).parse().unwrap_or(x);
    match rounding {
        Rounding::Nearest => rounded(x),
        // Half a unit more than a unit of the last digit can round away.
        Rounding::Up if rounded(x) < x * (1.0 + 1e-9) => rounded(x * (1.0 + 1e-5)),
        Rounding::Up => rounded(x),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::analysis::GainCertificate;
    use crate::scenario::PAPER;

    fn paper() -> Plan {
        let scenario = Scenario::parse("paper.toml", PAPER).unwrap();
        Plan::new(&scenario, GainCertificate::new(&scenario).eigenvalue_min)
    }

    /// Compares with an independent study in double precision, which rounds the bound to 4.46.
    #[test]
    fn constants_for_the_gain_of_the_paper() {
        let found = paper().certificate(2.26, 0.056_631_1);
        assert!((found.k2 - 35.4).abs() < 0.1, "{found:?}");
        assert!((found.kappa - 0.058).abs() < 1e-3, "{found:?}");
        assert!((found.delta - 7.13).abs() < 0.5, "{found:?}");
        assert!((found.epsilon - 173.0).abs() < 1.0, "{found:?}");
        assert!(found.bound < 4.47, "{found:?}");
        assert!(found.k1 <= paper().eigenvalue_min, "{found:?}");
    }

    #[test]
    fn no_constants_nearby_are_better() {
        let plan = paper();
        for radius in [1e-6, 1e-3, 0.05, 2.0] {
            let found = plan.certificate(2.26, radius);
            let least = found.bound * found.bound * (1.0 - 1e-5);
            for k2 in [0.5, 0.9, 0.99, 1.001].map(|factor| factor * found.k2) {
                for kappa in [0.5, 0.9, 1.0, 1.1, 2.0].map(|factor| factor * found.kappa) {
                    if k2 * kappa > 1.0 && k2 < plan.eigenvalue_min {
                        let other = plan.bound_squared(k2, kappa, 2.26, radius);
                        assert!(other >= least, "{radius}: {k2}, {kappa}, {found:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn the_knee_doubles_the_square_of_the_limit() {
        let (plan, rho) = (paper(), 2.0);
        let limit = 8.0 * rho * rho / (plan.eigenvalue_min * plan.eigenvalue_min);
        let knee = plan.knee(rho);
        assert!((knee.bound * knee.bound / limit - 2.0).abs() < 1e-3, "{knee:?}");
    }

    #[test]
    fn one_agent_has_finite_constants() {
        let plan = Plan { eigenvalue_min: 10.0, coupling: 0.0, laplacian: 0.0, agents: 1 };
        let found = plan.certificate(1.0, 0.1);
        assert!(found.kappa.is_finite() && found.bound > 0.0 && found.phi2 == 0.0, "{found:?}");
    }
}
