//! The postcard form of the metadata of a package of format 1, and the counts of numbers that follow from it.

use serde::{Deserialize, Serialize};

use super::{NeighbourIds, OnSwitch, Provenance, TrainingErrors, test_vector_length};
use crate::math::symmetric::MatrixForm;
use crate::observer::network::{Architecture, INNER_LAYERS_MAX, Layer};
use crate::wire::codec;

/// Bytes in a number, and its alignment.
pub(super) const WORD: usize = size_of::<f32>();

/// The bit of a kind that makes a section required.
pub const REQUIRED: u16 = 1 << 15;

/// Takes the next `count` numbers.
#[inline(never)]
pub(super) fn take<'a>(numbers: &mut &'a [f32], count: usize) -> &'a [f32] {
    // The caller has checked the total count.
    let (taken, rest) = numbers.split_at_checked(count).unwrap_or_default();
    *numbers = rest;
    taken
}

/// The contents of a body except for its origin and numbers.
#[derive(Serialize, Deserialize)]
pub(super) struct Metadata<'a> {
    pub(super) version: u32,
    pub(super) replaces: Option<u32>,
    pub(super) agent: u16,
    pub(super) outer_weights_on_switch: OnSwitch,
    pub(super) inputs: u8,
    pub(super) layers: heapless::Vec<Layer, INNER_LAYERS_MAX>,
    pub(super) outputs: u8,
    #[serde(borrow)]
    pub(super) neighbours: NeighbourIds<'a>,
    pub(super) gain: MatrixForm,
    pub(super) outer_gain: MatrixForm,
    pub(super) smoothness: u8,
    pub(super) test_vectors: u8,
}

/// Whether the origin of a package is decoded. A node has no use for it, and the code for it takes
/// 2 kB of flash; what reads files and lines decodes it, and refuses a package whose origin is
/// invalid.
#[derive(Clone, Copy)]
pub(super) enum Origin {
    Decoded,
    Skipped,
}

impl Origin {
    /// Reads the origin at the start of `bytes`, which ends the metadata; returns what follows it.
    // The caller says which, and its code for the other one is eliminated.
    #[inline(always)]
    pub(super) fn take(self, bytes: &[u8]) -> Option<(Provenance<'_>, &[u8])> {
        match self {
            Self::Decoded => codec::take(bytes),
            Self::Skipped => skip(bytes).map(|rest| (Provenance::NONE, rest)),
        }
    }
}

/// Returns what follows the origin at the start of `bytes`.
#[inline(never)]
fn skip<'a>(bytes: &'a [u8]) -> Option<&'a [u8]> {
    let (_, rest) = bytes.split_at_checked(size_of_val(&Provenance::NONE.scenario_hash))?;
    let (recipe, rest) = codec::take::<u32>(rest)?;
    let rest = rest.get(recipe as usize..)?;
    // Seed and samples end with their first byte below 0x80.
    let integer = |bytes: &'a [u8]| bytes.get(bytes.iter().position(|&byte| byte < 0x80)? + 1..);
    let rest = integer(integer(rest)?)?;
    let rest = match rest.split_first()? {
        (0, rest) => rest,
        (1, rest) => rest.get(size_of::<TrainingErrors>()..)?,
        _ => return None,
    };
    rest.get(size_of_val(&Provenance::NONE.tool_version)..)
}

/// How many numbers a body has of each kind, in their order.
pub(super) struct Counts {
    pub(super) inner: usize,
    pub(super) outer_weights: usize,
    pub(super) output_matrix: usize,
    pub(super) gain: usize,
    pub(super) outer_gain: usize,
    pub(super) edge_weights: usize,
    /// Inputs of the network.
    pub(super) inputs: usize,
    pub(super) test_vectors: usize,
}

/// `theta_0`, `beta`, `delta`, `phi_1`, `phi_2`, `epsilon / N`, `dt`, least broadcast interval.
pub(super) const CONSTANTS: usize = 8;

impl Counts {
    pub(super) fn new(
        metadata: &Metadata<'_>,
        architecture: &Architecture,
        dimension: usize,
    ) -> Self {
        let (n, features) = (dimension, architecture.features());
        let inputs = architecture.inputs();
        Self {
            inner: architecture.parameter_count(),
            outer_weights: features * n,
            output_matrix: usize::from(metadata.outputs) * n,
            gain: metadata.gain.count(n),
            outer_gain: metadata.outer_gain.count(features),
            edge_weights: metadata.neighbours.len(),
            inputs,
            test_vectors: usize::from(metadata.test_vectors)
                * test_vector_length(inputs, features, n),
        }
    }

    pub(super) fn total(&self) -> usize {
        self.inner
            + self.outer_weights
            + self.output_matrix
            + self.gain
            + self.outer_gain
            + self.edge_weights
            + CONSTANTS
            + 2 * self.inputs
            + self.test_vectors
    }
}
