//! Decodes packages.

use super::wire::{CONSTANTS, Counts, Metadata, Origin, WORD, take};
use super::{
    AgentConfig, Envelope, HEADER_LENGTH, Package, PackageError, Provenance, TEST_VECTORS_MAX,
    sections,
};
use crate::agent::exchange::ExchangeParams;
use crate::agent::region::StateBox;
use crate::observer::network::{Architecture, InnerNetwork};
use crate::observer::outer_law::OuterLawParams;
use crate::observer::projection::ProjectionParams;
use crate::observer::trigger::TriggerParams;
use crate::wire::codec;

#[cfg(target_endian = "big")]
compile_error!("packages are used in place and their numbers are little-endian");

impl<'a> Package<'a> {
    /// Decodes the package in `bytes`, which must start at an address that is a multiple of four.
    ///
    /// # Errors
    /// Any [`PackageError`].
    pub fn decode(bytes: &'a [u8]) -> Result<Self, PackageError> {
        Self::from_envelope(&Envelope::open(bytes)?)
    }

    /// Decodes a package from bytes that were decoded before and have not changed since; see
    /// [`Envelope::open_unchanged`]. Its origin is not decoded: it is [`Provenance::NONE`].
    ///
    /// # Errors
    /// Any [`PackageError`] except for checksums.
    pub fn decode_unchanged(bytes: &'a [u8]) -> Result<Self, PackageError> {
        Self::without_origin(&Envelope::open_unchanged(bytes)?)
    }

    /// Decodes the package in an envelope.
    ///
    /// # Errors
    /// Any [`PackageError`] about the body.
    pub fn from_envelope(envelope: &Envelope<'a>) -> Result<Self, PackageError> {
        match &envelope.header {
            None => from_body(envelope.body, Origin::Decoded),
            Some(header) => sections::decode(header, envelope.body, Origin::Decoded),
        }
    }

    /// Like [`Self::from_envelope`], but the origin is not decoded: it is [`Provenance::NONE`].
    ///
    /// # Errors
    /// Same as [`Self::from_envelope`], except for an invalid origin.
    // Separate from its callers, so that the stack used only for decoding is free again afterwards.
    #[inline(never)]
    pub fn without_origin(envelope: &Envelope<'a>) -> Result<Self, PackageError> {
        match &envelope.header {
            None => from_body(envelope.body, Origin::Skipped),
            Some(header) => sections::decode(header, envelope.body, Origin::Skipped),
        }
    }
}

/// Decodes the body of a package of format 1.
#[inline(always)] // One copy for each way to read the origin.
fn from_body(body: &[u8], origin: Origin) -> Result<Package<'_>, PackageError> {
    let malformed = PackageError::Malformed;
    let (metadata, rest) = codec::take::<Metadata<'_>>(body).ok_or(malformed)?;
    let (provenance, rest) = origin.take(rest).ok_or(malformed)?;
    let numbers = numbers(body, rest)?;
    let architecture = Architecture::new(metadata.inputs.into(), &metadata.layers)
        .map_err(PackageError::Network)?;
    if !(1..=architecture.inputs()).contains(&usize::from(metadata.outputs)) {
        return Err(PackageError::Outputs { found: metadata.outputs.into() });
    }
    if usize::from(metadata.test_vectors) > TEST_VECTORS_MAX {
        return Err(PackageError::TestVectors { found: metadata.test_vectors.into() });
    }
    let counts = Counts::new(&metadata, &architecture, architecture.inputs());
    let (expected, found) = (counts.total(), numbers.len());
    if expected != found {
        return Err(PackageError::NumberCount { expected, found });
    }
    if let Some(index) = numbers.iter().position(|number| !number.is_finite()) {
        return Err(PackageError::NotFinite { index });
    }
    if provenance.errors.is_some_and(|errors| !errors.is_finite()) {
        return Err(PackageError::TrainingErrorNotFinite);
    }
    Ok(Package { provenance, ..assemble(&metadata, architecture, &counts, numbers) })
}

/// Returns the words after the metadata: `rest` without at most three zero bytes of padding.
fn numbers<'a>(body: &[u8], rest: &'a [u8]) -> Result<&'a [f32], PackageError> {
    let end_of_metadata = HEADER_LENGTH + (body.len() - rest.len());
    let padding = end_of_metadata.next_multiple_of(WORD) - end_of_metadata;
    let (padding, words) = rest.split_at_checked(padding).ok_or(PackageError::Malformed)?;
    if padding.iter().any(|&byte| byte != 0) || !words.len().is_multiple_of(WORD) {
        return Err(PackageError::Malformed);
    }
    bytemuck::try_cast_slice(words).map_err(|_| PackageError::Alignment)
}

/// Assembles the package from the numbers, which are finite and match `counts`.
fn assemble<'a>(
    metadata: &Metadata<'a>,
    architecture: Architecture,
    counts: &Counts,
    mut numbers: &'a [f32],
) -> Package<'a> {
    let numbers = &mut numbers;
    let network = InnerNetwork::verified(architecture, take(numbers, counts.inner));
    let outer_weights = take(numbers, counts.outer_weights);
    let output_matrix = take(numbers, counts.output_matrix);
    let gain = metadata.gain.matrix(take(numbers, counts.gain));
    let outer_gain = metadata.outer_gain.matrix(take(numbers, counts.outer_gain));
    let edge_weights = take(numbers, counts.edge_weights);
    let constants = take(numbers, CONSTANTS).first_chunk().unwrap_or(&[0.0; CONSTANTS]);
    let &[
        radius,
        boundary_layer,
        smoothing,
        hold_error_weight,
        consensus_weight,
        threshold,
        step_size,
        broadcast_interval_min,
    ] = constants;
    let (low, high) = (take(numbers, counts.inputs), take(numbers, counts.inputs));
    let test_vectors = take(numbers, counts.test_vectors);
    Package {
        epoch: 0,
        version: metadata.version,
        replaces: metadata.replaces,
        known_inputs: 0,
        outer_weights_on_switch: metadata.outer_weights_on_switch,
        network,
        outer_weights,
        node: AgentConfig {
            agent: metadata.agent.into(),
            output_matrix,
            gain,
            neighbours: metadata.neighbours,
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
            exchange: ExchangeParams::PAPER,
            field: &[],
        },
        broadcast_interval_min,
        trained_box: StateBox { low, high },
        trial: None,
        provenance: Provenance::NONE,
        test_vectors,
    }
}
