//! What training knows of the activations: values and slopes in f64 for whole rows, and the ranges
//! that initial parameters are drawn for.
//!
//! Everything here that depends on the activation is a `match` without a default, so a new
//! activation does not compile until training knows it.
//!
//! Invariant: the same bits on every machine, as in [`super::elementary`].

use super::elementary::{exp_of_negative, tanh};
use agent_core::math::activation::Activation;
use pulp::{Simd, WithSimd};

/// Returns the least and the largest value of φ.
pub(super) fn output_range(activation: Activation) -> (f64, f64) {
    match activation {
        Activation::Tanh => (-1.0, 1.0),
        Activation::Logistic | Activation::Gaussian => (0.0, 1.0),
    }
}

/// Returns the half-width of the active range, outside of which φ hardly varies.
pub(super) fn active_half_width(activation: Activation) -> f64 {
    match activation {
        Activation::Tanh => 2.0,
        Activation::Logistic => 4.0,
        Activation::Gaussian => 1.0,
    }
}

/// `values = φ(pre_activation)`.
pub(super) struct Activate<'a> {
    pub(super) activation: Activation,
    pub(super) pre_activation: &'a [f64],
    pub(super) values: &'a mut [f64],
}

impl WithSimd for Activate<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let pairs = self.values.iter_mut().zip(self.pre_activation);
        // Loops, because closures might not be inlined and vectorised.
        match self.activation {
            Activation::Tanh => {
                for (value, z) in pairs {
                    *value = tanh(*z);
                }
            }
            Activation::Logistic => {
                for (value, z) in pairs {
                    *value = 0.5 + 0.5 * tanh(0.5 * z);
                }
            }
            Activation::Gaussian => {
                for (value, z) in pairs {
                    *value = exp_of_negative(-(z * z));
                }
            }
        }
    }
}

/// Number of samples propagated together. Sums over samples are taken batch by batch, so this
/// number affects the bits. With 64, the panels of a 12-wide layer fit the second-level cache and a
/// strip of them the first.
pub(super) const BATCH: usize = 64;

/// `sensitivities[p][o] *= φ'(pre_activation[p])`, where `values` is φ(pre_activation).
pub(super) struct ApplySlopes<'a> {
    pub(super) activation: Activation,
    pub(super) pre_activation: &'a [f64],
    pub(super) values: &'a [f64],
    pub(super) sensitivities: &'a mut [f64],
    /// Row length of the sensitivities, a multiple of [`BATCH`].
    pub(super) columns: usize,
}

impl WithSimd for ApplySlopes<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let (pre_activation, _) = self.pre_activation.as_chunks::<BATCH>();
        let (values, _) = self.values.as_chunks::<BATCH>();
        let nodes = pre_activation.iter().zip(values);
        for ((z, a), row) in nodes.zip(self.sensitivities.chunks_exact_mut(self.columns)) {
            let mut slopes = [0.0; BATCH];
            for s in 0..BATCH {
                slopes[s] = match self.activation {
                    Activation::Tanh => 1.0 - a[s] * a[s],
                    Activation::Logistic => a[s] * (1.0 - a[s]),
                    Activation::Gaussian => -2.0 * z[s] * a[s],
                };
            }
            for block in row.as_chunks_mut::<BATCH>().0 {
                for s in 0..BATCH {
                    block[s] *= slopes[s];
                }
            }
        }
    }
}
