//! Packages to push: valid ones with increasing versions, and invalid ones of every kind.
//!
//! Validity is known from the bytes: a package is valid for an agent if exactly these bytes were
//! made for it here, with at least the version in use. The node's own checks are not involved.
//! node's own has a say in it.

use std::collections::BTreeMap;
use std::num::NonZeroU32;

use agent_core::package::{CHECKED_FIRST, digest};
use agent_core::wire::crc::crc32;
use host_sim::analysis::TriggerConstants;
use host_sim::engine::{RunOptions, Silent, run};
use host_sim::learning::trained::initial;
use host_sim::packages::{Draft, PackageBytes};
use host_sim::scenario::{PAPER, Scenario, SwitchIn, Window};
use rand::{Rng, RngExt};

use crate::sim::scenario_builder::{Described, network, picks};

/// Variants of each agent's trained network.
const VARIANTS: usize = 3;

/// The defect of a package.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    Valid,
    /// Valid, but already in use.
    InUse,
    /// One bit differs.
    Flipped,
    /// The end is missing.
    Truncated,
    /// There are extra bytes at the end.
    Extended,
    OtherAgent,
    Older,
    OtherDimension,
    /// More features than the node's capacity.
    TooLarge,
    /// A random body with correct length and checksum.
    RandomBody,
    /// A test vector differs in one bit, with a correct checksum.
    OtherTestVector,
    /// A weight is NaN, with a correct checksum.
    NotFinite,
}

impl Kind {
    const BAD: [Self; 11] = [
        Self::InUse,
        Self::Flipped,
        Self::Truncated,
        Self::Extended,
        Self::OtherAgent,
        Self::Older,
        Self::OtherDimension,
        Self::TooLarge,
        Self::RandomBody,
        Self::OtherTestVector,
        Self::NotFinite,
    ];

    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Valid => "valid",
            Self::InUse => "valid, the one in use",
            Self::Flipped => "one bit flipped",
            Self::Truncated => "truncated",
            Self::Extended => "extended",
            Self::OtherAgent => "another agent's",
            Self::Older => "older",
            Self::OtherDimension => "of another dimension",
            Self::TooLarge => "too large",
            Self::RandomBody => "random body, right checksum",
            Self::OtherTestVector => "other test vector, right checksum",
            Self::NotFinite => "weight not a number, right checksum",
        }
    }

    /// Returns a kind that is invalid or useless.
    pub(super) fn any_bad(rng: &mut impl Rng) -> Self {
        Self::BAD[rng.random_range(0..Self::BAD.len())]
    }
}

/// Returns the paper's experiment, just long enough to learn from.
pub(super) fn scenario() -> Scenario {
    let mut scenario = Scenario::parse("paper", PAPER).unwrap();
    scenario.time.duration = 7.001;
    scenario.evaluation = Window { from: 6.5, to: 7.0 };
    scenario.learning[0].collect = Window { from: 2.0, to: 7.0 };
    scenario.learning[0].apply_at = 7.0;
    for recipe in &mut scenario.recipes {
        *recipe.trainer.epochs_max_mut() = 8;
        recipe.smoothing_window = Some(0.02);
        recipe.decimation = NonZeroU32::new(20);
        recipe.switch_in = SwitchIn::Always;
    }
    scenario
}

/// Creates packages.
#[derive(Debug)]
pub(super) struct Supply {
    /// For each agent, the trained network and variants of it.
    drafts: Vec<Vec<Draft>>,
    /// All packages made for each agent, by version.
    valid: Vec<BTreeMap<u32, Vec<u8>>>,
    other_dimension: Vec<u8>,
    too_large: Vec<u8>,
}

impl Supply {
    /// Trains the scenario's agents briefly.
    pub(super) fn new(scenario: &Scenario, rng: &mut impl Rng) -> Self {
        let options = RunOptions { seed: 0, learning: true, bounds: false };
        let result = run(scenario, options, &Silent).unwrap();
        let variants = result.trainings.iter().map(|training| {
            let mut draft = Draft::copy(&training.package.package());
            // A box that contains the plant's whole motion, so that a package can be confirmed.
            for (low, high) in draft.low.iter_mut().zip(&mut draft.high) {
                let width = *high - *low;
                (*low, *high) = (*low - width, *high + width);
            }
            let variant = |index: usize| {
                let mut variant = draft.clone();
                for weight in &mut variant.inner {
                    *weight *= 1.0 + index as f32 * rng.random_range(-0.02..0.02);
                }
                variant
            };
            (0..VARIANTS).map(variant).collect()
        });
        let drafts: Vec<_> = variants.collect();
        let mut supply = Self {
            valid: vec![BTreeMap::new(); drafts.len()],
            drafts,
            other_dimension: untrained(2, &[(4, "tanh"), (3, "tanh")]),
            too_large: untrained(3, &[(6, "tanh"), (12, "tanh")]),
        };
        for agent in 0..supply.drafts.len() {
            // An older one, until another exists.
            supply.make(agent, 0, 1);
            supply.make(agent, 0, 2);
        }
        supply
    }

    fn make(&mut self, agent: usize, variant: usize, version: u32) -> Vec<u8> {
        let draft = Draft { version, ..self.drafts[agent][variant].clone() };
        let bytes = draft.seal().unwrap().as_bytes().to_vec();
        self.valid[agent].insert(version, bytes.clone());
        bytes
    }

    /// Returns an agent's initial package; agents are counted from 0.
    pub(super) fn factory(&self, agent: usize) -> PackageBytes {
        PackageBytes::new(&self.valid[agent][&2]).unwrap()
    }

    /// Returns the version of these bytes if they are a package made for this agent.
    pub(super) fn version_of(&self, agent: usize, bytes: &[u8]) -> Option<u32> {
        // The version is not parsed: the newest packages are compared first.
        let mut newest_first = self.valid[agent].iter().rev();
        newest_first.find_map(|(&version, known)| (known == bytes).then_some(version))
    }

    /// Returns a package of this kind for an agent whose package in use has this version.
    pub(super) fn package(
        &mut self,
        kind: Kind,
        agent: usize,
        in_use: u32,
        rng: &mut impl Rng,
    ) -> Vec<u8> {
        let newest = *self.valid[agent].last_key_value().unwrap().0;
        let variant = rng.random_range(0..VARIANTS);
        let mut bytes = match kind {
            Kind::OtherAgent => {
                let other = (agent + rng.random_range(1..self.drafts.len())) % self.drafts.len();
                let version = *self.valid[other].last_key_value().unwrap().0;
                self.make(other, variant, version + 1)
            }
            Kind::Older => {
                let older: Vec<_> = self.valid[agent].range(..in_use).collect();
                older[rng.random_range(0..older.len())].1.clone()
            }
            Kind::OtherDimension => self.other_dimension.clone(),
            Kind::TooLarge => self.too_large.clone(),
            Kind::Valid => self.make(agent, variant, newest + 1),
            _ => self.valid[agent][&in_use].clone(),
        };
        let place = rng.random_range(0..bytes.len());
        match kind {
            Kind::Flipped => bytes[place] ^= 1 << rng.random_range(0..8),
            Kind::Truncated => bytes.truncate(place.max(1)),
            Kind::Extended => bytes.extend((0..=place % 100).map(|_| rng.random::<u8>())),
            Kind::RandomBody => {
                bytes[CHECKED_FIRST..].fill_with(|| rng.random());
                reseal(&mut bytes);
            }
            Kind::OtherTestVector => {
                let start = numbers(&bytes, |package| package.test_vectors);
                // Not an input but its expected output, which is at the end.
                let bit = rng.random_range(0..8 * 4 * 3);
                bytes[start.end - 1 - bit / 8] ^= 1 << (bit % 8);
                reseal(&mut bytes);
            }
            Kind::NotFinite => {
                let weights = numbers(&bytes, |package| package.outer_weights);
                let weight = weights.start + 4 * rng.random_range(0..weights.len() / 4);
                bytes[weight..weight + 4].copy_from_slice(&f32::NAN.to_le_bytes());
                reseal(&mut bytes);
            }
            _ => {}
        }
        bytes
    }
}

/// Returns a package whose network differs in size from the nodes'.
fn untrained(dimension: usize, layers: &[(u8, &str)]) -> Vec<u8> {
    let mut scenario_builder = Described::linear(dimension, "path", [(picks(dimension, [0]), 2)]);
    scenario_builder.network = network(layers, "2.0");
    let scenario = scenario_builder.scenario();
    let network = scenario.network.as_ref().unwrap();
    let inner = vec![0.1; network.architecture.parameter_count()];
    let trigger = TriggerConstants::new(&scenario);
    initial(&scenario, &trigger, network, &inner, 0, 0).unwrap().as_bytes().to_vec()
}

/// Returns the range of these numbers in the package.
fn numbers(
    bytes: &[u8],
    part: impl for<'p> Fn(&agent_core::package::Package<'p>) -> &'p [f32],
) -> std::ops::Range<usize> {
    let package = PackageBytes::new(bytes).unwrap();
    let package = package.package();
    let wanted: Vec<u8> = part(&package).iter().flat_map(|number| number.to_le_bytes()).collect();
    let start = bytes.windows(wanted.len()).position(|window| window == wanted).unwrap();
    start..start + wanted.len()
}

/// Corrects checksums and digest of a package of format 2.
fn reseal(bytes: &mut [u8]) {
    let (start, sections) = bytes.split_at_mut(CHECKED_FIRST);
    start[48..52].copy_from_slice(&crc32(&[sections]).to_le_bytes());
    start[52..84].copy_from_slice(&digest(sections));
    let checksum = crc32(&[&start[..124]]);
    start[124..128].copy_from_slice(&checksum.to_be_bytes());
}
