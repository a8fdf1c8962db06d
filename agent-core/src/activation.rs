//! Activation functions.

/// Which function the nodes of a layer apply.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Activation {
    /// Hyperbolic tangent, the paper's tangent-sigmoid.
    Tanh,
    /// Logistic sigmoid 1/(1 + exp(-x)).
    Logistic,
    /// Gaussian exp(-x^2).
    Gaussian,
}

impl Activation {
    /// Applies the function to every element of `values`, in place.
    #[inline]
    pub fn apply(self, values: &mut [f32]) {
        match self {
            Self::Tanh => values.iter_mut().for_each(|v| *v = tanh(*v)),
            Self::Logistic => values.iter_mut().for_each(|v| *v = logistic(*v)),
            Self::Gaussian => values.iter_mut().for_each(|v| *v = gaussian(*v)),
        }
    }
}

/// Placeholder until the fitted functions land.
#[must_use]
pub fn tanh(x: f32) -> f32 {
    let x = x.clamp(-9.0, 9.0);
    let e = micromath::F32Ext::exp(2.0 * x);
    (e - 1.0) / (e + 1.0)
}

/// Placeholder until the fitted functions land.
#[must_use]
pub fn logistic(x: f32) -> f32 {
    0.5 + 0.5 * tanh(0.5 * x)
}

/// Placeholder until the fitted functions land.
#[must_use]
pub fn gaussian(x: f32) -> f32 {
    micromath::F32Ext::exp(-x * x)
}
