//! Scales training data, so that units and offsets do not matter.
//!
//! ```text
//! u_i = (x_i − c_i) / h_i,   y'_o = y_o / τ_o,   W'[:, o] = W[:, o] / τ_o
//! ```
//!
//! c and h are the mean and the standard deviation of each input over the training samples, τ the
//! standard deviation of each target. A network trained on (u, y') with W' has the same residuals,
//! each relative to its target's deviation, as one on (x, y) with W whose first layer is folded:
//!
//! ```text
//! weight[i, p] = weight'[i, p] / h_i,   bias[p] = bias'[p] − Σ_i weight[i, p] c_i
//! ```
//!
//! so scaling costs the node nothing. Targets are scaled, not centred, because Ŵᵀσ has no bias to
//! absorb a centre. Damping, gradient limits, goal and weight decay then have the same meaning in
//! all units.
//!
//! Cost: one copy of the samples.
//!
//! Invariants: an input that varies by less than [`WIDTH_MIN`] of its magnitude is constant in
//! single precision; it is replaced by 0 and gets the weight 0. Scaling all inputs or targets by a
//! power of two does not change a bit of the training.

use agent_core::observer::network::Architecture;

use super::data::Dataset;

/// Smallest range of a varying input, relative to its largest absolute value: eight units in the
/// last place of single precision, in which nodes store the estimate.
pub const WIDTH_MIN: f64 = 1.0 / 1_048_576.0;

/// Centres and widths of inputs, widths of targets.
#[derive(Clone, Debug, PartialEq)]
pub struct Scaling {
    /// c, shape `[n]`. \[state unit\]
    centre: Vec<f64>,
    /// h, shape `[n]`; `None` for a constant input. \[state unit\]
    width: Vec<Option<f64>>,
    /// τ, shape `[n]`, above 0. \[state unit/s\]
    target: Vec<f64>,
    /// Whether each target is constant.
    constant_target: Vec<bool>,
}

/// Mean, standard deviation, and whether the values vary by more than rounding.
pub(super) struct Spread {
    pub(super) mean: f64,
    pub(super) deviation: f64,
    pub(super) varies: bool,
}

impl Spread {
    /// Computes the spread of component `index` of row-major values, shape `[samples][n]`.
    pub(super) fn of(values: &[f64], dimension: usize, index: usize) -> Self {
        let column = || values.iter().skip(index).step_by(dimension);
        let count = (values.len() / dimension) as f64;
        let low = column().fold(f64::INFINITY, |low, &x| low.min(x));
        let high = column().fold(f64::NEG_INFINITY, |high, &x| high.max(x));
        let size = low.abs().max(high.abs());
        // Relative to the magnitude, so that no square overflows or underflows.
        let unit = power_of_two(size);
        let mean = column().fold(0.0, |sum, x| sum + x / unit) / count;
        let squares = column().fold(0.0, |sum, x| sum + (x / unit - mean) * (x / unit - mean));
        Self {
            mean: mean * unit,
            deviation: (squares / count).sqrt() * unit,
            varies: high * 0.5 - low * 0.5 > 0.5 * WIDTH_MIN * size,
        }
    }
}

/// Returns the power of two at or below `size`, 1 for 0; dividing by it is exact.
fn power_of_two(size: f64) -> f64 {
    if size > 0.0 && size.is_finite() { libm::ldexp(1.0, libm::ilogb(size)) } else { 1.0 }
}

impl Scaling {
    /// Computes the scaling of these training samples.
    #[must_use]
    pub fn of(train: &Dataset) -> Self {
        let (n, width) = (train.dimension(), train.width());
        let inputs: Vec<Spread> =
            (0..width).map(|i| Spread::of(train.inputs(), width, i)).collect();
        let targets: Vec<Spread> = (0..n).map(|i| Spread::of(train.targets(), n, i)).collect();
        let varying = targets.iter().filter(|spread| spread.varies);
        let largest = varying.fold(0.0f64, |largest, spread| largest.max(spread.deviation));
        let target = |spread: &Spread| match spread {
            Spread { varies: true, deviation, .. } => *deviation,
            // A constant target is scaled by its magnitude, or like the others if it is zero.
            Spread { mean, .. } if *mean != 0.0 => mean.abs(),
            _ if largest > 0.0 => largest,
            _ => 1.0,
        };
        Self {
            centre: inputs.iter().map(|spread| spread.mean).collect(),
            width: inputs.iter().map(|s| s.varies.then_some(s.deviation)).collect(),
            target: targets.iter().map(target).collect(),
            constant_target: targets.iter().map(|spread| !spread.varies).collect(),
        }
    }

    /// Returns scaled samples.
    #[must_use]
    pub fn apply(&self, data: &Dataset) -> Dataset {
        let (n, count) = (data.dimension(), data.width());
        let inputs = data.inputs().iter().enumerate().map(|(index, x)| {
            let (centre, width) = (self.centre[index % count], self.width[index % count]);
            width.map_or(0.0, |width| (x - centre) / width)
        });
        let targets = data.targets().iter().enumerate().map(|(i, y)| y / self.target[i % n]);
        data.with_values(inputs.collect(), targets.collect())
    }

    /// Returns W', row-major, shape `[L][n]`.
    #[must_use]
    pub fn outer_weights(&self, outer: &[f64]) -> Vec<f64> {
        let n = self.target.len();
        outer.iter().enumerate().map(|(index, w)| w / self.target[index % n]).collect()
    }

    /// Converts the parameters of a network on u to those of the same network on x, in place.
    ///
    /// Weights of the first layer are rounded to single precision before the biases are computed
    /// from them, so that later rounding does not shift the network when a centre is large.
    ///
    /// # Panics
    /// If `parameters` does not match `architecture`.
    pub fn fold(&self, architecture: &Architecture, parameters: &mut [f64]) {
        let width = first_width(architecture);
        let (biases, rest) = parameters.split_at_mut(width);
        for ((row, centre), h) in rest.chunks_exact_mut(width).zip(&self.centre).zip(&self.width) {
            for (weight, bias) in row.iter_mut().zip(&mut *biases) {
                *weight = h.map_or(0.0, |h| f64::from((*weight / h) as f32));
                *bias -= *weight * centre;
            }
        }
    }

    /// The inverse of [`Self::fold`], except for rounding and constant inputs.
    ///
    /// # Panics
    /// If `parameters` does not match `architecture`.
    pub fn unfold(&self, architecture: &Architecture, parameters: &mut [f64]) {
        let width = first_width(architecture);
        let (biases, rest) = parameters.split_at_mut(width);
        for ((row, centre), h) in rest.chunks_exact_mut(width).zip(&self.centre).zip(&self.width) {
            for (weight, bias) in row.iter_mut().zip(&mut *biases) {
                *bias += *weight * centre;
                *weight *= h.unwrap_or(0.0);
            }
        }
    }

    /// Returns the indices of constant inputs, from 0.
    pub fn constant_inputs(&self) -> impl Iterator<Item = usize> + '_ {
        self.width.iter().enumerate().filter_map(|(i, width)| width.is_none().then_some(i))
    }

    /// Returns the distance of each input's centre from 0 in standard deviations; `None` if the
    /// input is constant.
    pub fn offsets(&self) -> impl Iterator<Item = Option<f64>> + '_ {
        self.centre.iter().zip(&self.width).map(|(c, width)| width.map(|h| c.abs() / h))
    }

    /// Returns τ, shape `[n]`. \[state unit/s\]
    #[must_use]
    pub fn targets(&self) -> &[f64] {
        &self.target
    }

    /// Whether the target of this component, from 0, is constant.
    ///
    /// # Panics
    /// If the component does not exist.
    #[must_use]
    pub fn is_constant_target(&self, component: usize) -> bool {
        self.constant_target[component]
    }
}

fn first_width(architecture: &Architecture) -> usize {
    architecture.shapes().next().map_or(0, |(_, layer)| usize::from(layer.width))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::training::testing::{architecture, assert_close};
    use agent_core::math::activation::Activation::Tanh;

    fn data(scale: f64, offset: f64) -> Dataset {
        let wave = |s: usize| libm::sin(0.3 * s as f64);
        let inputs = (0..50).flat_map(|s| [scale * wave(s) + offset, 0.1, wave(s + 9)]).collect();
        let targets = (0..50).flat_map(|s| [scale * wave(s + 3), 0.0, 4.0]).collect();
        Dataset::new(3, inputs, targets).expect("valid")
    }

    #[test]
    fn scaled_samples_are_independent_of_units() {
        let one = data(1.0, 0.0);
        for (scale, offset) in [(1e-6, 0.0), (1e6, 0.0), (1.0, 300.0), (3.0, -1e3)] {
            let other = data(scale, offset);
            let [one, other] = [&one, &other].map(|data| Scaling::of(data).apply(data));
            assert_close(one.inputs(), other.inputs(), 0.0, 1e-12 * (1.0 + offset.abs()));
            assert_close(one.targets(), other.targets(), 1e-13, 0.0);
        }
        let far = data(1e200, 0.0);
        assert!(Scaling::of(&far).apply(&far).targets().iter().all(|y| y.is_finite()));
    }

    #[test]
    fn input_that_varies_only_by_rounding_is_constant() {
        let scaling = Scaling::of(&data(1.0, 0.0));
        assert_eq!(scaling.constant_inputs().collect::<Vec<_>>(), [1]);
        // Averages of 0.1 that differ in their last bits.
        let jitter = |s: usize| 0.1 + 1e-17 * s as f64;
        let values: Vec<f64> = (0..50).map(jitter).collect();
        let jittering = Dataset::new(1, values.clone(), values).expect("valid");
        let scaling = Scaling::of(&jittering);
        assert_eq!(scaling.constant_inputs().count(), 1);
        let mut parameters = vec![0.5, -0.25, 3.0, 4.0];
        scaling.fold(&architecture(1, &[(2, Tanh)]), &mut parameters);
        assert_eq!(parameters, [0.5, -0.25, 0.0, 0.0]);
        assert_eq!(scaling.apply(&jittering).inputs(), [0.0; 50]);
    }

    #[test]
    fn constant_targets_are_scaled_by_their_magnitude() {
        let scaling = Scaling::of(&data(2.0, 0.0));
        let [wave, zero, four] = scaling.targets() else { panic!("three targets") };
        assert_eq!((zero, *four), (wave, 4.0));
        let still = Dataset::new(1, vec![0.0; 3], vec![0.0; 3]).expect("valid");
        assert_eq!(Scaling::of(&still).targets(), [1.0]);
    }

    #[test]
    fn folding_keeps_the_network_function() {
        let (architecture, data) = (architecture(3, &[(4, Tanh)]), data(0.5, 70.0));
        let scaling = Scaling::of(&data);
        let scaled: Vec<f64> = (0..16).map(|p| 0.1 * f64::from(p) - 0.7).collect();
        let mut folded = scaled.clone();
        scaling.fold(&architecture, &mut folded);
        let entering = |p: &[f64], x: &[f64], q: usize| {
            (0..3).fold(p[q], |sum, i| sum + p[4 + 4 * i + q] * x[i])
        };
        let units = scaling.apply(&data);
        for (x, u) in data.inputs().chunks_exact(3).zip(units.inputs().chunks_exact(3)) {
            for q in 0..4 {
                // Weights are rounded to single precision; the bias compensates for it at the
                // centre.
                let expected = entering(&scaled, u, q);
                assert_close(&[entering(&folded, x, q)], &[expected], 0.0, 1e-6);
            }
        }
        scaling.unfold(&architecture, &mut folded);
        assert_close(&folded[8..12], &[0.0; 4], 0.0, 0.0);
        assert_close(&folded[..8], &scaled[..8], 1e-5, 0.0);
    }
}
