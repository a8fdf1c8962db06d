//! Exponential and hyperbolic tangent in f64, for whole rows at once.
//!
//! ```text
//! exp(y) = 2^k (1 + q),   k = round(y / ln 2),   q = exp(y − k ln 2) − 1
//! tanh(x) = sign(x) E / (E + 2),   E = exp(2|x|) − 1 = 2^k q + (2^k − 1)
//! ```
//!
//! `q` is the Taylor polynomial of degree 13 on |r| ≤ ln 2 / 2, whose first neglected term is
//! below 5e-18.
//!
//! Cost: about 20 multiplications and additions per value, without tables or branches, so that a
//! loop over a slice is vectorised; libm's functions branch and are not.
//!
//! Invariants: only multiplications, additions and bit operations, so the bits are the same on
//! every machine; |tanh| ≤ 1; tanh is odd; NaN stays NaN. The absolute error of `tanh` and the
//! relative error of `exp` are below 4e-16 (tested against libm).

use std::f64::consts::LOG2_E;

/// ln 2 with its last 21 bits zero, so that `k · LN_2_HIGH` is exact for |k| < 2^21.
const LN_2_HIGH: f64 = f64::from_bits(0x3fe6_2e42_fee0_0000);
/// ln 2 − [`LN_2_HIGH`].
const LN_2_LOW: f64 = 1.908_214_929_270_587_7e-10;
/// 1.5 · 2^52: adding it rounds to an integer, held in the low bits of the sum.
const ROUNDER: f64 = 6_755_399_441_055_744.0;
/// exp(−708) is the smallest integer power that is not subnormal.
const EXPONENT_MIN: f64 = -708.0;
/// tanh(20) rounds to 1.
const TANH_ONE: f64 = 20.0;

/// 1/j! for j = 13 down to 2.
const INVERSE_FACTORIALS: [f64; 12] = [
    1.0 / 6_227_020_800.0,
    1.0 / 479_001_600.0,
    1.0 / 39_916_800.0,
    1.0 / 3_628_800.0,
    1.0 / 362_880.0,
    1.0 / 40_320.0,
    1.0 / 5_040.0,
    1.0 / 720.0,
    1.0 / 120.0,
    1.0 / 24.0,
    1.0 / 6.0,
    1.0 / 2.0,
];

/// `(2^k, exp(r) − 1)` with `exp(y) = 2^k exp(r)`, for −708 ≤ y ≤ 709.
#[inline(always)]
fn reduced_exp(y: f64) -> (f64, f64) {
    let shifted = y * LOG2_E + ROUNDER;
    let k = shifted - ROUNDER;
    let r = (y - k * LN_2_HIGH) - k * LN_2_LOW;
    let scale = f64::from_bits((shifted.to_bits() << 52).wrapping_add(1.0f64.to_bits()));
    let mut tail = INVERSE_FACTORIALS[0];
    for coefficient in &INVERSE_FACTORIALS[1..] {
        tail = tail * r + coefficient;
    }
    (scale, r + r * r * tail)
}

/// Computes exp(y) for y ≤ 0; below −708 it returns exp(−708), about 3e-308.
#[inline(always)]
pub(super) fn exp_of_negative(y: f64) -> f64 {
    let y = if y < EXPONENT_MIN { EXPONENT_MIN } else { y };
    let (scale, q) = reduced_exp(y);
    scale + scale * q
}

/// Computes the hyperbolic tangent.
#[inline(always)]
pub(super) fn tanh(x: f64) -> f64 {
    let magnitude = x.abs();
    let magnitude = if magnitude > TANH_ONE { TANH_ONE } else { magnitude };
    let (scale, q) = reduced_exp(2.0 * magnitude);
    let e = scale * q + (scale - 1.0);
    (e / (e + 2.0)).copysign(x)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tanh_matches_libm() {
        let mut worst = 0.0f64;
        let mut previous = -1.0;
        for i in -400_000..=400_000 {
            let x = f64::from(i) * 6.1e-5;
            let value = tanh(x);
            worst = worst.max((value - libm::tanh(x)).abs());
            assert!(value.abs() <= 1.0);
            assert_eq!(value.to_bits(), (-tanh(-x)).to_bits());
            assert!(value >= previous - 2.3e-16, "{x}: rises, up to rounding");
            previous = value;
        }
        assert!(worst < 4e-16, "absolute error {worst:e}");
        for x in [1e-300, 1e-20, 1e-8, 1e-3, 0.1] {
            let error = (tanh(x) - libm::tanh(x)).abs() / libm::tanh(x);
            assert!(error < 5e-16, "relative error {error:e} at {x}");
        }
        assert_eq!(tanh(f64::INFINITY), 1.0);
        assert_eq!(tanh(f64::NEG_INFINITY), -1.0);
        assert_eq!(tanh(-0.0).to_bits(), (-0.0f64).to_bits());
        assert!(tanh(f64::NAN).is_nan());
    }

    #[test]
    fn exp_matches_libm() {
        let mut worst = 0.0f64;
        for i in 0..=700_000 {
            let y = -f64::from(i) * 1.01e-3;
            let expected = libm::exp(y);
            worst = worst.max((exp_of_negative(y) - expected).abs() / expected);
        }
        assert!(worst < 4e-16, "relative error {worst:e}");
        assert_eq!(exp_of_negative(0.0), 1.0);
        assert!(exp_of_negative(-1e300) < 4e-308);
        assert!(exp_of_negative(f64::NAN).is_nan());
    }
}
