//! What the rules know of the plant, from a trajectory and, if there is one, a model `f`:
//!
//! ```text
//! s_c = p95 |d xi_c/dt|    m_c = p95 |d xi_c/dt - (T f)_c| / s_c    Gamma = || max |T J T^-1| ||_2
//! ```
//!
//! Derivatives are differences of neighbouring samples; J, the Jacobian of f, is differenced too,
//! and the maximum over the data is taken element by element.
//!
//! Cost: a pass over the samples, at most about 5,000 + 200 (n + 1) evaluations of the model.

use nalgebra::DMatrix;

use super::dense::product;
use super::geometry::Geometry;
use super::trajectory::{Trajectory, units};
use crate::analysis::spectral_norm;

/// Samples at which the model is compared, about: enough for a 95 % quantile.
const COMPARED: usize = 5000;

/// Samples at which the model is differenced, about: the rules were found with 100 to 200.
const DIFFERENCED: usize = 200;

/// Step of a difference, in standard deviations.
const DIFFERENCE: f64 = 1e-5;

/// Quantile that stands for the largest value, outliers aside.
const QUANTILE: f64 = 0.95;

/// A model: writes `f(t, x)` \[state unit/s\] for a time \[s\] and a state, shape `[n]`.
pub type Model<'m> = dyn Fn(f64, &[f64], &mut [f64]) + 'm;

/// Statistics of a plant's states and of a model's error.
#[derive(Clone, Debug, PartialEq)]
pub struct Statistics {
    /// Mean of x, shape `[n]`. \[state unit\]
    pub mean: Vec<f64>,
    /// Standard deviation of x, shape `[n]`. \[state unit\]
    pub deviation: Vec<f64>,
    /// Standard deviation of `xi`, shape `[n]`; 1 with a [scaled](Geometry::scaled) geometry of the
    /// same data. \[unit of xi\]
    pub spread: Vec<f64>,
    /// `s_c`, shape `[n]`. \[unit of xi/s\]
    pub speed: Vec<f64>,
    /// `m_c`, the part of the speed that the model does not explain, shape `[n]`; 1 without a
    /// model.
    pub residual: Vec<f64>,
    /// `Gamma`; 0 without a model. \[1/s\]
    pub lipschitz: f64,
    /// Whether there is a model.
    pub has_model: bool,
}

impl Statistics {
    /// Computes them from at least two samples, and a model if there is one.
    ///
    /// # Panics
    /// If there are fewer than two samples, or the trajectory's dimension is not the geometry's.
    #[must_use]
    pub fn new(trajectory: &Trajectory, geometry: &Geometry, model: Option<&Model<'_>>) -> Self {
        let n = geometry.dimension();
        assert_eq!(
            trajectory.dimension, n,
            "trajectory and geometry must have the same state dimension"
        );
        let intervals = trajectory.samples().checked_sub(1).filter(|&k| k > 0);
        let intervals = intervals.expect("a derivative needs two samples");
        let mut along = vec![0.0; trajectory.samples() * n];
        for (k, xi) in along.chunks_exact_mut(n).enumerate() {
            geometry.directions_of(trajectory.state(k), xi);
        }
        let along = Trajectory { dimension: n, step: trajectory.step, states: along };
        let rate =
            |k: usize, c: usize| (along.state(k + 1)[c] - along.state(k)[c]) / trajectory.step;
        let speeds = |stride: usize| -> Vec<f64> {
            let of = |c| (0..intervals).step_by(stride).map(|k| rate(k, c).abs()).collect();
            (0..n).map(|c| quantile(of(c))).collect()
        };
        let speed = speeds(1);
        let (mut residual, mut lipschitz) = (vec![1.0; n], 0.0);
        if let Some(model) = model {
            let stride = (intervals / COMPARED).max(1);
            let mut errors = vec![Vec::new(); n];
            let (mut f, mut in_directions) = (vec![0.0; n], vec![0.0; n]);
            for k in (0..intervals).step_by(stride) {
                model(trajectory.time(k), trajectory.state(k), &mut f);
                geometry.directions_of(&f, &mut in_directions);
                for (c, errors) in errors.iter_mut().enumerate() {
                    errors.push((rate(k, c) - in_directions[c]).abs());
                }
            }
            let speeds = speeds(stride);
            for (c, errors) in errors.into_iter().enumerate() {
                residual[c] = if speeds[c] > 0.0 { quantile(errors) / speeds[c] } else { 1.0 };
            }
            lipschitz = largest_slopes(trajectory, geometry, model);
        }
        Self {
            mean: trajectory.mean(),
            deviation: trajectory.deviation(),
            spread: along.deviation(),
            speed,
            residual,
            lipschitz,
            has_model: model.is_some(),
        }
    }
}

/// Returns the norm of the elementwise largest `|T J T^-1|`. \[1/s\]
fn largest_slopes(trajectory: &Trajectory, geometry: &Geometry, model: &Model<'_>) -> f64 {
    let n = geometry.dimension();
    let unit = units(&trajectory.deviation());
    let mut largest = DMatrix::zeros(n, n);
    let mut jacobian = DMatrix::zeros(n, n);
    let [mut here, mut there, mut moved] = [vec![0.0; n], vec![0.0; n], vec![0.0; n]];
    for k in (0..trajectory.samples()).step_by((trajectory.samples() / DIFFERENCED).max(1)) {
        let (time, state) = (trajectory.time(k), trajectory.state(k));
        model(time, state, &mut here);
        for j in 0..n {
            moved.copy_from_slice(state);
            moved[j] += DIFFERENCE * unit[j];
            model(time, &moved, &mut there);
            // What the state moved by after rounding.
            let by = moved[j] - state[j];
            for row in 0..n {
                jacobian[(row, j)] = (there[row] - here[row]) / by;
            }
        }
        let slopes = product(&product(&geometry.transform, &jacobian), &geometry.inverse);
        largest = largest.zip_map(&slopes, |largest: f64, slope| largest.max(slope.abs()));
    }
    spectral_norm(&largest)
}

/// Returns the 95 % quantile, interpolated between neighbours.
fn quantile(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let at = QUANTILE * (values.len() - 1) as f64;
    let below = at as usize;
    let above = (below + 1).min(values.len() - 1);
    values[below] + (at - below as f64) * (values[above] - values[below])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::testing::{close, references};
    use nalgebra::dmatrix;

    #[test]
    fn a_rotation_has_constant_speed_and_the_slopes_of_its_matrix() {
        let omega = 3.0;
        let step = 1e-3;
        let states = (0..4000)
            .flat_map(|k| {
                let angle = omega * step * f64::from(k);
                [libm::cos(angle), 2.0 * libm::sin(angle)]
            })
            .collect();
        let trajectory = Trajectory { dimension: 2, step, states };
        let outputs = [dmatrix![1.0, 0.0], dmatrix![0.0, 1.0]];
        let geometry = Geometry::in_state_units(&references(&outputs)).unwrap();
        let exact = |_: f64, x: &[f64], dx: &mut [f64]| {
            dx[0] = -0.5 * omega * x[1];
            dx[1] = 2.0 * omega * x[0];
        };
        let found = Statistics::new(&trajectory, &geometry, Some(&exact));
        assert!((found.speed[0] - 3.0).abs() < 0.02 && (found.speed[1] - 6.0).abs() < 0.04);
        assert!(found.residual.iter().all(|&m| m < 2e-3), "{found:?}");
        assert!((found.lipschitz - 6.0).abs() < 1e-6, "{found:?}");
        let blind = Statistics::new(&trajectory, &geometry, None);
        assert_eq!((blind.residual, blind.lipschitz), (vec![1.0, 1.0], 0.0));
        close(&blind.spread, &blind.deviation, 1e-12);
    }

    #[test]
    fn quantiles_interpolate() {
        assert_eq!(quantile(vec![7.0]), 7.0);
        assert!((quantile((0..=100).rev().map(f64::from).collect()) - 95.0).abs() < 1e-12);
        assert!((quantile(vec![2.0, 1.0]) - 1.95).abs() < 1e-12);
    }
}
