//! Weight packages: the embedded one, damaged and changed ones, and checksums.

use agent_core::observer::network::Scratch;
use agent_core::package::{
    Capacity, HEADER_LENGTH, Package, Refusal, Requirements, StepRange, accept,
};
use agent_core::wire::crc::crc32;

use crate::Unusable;
use crate::digest::Digest;
use crate::draw::Draw;
use crate::meter::{Figure, Figures, Meter};
use crate::node::{FEATURES, N, NEIGHBOURS};

/// Bytes of the fixture.
pub(crate) const LENGTH: usize = 2_096;

/// Numbers are used in place, so a package is aligned to four bytes.
#[repr(C, align(4))]
pub(crate) struct Aligned(pub(crate) [u8; LENGTH]);

pub(crate) const FIXTURE: Aligned = Aligned(*include_bytes!("../fixtures/agent1.weights"));

static PLACED: Aligned = FIXTURE;

/// Position of the checksum, which covers everything else, in the header.
const CHECKSUM: core::ops::Range<usize> = HEADER_LENGTH - 4..HEADER_LENGTH;

/// Distance between the flipped bits of the package; a prime.
const FLIP_STRIDE: usize = 499;

const REQUIREMENTS: Requirements<'static> = Requirements {
    public_keys: &[],
    agent: None,
    highest: None,
    step_range: StepRange::ANY,
    capacity: Capacity {
        features: FEATURES,
        neighbours: NEIGHBOURS,
        gain_entries: 1,
        known_inputs: 0,
    },
};

/// Returns the embedded package's bytes.
pub(crate) fn bytes() -> &'static [u8] {
    &PLACED.0
}

/// Returns the embedded package.
pub(crate) fn package(scratch: &mut Scratch) -> Result<Package<'static>, Unusable> {
    accept::<N>(bytes(), &REQUIREMENTS, scratch)
        .map_err(|_| Unusable { what: "the embedded package is refused" })
}

/// Not inlined, so that its instructions are those on a node.
#[inline(never)]
fn is_accepted(bytes: &[u8], scratch: &mut Scratch) -> Result<u32, Refusal> {
    accept::<N>(bytes, &REQUIREMENTS, scratch).map(|package| package.version)
}

#[inline(never)]
pub(crate) fn digest(meter: &mut impl Meter, figures: &mut Figures) -> Result<u64, Unusable> {
    let mut digest = Digest::NEW;
    let mut scratch = Scratch::NEW;
    for _ in 0..4 {
        let (accepted, instructions) = meter.count(|| is_accepted(bytes(), &mut scratch));
        figures.add(Figure::Package, instructions);
        digest.number(outcome(&accepted));
    }

    let package = package(&mut scratch)?;
    digest.floats(package.network.parameters());
    digest.bytes(package.provenance.recipe.as_bytes());
    for vector in package.test_vectors() {
        let Some(input) = vector.input.first_chunk::<N>() else { continue };
        if let Some((features, output)) = package.evaluate::<N>(input, &mut scratch) {
            digest.floats(features);
            digest.floats(&output);
        }
    }

    // Damage that the checksum detects, then the same with a matching checksum, so that the inner
    // checks are reached: the format, the parameters' ranges, the test vectors.
    let mut copy = Aligned(FIXTURE.0);
    for bit in (0..8 * LENGTH).step_by(FLIP_STRIDE) {
        let flip = 1 << (bit % 8);
        copy.0[bit / 8] ^= flip;
        digest.number(outcome(&is_accepted(&copy.0, &mut scratch)));
        let checksum = crc32(&[&copy.0[..CHECKSUM.start], &copy.0[CHECKSUM.end..]]);
        copy.0[CHECKSUM].copy_from_slice(&checksum.to_le_bytes());
        digest.number(outcome(&is_accepted(&copy.0, &mut scratch)));
        copy.0[bit / 8] ^= flip;
        copy.0[CHECKSUM].copy_from_slice(&FIXTURE.0[CHECKSUM]);
    }

    let mut draw = Draw::new(0x0c0d_e5e5);
    copy.0.fill_with(|| draw.bits() as u8);
    for length in (0..LENGTH).step_by(131) {
        digest.number(crc32(&[&copy.0[..length]]));
    }
    Ok(digest.finish())
}

/// Returns a number for every result of acceptance.
fn outcome(accepted: &Result<u32, Refusal>) -> u32 {
    match accepted {
        Ok(version) => *version,
        Err(Refusal::Package(_)) => 1_001,
        Err(Refusal::Dimension { found, .. }) => 2_000 + *found as u32,
        Err(Refusal::Capacity { found, .. }) => 3_000 + *found as u32,
        Err(Refusal::Parameter(_)) => 1_004,
        Err(Refusal::NeighbourOrder { .. }) => 1_005,
        Err(Refusal::EmptyBox { component }) => 6_000 + *component as u32,
        Err(Refusal::TestVector { index }) => 7_000 + *index as u32,
        Err(_) => 1_008,
    }
}
