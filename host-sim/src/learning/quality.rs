//! How well the network in a package fits the samples, evaluated in single precision by the core's
//! own code.
//!
//! ```text
//! error = (1/(S n)) Σ_s ‖f̂(x_s) − y_s‖²
//! explained = 1 − Σ_c Σ_s (f̂_c(x_s) − y_c,s)²/τ_c² / Σ_c Σ_s (y_c,s − ȳ_c)²/τ_c²
//! ```
//!
//! τ_c is the standard deviation of component c over the training samples, so that the explained
//! share does not depend on the units of the components. For a component that is constant in the
//! training samples, ȳ_c is replaced by 0.
//!
//! Cost: one forward pass per sample.

use agent_core::observer::network::Scratch;

use crate::packages::{PackageBytes, with_dimension};
use crate::training::{Dataset, Scaling};

/// The fit of a network to a set of samples.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fit {
    /// Mean squared error. \[squared state unit/s^2\]
    pub error: f64,
    /// Explained share of the smoothed targets' variance: at most 1, and 0 for a constant. `None`
    /// if the targets do not vary or there are none.
    pub explained: Option<f64>,
}

/// The fit of a trained network to its samples.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Quality {
    /// On the training samples.
    pub training: Fit,
    /// On the validation samples, which determine when training stops.
    pub validation: Option<Fit>,
    /// On the test samples.
    pub test: Option<Fit>,
    /// Share explained in the last [`LAST_SHARE`] of all samples in time, including training
    /// samples.
    pub last: Option<f64>,
}

impl Quality {
    /// Returns whether the network explains more than a constant at the end of the samples and on
    /// the validation samples, if any. Otherwise it is not switched in.
    ///
    /// The constant is the mean over the end only, because the network is used from there on. This
    /// rejects networks trained on too short a time or on chatter. It may also reject a useful
    /// network if the plant's disturbance is as large as its drift.
    #[must_use]
    pub fn explains(&self) -> bool {
        let validation = self.validation.and_then(|fit| fit.explained);
        self.last.is_some_and(|share| share > 0.0) && validation.is_none_or(|share| share > 0.0)
    }
}

/// The share of samples, the last in time, that decides whether the network is used.
pub const LAST_SHARE: f64 = 0.15;

/// Returns `f_hat` for each input of `samples`, shape `[samples][n]`; NaN where the core rejects
/// the input.
///
/// # Panics
/// If the dimensions of samples and package differ.
#[must_use]
pub fn estimates(package: &PackageBytes, samples: &Dataset) -> Vec<f64> {
    let inputs = package.architecture().inputs();
    assert_eq!(samples.width(), inputs, "inputs of the samples");
    with_dimension!(samples.dimension(), estimates_of(package, samples), else Vec::new())
}

fn estimates_of<const N: usize>(bytes: &PackageBytes, samples: &Dataset) -> Vec<f64> {
    let (package, mut scratch) = (bytes.package(), Scratch::NEW);
    let mut estimates = Vec::with_capacity(samples.targets().len());
    let mut inputs = Vec::with_capacity(samples.width());
    for row in samples.inputs().chunks_exact(samples.width()) {
        inputs.clear();
        inputs.extend(row.iter().map(|&x| x as f32));
        match package.evaluate::<N>(&inputs, &mut scratch) {
            Some((_, estimate)) => estimates.extend(estimate.iter().map(|&f| f64::from(f))),
            None => estimates.extend([f64::NAN; N]),
        }
    }
    estimates
}

/// Returns the mean squared error of `estimates` relative to the targets of `samples`.
#[must_use]
pub fn mean_squared_error(samples: &Dataset, estimates: &[f64]) -> f64 {
    let pairs = estimates.iter().zip(samples.targets());
    let sum = pairs.fold(0.0, |sum, (f, y)| sum + (f - y) * (f - y));
    sum / estimates.len() as f64
}

/// Returns the share of the targets' variance that `estimates` explain.
#[must_use]
pub fn explained(samples: &Dataset, estimates: &[f64], scaling: &Scaling) -> Option<f64> {
    let n = samples.dimension();
    let (mut unexplained, mut variance) = (0.0, 0.0);
    for (component, &unit) in scaling.targets().iter().enumerate() {
        let targets = || samples.targets().iter().skip(component).step_by(n).map(|y| y / unit);
        let mean = match scaling.is_constant_target(component) {
            true => 0.0,
            false => targets().fold(0.0, |sum, y| sum + y) / samples.len() as f64,
        };
        let found = estimates.iter().skip(component).step_by(n).map(|f| f / unit);
        for (y, f) in targets().zip(found) {
            unexplained += (f - y) * (f - y);
            variance += (y - mean) * (y - mean);
        }
    }
    // Targets that vary only by rounding have no variance to explain.
    (variance > 1e-24 * estimates.len() as f64).then_some(1.0 - unexplained / variance)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wave(scale: [f64; 2]) -> Dataset {
        let row = |s: usize| [libm::sin(0.2 * s as f64), libm::cos(0.3 * s as f64)];
        let values: Vec<f64> =
            (0..100).flat_map(row).zip(scale.into_iter().cycle()).map(|(v, s)| v * s).collect();
        Dataset::new(2, values.clone(), values).unwrap()
    }

    #[test]
    fn explained_is_one_for_the_targets_and_zero_for_their_mean_in_any_unit() {
        for scale in [[1.0, 1.0], [1e-6, 1e3], [1e150, 1e-150]] {
            let samples = wave(scale);
            let scaling = Scaling::of(&samples);
            let share = |estimates: &[f64]| explained(&samples, estimates, &scaling).unwrap();
            assert_eq!(share(samples.targets()), 1.0);
            let mean = |c| samples.targets().iter().skip(c).step_by(2).sum::<f64>() / 100.0;
            let means: Vec<f64> = [mean(0), mean(1)].into_iter().cycle().take(200).collect();
            assert!(share(&means).abs() < 1e-12, "{scale:?}");
            // Half of the amplitude leaves a quarter of the power unexplained.
            let half: Vec<f64> =
                samples.targets().iter().zip(&means).map(|(y, m)| 0.5 * (y + m)).collect();
            assert!((share(&half) - 0.75).abs() < 1e-12, "{scale:?}");
        }
    }

    #[test]
    fn constant_targets_have_no_variance_to_explain() {
        let still = Dataset::new(1, vec![1.0; 9], vec![0.0; 9]).unwrap();
        assert_eq!(explained(&still, &[0.0; 9], &Scaling::of(&still)), None);
        // A constant other than 0 has to be learned.
        let drift = Dataset::new(1, vec![1.0; 9], vec![4.0; 9]).unwrap();
        assert_eq!(explained(&drift, &[4.0; 9], &Scaling::of(&drift)), Some(1.0));
        assert_eq!(explained(&drift, &[0.0; 9], &Scaling::of(&drift)), Some(0.0));
        assert_eq!(mean_squared_error(&drift, &[1.0; 9]), 9.0);
    }
}
