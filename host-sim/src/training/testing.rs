//! Helpers for the unit tests of training.

use super::data::Dataset;
use agent_core::math::activation::Activation;
use agent_core::observer::network::{Architecture, Layer};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Asserts |found − expected| ≤ atol + rtol · |expected|, element by element.
#[track_caller]
pub(crate) fn assert_close(found: &[f64], expected: &[f64], rtol: f64, atol: f64) {
    assert_eq!(found.len(), expected.len(), "lengths");
    for (index, (found, expected)) in found.iter().zip(expected).enumerate() {
        let error = (found - expected).abs();
        let allowed = atol + rtol * expected.abs();
        assert!(
            error <= allowed,
            "element {index}: {found:e}, expected {expected:e} to {allowed:e}"
        );
    }
}

/// Returns the instruction sets of this machine, including scalar code.
pub(crate) fn instruction_sets() -> Vec<pulp::Arch> {
    let mut sets = vec![pulp::Arch::Scalar, pulp::Arch::new()];
    #[cfg(target_arch = "x86_64")]
    sets.extend(pulp::x86::V3::try_new().map(pulp::Arch::V3));
    sets
}

/// Returns values uniform in [−1, 1).
pub(crate) fn random_values(count: usize, seed: u64) -> Vec<f64> {
    let mut generator = ChaCha8Rng::seed_from_u64(seed);
    (0..count).map(|_| generator.next_u32() as f64 / 2_147_483_648.0 - 1.0).collect()
}

/// Returns a valid architecture.
pub(crate) fn architecture(inputs: usize, layers: &[(u8, Activation)]) -> Architecture {
    let layers: Vec<Layer> =
        layers.iter().map(|&(width, activation)| Layer { width, activation }).collect();
    Architecture::new(inputs, &layers).expect("valid architecture")
}

/// Returns random samples.
pub(crate) fn random_data(dimension: usize, samples: usize, seed: u64) -> Dataset {
    let inputs = random_values(dimension * samples, seed);
    let targets = random_values(dimension * samples, seed + 1);
    Dataset::new(dimension, inputs, targets).expect("valid data")
}
