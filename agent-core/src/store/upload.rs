//! Writes a package into a slot, in chunks of any size.
//!
//! The first bytes are kept in memory until the caller has checked them, so that a package that is
//! refused by its header costs no flash. After that, each erase unit is erased just before its
//! first word is written, even if it looks erased, because an interrupted erasure can look
//! complete. Whole words go straight from the chunk to flash and are read back; the rest of a chunk
//! is buffered until its word is complete.
//!
//! Memory: the header and one word of 32 bytes. Cost of a chunk: its bytes are written once,
//! compared once and added to the checksum once, plus an erasure for each unit it enters.

use super::flash::{MappedFlash, WORD_LENGTH_MAX, bytes_at, driver_error, erase_unit};
use super::record::Extent;
use super::{HEADER_LENGTH, Slot, StoreError};
use crate::wire::crc::Checksum;

/// An unfinished upload.
#[derive(Clone, Debug)]
pub(super) struct Upload {
    pub(super) slot: Slot,
    /// Whether the header has been checked, and bytes may have been erased.
    pub(super) is_started: bool,
    /// Offset of the slot in the region.
    start: u32,
    /// Announced length in bytes.
    pub(super) length: u32,
    /// Bytes received.
    pub(super) received: u32,
    /// Checksum of the bytes received.
    checksum: Checksum,
    /// Bytes written to flash, in whole words.
    written: u32,
    /// The first `received - written` bytes of the next word.
    word: [u8; WORD_LENGTH_MAX],
    /// The first bytes of the package.
    header: [u8; HEADER_LENGTH],
}

impl Upload {
    pub(super) fn new(slot: Slot, start: u32, length: u32) -> Self {
        Self {
            slot,
            is_started: false,
            start,
            length,
            received: 0,
            checksum: Checksum::new(),
            written: 0,
            word: [0; WORD_LENGTH_MAX],
            header: [0; HEADER_LENGTH],
        }
    }

    /// Returns length and checksum of the received bytes, for the record.
    pub(super) fn extent(&self) -> Extent {
        Extent { length: self.received, checksum: self.checksum.clone().finish() }
    }

    /// Returns the part of `bytes`, starting at `offset`, that is new; the rest must match what was
    /// received before.
    pub(super) fn unseen<'a, F: MappedFlash>(
        &self,
        flash: &F,
        offset: u32,
        bytes: &'a [u8],
    ) -> Result<&'a [u8], StoreError> {
        let gap = StoreError::Gap { received: self.received };
        let repeated = self.received.checked_sub(offset).ok_or(gap)?;
        let past_end = StoreError::PastEnd { length: self.length };
        let room = self.length.checked_sub(offset).ok_or(past_end)?;
        if u32::try_from(bytes.len()).map_or(true, |length| length > room) {
            return Err(past_end);
        }
        let (old, new) = bytes.split_at_checked(repeated as usize).unwrap_or((bytes, &[]));
        // Up to `written` they are in flash, the others in memory.
        let in_flash = self.written.saturating_sub(offset);
        let (first, second) = old.split_at_checked(in_flash as usize).unwrap_or((old, &[]));
        let from = offset.max(self.written).wrapping_sub(self.written);
        let waiting = if self.is_started { &self.word[..] } else { &self.header };
        let waiting = waiting.get(from as usize..).unwrap_or_default();
        let stored = bytes_at(flash, self.start.wrapping_add(offset), first.len() as u32);
        if stored != Some(first) || !waiting.starts_with(second) {
            return Err(StoreError::Conflict { offset });
        }
        Ok(new)
    }

    /// Takes as many of the next bytes as the header still needs, and returns the others.
    pub(super) fn take_header<'a>(&mut self, bytes: &'a [u8]) -> &'a [u8] {
        let room = self.header.get_mut(self.received as usize..).unwrap_or_default();
        let (now, later) = bytes.split_at_checked(room.len()).unwrap_or((bytes, &[]));
        room.iter_mut().zip(now).for_each(|(place, byte)| *place = *byte);
        // At most the length of the header.
        self.received = self.received.wrapping_add(now.len() as u32);
        self.checksum.update(now);
        later
    }

    /// Returns the header, once it is complete; a shorter package is all header.
    pub(super) fn header(&self) -> Option<&[u8]> {
        let length = (self.length as usize).min(HEADER_LENGTH);
        self.header.get(..length).filter(|_| self.received as usize >= length)
    }

    /// Writes the header's whole words, after it has been checked.
    pub(super) fn begin<F: MappedFlash>(&mut self, flash: &mut F) -> Result<(), StoreError> {
        self.is_started = true;
        let header = self.header.get(..self.received as usize).unwrap_or(&self.header);
        let mut rest = header;
        while rest.len() >= F::WRITE_SIZE {
            rest = program_some(flash, self.start, &mut self.written, rest)?;
        }
        self.word.iter_mut().zip(rest).for_each(|(place, byte)| *place = *byte);
        Ok(())
    }

    /// Returns whether a unit will be erased before the first `end` bytes are in flash. The first one is
    /// erased as soon as the header has been accepted.
    pub(super) fn erases_for<F: MappedFlash>(&self, end: u32) -> bool {
        let next_unit = self.written.checked_next_multiple_of(F::ERASE_SIZE as u32);
        self.is_started && next_unit.is_some_and(|unit| unit < end.min(self.length))
    }

    /// Appends the next bytes. After an error the slot's contents are undefined.
    pub(super) fn append<F: MappedFlash>(
        &mut self,
        flash: &mut F,
        bytes: &[u8],
    ) -> Result<(), StoreError> {
        // A repetition has nothing new, and may arrive when the last word is already padded.
        if bytes.is_empty() {
            return Ok(());
        }
        let mut rest = bytes;
        let waiting = self.received.saturating_sub(self.written) as usize;
        // Fits into 32 bits, as checked by the caller.
        self.received = self.received.wrapping_add(bytes.len() as u32);
        self.checksum.update(bytes);
        if waiting > 0 {
            let room = self.word.get_mut(waiting..F::WRITE_SIZE).unwrap_or_default();
            let taken = room.len().min(rest.len());
            let (now, later) = rest.split_at_checked(taken).unwrap_or((rest, &[]));
            for (place, byte) in room.iter_mut().zip(now) {
                *place = *byte;
            }
            if waiting.wrapping_add(taken) < F::WRITE_SIZE {
                return Ok(());
            }
            self.program_word(flash)?;
            rest = later;
        }
        while rest.len() >= F::WRITE_SIZE {
            rest = program_some(flash, self.start, &mut self.written, rest)?;
        }
        for (place, byte) in self.word.iter_mut().zip(rest) {
            *place = *byte;
        }
        Ok(())
    }

    /// Writes the last word, padded with the value of erased flash.
    pub(super) fn finish<F: MappedFlash>(&mut self, flash: &mut F) -> Result<(), StoreError> {
        let waiting = self.received.saturating_sub(self.written) as usize;
        if waiting == 0 {
            return Ok(());
        }
        self.word.iter_mut().skip(waiting).for_each(|byte| *byte = 0xff);
        self.program_word(flash)
    }

    fn program_word<F: MappedFlash>(&mut self, flash: &mut F) -> Result<(), StoreError> {
        let word = self.word.get(..F::WRITE_SIZE).unwrap_or_default();
        program_some(flash, self.start, &mut self.written, word).map(|_| ())
    }
}

/// Writes whole words up to the end of the erase unit, reads them back, and returns the other
/// bytes.
#[inline(never)]
fn program_some<'a, F: MappedFlash>(
    flash: &mut F,
    start: u32,
    written: &mut u32,
    bytes: &'a [u8],
) -> Result<&'a [u8], StoreError> {
    let room = F::ERASE_SIZE.wrapping_sub(*written as usize % F::ERASE_SIZE);
    let whole = bytes.len().wrapping_sub(bytes.len() % F::WRITE_SIZE);
    let (words, rest) = bytes.split_at_checked(room.min(whole)).unwrap_or((bytes, &[]));
    let offset = start.wrapping_add(*written);
    if written.is_multiple_of(F::ERASE_SIZE as u32) {
        erase_unit(flash, offset)?;
    }
    flash.write(offset, words).map_err(driver_error)?;
    if bytes_at(flash, offset, words.len() as u32) != Some(words) {
        return Err(StoreError::Verify { offset });
    }
    *written = written.wrapping_add(words.len() as u32);
    Ok(rest)
}
