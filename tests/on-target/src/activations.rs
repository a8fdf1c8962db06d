//! The activations.
//!
//! NaN is not tested: the core refuses it earlier, and its payload differs between processors.

use agent_core::math::activation::Activation;

use crate::digest::Digest;

/// A prime: the sweep covers every residue of the low bits. About 1,000 floats of each sign.
const SWEEP_STRIDE: u32 = 2_130_001;

const INFINITY_BITS: u32 = 0x7f80_0000;

/// Floats at which the behaviour changes; their neighbours are tested too.
const CRITICAL: [f32; 16] = [
    f32::from_bits(1),
    f32::MIN_POSITIVE,
    1e-30,
    1e-5,
    0.25,
    0.549_306_15,
    0.55,
    1.0,
    9.01,
    9.35,
    10.2,
    20.0,
    87.3,
    103.97,
    104.0,
    f32::MAX,
];

/// Number of tested floats on each side of a critical one.
const AROUND: u32 = 2;

#[inline(never)]
pub(crate) fn digest() -> u64 {
    let mut digest = Digest::NEW;
    let mut both_signs = |bits: u32| {
        for x in [f32::from_bits(bits), -f32::from_bits(bits)] {
            let single = Activation::ALL.map(|activation| activation.value(x));
            digest.floats(&single);
            // In a block, as layers do it, every value has to come out the same.
            for activation in Activation::ALL {
                let mut block = [x, 0.5, -x, -0.75, x, 0.0, x];
                activation.apply(&mut block);
                digest.floats(&block);
            }
        }
    };
    both_signs(0);
    for x in CRITICAL {
        let bits = x.to_bits();
        (bits - AROUND.min(bits)..=bits + AROUND)
            .filter(|&bits| bits <= INFINITY_BITS)
            .for_each(&mut both_signs);
    }
    both_signs(INFINITY_BITS);
    let mut bits = 0;
    while bits < INFINITY_BITS {
        both_signs(bits);
        bits += SWEEP_STRIDE;
    }
    digest.finish()
}
