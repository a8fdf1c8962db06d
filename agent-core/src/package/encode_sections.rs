//! Encodes packages in format 2.

use super::header::{CHECKED_FIRST, HEADER2_LENGTH, Header, digest};
use super::sections::{SECTION_HEADER_LENGTH, kind};
use super::wire::WORD;
use super::{EncodeError, Package, Provenance};
use crate::agent::exchange::ExchangeParams;
use crate::wire::crc::crc32;

/// Appends sections to a buffer.
struct Writer<'b> {
    buffer: &'b mut [u8],
    length: usize,
}

impl Writer<'_> {
    /// Returns the next `length` bytes.
    fn place(&mut self, length: usize) -> Result<&mut [u8], EncodeError> {
        let start = self.length;
        self.length = start.checked_add(length).ok_or(EncodeError::Space)?;
        self.buffer.get_mut(start..self.length).ok_or(EncodeError::Space)
    }

    fn bytes(&mut self, bytes: &[u8]) -> Result<(), EncodeError> {
        self.place(bytes.len())?.copy_from_slice(bytes);
        Ok(())
    }

    fn words(&mut self, numbers: &[f32]) -> Result<(), EncodeError> {
        numbers.iter().try_for_each(|number| self.bytes(&number.to_le_bytes()))
    }

    /// Appends a section with the content that `write` appends; nothing if there is none.
    fn section(
        &mut self,
        kind: u16,
        write: impl FnOnce(&mut Self) -> Result<(), EncodeError>,
    ) -> Result<(), EncodeError> {
        // An empty section takes no space, not even that of its header.
        let start = self.length;
        let content = start.checked_add(SECTION_HEADER_LENGTH).ok_or(EncodeError::Space)?;
        self.length = content;
        write(self)?;
        let length = self.length - content;
        if length == 0 {
            self.length = start;
            return Ok(());
        }
        self.place(length.wrapping_neg() % WORD)?.fill(0);
        let [low, high] = kind.to_le_bytes();
        let length = u32::try_from(length).map_err(|_| EncodeError::Space)?.to_le_bytes();
        let header = [[low, high, 0, 0], length];
        let place = self.buffer.get_mut(start..content).ok_or(EncodeError::Space)?;
        place.copy_from_slice(header.as_flattened());
        Ok(())
    }

    /// Appends a section with the postcard form of `value`.
    fn value(&mut self, kind: u16, value: &impl serde::Serialize) -> Result<(), EncodeError> {
        self.section(kind, |writer| {
            let rest = writer.buffer.get_mut(writer.length..).ok_or(EncodeError::Space)?;
            let length = postcard::to_slice(value, rest).map_err(|_| EncodeError::Space)?.len();
            writer.place(length).map(|_| ())
        })
    }
}

impl Package<'_> {
    pub(super) fn encode_format2(&self, buffer: &mut [u8]) -> Result<usize, EncodeError> {
        if self.replaces.is_some() {
            return Err(EncodeError::Replaces);
        }
        self.check_counts()?;
        let mut writer = Writer { buffer, length: CHECKED_FIRST };
        self.write_sections(&mut writer)?;
        let length = writer.length;
        let (header, rest) = buffer.split_first_chunk_mut().ok_or(EncodeError::Space)?;
        let (block, rest) =
            rest.split_at_mut_checked(CHECKED_FIRST - HEADER2_LENGTH).ok_or(EncodeError::Space)?;
        let sections = rest.get(..length - CHECKED_FIRST).ok_or(EncodeError::Space)?;
        block.fill(0);
        let fields = Header {
            agent: self.node.agent,
            serial: self.serial(),
            length: u32::try_from(length).map_err(|_| EncodeError::Space)?,
            dimension: self.dimension(),
            architecture: self.network.architecture().clone(),
            outputs: self.node.outputs(self.dimension()),
            neighbours: self.node.neighbours.len(),
            outer_weights_on_switch: self.outer_weights_on_switch,
            step_size: self.node.step_size,
            checksum: crc32(&[sections]),
        };
        *header = fields.encode(&digest(sections)).ok_or(EncodeError::Space)?;
        Ok(length)
    }

    fn write_sections(&self, writer: &mut Writer<'_>) -> Result<(), EncodeError> {
        let (node, law) = (&self.node, &self.node.outer_law);
        let (projection, trigger) = (&law.projection, &node.trigger);
        writer.section(kind::INNER, |w| w.words(self.network.parameters()))?;
        writer.section(kind::OUTER_WEIGHTS, |w| w.words(self.outer_weights))?;
        writer.section(kind::AGENT, |w| {
            let forms = [node.gain.form() as u8, law.gain.form() as u8];
            w.bytes(&forms)?;
            w.bytes(&[projection.smoothness, 0])?;
            w.words(node.output_matrix)?;
            w.words(node.gain.entries())?;
            w.words(law.gain.entries())?;
            w.words(node.edge_weights)?;
            node.neighbours.iter().try_for_each(|id| w.bytes(&id.to_le_bytes()))
        })?;
        writer.section(kind::CONSTANTS, |w| {
            w.words(&[
                projection.radius,
                projection.boundary_layer,
                projection.smoothing,
                trigger.hold_error_weight,
                trigger.consensus_weight,
                trigger.threshold,
                self.broadcast_interval_min,
            ])
        })?;
        writer.section(kind::TRAINED_BOX, |w| {
            w.words(self.trained_box.low)?;
            w.words(self.trained_box.high)
        })?;
        writer.section(kind::TEST_VECTORS, |w| w.words(self.test_vectors))?;
        if let Some(limits) = &self.trial {
            writer.value(kind::TRIAL, limits)?;
        }
        if self.provenance != Provenance::NONE {
            writer.value(kind::PROVENANCE, &self.provenance)?;
        }
        if node.exchange != ExchangeParams::PAPER {
            writer.section(kind::EXCHANGE, |w| {
                let words = node.exchange.words();
                words.iter().try_for_each(|word| w.bytes(&word.to_le_bytes()))
            })?;
        }
        writer.section(kind::FIELD, |w| w.words(node.field))?;
        Ok(())
    }
}
