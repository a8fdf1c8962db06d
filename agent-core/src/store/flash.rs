//! The interface to the flash driver.

use embedded_storage::nor_flash::{NorFlash, NorFlashError, ReadNorFlash};

use super::StoreError;

/// NOR flash that can also be read in place.
///
/// The store relies on the guarantees of [`NorFlash`]: erased bytes are 0xFF, a word is written
/// once between two erasures, an interrupted write leaves only its own words undefined, and an
/// interrupted erasure only its own units. A driver whose flash erases to another value must invert
/// reads and writes.
pub trait MappedFlash: NorFlash {
    /// Whether the chip stalls while it erases. A node on such a board says farewell to its
    /// neighbours first; `erase` then begins with a wait for the link, so that the frame gets out.
    const STALLS: bool = false;

    /// Returns the whole region from offset 0, with the contents that [`ReadNorFlash::read`]
    /// returns, also right after a write or an erasure. A driver for cached flash must invalidate
    /// the cache.
    ///
    /// The first byte must be at an address that is a multiple of 4, because the numbers of a
    /// package are used in place as 32-bit words. Otherwise packages are refused.
    fn mapped(&self) -> &[u8];
}

impl<F: MappedFlash> MappedFlash for &mut F {
    const STALLS: bool = F::STALLS;

    fn mapped(&self) -> &[u8] {
        F::mapped(self)
    }
}

/// Largest supported write size. \[byte\]
pub(super) const WORD_LENGTH_MAX: usize = 32;

/// Erases the unit that starts at `offset`.
pub(super) fn erase_unit<F: NorFlash>(flash: &mut F, offset: u32) -> Result<(), StoreError> {
    flash.erase(offset, offset.wrapping_add(F::ERASE_SIZE as u32)).map_err(driver_error)
}

/// Returns the `length` bytes at `offset`; `None` if they exceed the region.
pub(super) fn bytes_at<F: MappedFlash>(flash: &F, offset: u32, length: u32) -> Option<&[u8]> {
    let (offset, length) = (usize::try_from(offset).ok()?, usize::try_from(length).ok()?);
    flash.mapped().get(offset..)?.get(..length)
}

/// Converts a driver's error to its portable kind.
#[expect(clippy::needless_pass_by_value, reason = "passed to `map_err`")]
pub(super) fn driver_error<E: NorFlashError>(error: E) -> StoreError {
    StoreError::Flash(error.kind())
}

/// Fails to compile for flash whose write or erase size is not supported.
pub(super) const fn assert_units<F: NorFlash>() {
    assert!(F::WRITE_SIZE >= 1 && WORD_LENGTH_MAX.is_multiple_of(F::WRITE_SIZE));
    assert!(<F as ReadNorFlash>::READ_SIZE >= 1 && WORD_LENGTH_MAX.is_multiple_of(F::READ_SIZE));
    assert!(F::ERASE_SIZE >= 1 && F::ERASE_SIZE.is_multiple_of(F::WRITE_SIZE));
    assert!(F::ERASE_SIZE <= 1 << 31);
}
