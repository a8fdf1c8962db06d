//! Flash of a node, in memory, so that the node's own store can work on it.

use agent_core::store::MappedFlash;
use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash,
};

use super::{ERASED, Segment};
use crate::memory_map::WeightsRegion;

/// The weights region of a node that is not running. Writes by the store, such as ending a trial, change
/// only this copy.
#[derive(Debug)]
pub(crate) struct RamFlash {
    words: Vec<u32>,
    length: usize,
}

/// An access beyond its end.
#[derive(Debug)]
pub(crate) struct Outside;

impl NorFlashError for Outside {
    fn kind(&self) -> NorFlashErrorKind {
        NorFlashErrorKind::OutOfBounds
    }
}

impl RamFlash {
    /// Creates a flash with these bytes.
    pub(crate) fn new(bytes: &[u8]) -> Self {
        let mut words = vec![0u32; bytes.len().div_ceil(4)];
        bytemuck::cast_slice_mut(&mut words)[..bytes.len()].copy_from_slice(bytes);
        Self { words, length: bytes.len() }
    }

    /// Creates an erased flash for a region, with these segments of it.
    pub(super) fn holding<'s>(
        region: &WeightsRegion,
        segments: impl IntoIterator<Item = &'s Segment>,
    ) -> Self {
        let mut bytes = vec![ERASED; region.length as usize];
        for segment in segments {
            let start = (segment.address - region.origin) as usize;
            bytes[start..][..segment.bytes.len()].copy_from_slice(&segment.bytes);
        }
        Self::new(&bytes)
    }

    fn part(&mut self, offset: u32, length: usize) -> Result<&mut [u8], Outside> {
        let all = &mut bytemuck::cast_slice_mut(&mut self.words)[..self.length];
        let start = offset as usize;
        start.checked_add(length).and_then(|end| all.get_mut(start..end)).ok_or(Outside)
    }
}

impl ErrorType for RamFlash {
    type Error = Outside;
}

impl ReadNorFlash for RamFlash {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), Outside> {
        bytes.copy_from_slice(self.part(offset, bytes.len())?);
        Ok(())
    }

    fn capacity(&self) -> usize {
        self.length
    }
}

// The smallest units, so that it serves every memory map.
impl NorFlash for RamFlash {
    const WRITE_SIZE: usize = 1;
    const ERASE_SIZE: usize = 1;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), Outside> {
        self.part(from, to.saturating_sub(from) as usize)?.fill(ERASED);
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Outside> {
        self.part(offset, bytes.len())?.copy_from_slice(bytes);
        Ok(())
    }
}

impl MappedFlash for RamFlash {
    fn mapped(&self) -> &[u8] {
        &bytemuck::cast_slice(&self.words)[..self.length]
    }
}
