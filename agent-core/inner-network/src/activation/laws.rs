//! What is known of each activation: an exact reference, its symmetry, its range and its measured
//! error. The unit tests and `examples/activation_error.rs` share this table.

use super::Activation;

/// How f(-x) follows from f(x).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Symmetry {
    Odd,
    Even,
    None,
}

/// What an activation must satisfy.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Law {
    /// The function in double precision.
    pub(crate) reference: fn(f64) -> f64,
    pub(crate) symmetry: Symmetry,
    /// Whether the values fall for x from 0 to +infinity; for x from 0 to -infinity all activations
    /// fall.
    pub(crate) falls: bool,
    /// Least and largest value.
    pub(crate) range: (f32, f32),
    /// The documented largest error, rounded up. \[ulp\]
    pub(crate) worst_ulp: f64,
    /// FNV-1a of 100,000 values, as the test `golden_bits` hashes them. For polynomials it comes
    /// from the binary32 model of `fit_activations.py --golden`, not from this code.
    pub(crate) golden: u64,
}

/// Returns the law of an activation.
pub(crate) const fn law(activation: Activation) -> Law {
    match activation {
        Activation::Tanh => Law {
            reference: libm::tanh,
            symmetry: Symmetry::Odd,
            falls: false,
            range: (-1.0, 1.0),
            worst_ulp: 2.609,
            golden: 0xed3e_6e94_a4d0_f88e,
        },
        Activation::Logistic => Law {
            reference: |x| 1.0 / (1.0 + libm::exp(-x)),
            symmetry: Symmetry::None,
            falls: false,
            range: (0.0, 1.0),
            worst_ulp: 2.481,
            golden: 0x08ca_cb3d_c3b5_1dea,
        },
        Activation::Gaussian => Law {
            // The square of a single-precision number is exact: it has 48 bits.
            reference: |x| libm::exp(-x * x),
            symmetry: Symmetry::Even,
            falls: true,
            range: (0.0, 1.0),
            worst_ulp: 1.030,
            golden: 0x7317_1064_9956_7cc2,
        },
    }
}
