//! The bound on the error after a long time. With the decay rate lambda and the certificate's
//! condition `k_2 + rho^2/delta <= lambda`, the Lyapunov function of Theorem 1 gives
//!
//! ```text
//! alpha = k_2 - 1/kappa                       epsilon = (k_2/2 + kappa/2 |E|^2) |e_hold|^2
//! |e_1|^2 <= cond(P) 2 (delta + epsilon) / alpha
//! ```
//!
//! with `cond(P) = 1` in the plain norm. rho is the bound on the lumped uncertainty: what the model
//! does not explain and the clipped estimate of the disturbance, in the unit of xi per second. The
//! error of the outer weights is not counted.
//!
//! `k_2` is where the bound is least: for each, `kappa` in closed form, `(1 + sqrt(1 + (delta +
//! H k_2/2) k_2 / (H |E|^2/2))) / k_2` with `H = |e_hold|^2`; over `k_2`, a scan and a golden
//! section. About 150 evaluations of 20 operations.

use super::certificate::Certificate;

/// Range of `ln((lambda - k_2)/k_2)` that is scanned, and the number of its points.
const SCAN: (f64, f64, usize) = (-32.0, 6.0, 77);

/// Sections, each of which shortens the interval to 0.618 of it: to `1e-8` of a scan's interval.
const SECTIONS: usize = 40;

/// Bound on the error of all agents, stacked, and the constants that give it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UltimateBound {
    /// Whether it is that of the weighted certificate.
    pub weighted: bool,
    /// `k_2`. \[1/s\]
    pub k2: f64,
    /// `kappa`; infinite if no agent listens to another. \[s\]
    pub kappa: f64,
    /// `delta = rho^2 / (lambda - k_2)`. \[squared unit of xi/s\]
    pub delta: f64,
    /// `epsilon`, for the whole network. \[squared unit of xi/s\]
    pub epsilon: f64,
    /// `epsilon / N`. \[squared unit of xi/s\]
    pub threshold: f64,
    /// The bound on `|e_1|`; infinite without a certificate. \[unit of xi\]
    pub radius: f64,
}

/// Returns the smaller of the bounds of the plain and the weighted certificate for `rho`
/// \[unit of xi/s\], the trigger's radius in each direction \[unit of xi\], and the number of
/// `agents`, over whom epsilon is shared.
///
/// # Panics
/// If the number of radii is not that of the directions.
#[must_use]
pub fn ultimate(
    certificate: &Certificate,
    rho: f64,
    radii: &[f64],
    agents: usize,
) -> UltimateBound {
    let plain = ultimate_plain(certificate, rho, radii, agents);
    let weighted = ultimate_weighted(certificate, rho, radii, agents);
    match (plain, weighted) {
        (Some(plain), Some(weighted)) if plain.radius <= weighted.radius => plain,
        (_, Some(weighted)) => weighted,
        (Some(plain), None) => plain,
        (None, None) => UltimateBound {
            weighted: true,
            k2: 0.0,
            kappa: f64::INFINITY,
            delta: f64::INFINITY,
            epsilon: f64::INFINITY,
            threshold: f64::INFINITY,
            radius: f64::INFINITY,
        },
    }
}

/// Returns the bound in the plain norm, for a radius per direction; `None` if the plain certificate
/// is not positive.
///
/// # Panics
/// If the number of radii is not that of the directions.
#[must_use]
pub(super) fn ultimate_plain(
    certificate: &Certificate,
    rho: f64,
    radii: &[f64],
    agents: usize,
) -> Option<UltimateBound> {
    let problem = Problem {
        weighted: false,
        rate: certificate.plain,
        rho,
        hold: hold(&certificate.hold, radii),
        coupling: certificate.coupling,
        agents: agents as f64,
        condition: 1.0,
    };
    problem.solve()
}

/// Returns the bound through the weighted norm, for a radius per direction; `None` if an agent has
/// no path to a root.
///
/// # Panics
/// If the number of radii is not that of the directions.
#[must_use]
pub(super) fn ultimate_weighted(
    certificate: &Certificate,
    rho: f64,
    radii: &[f64],
    agents: usize,
) -> Option<UltimateBound> {
    let problem = Problem {
        weighted: true,
        rate: certificate.eigenvalue_min,
        rho,
        hold: hold(&certificate.weighted_hold, radii),
        coupling: certificate.weighted_coupling,
        agents: agents as f64,
        condition: certificate.condition,
    };
    problem.solve()
}

/// Returns `|e_hold|^2`.
fn hold(squared_radii: &[f64], radii: &[f64]) -> f64 {
    assert_eq!(squared_radii.len(), radii.len(), "a radius for every direction");
    squared_radii.iter().zip(radii).fold(0.0, |sum, (hold, radius)| sum + hold * radius * radius)
}

/// What the bound depends on. The largest weight is 1, so that rho is the same in both norms.
struct Problem {
    weighted: bool,
    rate: f64,
    rho: f64,
    hold: f64,
    coupling: f64,
    agents: f64,
    condition: f64,
}

impl Problem {
    fn solve(&self) -> Option<UltimateBound> {
        // Infinite if there is no agent.
        if !(self.rate > 0.0 && self.rate.is_finite()) {
            return None;
        }
        let (from, to, points) = SCAN;
        let spacing = (to - from) / (points - 1) as f64;
        let value = |x: f64| self.at(x).radius;
        let (mut best, mut least) = (from, f64::INFINITY);
        for k in 0..points {
            let x = from + spacing * k as f64;
            if value(x) < least {
                (best, least) = (x, value(x));
            }
        }
        let golden = 0.5 * (5f64.sqrt() - 1.0);
        let (mut low, mut high) = (best - spacing, best + spacing);
        for _ in 0..SECTIONS {
            let step = golden * (high - low);
            if value(high - step) <= value(low + step) {
                high = low + step;
            } else {
                low = high - step;
            }
        }
        Some(self.at(0.5 * (low + high)))
    }

    /// Returns the bound for `x = ln((lambda - k_2)/k_2)`.
    fn at(&self, x: f64) -> UltimateBound {
        let odds = libm::exp(x);
        let k2 = self.rate / (1.0 + odds);
        let delta = self.rho * self.rho / (k2 * odds);
        let own = 0.5 * self.hold * k2;
        let slope = 0.5 * self.hold * self.coupling * self.coupling;
        let (kappa, epsilon, alpha);
        if slope > 0.0 {
            kappa = (1.0 + (1.0 + (delta + own) * k2 / slope).sqrt()) / k2;
            epsilon = own + kappa * slope;
            alpha = k2 - 1.0 / kappa;
        } else {
            (kappa, epsilon, alpha) = (f64::INFINITY, own, k2);
        }
        let radius = (2.0 * self.condition * (delta + epsilon) / alpha).sqrt();
        let threshold = epsilon / self.agents;
        UltimateBound { weighted: self.weighted, k2, kappa, delta, epsilon, threshold, radius }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::DMatrix;

    /// The star of 3 with one gain for roots and one for others.
    fn certificate(plain: f64, coupling: f64) -> Certificate {
        Certificate {
            eigenvalue_min: 0.0,
            plain,
            bound: 0.0,
            condition: 1.0,
            coupling,
            weighted_coupling: coupling,
            hold: vec![5.0],
            weighted_hold: vec![5.0],
            weights: DMatrix::zeros(3, 1),
        }
    }

    /// What a study with other code found for these rates.
    #[test]
    fn bounds_of_the_papers_network() {
        let root = 2f64.sqrt();
        let cases = [
            // rate, |E|, rho, r: k2, kappa, delta, epsilon, bound
            (87.2, 200.0 * root, 2.26, 0.05, [83.2, 0.026, 1.29, 13.4, 0.81]),
            (32.2, 100.0 * root, 2.26, 0.06, [29.9, 0.073, 2.21, 13.4, 1.39]),
            (34.0, 100.0 * root, 2.26, 0.08, [32.1, 0.067, 2.69, 21.9, 1.69]),
        ];
        for (rate, coupling, rho, radius, [k2, kappa, delta, epsilon, error]) in cases {
            let found = ultimate(&certificate(rate, coupling), rho, &[radius], 3);
            let near = |found: f64, expected: f64, unit: f64| {
                assert!((found - expected).abs() <= unit, "{found}, expected {expected}");
            };
            near(found.k2, k2, 0.05);
            near(found.kappa, kappa, 0.0005);
            near(found.delta, delta, 0.005);
            near(found.epsilon, epsilon, 0.05);
            near(found.radius, error, 0.005);
            assert_eq!(found.threshold, found.epsilon / 3.0);
            assert!(!found.weighted);
        }
        let wide = ultimate(&certificate(32.2, 100.0 * root), 12.0, &[0.06], 3);
        assert!((wide.radius - 2.24).abs() < 0.005, "{wide:?}");
        let wide = ultimate(&certificate(34.0, 100.0 * root), 12.0, &[0.08], 3);
        assert!((wide.radius - 2.50).abs() < 0.005, "{wide:?}");
    }

    #[test]
    fn no_other_constants_give_a_smaller_bound() {
        let found = ultimate(&certificate(50.0, 300.0), 3.0, &[0.07], 3);
        let hold = 5.0 * 0.07 * 0.07;
        for k2 in (1..500).map(|k| 0.1 * f64::from(k)) {
            for kappa in (1..1000).map(|k| 0.001 * f64::from(k)) {
                let (alpha, delta) = (k2 - 1.0 / kappa, 9.0 / (50.0 - k2));
                let epsilon = hold * 0.5 * (k2 + kappa * 300.0 * 300.0);
                let bound = 2.0 * (delta + epsilon) / alpha;
                assert!(alpha <= 0.0 || bound >= found.radius * found.radius * (1.0 - 1e-9));
            }
        }
        let rate = found.k2 + 9.0 / found.delta;
        assert!((rate - 50.0).abs() < 1e-9, "{rate}");
    }

    #[test]
    fn extremes_have_a_bound() {
        let calm = ultimate(&certificate(50.0, 300.0), 0.0, &[0.07], 3);
        assert!((calm.k2 - 50.0).abs() < 1e-6 && calm.delta == 0.0, "{calm:?}");
        let alone = ultimate(&certificate(50.0, 0.0), 3.0, &[0.0], 1);
        // 2 rho^2 / ((lambda - k2) k2) is least at half the rate.
        assert!((alone.k2 - 25.0).abs() < 1e-3 && alone.kappa.is_infinite(), "{alone:?}");
        assert!((alone.radius - (2.0 * 9.0 / 625.0f64).sqrt()).abs() < 1e-9);
        let none = ultimate(&certificate(-1.0, 300.0), 3.0, &[0.07], 3);
        assert!(none.radius.is_infinite());
    }
}
