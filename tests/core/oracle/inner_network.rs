//! The inner network (`Phi func`) with each activation after the affine map:
//! `a_q = phi_q(W_q^T a_(q-1) + b_q)`.

use nalgebra::{DMatrix, DVector};

/// A bounded continuous activation function.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Activation {
    /// `tanh(x)`.
    Tanh,
    /// `1 / (1 + exp(-x))`.
    Logistic,
    /// `exp(-x^2)`.
    Gaussian,
}

impl Activation {
    /// The function's value.
    pub(crate) fn value(self, x: f64) -> f64 {
        match self {
            Self::Tanh => x.tanh(),
            Self::Logistic => 1.0 / (1.0 + (-x).exp()),
            Self::Gaussian => (-x * x).exp(),
        }
    }

    /// The function's derivative.
    pub(crate) fn slope(self, x: f64) -> f64 {
        let value = self.value(x);
        match self {
            Self::Tanh => 1.0 - value * value,
            Self::Logistic => value * (1.0 - value),
            Self::Gaussian => -2.0 * x * value,
        }
    }

    /// The largest magnitude of the second derivative:
    /// `4 / (3 sqrt 3)`, `1 / (6 sqrt 3)` and 2.
    pub(crate) fn curvature(self) -> f64 {
        match self {
            Self::Tanh => 4.0 / 27.0f64.sqrt(),
            Self::Logistic => 0.5 / 27.0f64.sqrt(),
            Self::Gaussian => 2.0,
        }
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
            layer.affine(&input).map(|sum| layer.activation.value(sum))
        })
    }
}

#[test]
fn slopes_and_curvatures_match_finite_differences() {
    for activation in [Activation::Tanh, Activation::Logistic, Activation::Gaussian] {
        let mut largest = 0.0f64;
        for x in (-4000..=4000).map(|step| f64::from(step) * 1e-3) {
            let (width, value) = (1e-4, |x| activation.value(x));
            let slope = (value(x + width) - value(x - width)) / (2.0 * width);
            // Truncation: the third derivative is below 8, times width^2 / 6.
            assert!(test_support::close(activation.slope(x), slope, 0.0, 2e-8));
            let curvature =
                (activation.slope(x + width) - activation.slope(x - width)) / (2.0 * width);
            largest = largest.max(curvature.abs());
        }
        assert!(test_support::close(largest, activation.curvature(), 1e-5, 0.0));
    }
}
