//! The border to the flash driver.

use embedded_storage::nor_flash::{NorFlash, NorFlashError, ReadNorFlash};

use super::StoreError;

/// NOR flash that can also be read in place.
///
/// The store expects what [`NorFlash`] promises: erased bytes are 0xFF, a word is written once
/// between two erasures, a cut write leaves only its own words undefined and a cut erasure only
/// its own units. A driver that erases to another value must invert what it reads and writes.
pub trait MappedFlash: NorFlash {
    /// The whole region, offset 0 first: what [`ReadNorFlash::read`] would read, also right after
    /// a write or an erasure. A driver in front of which there is a cache must invalidate it.
    ///
    /// The first byte must lie at an address that is a multiple of 4, since the numbers of a
    /// package are used in place as words of 32 bits. Where it does not, packages are refused.
    fn mapped(&self) -> &[u8];
}

impl<F: MappedFlash> MappedFlash for &mut F {
    fn mapped(&self) -> &[u8] {
        F::mapped(self)
    }
}

/// The largest word that can be written. \[byte\]
pub(super) const WORD_LENGTH_MAX: usize = super::RECORD_LENGTH;

/// Erases the unit that begins at `offset`.
pub(super) fn erase_unit<F: NorFlash>(flash: &mut F, offset: u32) -> Result<(), StoreError> {
    flash.erase(offset, offset.wrapping_add(F::ERASE_SIZE as u32)).map_err(driver_error)
}

/// The `length` bytes at `offset`, if the region has them.
pub(super) fn bytes_at<F: MappedFlash>(flash: &F, offset: u32, length: u32) -> Option<&[u8]> {
    let (offset, length) = (usize::try_from(offset).ok()?, usize::try_from(length).ok()?);
    flash.mapped().get(offset..)?.get(..length)
}

/// What a driver's error says to someone who does not know the driver.
#[expect(clippy::needless_pass_by_value, reason = "it goes into `map_err`")]
pub(super) fn driver_error<E: NorFlashError>(error: E) -> StoreError {
    StoreError::Flash(error.kind())
}

/// Refuses to compile for flash whose units the formats here do not fit.
pub(super) const fn assert_units<F: NorFlash>() {
    assert!(F::WRITE_SIZE >= 1 && WORD_LENGTH_MAX.is_multiple_of(F::WRITE_SIZE));
    assert!(<F as ReadNorFlash>::READ_SIZE >= 1 && WORD_LENGTH_MAX.is_multiple_of(F::READ_SIZE));
    assert!(F::ERASE_SIZE >= 1 && F::ERASE_SIZE.is_multiple_of(F::WRITE_SIZE));
    assert!(F::ERASE_SIZE <= 1 << 31);
}
