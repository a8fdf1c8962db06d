//! Activation functions in software, the same bits on every target.
//!
//! `tanh(x)`, the logistic `1 / (1 + exp(-x))` and the Gaussian `exp(-x^2)`: the functions
//! phi of equation `Phi func`, which [`crate::network`] applies to every node. They are
//! built only from IEEE 754 binary32 addition, subtraction, multiplication, division,
//! comparison and bit casts, in a fixed order and without fused multiply-add, so a
//! desktop's vector unit, an M4F and a soft-float M0 agree to the last bit.
//!
//! ```
//! use inner_network::activation::Activation;
//!
//! let mut values = [-1.0, 0.0, 1.0];
//! Activation::Tanh.apply(&mut values);
//! assert_eq!(values[1], 0.0);
//! assert_eq!(values[0], -values[2]); // odd bit for bit
//! ```
//!
//! # Equations
//!
//! - `tanh`, `a = |x| < 0.55`: `a - a (t P(t))` with `t = a^2`.
//! - `tanh`, `a >= 0.55`: `1 - 2 / (m + 2)` with `m = expm1(2 a)`. Start from
//!   `expm1(z) = z + z^2 Q(z)` at `z = a / 4`; three times `expm1(2 v) = m (m + 2)`,
//!   `m = expm1(v)`, lead to `2 a`. The sign of `x` is restored at the end.
//! - `exp(y) = 2^k (1 + (r + r^2 R(r)))`, `k` the integer nearest to `y / ln 2` and
//!   `r = y - k ln 2`.
//! - logistic: `s / (s + s exp(-x))` with `s = 2^-64`. The scale keeps `exp(-x)` from
//!   overflowing while the quotient is still a subnormal number.
//! - Gaussian: `exp(-(h^2 + l))` with `h` the upper 12 bits of `|x|` and
//!   `l = (|x| - h)(|x| + h)`, so that `h^2` is exact. This avoids the rounding error of
//!   `x^2`, which the exponential would multiply by up to 87.
//!
//! P, Q and R have degree 3, 4 and 4. `agent-core/scripts/fit_activations.py` fits them and
//! prints every constant of this file.
//!
//! # Cost
//!
//! Arithmetic operations per value, including divisions but not loads:
//!
//! | function | operations | divisions | other |
//! | --- | --- | --- | --- |
//! | `tanh` | 10 below 0.55, 21 above (31 in a vector) | 1 (0 below 0.55) | 1 comparison, sign |
//! | logistic | 22 | 1 | 2 comparisons, 2 integer operations |
//! | Gaussian | 26 | 0 | 1 comparison, 3 integer operations |
//!
//! No memory, no table, no unavoidable branch: `apply` becomes vector code on x86-64, and on a
//! Cortex-M it branches on `a < 0.55` and computes only one form.
//!
//! # Invariants
//!
//! Checked over all 2^32 floats by `examples/activation_error.rs`:
//!
//! - `tanh` is odd bit for bit (`-0.0` included), never decreases, and stays in [-1, 1].
//! - logistic never decreases and stays in [0, 1].
//! - Gaussian is even bit for bit, never increases with `|x|`, and stays in [0, 1].
//! - Infinities give the limits (1, -1, 0). NaN gives NaN, but *which* NaN differs between
//!   processors: callers refuse input that is not finite, as
//!   [`InnerNetwork::new`](crate::network::InnerNetwork::new) does with parameters.
//!
//! Why `tanh` never decreases: from 0.55 on every operation is a rounded monotone function
//! (the coefficients of Q are all positive), and so is their composition, however it is
//! rounded; an overflow to infinity gives exactly 1, so no clamping is needed. Below 0.55
//! and in the exponential, the last operation adds a small correction to an argument; the
//! rounding of the correction is smaller than the step of the argument. The seams are
//! verified by measurement.
//!
//! # Measured errors
//!
//! The largest error over all finite floats, subnormal ones included, in units in the last
//! place of the binade of the exact result (2^-149 for subnormal results):
//!
//! | function | ulp | at x |
//! | --- | --- | --- |
//! | `tanh` | 2.609 | ±0.5527 |
//! | logistic | 2.481 | -16.636 |
//! | Gaussian | 1.030 | ±9.1365 |
//!
//! `docs/decisions/0001-software-activations.md` compares them with alternatives.

#[cfg(test)]
mod laws;
#[cfg(test)]
mod tests;

use core::f32::consts::LOG2_E;

use serde::{Deserialize, Serialize};

/// Where `tanh` changes its form: just above atanh(1/2) = 0.5493, so that `1 - 2 / (m + 2)`
/// never gives a result in the finer binade below 1/2. Chosen, not fitted.
///
/// [`tanh_below`] and [`tanh_above`] are the two forms.
pub const TANH_SMALL_BELOW: f32 = 0.55;

/// P of the module's equations, lowest degree first: minimax in the relative error of
/// `tanh` on (0, 0.55^2], 0.62 * 2^-24 (`fit_activations.py`, `TANH_SMALL`).
const TANH_SMALL: [f32; 4] = [0.333_329_44, -0.133_207_22, 0.052_672_002, -0.016_437_877];

/// Q, lowest degree first: minimax in the relative error of `tanh` for x from 0.55 to 9.4,
/// 0.17 * 2^-24 (`fit_activations.py`, `TANH_LARGE`). All positive: see the invariants.
const TANH_LARGE: [f32; 5] =
    [0.500_003_93, 0.166_608_87, 0.041_965_596, 0.007_656_013_6, 0.002_050_456];

/// R, lowest degree first: minimax in the relative error of `exp` for |r| <= ln(2) / 2,
/// 0.05 * 2^-24 (`fit_activations.py`, `EXP`).
const EXP: [f32; 5] = [0.499_999_97, 0.166_665_23, 0.041_668_11, 0.008_369_166, 0.001_383_803_1];

/// 1.5 * 2^23. Floats of this size are spaced by one: adding it to a number rounds that to the
/// nearest integer and leaves the integer in the low bits.
const ROUNDER: f32 = 12_582_912.0;

/// ln 2 rounded to 16 bits: its product with any occurring k (8 bits) is exact.
const LN2_HIGH: f32 = 0.693_145_75;

/// ln 2 - [`LN2_HIGH`].
const LN2_LOW: f32 = 0.000_001_428_606_8;

/// exp(-104) < 2^-150, half of the smallest subnormal: smaller results round to 0.
const EXP_LIMIT: f32 = 104.0;

/// The same limit for exp(-x^2): 10.2^2 = 104.04.
const GAUSSIAN_LIMIT: f32 = 10.2;

/// exp(-20) < 2^-25: from here on 1 + exp(-x) is 1.
const LOGISTIC_SATURATION: f32 = 20.0;

/// Bias of the stored exponent (IEEE 754, binary32).
const EXPONENT_BIAS: u32 = 127;

/// Stored bits of the significand (IEEE 754, binary32).
const SIGNIFICAND_BITS: u32 = 23;

/// The exponential is computed times 2^64 or 2^-64, so that all results that matter are
/// normal numbers until the last operation: k is in -151..=151, the exponents that a normal
/// number can have are -126..=127.
const SCALE_EXPONENT: u32 = 64;

/// 2^-64.
const SCALE: f32 = f32::from_bits((EXPONENT_BIAS - SCALE_EXPONENT) << SIGNIFICAND_BITS);

/// The sign bit.
const SIGN: u32 = 1 << 31;

/// Clears the lower 12 of the 24 significand bits.
const UPPER_HALF: u32 = 0xffff_f000;

/// Makes the enumeration and its tables from one list: each activation's name in files, its value,
/// and what applies it to a slice. Packages number the activations in this order, so a new one goes
/// to the end.
macro_rules! activations {
    ($($(#[doc = $doc:literal])+ $variant:ident: $name:literal, $value:ident, $in_place:ident,)+) => {
        /// Which function the nodes of a layer apply; packages number them in this order.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
        pub enum Activation {
            $($(#[doc = $doc])+ $variant,)+
        }

        impl Activation {
            /// Every activation, in the order of the numbers in packages.
            pub const ALL: [Self; [$($name),+].len()] = [$(Self::$variant),+];

            /// Every activation with its name, as people write it in files.
            pub const NAMES: [(&'static str, Self); Self::ALL.len()] =
                [$(($name, Self::$variant)),+];

            /// Returns its name in [`Self::NAMES`].
            #[must_use]
            pub const fn name(self) -> &'static str {
                match self {
                    $(Self::$variant => $name,)+
                }
            }

            /// Returns the function's value at `x`.
            #[must_use]
            pub fn value(self, x: f32) -> f32 {
                match self {
                    $(Self::$variant => $value(x),)+
                }
            }

            /// Applies the function to every element of `values`, in place.
            ///
            /// Each element gets the bits that [`Self::value`] gives for it, whatever the length.
            #[inline(always)]
            pub fn apply(self, values: &mut [f32]) {
                match self {
                    $(Self::$variant => $in_place(values),)+
                }
            }

            /// Does the same as [`Self::apply`] in the caller's own code, so that a caller that is compiled
            /// for longer vectors uses them.
            #[inline(always)]
            pub fn apply_inlined(self, values: &mut [f32]) {
                match self {
                    $(Self::$variant => {
                        for value in values {
                            *value = $value(*value);
                        }
                    })+
                }
            }
        }
    };
}

activations! {
    /// Hyperbolic tangent, the paper's tangent-sigmoid.
    Tanh: "tanh", tanh, tanh_in_place,
    /// Logistic sigmoid 1/(1 + exp(-x)).
    Logistic: "logistic", logistic, logistic_in_place,
    /// Gaussian exp(-x^2).
    Gaussian: "gaussian", gaussian, gaussian_in_place,
}

// Plain loops: the compiler turns these, unlike manual groups of four, into vector code without
// shuffles. Each is a separate function, so that only its own constants are in registers.

#[inline(never)]
fn tanh_in_place(values: &mut [f32]) {
    let bits: &mut [u32] = bytemuck::cast_slice_mut(values);
    for bits in bits {
        *bits = tanh_bits(*bits);
    }
}

#[inline(never)]
fn logistic_in_place(values: &mut [f32]) {
    for value in values {
        *value = logistic(*value);
    }
}

#[inline(never)]
fn gaussian_in_place(values: &mut [f32]) {
    for value in values {
        *value = gaussian(*value);
    }
}

/// Hyperbolic tangent: odd, never decreasing, in [-1, 1].
///
/// Errors, cost, infinities and NaN: see the [module](self).
#[inline]
#[must_use]
pub fn tanh(x: f32) -> f32 {
    f32::from_bits(tanh_bits(x.to_bits()))
}

/// [`tanh`] of an `x` with `|x| <` [`TANH_SMALL_BELOW`], for callers that know that of several numbers.
#[inline(always)]
#[must_use]
pub fn tanh_below(x: f32) -> f32 {
    f32::from_bits(with_sign_of(x.to_bits(), tanh_small(f32::from_bits(x.to_bits() & !SIGN))))
}

/// [`tanh`] of all remaining `x`, NaN included.
#[inline(always)]
#[must_use]
pub fn tanh_above(x: f32) -> f32 {
    f32::from_bits(with_sign_of(x.to_bits(), tanh_large(f32::from_bits(x.to_bits() & !SIGN))))
}

/// [`tanh`] on bit patterns. Sign and comparison use integers (positive floats are in the order of
/// their bits), which avoids moves between register files, and a call on targets that compare floats
/// in software.
#[inline(always)]
fn tanh_bits(x: u32) -> u32 {
    let magnitude = f32::from_bits(x & !SIGN);
    let is_small = x & !SIGN < TANH_SMALL_BELOW.to_bits();
    let result = if is_small { tanh_small(magnitude) } else { tanh_large(magnitude) };
    with_sign_of(x, result)
}

#[inline(always)]
fn with_sign_of(x: u32, magnitude: f32) -> u32 {
    x & SIGN | magnitude.to_bits() & !SIGN
}

#[inline(always)]
fn tanh_small(magnitude: f32) -> f32 {
    let square = magnitude * magnitude;
    magnitude - magnitude * (square * cubic(TANH_SMALL, square))
}

#[inline(always)]
fn tanh_large(magnitude: f32) -> f32 {
    let quarter = 0.25 * magnitude;
    let mut expm1 = quarter + (quarter * quarter) * quartic(TANH_LARGE, quarter);
    expm1 = expm1 * (expm1 + 2.0);
    expm1 = expm1 * (expm1 + 2.0);
    expm1 = expm1 * (expm1 + 2.0);
    1.0 - 2.0 / (expm1 + 2.0)
}

/// Logistic sigmoid `1 / (1 + exp(-x))`: never decreasing, in [0, 1].
///
/// The error is relative for negative `x` too, down to the subnormal numbers.
/// Errors, cost, infinities and NaN: see the [module](self).
#[inline]
#[must_use]
pub fn logistic(x: f32) -> f32 {
    // Comparisons that are false for NaN let it through.
    let x = if x < -EXP_LIMIT { -EXP_LIMIT } else { x };
    let x = if x > LOGISTIC_SATURATION { LOGISTIC_SATURATION } else { x };
    // -0.0 is the neutral element of addition, so the compiler can drop it; 0.0 is not.
    SCALE / (SCALE + exp_scaled(-x, -0.0, EXPONENT_BIAS - SCALE_EXPONENT))
}

/// Gaussian `exp(-x^2)`: even, never increasing with `|x|`, in [0, 1].
///
/// Subnormal results (from |x| = 9.35 on) lose digits one by one; 0 from |x| = 10.2 on.
/// Errors, cost, infinities and NaN: see the [module](self).
#[inline]
#[must_use]
pub fn gaussian(x: f32) -> f32 {
    let magnitude = x.abs();
    let magnitude = if magnitude > GAUSSIAN_LIMIT { GAUSSIAN_LIMIT } else { magnitude };
    let head = f32::from_bits(magnitude.to_bits() & UPPER_HALF);
    let tail = (magnitude - head) * (magnitude + head);
    exp_scaled(-(head * head), -tail, EXPONENT_BIAS + SCALE_EXPONENT) * SCALE
}

/// `2^(biased_one - 127) exp(high + tail)`.
///
/// `|high| <= 104.04`, `tail` is small beside it, and the scaled result must be a normal
/// number. `high - k LN2_HIGH` is exact: both are multiples of the smaller of 2^-16 and the
/// ulp of `high`, which is 2^-25 or more unless k = 0, and their difference is below 1/2.
#[inline]
fn exp_scaled(high: f32, tail: f32, biased_one: u32) -> f32 {
    let rounded = (high + tail) * LOG2_E + ROUNDER;
    let k = rounded - ROUNDER;
    let r = (high - k * LN2_HIGH) + (tail - k * LN2_LOW);
    let significand = 1.0 + (r + (r * r) * quartic(EXP, r));
    // The bits of `rounded` are those of ROUNDER plus k; the shift drops all but k.
    let power = f32::from_bits(rounded.to_bits().wrapping_add(biased_one) << SIGNIFICAND_BITS);
    significand * power
}

// Written out, because the compiler keeps a loop when it optimises for size.

/// Evaluates the polynomial with these coefficients, lowest degree first, at `v`.
#[inline(always)]
fn cubic([c0, c1, c2, c3]: [f32; 4], v: f32) -> f32 {
    ((c3 * v + c2) * v + c1) * v + c0
}

/// The same with one more degree.
#[inline(always)]
fn quartic([c0, c1, c2, c3, c4]: [f32; 5], v: f32) -> f32 {
    cubic([c1, c2, c3, c4], v) * v + c0
}
