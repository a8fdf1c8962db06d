//! Polynomials of the state and the known inputs in place of a network, fitted by least squares as in sparse identification
//! of dynamics, without its thresholds.
//!
//! The state is scaled so that the training samples fill [-1, 1] in each component, and limited to that
//! range, because a cubic fitted inside says nothing outside. Features are all monomials up to the
//! third degree, or up to a lower one if these are more than a layer has nodes (more than 5 states:
//! 2; more than 9: 1).
//!
//! The fit solves the normal equations with a small ridge, in a fixed order.

use agent_core::observer::network::LAYER_WIDTH_MAX;
use nalgebra::{Cholesky, DMatrix};

use crate::training::Dataset;

/// Highest degree.
const DEGREE: usize = 3;

/// Ridge relative to the mean of the squares of the features.
const RIDGE: f64 = 1e-8;

/// All monomials of a scaled state.
#[derive(Clone, Debug, PartialEq)]
pub struct Polynomial {
    /// Middle of each component's range.
    middle: Vec<f32>,
    /// One over half of each component's range; all 0 before training.
    scale: Vec<f32>,
    degree: usize,
}

impl Polynomial {
    /// Creates the polynomials for samples with these smallest and largest components. Without finite
    /// limits, as before training, all features are 0.
    #[must_use]
    pub fn new(low: &[f32], high: &[f32]) -> Self {
        let limits = || low.iter().zip(high);
        let half = |(&low, &high): (&f32, &f32)| 0.5 * (high - low);
        let is_trained = limits().map(half).all(f32::is_finite);
        let scale = |limits: (&f32, &f32)| match half(limits) {
            half if is_trained && half > 0.0 => 1.0 / half,
            _ => 0.0,
        };
        Self {
            middle: limits().map(|(&low, &high)| 0.5 * low + 0.5 * high).collect(),
            scale: limits().map(scale).collect(),
            degree: if is_trained { degree(low.len()) } else { 0 },
        }
    }

    /// Returns the number of variables.
    #[must_use]
    pub fn dimension(&self) -> usize {
        self.middle.len()
    }

    /// Returns the number of monomials.
    #[must_use]
    pub fn count(&self) -> usize {
        count(self.dimension())
    }

    /// Returns how far `x`, shape `[n]`, is outside the range of the training samples in each component, as a share of
    /// its width; nothing before training.
    pub fn outside<'x>(
        &'x self,
        x: impl Iterator<Item = f32> + 'x,
    ) -> impl Iterator<Item = f32> + 'x {
        let scaled = x.zip(self.middle.iter().zip(&self.scale));
        let scaled = scaled.filter(|_| self.degree > 0);
        scaled.map(|(x, (middle, scale))| 0.5 * (((x - middle) * scale).abs() - 1.0).max(0.0))
    }

    /// Writes the monomials at `x`, shape `[n]`, to `outputs`; `None` if a length does not fit.
    pub(super) fn features<'o>(&self, x: &[f32], outputs: &'o mut [f32]) -> Option<&'o [f32]> {
        let n = self.dimension();
        let outputs = outputs.get_mut(..self.count()).filter(|_| x.len() == n)?;
        outputs.fill(0.0);
        if self.degree == 0 {
            return Some(outputs);
        }
        let mut scaled = [0.0f32; LAYER_WIDTH_MAX];
        let scaled = scaled.get_mut(..n)?;
        for (c, scaled) in scaled.iter_mut().enumerate() {
            *scaled = ((x[c] - self.middle[c]) * self.scale[c]).clamp(-1.0, 1.0);
        }
        let mut places = outputs.iter_mut();
        *places.next()? = 1.0;
        for i in 0..n {
            *places.next()? = scaled[i];
            for j in (0..=i).filter(|_| self.degree >= 2) {
                let product = scaled[i] * scaled[j];
                *places.next()? = product;
                for scaled in scaled.iter().take(j + 1).filter(|_| self.degree >= 3) {
                    *places.next()? = product * scaled;
                }
            }
        }
        Some(outputs)
    }

    /// Returns the outer weights, row by row, shape `[L, n]`, that fit the targets of `data` best;
    /// `None` if there is no finite solution.
    #[must_use]
    pub fn fit(&self, data: &Dataset) -> Option<Vec<f32>> {
        let (count, n) = (self.count(), data.dimension());
        let mut squares = DMatrix::<f64>::zeros(count, count);
        let mut products = DMatrix::<f64>::zeros(count, n);
        let mut outputs = [0.0; LAYER_WIDTH_MAX];
        let rows = data.inputs().chunks_exact(data.width()).zip(data.targets().chunks_exact(n));
        for (inputs, targets) in rows {
            let x: Vec<f32> = inputs.iter().map(|&x| x as f32).collect();
            let features = self.features(&x, &mut outputs)?;
            for (i, &feature) in features.iter().enumerate() {
                let feature = f64::from(feature);
                for (j, &other) in features.iter().enumerate().take(i + 1) {
                    squares[(i, j)] += feature * f64::from(other);
                }
                for (k, target) in targets.iter().enumerate() {
                    products[(i, k)] += feature * target;
                }
            }
        }
        squares.fill_upper_triangle_with_lower_triangle();
        let ridge = RIDGE * squares.trace() / count as f64;
        for i in 0..count {
            squares[(i, i)] += ridge;
        }
        let weights = Cholesky::new(squares)?.solve(&products);
        let rows: Vec<f32> = weights.transpose().iter().map(|&weight| weight as f32).collect();
        rows.iter().all(|weight| weight.is_finite()).then_some(rows)
    }
}

/// Returns the degree for `n` states.
fn degree(n: usize) -> usize {
    (1..=DEGREE).rev().find(|&degree| monomials(n, degree) <= LAYER_WIDTH_MAX).unwrap_or(1)
}

/// Returns the number of monomials for `n` states.
pub(super) fn count(n: usize) -> usize {
    monomials(n, degree(n))
}

/// Returns how many monomials of `n` variables have at most this degree.
fn monomials(n: usize, degree: usize) -> usize {
    (1..=degree).fold(1, |count, d| count * (n + d) / d)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_monomial_appears_once() {
        let polynomial = Polynomial::new(&[-1.0, -1.0, -1.0], &[1.0, 1.0, 1.0]);
        let mut outputs = [0.0; LAYER_WIDTH_MAX];
        // Powers of distinct primes tell all products apart.
        let features = polynomial.features(&[0.5, 0.25, 0.0625], &mut outputs).unwrap();
        assert_eq!(features.len(), 20);
        let mut exponents = Vec::new();
        for i in 0..=3u8 {
            for j in 0..=3 - i {
                for k in 0..=3 - i - j {
                    exponents.push(f32::from(i) + 2.0 * f32::from(j) + 4.0 * f32::from(k));
                }
            }
        }
        let mut expected: Vec<f32> = exponents.iter().map(|&power| 0.5f32.powf(power)).collect();
        let mut found = features.to_vec();
        expected.sort_by(f32::total_cmp);
        found.sort_by(f32::total_cmp);
        assert_eq!(found, expected);
        assert_eq!([1, 5, 6, 9, 10, 12].map(degree), [3, 3, 2, 2, 1, 1]);
        assert_eq!([1, 5, 6, 9, 10, 12].map(count), [4, 56, 28, 55, 11, 13]);
    }

    #[test]
    fn a_cubic_is_found_again() {
        let inputs: Vec<f64> = (0..400)
            .flat_map(|k| {
                let t = f64::from(k);
                [3.0 + 2.0 * libm::sin(0.7 * t), -1.0 + libm::cos(1.3 * t)]
            })
            .collect();
        let cubic = |x: f64, y: f64| [x - x * x * x / 3.0 - y, x * y * y];
        let targets: Vec<f64> = inputs.chunks_exact(2).flat_map(|x| cubic(x[0], x[1])).collect();
        let data = Dataset::new(2, inputs, targets).unwrap();
        let polynomial = Polynomial::new(&[1.0, -2.0], &[5.0, 0.0]);
        let weights = polynomial.fit(&data).unwrap();
        let mut outputs = [0.0; LAYER_WIDTH_MAX];
        let features = polynomial.features(&[2.0, -0.5], &mut outputs).unwrap();
        let value = |k: usize| -> f32 {
            features.iter().zip(weights.chunks_exact(2)).map(|(f, row)| f * row[k]).sum()
        };
        let expected = cubic(2.0, -0.5);
        assert!((f64::from(value(0)) - expected[0]).abs() < 1e-4, "{}", value(0));
        assert!((f64::from(value(1)) - expected[1]).abs() < 1e-4, "{}", value(1));
    }

    #[test]
    fn features_are_0_before_training_and_limited_after() {
        let mut outputs = [1.0; LAYER_WIDTH_MAX];
        let untrained = Polynomial::new(&[f32::MIN], &[f32::MAX]);
        assert_eq!(untrained.features(&[1.0], &mut outputs), Some(&[0.0; 4][..]));
        let trained = Polynomial::new(&[0.0], &[2.0]);
        assert_eq!(trained.features(&[9.0], &mut outputs), Some(&[1.0; 4][..]));
        assert_eq!(trained.features(&[1.0, 1.0], &mut outputs), None);
        // The range is 2 wide.
        let outside =
            |polynomial: &Polynomial, x| polynomial.outside([x].into_iter()).collect::<Vec<_>>();
        assert!(outside(&untrained, 9.0).is_empty());
        assert_eq!([-1.0, 0.5, 3.0].map(|x| outside(&trained, x)), [[0.5], [0.0], [0.5]]);
    }
}
