//! From bytes to a package.

use super::wire::{CONSTANTS, Counts, Metadata};
use super::{
    Envelope, HEADER_LENGTH, NeighbourIds, Node, Package, PackageError, StateBox, TEST_VECTORS_MAX,
};
use crate::codec::Reader;
use crate::network::{Architecture, InnerNetwork};
use crate::outer_law::OuterLawParams;
use crate::projection::ProjectionParams;
use crate::trigger::TriggerParams;

/// Numbers are words of this many bytes, at addresses that are multiples of it.
pub(super) const WORD: usize = size_of::<f32>();

#[cfg(target_endian = "big")]
compile_error!("packages are used in place and their numbers are little-endian");

impl<'a> Package<'a> {
    /// The package that `bytes` hold, which must begin at an address that is a multiple of four.
    ///
    /// # Errors
    /// Whatever [`PackageError`] lists.
    pub fn decode(bytes: &'a [u8]) -> Result<Self, PackageError> {
        Self::from_envelope(&Envelope::open(bytes)?)
    }

    /// The package in an envelope.
    ///
    /// # Errors
    /// What [`PackageError`] lists about bodies.
    // Apart from its callers, so that what only decoding needs is off the stack in what follows.
    #[inline(never)]
    pub fn from_envelope(envelope: &Envelope<'a>) -> Result<Self, PackageError> {
        let mut reader = Reader::new(envelope.body);
        let metadata = Metadata::read(&mut reader).ok_or(PackageError::Malformed)?;
        let rest = reader.finish().ok_or(PackageError::Malformed)?;
        let numbers = numbers(envelope.body, rest)?;
        let architecture = Architecture::new(metadata.inputs.into(), &metadata.layers)
            .map_err(PackageError::Network)?;
        if !(1..=architecture.inputs()).contains(&usize::from(metadata.outputs)) {
            return Err(PackageError::Outputs { found: metadata.outputs.into() });
        }
        if usize::from(metadata.test_vectors) > TEST_VECTORS_MAX {
            return Err(PackageError::TestVectors { found: metadata.test_vectors.into() });
        }
        let neighbours = NeighbourIds::new(metadata.neighbours).ok_or(PackageError::Malformed)?;
        let counts = Counts::new(&metadata, &architecture);
        let wrong_count =
            PackageError::NumberCount { expected: counts.total(), found: numbers.len() };
        if numbers.len() != counts.total() {
            return Err(wrong_count);
        }
        if let Some(index) = numbers.iter().position(|number| !number.is_finite()) {
            return Err(PackageError::NotFinite { index });
        }
        if metadata.provenance.errors.is_some_and(|errors| !errors.is_finite()) {
            return Err(PackageError::TrainingErrorNotFinite);
        }
        let mut numbers = Numbers { rest: numbers, wrong_count };
        assemble(&metadata, architecture, neighbours, &counts, &mut numbers)
    }
}

/// The words that follow the metadata: `rest` after at most three zero bytes.
fn numbers<'a>(body: &[u8], rest: &'a [u8]) -> Result<&'a [f32], PackageError> {
    let end_of_metadata = HEADER_LENGTH + (body.len() - rest.len());
    let padding = end_of_metadata.next_multiple_of(WORD) - end_of_metadata;
    let (padding, words) = rest.split_at_checked(padding).ok_or(PackageError::Malformed)?;
    if padding.iter().any(|&byte| byte != 0) || !words.len().is_multiple_of(WORD) {
        return Err(PackageError::Malformed);
    }
    bytemuck::try_cast_slice(words).map_err(|_| PackageError::Alignment)
}

/// The numbers that have not been dealt out yet.
struct Numbers<'a> {
    rest: &'a [f32],
    /// What is wrong if they do not suffice.
    wrong_count: PackageError,
}

impl<'a> Numbers<'a> {
    fn take(&mut self, count: usize) -> Result<&'a [f32], PackageError> {
        let (taken, rest) = self.rest.split_at_checked(count).ok_or(self.wrong_count)?;
        self.rest = rest;
        Ok(taken)
    }
}

/// Deals out the numbers. Its result is the caller's, so that a package is not copied on its way.
fn assemble<'a>(
    metadata: &Metadata<'a>,
    architecture: Architecture,
    neighbours: NeighbourIds<'a>,
    counts: &Counts,
    numbers: &mut Numbers<'a>,
) -> Result<Package<'a>, PackageError> {
    let inner = numbers.take(counts.inner)?;
    let outer_weights = numbers.take(counts.outer_weights)?;
    let output_matrix = numbers.take(counts.output_matrix)?;
    let gain = numbers.take(counts.gain)?;
    let gain = metadata.gain.matrix(gain).ok_or(numbers.wrong_count)?;
    let outer_gain = numbers.take(counts.outer_gain)?;
    let outer_gain = metadata.outer_gain.matrix(outer_gain).ok_or(numbers.wrong_count)?;
    let edge_weights = numbers.take(counts.edge_weights)?;
    let &[
        radius,
        boundary_layer,
        smoothing,
        hold_error_weight,
        consensus_weight,
        threshold,
        step_size,
        broadcast_interval_min,
    ] = <&[f32; CONSTANTS]>::try_from(numbers.take(CONSTANTS)?).map_err(|_| numbers.wrong_count)?;
    let (low, high) = (numbers.take(counts.dimension)?, numbers.take(counts.dimension)?);
    let test_vectors = numbers.take(counts.test_vectors)?;
    let network = InnerNetwork::new(architecture, inner).map_err(PackageError::Network)?;
    Ok(Package {
        version: metadata.version,
        replaces: metadata.replaces,
        outer_weights_on_switch: metadata.outer_weights_on_switch,
        network,
        outer_weights,
        node: Node {
            agent: metadata.agent,
            output_matrix,
            gain,
            neighbours,
            edge_weights,
            outer_law: OuterLawParams {
                gain: outer_gain,
                projection: ProjectionParams {
                    radius,
                    boundary_layer,
                    smoothing,
                    smoothness: metadata.smoothness,
                },
            },
            trigger: TriggerParams { hold_error_weight, consensus_weight, threshold },
            step_size,
        },
        broadcast_interval_min,
        trained_box: StateBox { low, high },
        provenance: metadata.provenance,
        test_vectors,
    })
}
