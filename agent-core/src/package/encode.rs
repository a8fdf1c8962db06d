//! Encodes packages, in format 1 and by way of the other module in format 2.

use super::envelope::header;
use super::wire::{Counts, Metadata, WORD};
use super::{Format, HEADER_LENGTH, Package, TEST_VECTORS_MAX};
use crate::AgentId;
use crate::agent::exchange::ExchangeParams;

/// Why a package cannot be encoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum EncodeError {
    /// The buffer is too small, or the package too long for its header.
    Space,
    /// The numbers do not match the architecture, or there are too many.
    Counts {
        /// The count that the metadata requires.
        expected: usize,
        /// The count found.
        found: usize,
    },
    /// Format 1 has no room for an agent or a neighbour above 65535.
    Agent {
        /// The number.
        id: AgentId,
    },
    /// Format 1 has no epochs.
    Epoch {
        /// The package's epoch.
        epoch: u32,
    },
    /// Format 1 has no room for an exchange that is not the paper's.
    Exchange,
    /// Format 1 has no room for the field observer.
    Field,
    /// Format 1 has networks of the state only.
    KnownInputs,
    /// Format 2 has no permission to replace newer versions: it has epochs.
    Replaces,
}

impl core::fmt::Display for EncodeError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match *self {
            Self::Space => write!(f, "the buffer is too small for the package"),
            Self::Counts { expected, found } => {
                write!(f, "the package has {found} numbers, but its metadata requires {expected}")
            }
            Self::Agent { id } => {
                write!(f, "format 1 has agents up to 65535, not {id}; use package format 2")
            }
            Self::Epoch { epoch } => {
                write!(
                    f,
                    "format 1 has no package epochs, but this is of package epoch {epoch}; use package format 2"
                )
            }
            Self::Exchange => write!(
                f,
                "format 1 has no parameters of the exchange; leave out [exchange], or use package \
                 format 2"
            ),
            Self::Field => write!(
                f,
                "format 1 has no parameters of the field observer; leave out [observer], or use package \
                 format 2"
            ),
            Self::KnownInputs => write!(
                f,
                "format 1 has no known inputs of the network; leave out plant.inputs, or use package \
                 format 2"
            ),
            Self::Replaces => write!(
                f,
                "format 2 cannot replace newer versions; use a higher package epoch, or package format 1"
            ),
        }
    }
}

impl core::error::Error for EncodeError {}

impl Package<'_> {
    /// Encodes the unsigned package in this format at the start of `buffer`; returns its length.
    /// Format 1 has no limits for the trial and leaves them out.
    ///
    /// # Errors
    /// See [`EncodeError`]. This does not check whether a node would accept the package.
    pub fn encode(&self, format: Format, buffer: &mut [u8]) -> Result<usize, EncodeError> {
        match format {
            Format::One => self.encode_format1(buffer),
            Format::Two => self.encode_format2(buffer),
        }
    }

    fn encode_format1(&self, buffer: &mut [u8]) -> Result<usize, EncodeError> {
        if self.epoch != 0 {
            return Err(EncodeError::Epoch { epoch: self.epoch });
        }
        if self.node.exchange != ExchangeParams::PAPER {
            return Err(EncodeError::Exchange);
        }
        if !self.node.field.is_empty() {
            return Err(EncodeError::Field);
        }
        if self.known_inputs != 0 {
            return Err(EncodeError::KnownInputs);
        }
        let ids = self.node.neighbours.iter().chain([self.node.agent]);
        if let Some(id) = ids.into_iter().find(|&id| id > u16::MAX.into()) {
            return Err(EncodeError::Agent { id });
        }
        let body = buffer.get_mut(HEADER_LENGTH..).ok_or(EncodeError::Space)?;
        let length = self.encode_body(body)?;
        let body = body.get(..length).ok_or(EncodeError::Space)?;
        let header = header(body).ok_or(EncodeError::Space)?;
        let place = buffer.first_chunk_mut::<HEADER_LENGTH>().ok_or(EncodeError::Space)?;
        *place = header;
        Ok(HEADER_LENGTH + length)
    }

    fn encode_body(&self, body: &mut [u8]) -> Result<usize, EncodeError> {
        let found = self.check_counts()?;
        let length = postcard::to_slice(&(self.metadata()?, self.provenance), body);
        let length = length.map_err(|_| EncodeError::Space)?.len();
        let start = (HEADER_LENGTH + length).next_multiple_of(WORD) - HEADER_LENGTH;
        let end = start + WORD * found;
        body.get_mut(length..start).ok_or(EncodeError::Space)?.fill(0);
        let words = body.get_mut(start..end).ok_or(EncodeError::Space)?;
        let (words, _) = words.as_chunks_mut::<WORD>();
        for (word, number) in words.iter_mut().zip(self.numbers()) {
            *word = number.to_le_bytes();
        }
        Ok(end)
    }

    /// Returns how many numbers there are in format 1.
    ///
    /// # Errors
    /// [`EncodeError::Counts`] if the metadata require another count.
    pub(super) fn check_counts(&self) -> Result<usize, EncodeError> {
        let expected =
            Counts::new(&self.metadata()?, self.network.architecture(), self.dimension()).total();
        let found = self.numbers().count();
        if expected == found { Ok(found) } else { Err(EncodeError::Counts { expected, found }) }
    }

    fn metadata(&self) -> Result<Metadata<'_>, EncodeError> {
        let architecture = self.network.architecture();
        let vector_length = self.test_vector_length();
        let test_vectors = self.test_vectors.len() / vector_length.max(1);
        if test_vectors > TEST_VECTORS_MAX {
            let expected = TEST_VECTORS_MAX * vector_length;
            return Err(EncodeError::Counts { expected, found: self.test_vectors.len() });
        }
        Ok(Metadata {
            version: self.version,
            replaces: self.replaces,
            // The caller has checked that it fits.
            agent: self.node.agent as u16,
            outer_weights_on_switch: self.outer_weights_on_switch,
            // Bounded by the architecture and its number of outputs.
            inputs: architecture.inputs() as u8,
            layers: architecture.layers().iter().copied().collect(),
            outputs: self.node.outputs(self.dimension()) as u8,
            neighbours: self.node.neighbours,
            gain: self.node.gain.form(),
            outer_gain: self.node.outer_law.gain.form(),
            smoothness: self.node.outer_law.projection.smoothness,
            test_vectors: test_vectors as u8,
        })
    }

    /// Returns all numbers in the order of the format.
    fn numbers(&self) -> impl Iterator<Item = f32> + '_ {
        let (projection, trigger) = (&self.node.outer_law.projection, &self.node.trigger);
        let constants = [
            projection.radius,
            projection.boundary_layer,
            projection.smoothing,
            trigger.hold_error_weight,
            trigger.consensus_weight,
            trigger.threshold,
            self.node.step_size,
            self.broadcast_interval_min,
        ];
        let network = self.network.parameters().iter();
        let matrices = self.outer_weights.iter().chain(self.node.output_matrix);
        let gains = self.node.gain.entries().iter().chain(self.node.outer_law.gain.entries());
        let before = network.chain(matrices).chain(gains).chain(self.node.edge_weights);
        let limits = self.trained_box.low.iter().chain(self.trained_box.high);
        before.copied().chain(constants).chain(limits.chain(self.test_vectors).copied())
    }
}
