//! Initial parameters for training.
//!
//! With a constant start, as in the paper (0.1), the nodes of a layer stay identical because their
//! gradients are equal, and the network is as narrow as one node per layer. A random start breaks
//! the symmetry. There are two, for a layer of w nodes and m inputs:
//!
//! ```text
//! Glorot and Bengio (2010):   weight ~ U(−r, r),  r = √(6 / (m + w)),  bias = 0
//! Nguyen and Widrow (1990):   ‖weights of a node‖ = β = 0.7 w^(1/m) · A,  direction random,
//!                             bias_p = β · (−1 + 2p/(w−1)) · random sign    (0 for w = 1)
//! ```
//!
//! A is the half-width of the activation's active range. Both formulas assume inputs of about [−1, 1]. The inputs of the first layer are
//! standardised by the data's mean and deviation (Glorot) or range (Nguyen–Widrow), those of a
//! later layer by the activation's range; the affine map is then folded into weights and biases:
//! `(x − c)/h` gives `weight/h` and `bias − Σ weight·c/h`.
//!
//! Invariant: the same seed gives the same bits on every machine.

use super::activation::{active_half_width, output_range};
use super::data::Dataset;
use agent_core::math::activation::Activation;
use agent_core::observer::network::Architecture;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// The initial parameters of training.
#[derive(Clone, Debug, PartialEq)]
pub enum InitialParameters {
    /// All parameters have this value; 0.1 in the paper.
    Constant(f64),
    /// These parameters, in the flat order of the core's networks, to continue a training.
    Given(Vec<f64>),
    /// Glorot and Bengio's uniform weights for standardised inputs.
    Glorot,
    /// Nguyen and Widrow's method: active ranges spread evenly over the inputs.
    NguyenWidrow,
}

/// Why there are no initial parameters.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum InitialError {
    /// A parameter is infinite or NaN.
    #[error("initial parameter {index} is not finite")]
    NotFinite {
        /// Its index.
        index: usize,
    },
    /// The given parameters do not match the architecture.
    #[error("{found} initial parameters, but the architecture has {expected}")]
    Count {
        /// Number of parameters of the architecture.
        expected: usize,
        /// Number of parameters given.
        found: usize,
    },
}

impl InitialParameters {
    /// Returns the flat parameters for `architecture`, whose first layer gets the inputs of `data`.
    ///
    /// # Errors
    /// If given parameters are not finite or do not match.
    pub fn draw(
        &self,
        architecture: &Architecture,
        data: &Dataset,
        seed: u64,
    ) -> Result<Vec<f64>, InitialError> {
        let expected = architecture.parameter_count();
        let parameters = match self {
            Self::Constant(value) => vec![*value; expected],
            Self::Given(values) => values.clone(),
            Self::Glorot => random(architecture, &standard_ranges(data), seed, glorot),
            Self::NguyenWidrow => random(architecture, &extreme_ranges(data), seed, nguyen_widrow),
        };
        let found = parameters.len();
        if found != expected {
            return Err(InitialError::Count { expected, found });
        }
        match parameters.iter().position(|value| !value.is_finite()) {
            Some(index) => Err(InitialError::NotFinite { index }),
            None => Ok(parameters),
        }
    }
}

/// Centre and half-width of an input.
#[derive(Clone, Copy, Debug)]
struct InputRange {
    centre: f64,
    half_width: f64,
}

impl InputRange {
    /// A constant input has no width and is only centred.
    fn new(centre: f64, half_width: f64) -> Self {
        Self { centre, half_width: if half_width > 0.0 { half_width } else { 1.0 } }
    }

    /// From the least to the largest value.
    fn of(low: f64, high: f64) -> Self {
        Self::new(0.5 * low + 0.5 * high, 0.5 * high - 0.5 * low)
    }
}

/// Returns mean and standard deviation of each input.
fn standard_ranges(data: &Dataset) -> Vec<InputRange> {
    let (n, count) = (data.width(), data.len() as f64);
    let column = |i: usize| data.inputs().iter().skip(i).step_by(n);
    let range = |i| {
        let mean = column(i).fold(0.0, |sum, x| sum + x) / count;
        let variance = column(i).fold(0.0, |sum, x| sum + (x - mean) * (x - mean)) / count;
        InputRange::new(mean, variance.sqrt())
    };
    (0..n).map(range).collect()
}

/// Returns midpoint and half-width of each input's range.
fn extreme_ranges(data: &Dataset) -> Vec<InputRange> {
    let n = data.width();
    let column = |i: usize| data.inputs().iter().skip(i).step_by(n);
    let range = |i| {
        let low = column(i).fold(f64::INFINITY, |low, &x| low.min(x));
        let high = column(i).fold(f64::NEG_INFINITY, |high, &x| high.max(x));
        InputRange::of(low, high)
    };
    (0..n).map(range).collect()
}

/// Draws biases `[width]` and weights `[inputs][width]` of one layer for inputs of about [−1, 1].
type DrawLayer = fn(usize, usize, Activation, &mut ChaCha8Rng) -> (Vec<f64>, Vec<f64>);

fn random(
    architecture: &Architecture,
    first: &[InputRange],
    seed: u64,
    draw_layer: DrawLayer,
) -> Vec<f64> {
    let mut generator = ChaCha8Rng::seed_from_u64(seed);
    let mut parameters = Vec::with_capacity(architecture.parameter_count());
    let mut ranges = first.to_vec();
    for (inputs, layer) in architecture.shapes() {
        let width = usize::from(layer.width);
        let (mut biases, mut weights) = draw_layer(inputs, width, layer.activation, &mut generator);
        for (row, range) in weights.chunks_exact_mut(width).zip(&ranges) {
            for (weight, bias) in row.iter_mut().zip(&mut biases) {
                *weight /= range.half_width;
                *bias -= *weight * range.centre;
            }
        }
        parameters.append(&mut biases);
        parameters.append(&mut weights);
        let (low, high) = output_range(layer.activation);
        ranges = vec![InputRange::of(low, high); width];
    }
    parameters
}

fn glorot(
    inputs: usize,
    width: usize,
    _: Activation,
    generator: &mut ChaCha8Rng,
) -> (Vec<f64>, Vec<f64>) {
    let radius = (6.0 / (inputs + width) as f64).sqrt();
    let weights = (0..inputs * width).map(|_| radius * symmetric_uniform(generator)).collect();
    (vec![0.0; width], weights)
}

fn nguyen_widrow(
    inputs: usize,
    width: usize,
    activation: Activation,
    generator: &mut ChaCha8Rng,
) -> (Vec<f64>, Vec<f64>) {
    let norm = 0.7 * libm::pow(width as f64, 1.0 / inputs as f64) * active_half_width(activation);
    let mut biases = vec![0.0; width];
    let mut weights = vec![0.0; inputs * width];
    for (p, bias) in biases.iter_mut().enumerate() {
        let direction: Vec<f64> = (0..inputs).map(|_| symmetric_uniform(generator)).collect();
        let length = direction.iter().fold(0.0, |sum, d| sum + d * d).sqrt();
        for (i, d) in direction.iter().enumerate() {
            weights[i * width + p] = norm * d / length;
        }
        let sign = if symmetric_uniform(generator) < 0.0 { -1.0 } else { 1.0 };
        if width > 1 {
            *bias = sign * norm * (2.0 * p as f64 / (width - 1) as f64 - 1.0);
        }
    }
    (biases, weights)
}

/// Draws uniformly from 2^53 points in (−1, 1), not including 0.
fn symmetric_uniform(generator: &mut impl Rng) -> f64 {
    let unit = ((generator.next_u64() >> 11) as f64 + 0.5) * (1.0 / 9_007_199_254_740_992.0);
    2.0 * unit - 1.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::training::testing::{architecture, assert_close};
    use Activation::{Gaussian, Logistic, Tanh};

    fn data() -> Dataset {
        // Means 3 and −40; ranges [1, 5] and [−60, −20].
        Dataset::new(2, vec![1.0, -20.0, 5.0, -60.0, 3.0, -40.0], vec![0.0; 6]).expect("valid")
    }

    #[test]
    fn bits_depend_only_on_the_seed() {
        let architecture = architecture(2, &[(5, Tanh), (3, Logistic), (4, Gaussian)]);
        for initial in [InitialParameters::Glorot, InitialParameters::NguyenWidrow] {
            let draw = |seed| initial.draw(&architecture, &data(), seed).expect("finite");
            assert_eq!(draw(1), draw(1));
            assert_ne!(draw(1), draw(2));
            assert_eq!(draw(1).len(), architecture.parameter_count());
        }
    }

    #[test]
    fn constant_and_given_parameters_are_used_unchanged() {
        let architecture = architecture(2, &[(2, Tanh)]);
        let constant = InitialParameters::Constant(0.1).draw(&architecture, &data(), 0);
        assert_eq!(constant, Ok(vec![0.1; 6]));
        let given = InitialParameters::Given(vec![1.0; 6]).draw(&architecture, &data(), 0);
        assert_eq!(given, Ok(vec![1.0; 6]));
        let short = InitialParameters::Given(vec![1.0; 5]).draw(&architecture, &data(), 0);
        assert_eq!(short, Err(InitialError::Count { expected: 6, found: 5 }));
        let infinite = InitialParameters::Constant(f64::INFINITY).draw(&architecture, &data(), 0);
        assert_eq!(infinite, Err(InitialError::NotFinite { index: 0 }));
    }

    #[test]
    fn glorot_centres_the_first_layer_on_the_data() {
        let architecture = architecture(2, &[(6, Tanh)]);
        let p = InitialParameters::Glorot.draw(&architecture, &data(), 5).expect("finite");
        // At the mean of the data, every node is at the centre of its active range.
        let sums: Vec<f64> = (0..6).map(|q| p[q] + 3.0 * p[6 + q] - 40.0 * p[12 + q]).collect();
        assert_close(&sums, &[0.0; 6], 0.0, 1e-13);
        let radius = (6.0f64 / 8.0).sqrt();
        let deviation = [(8.0f64 / 3.0).sqrt(), (800.0f64 / 3.0).sqrt()];
        for (row, deviation) in p[6..].chunks_exact(6).zip(deviation) {
            assert!(row.iter().all(|w| (w * deviation).abs() <= radius));
        }
    }

    #[test]
    fn nguyen_widrow_spreads_the_active_ranges_over_the_data() {
        let architecture = architecture(2, &[(5, Tanh)]);
        let p = InitialParameters::NguyenWidrow.draw(&architecture, &data(), 5).expect("finite");
        let norm = 0.7 * 5f64.sqrt() * 2.0;
        for q in 0..5 {
            // In units of half the range, every node's weights have this norm.
            let weights = [p[5 + q] * 2.0, p[10 + q] * 20.0];
            assert_close(&[(weights[0].powi(2) + weights[1].powi(2)).sqrt()], &[norm], 1e-14, 0.0);
            // At the centre of the data, the pre-activation is the evenly spread bias.
            let middle = p[q] + 3.0 * p[5 + q] - 40.0 * p[10 + q];
            assert_close(&[middle.abs()], &[norm * (q as f64 / 2.0 - 1.0).abs()], 1e-12, 1e-13);
        }
    }
}
