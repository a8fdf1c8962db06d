//! The inner network (`Phi func`) with each activation after the affine map:
//! `a_q = phi_q(W_q^T a_(q-1) + b_q)`.

use agent_core::math::activation::Activation;
use nalgebra::{DMatrix, DVector};

/// The function's value.
pub(crate) fn value(activation: Activation, x: f64) -> f64 {
    match activation {
        Activation::Tanh => x.tanh(),
        Activation::Logistic => 1.0 / (1.0 + (-x).exp()),
        Activation::Gaussian => (-x * x).exp(),
    }
}

/// The function's derivative.
pub(crate) fn slope(activation: Activation, x: f64) -> f64 {
    let value = value(activation, x);
    match activation {
        Activation::Tanh => 1.0 - value * value,
        Activation::Logistic => value * (1.0 - value),
        Activation::Gaussian => -2.0 * x * value,
    }
}

/// The largest magnitude that the second derivative has anywhere:
/// `4 / (3 sqrt 3)`, `1 / (6 sqrt 3)` and 2.
pub(crate) fn curvature(activation: Activation) -> f64 {
    match activation {
        Activation::Tanh => 4.0 / 27.0f64.sqrt(),
        Activation::Logistic => 0.5 / 27.0f64.sqrt(),
        Activation::Gaussian => 2.0,
    }
}

/// One inner layer.
#[derive(Clone, Debug)]
pub(crate) struct Layer {
    /// `W_q`, shape `[inputs, width]`.
    pub(crate) weights: DMatrix<f64>,
    /// `b_q`, shape `[width]`.
    pub(crate) biases: DVector<f64>,
    /// `phi_q`.
    pub(crate) activation: Activation,
}

impl Layer {
    /// `W_q^T a + b_q`.
    pub(crate) fn affine(&self, input: &DVector<f64>) -> DVector<f64> {
        self.weights.transpose() * input + &self.biases
    }
}

/// The inner layers, first to last.
#[derive(Clone, Debug)]
pub(crate) struct InnerNetwork {
    /// The layers.
    pub(crate) layers: Vec<Layer>,
}

impl InnerNetwork {
    /// `sigma(Phi_hat(x))`, shape `[L]`.
    pub(crate) fn features(&self, x: &DVector<f64>) -> DVector<f64> {
        self.layers.iter().fold(x.clone(), |input, layer| {
            layer.affine(&input).map(|sum| value(layer.activation, sum))
        })
    }
}

#[test]
fn slopes_and_curvatures_match_finite_differences() {
    for activation in Activation::ALL {
        let mut largest = 0.0f64;
        for x in (-4000..=4000).map(|step| f64::from(step) * 1e-3) {
            let (width, value) = (1e-4, |x| value(activation, x));
            let expected = (value(x + width) - value(x - width)) / (2.0 * width);
            // Truncation: the third derivative is below 8, times width^2 / 6.
            assert!(test_support::close(slope(activation, x), expected, 0.0, 2e-8));
            let curvature =
                (slope(activation, x + width) - slope(activation, x - width)) / (2.0 * width);
            largest = largest.max(curvature.abs());
        }
        assert!(test_support::close(largest, curvature(activation), 1e-5, 0.0));
    }
}
