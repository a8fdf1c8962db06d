//! Checks the documented properties and bounds on a sample of all floats, and on every float
//! near the points where the behaviour changes. `examples/activation_error.rs` checks all floats.

use super::laws::{Symmetry, law};
use super::*;
use core::f32::consts::LN_2;

/// A prime, so that a sweep covers every residue of the low bits: about 10^6 floats.
const SWEEP_STRIDE: usize = 4_099;

/// Floats on each side of a critical point.
const NEIGHBOURS: u32 = 200;

const INFINITY_BITS: u32 = 0x7f80_0000;

/// |value - reference| in ulps of the binary32 binade of `reference`.
fn ulp_error(value: f32, reference: f64) -> f64 {
    let exponent = libm::ilogb(reference).max(-126);
    libm::scalbn((f64::from(value) - reference).abs(), 23 - exponent)
}

/// Checks value, range and symmetry at `x` and `-x`, and order against the magnitude `before`, which
/// is smaller.
fn check(activation: Activation, before: f32, x: f32) {
    let (name, law) = (activation.name(), law(activation));
    let (positive, negative) = (activation.value(x), activation.value(-x));
    let (earlier, earlier_negative) = (activation.value(before), activation.value(-before));
    for (input, value) in [(x, positive), (-x, negative)] {
        let error = ulp_error(value, (law.reference)(f64::from(input)));
        assert!(error <= law.worst_ulp, "{name}({input:e}) = {value:e}: {error} ulp");
        assert!(
            (law.range.0..=law.range.1).contains(&value),
            "{name}({input:e}) = {value:e} is out of range"
        );
    }
    match law.symmetry {
        Symmetry::Odd => assert_eq!(negative.to_bits(), (-positive).to_bits(), "{x:e}"),
        Symmetry::Even => assert_eq!(negative.to_bits(), positive.to_bits(), "{x:e}"),
        Symmetry::None => {}
    }
    assert!(negative <= earlier_negative, "{name} rises from {:e} to {:e}", -before, -x);
    let ordered = if law.falls { positive <= earlier } else { positive >= earlier };
    assert!(ordered, "{name} is not monotone from {before:e} to {x:e}");
}

/// Checks every float near `point` > 0.
fn check_around(activation: Activation, point: f32) {
    let first = point.to_bits().saturating_sub(NEIGHBOURS);
    let last = (point.to_bits() + NEIGHBOURS).min(INFINITY_BITS);
    for bits in first..last {
        check(activation, f32::from_bits(bits), f32::from_bits(bits + 1));
    }
}

#[test]
fn a_sweep_over_all_floats_obeys_the_laws() {
    for activation in Activation::ALL {
        let mut before = 0.0;
        for bits in (0..=INFINITY_BITS).step_by(SWEEP_STRIDE) {
            let x = f32::from_bits(bits);
            check(activation, before, x);
            before = x;
        }
    }
}

#[test]
fn every_binade_edge_obeys_the_laws() {
    for activation in Activation::ALL {
        for exponent in 0..=255 {
            check_around(activation, f32::from_bits(exponent << SIGNIFICAND_BITS));
        }
    }
}

#[test]
fn every_seam_obeys_the_laws() {
    for activation in Activation::ALL {
        for point in [TANH_SMALL_BELOW, EXP_LIMIT, GAUSSIAN_LIMIT, LOGISTIC_SATURATION] {
            check_around(activation, point);
        }
        // Where tanh and the logistic become 1, where exp(-x) and exp(-x^2) leave the
        // normal numbers and where they become 0.
        for point in [9.01, 17.33, 87.34, 88.73, 103.97, 9.346, 10.197] {
            check_around(activation, point);
        }
        // Where the exponential switches to the next k: x, and x^2, halfway between two
        // multiples of ln 2.
        for k in 0u8..=150 {
            let seam = (f32::from(k) + 0.5) * LN_2;
            check_around(activation, seam);
            check_around(activation, libm::sqrtf(seam));
        }
    }
}

#[test]
fn limits_are_exact_and_nan_stays_nan() {
    assert_eq!(tanh(f32::INFINITY).to_bits(), 1.0f32.to_bits());
    assert_eq!(tanh(f32::NEG_INFINITY).to_bits(), (-1.0f32).to_bits());
    assert_eq!(tanh(-0.0).to_bits(), (-0.0f32).to_bits());
    assert_eq!(logistic(f32::INFINITY).to_bits(), 1.0f32.to_bits());
    assert_eq!(logistic(f32::NEG_INFINITY).to_bits(), 0.0f32.to_bits());
    assert_eq!(logistic(0.0).to_bits(), 0.5f32.to_bits());
    assert_eq!(gaussian(f32::INFINITY).to_bits(), 0.0f32.to_bits());
    assert_eq!(gaussian(0.0).to_bits(), 1.0f32.to_bits());
    // Also a NaN whose payload is in the bits that the Gaussian's split clears.
    for nan in [f32::NAN, -f32::NAN, f32::from_bits(INFINITY_BITS + 1)] {
        for activation in Activation::ALL {
            assert!(activation.value(nan).is_nan(), "{activation:?}");
        }
    }
}

#[test]
fn small_arguments_pass_through_tanh_unchanged() {
    for x in [f32::from_bits(1), f32::MIN_POSITIVE, 1e-30, 1e-5, -1e-5] {
        assert_eq!(tanh(x).to_bits(), x.to_bits());
    }
}

#[test]
fn apply_gives_the_bits_of_the_scalar_functions() {
    for activation in Activation::ALL {
        for length in 0..=64usize {
            let mut values = [0.0f32; 64];
            for (index, value) in values.iter_mut().enumerate() {
                *value = f32::from_bits(sample_bits(997 * length + index));
            }
            let mut applied = values;
            activation.apply(&mut applied[..length]);
            for (index, (&x, &y)) in values.iter().zip(&applied).enumerate() {
                let expected = if index < length { activation.value(x) } else { x };
                assert_eq!(y.to_bits(), expected.to_bits(), "{activation:?}({x:e})");
            }
        }
    }
}

/// Number of inputs of a golden hash.
const GOLDEN_SAMPLES: usize = 100_000;

/// Returns the bits of a float in (-128, 128), where the functions vary, with all exponents and
/// signs in turn.
fn sample_bits(index: usize) -> u32 {
    /// 2^32 / golden ratio, made odd: consecutive multiples fill the range evenly.
    const STEP: u32 = 0x9e37_79b9;
    const BELOW_128: u32 = 0x4300_0000;
    let index = u32::try_from(index).expect("the samples are few");
    let spread = index.wrapping_mul(STEP);
    ((spread >> 1) % BELOW_128) | (spread << 31)
}

/// FNV-1a, 64 bits, over the little-endian bytes of `words`.
fn fnv1a(words: impl Iterator<Item = u32>) -> u64 {
    const OFFSET_BASIS: u64 = 0xcbf2_9ce4_8422_2325;
    const PRIME: u64 = 0x0000_0100_0000_01b3;
    words
        .flat_map(u32::to_le_bytes)
        .fold(OFFSET_BASIS, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(PRIME))
}

#[test]
fn fnv1a_gives_the_published_hash() {
    // "foob", from the test vectors of the algorithm's authors.
    assert_eq!(fnv1a(core::iter::once(u32::from_le_bytes(*b"foob"))), 0xdd12_0e79_0c25_12af);
}

#[test]
fn golden_bits() {
    // Expected from every target, at every optimisation level.
    for activation in Activation::ALL {
        let outputs =
            (0..GOLDEN_SAMPLES).map(|i| activation.value(f32::from_bits(sample_bits(i))).to_bits());
        let hash = fnv1a(outputs);
        assert_eq!(hash, law(activation).golden, "{activation:?}: {hash:#018x}");
    }
    let golden_tanh: [(f32, u32); 6] = [
        (0.1, 0x3dcc_1ebc),
        (0.54, 0x3efc_68ec),
        (0.55, 0x3f00_2217),
        (1.0, 0x3f42_f7d6),
        (-2.5, 0xbf7c_92c1),
        (9.0, 0x3f7f_ffff),
    ];
    for (x, bits) in golden_tanh {
        assert_eq!(tanh(x).to_bits(), bits, "tanh({x})");
    }
}

#[test]
fn the_forms_of_tanh_are_tanh_where_they_hold() {
    for i in 0..GOLDEN_SAMPLES {
        let x = f32::from_bits(sample_bits(i));
        let form = if x.abs() < TANH_SMALL_BELOW { tanh_below } else { tanh_above };
        let (found, expected) = (form(x), tanh(x));
        assert!(found.to_bits() == expected.to_bits() || x.is_nan(), "{x}");
        assert_eq!(found.is_nan(), x.is_nan());
    }
}
