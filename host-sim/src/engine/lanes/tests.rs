//! Lanes compared with the network itself, bit by bit.

use std::sync::Arc;

use agent_core::math::activation::Activation;
use agent_core::observer::features::Features;
use agent_core::observer::network::{
    Architecture, INNER_LAYERS_MAX, InnerNetwork, LAYER_WIDTH_MAX, Layer, Scratch,
};
use pulp::{Simd, WithSimd};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::*;

/// Returns the instruction sets of this machine.
pub(super) fn instruction_sets() -> Vec<Arch> {
    let mut sets = vec![Arch::Scalar, Arch::new()];
    #[cfg(target_arch = "x86_64")]
    sets.extend(pulp::x86::V3::try_new().map(Arch::V3));
    sets
}

/// Which NaN it is differs between processors.
fn bits(x: f32) -> u32 {
    if x.is_nan() { f32::NAN.to_bits() } else { x.to_bits() }
}

/// A source of random networks and inputs.
struct Draws(ChaCha8Rng);

impl Draws {
    /// Returns a number from 0 to `end`, exclusive.
    fn below(&mut self, end: usize) -> usize {
        (self.0.next_u32() as usize) % end
    }

    /// Returns a number of about this size.
    fn near(&mut self, size: f32) -> f32 {
        (self.0.next_u32() as f32 / 2_147_483_648.0 - 1.0) * size
    }

    /// Returns a finite number: usual, subnormal, huge, or with any bits.
    fn finite(&mut self) -> f32 {
        let any = f32::from_bits(self.0.next_u32());
        match self.below(8) {
            0 => self.near(1e-40),
            1 => self.near(f32::MAX),
            2 => -0.0,
            3 if any.is_finite() => any,
            _ => self.near(3.0),
        }
    }

    /// Returns any number.
    fn any(&mut self) -> f32 {
        match self.below(16) {
            0 => f32::INFINITY,
            1 => f32::NEG_INFINITY,
            2 => f32::NAN,
            3 => 0.0,
            _ => self.finite(),
        }
    }

    fn architecture(&mut self, inputs: usize) -> Architecture {
        let layers: Vec<_> = (0..1 + self.below(INNER_LAYERS_MAX))
            .map(|_| {
                let most = if self.below(4) == 0 { LAYER_WIDTH_MAX } else { 14 };
                let width = 1 + self.below(most) as u8;
                let activation = Activation::ALL[self.below(Activation::ALL.len())];
                Layer { width, activation }
            })
            .collect();
        Architecture::new(inputs, &layers).unwrap()
    }

    /// Returns a network with parameters of the size that keeps its sums small, or with any.
    fn network(&mut self, architecture: &Architecture, is_tame: bool) -> SharedNetwork {
        let parameters = (0..architecture.parameter_count())
            .map(|_| if is_tame { self.near(0.7) } else { self.finite() });
        InnerNetwork::new(architecture.clone(), parameters.collect()).unwrap()
    }
}

/// Compares every lane with its network, for each set of instructions.
fn compare<const N: usize>(draws: &mut Draws, is_tame: bool) {
    let architecture = draws.architecture(N);
    let count = BLOCK_MIN + draws.below(LANES + 1 - BLOCK_MIN);
    let shared = draws.network(&architecture, is_tame);
    let is_shared = draws.below(2) == 0;
    let networks: Vec<_> = (0..count)
        .map(|_| if is_shared { shared.clone() } else { draws.network(&architecture, is_tame) })
        .collect();
    let inputs: Vec<[f32; N]> = (0..count)
        .map(|_| core::array::from_fn(|_| if is_tame { draws.near(9.0) } else { draws.any() }))
        .collect();
    for arch in instruction_sets() {
        let mut lanes = Lanes::<N>::new(networks.iter().map(Some), LaneMode::Only(arch));
        // Twice: nothing may be left from the evaluation before.
        for turn in [1, 0] {
            lanes.evaluate(|agent| inputs[(agent + turn) % count]);
        }
        for (agent, (network, input)) in networks.iter().zip(&inputs).enumerate() {
            let computed = lanes.computed(agent, Some(network)).unwrap();
            assert_eq!(computed.input.map(bits), input.map(bits));
            let mut scratch = Scratch::NEW;
            let expected = network.features(input, &mut scratch).unwrap();
            let found: Vec<_> = computed.features.iter().copied().map(bits).collect();
            let expected: Vec<_> = expected.iter().copied().map(bits).collect();
            assert_eq!(found, expected, "{arch:?}, agent {agent} of {count}, {architecture:?}");
        }
    }
}

#[test]
fn every_lane_has_the_bits_of_its_network() {
    let mut draws = Draws(ChaCha8Rng::seed_from_u64(1));
    for turn in 0..150 {
        let is_tame = turn % 3 > 0;
        compare::<1>(&mut draws, is_tame);
        compare::<2>(&mut draws, is_tame);
        compare::<3>(&mut draws, is_tame);
        compare::<4>(&mut draws, is_tame);
        compare::<7>(&mut draws, is_tame);
        compare::<12>(&mut draws, is_tame);
    }
}

/// An activation in the code of one set of instructions.
struct Apply<'a> {
    activation: Activation,
    values: &'a mut [f32],
}

impl WithSimd for Apply<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        self.activation.apply_inlined(self.values);
    }
}

#[test]
fn activations_have_their_bits_in_every_lane() {
    let specials = [f32::INFINITY, f32::NEG_INFINITY, f32::NAN, 0.0, -0.0, f32::MAX, f32::MIN];
    let seams = [0.55, -0.55, 104.0, -104.0, 20.0, 10.2, -10.2, f32::MIN_POSITIVE];
    let near_seams =
        seams.iter().flat_map(|x: &f32| (0..16).map(|i| f32::from_bits(x.to_bits() + i - 8)));
    // A prime number, so that all parts of the number are exercised.
    let sample = (0..=u32::MAX).step_by(4_999).map(f32::from_bits);
    let inputs: Vec<f32> = specials.into_iter().chain(near_seams).chain(sample).collect();
    for activation in Activation::ALL {
        let expected: Vec<_> = inputs.iter().map(|&x| bits(activation.value(x))).collect();
        for arch in instruction_sets() {
            let mut values = inputs.clone();
            arch.dispatch(Apply { activation, values: &mut values });
            let found: Vec<_> = values.into_iter().map(bits).collect();
            assert!(found == expected, "{activation:?}, {arch:?}");
        }
    }
}

fn tanh_network(width: u8, parameter: f32) -> SharedNetwork {
    let layer = Layer { width, activation: Activation::Tanh };
    let architecture = Architecture::new(1, &[layer]).unwrap();
    let parameters = vec![parameter; architecture.parameter_count()];
    InnerNetwork::new(architecture, parameters.into()).unwrap()
}

#[test]
fn agents_are_grouped_by_architecture() {
    let (narrow, wide, rare) = (tanh_network(2, 0.1), tanh_network(3, 0.2), tanh_network(4, 0.3));
    let networks: Vec<Option<&SharedNetwork>> = (0..CHUNK)
        .map(|agent| match agent {
            7 => None,
            8 => Some(&rare),
            _ if agent % 2 == 0 => Some(&narrow),
            _ => Some(&wide),
        })
        .collect();
    let mut lanes = Lanes::<1>::new(networks.iter().copied(), LaneMode::Longest);
    lanes.evaluate(|agent| [agent as f32]);
    for (agent, network) in networks.iter().enumerate() {
        let count = lanes.computed(agent, *network).map(|computed| computed.features.len());
        let expected = match agent {
            // One agent with its architecture is not worth a block.
            7 | 8 => None,
            _ => Some(if agent % 2 == 0 { 2 } else { 3 }),
        };
        assert_eq!(count, expected, "{agent}");
    }
    assert!(lanes.blocks.iter().all(|block| block.parameters.is_none()));
    // Nothing is handed to an agent whose network has changed since, or that uses none now.
    let other = tanh_network(2, 0.1);
    assert!(lanes.computed(0, Some(&other)).is_none());
    assert!(lanes.computed(0, None).is_none());
    // More agents than a chunk has.
    assert!(lanes.computed(CHUNK, Some(&narrow)).is_none());
    let off = Lanes::<1>::new(networks.iter().copied(), LaneMode::Off);
    assert!((0..CHUNK).all(|agent| off.computed(agent, networks[agent]).is_none()));
}

/// A source that says when it is asked.
struct Asked;

impl Features for Asked {
    fn inputs(&self) -> usize {
        2
    }

    fn count(&self) -> usize {
        1
    }

    fn features<'s>(&'s self, x: &[f32], _: &'s mut Scratch) -> Option<&'s [f32]> {
        (x.len() == 2).then_some(&[-1.0])
    }
}

#[test]
fn features_are_handed_over_for_exactly_their_input() {
    let input = [0.0, 1.5];
    let computed = Some(Computed { input: &input, features: &[7.0] });
    let ahead = Ahead { source: &Asked, computed };
    assert_eq!((ahead.inputs(), ahead.count()), (2, 1));
    for (x, expected) in [
        (&[0.0, 1.5][..], Some(&[7.0][..])),
        // Equal, but not the same bits.
        (&[-0.0, 1.5], Some(&[-1.0])),
        (&[0.0, 1.500_000_1], Some(&[-1.0])),
        (&[0.0], None),
        (&[0.0, 1.5, 0.0], None),
    ] {
        assert_eq!(ahead.features(x, &mut Scratch::NEW.clone()), expected);
    }
    let without = Ahead::<_, 2> { source: &Asked, computed: None };
    assert_eq!(without.features(&input, &mut Scratch::NEW.clone()), Some(&[-1.0][..]));
}

#[test]
fn agents_with_the_same_parameters_share_them() {
    let shared = tanh_network(5, 0.1);
    let equal: SharedNetwork =
        InnerNetwork::new(shared.architecture().clone(), Arc::from(shared.parameters())).unwrap();
    let together = Lanes::<1>::new((0..CHUNK).map(|_| Some(&shared)), LaneMode::Longest);
    assert_eq!(together.blocks.len(), CHUNK / LANES);
    assert!(together.blocks.iter().all(|block| block.parameters.is_none()));
    let networks = (0..CHUNK).map(|agent| Some(if agent == 3 { &equal } else { &shared }));
    let apart = Lanes::<1>::new(networks, LaneMode::Longest);
    assert!(apart.blocks[0].parameters.is_some() && apart.blocks[1].parameters.is_none());
}
