//! Code that the boards share below the traits: memory defined by the linker, state shared by the
//! program and its interrupts, the operator's key, and the reset after a fault.
//!
//! This is the library's only module with `unsafe` code. Boards add their own for registers.
//!
//! Cost: none compared with code written for one board.
#![allow(unsafe_code, reason = "reads memory-mapped flash and the painted stack")]

use core::cell::RefCell;

use agent_core::package::signature::PublicKey;
use critical_section::Mutex;
use embedded_storage::nor_flash::NorFlashErrorKind;

#[cfg(all(target_os = "none", target_arch = "arm"))]
use crate::{BootRecord, Epochs, Start};
#[cfg(all(target_os = "none", target_arch = "arm"))]
use agent_core::service::{PanicPlace, ResetCause};

use crate::WeightsRegion;

/// A region of memory-mapped flash.
///
/// Invariant: it has no other owner, and its contents change only through an exclusive borrow of
/// this value.
#[derive(Debug)]
pub struct MappedRegion {
    origin: usize,
    length: usize,
}

impl MappedRegion {
    /// Creates the region that `memory.x` reserves for weights.
    ///
    /// # Safety
    /// The region must be readable memory of this length, and this must be the only value for it.
    #[must_use]
    pub const unsafe fn new(region: &WeightsRegion) -> Self {
        Self { origin: region.origin, length: region.length }
    }

    /// Returns the length. \[byte\]
    #[must_use]
    pub const fn length(&self) -> usize {
        self.length
    }

    /// Returns the address at `offset` from the start.
    #[must_use]
    pub const fn address(&self, offset: u32) -> usize {
        self.origin + offset as usize
    }

    /// Returns the bytes.
    #[must_use]
    pub fn bytes(&self) -> &[u8] {
        let first = core::ptr::with_exposed_provenance(self.origin);
        // SAFETY: `new` promised readable memory of this length, in which any content is a valid `u8`;
        // it changes only through an exclusive borrow of `self`.
        unsafe { core::slice::from_raw_parts(first, self.length) }
    }

    /// Copies the bytes at `offset` to `bytes`.
    ///
    /// # Errors
    /// The range is not within the region.
    pub fn read(&self, offset: u32, bytes: &mut [u8]) -> Result<(), NorFlashErrorKind> {
        let stored = self.bytes().get(offset as usize..).and_then(|rest| rest.get(..bytes.len()));
        let stored = stored.ok_or(NorFlashErrorKind::OutOfBounds)?;
        bytes.iter_mut().zip(stored).for_each(|(byte, stored)| *byte = *stored);
        Ok(())
    }

    /// Returns the address and the value of each word of `bytes`, starting at `offset`, for flash
    /// that is written 32 bits at a time. Bytes after the last whole word are ignored.
    pub fn words<'b>(
        &mut self,
        offset: u32,
        bytes: &'b [u8],
    ) -> impl Iterator<Item = (*mut u32, u32)> + use<'b> {
        let first = core::ptr::with_exposed_provenance_mut::<u32>(self.address(offset));
        let (words, _) = bytes.as_chunks();
        let value = |word: &[u8; 4]| u32::from_le_bytes(*word);
        words.iter().enumerate().map(move |(i, word)| (first.wrapping_add(i), value(word)))
    }
}

/// State shared by an interrupt handler and the rest of the program, once initialised.
pub struct Shared<T>(Mutex<RefCell<Option<T>>>);

impl<T> Shared<T> {
    /// Creates uninitialised state.
    #[must_use]
    pub const fn new() -> Self {
        Self(Mutex::new(RefCell::new(None)))
    }

    /// Sets the value.
    pub fn set(&self, value: T) {
        critical_section::with(|token| self.0.borrow(token).replace(Some(value)));
    }

    /// Takes the value; the state is uninitialised afterwards.
    pub fn take(&self) -> Option<T> {
        critical_section::with(|token| self.0.take(token))
    }

    /// Calls `act` with interrupts off; `None` if the value is not set or already in use.
    pub fn with<R>(&self, act: impl FnOnce(&mut T) -> R) -> Option<R> {
        critical_section::with(|token| {
            let mut value = self.0.borrow(token).try_borrow_mut().ok()?;
            value.as_mut().map(act)
        })
    }
}

impl<T> Default for Shared<T> {
    fn default() -> Self {
        Self::new()
    }
}

/// The compiled-in key is not a public key, so no package can be trusted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct InvalidKey;

/// Returns the key that packages must be signed with, if the firmware was built with one.
///
/// # Errors
/// [`InvalidKey`]; a node must then refuse all packages.
#[cfg(feature = "signature")]
pub fn public_key() -> Result<Option<PublicKey>, InvalidKey> {
    const BYTES: [u8; 32] = crate::key_from_hex(env!(
        "NODE_PUBLIC_KEY",
        "set NODE_PUBLIC_KEY to the operator's public key in hexadecimal digits, which \
         `host-sim weights keygen` prints, or build without the `signature` feature"
    ));
    PublicKey::from_bytes(&BYTES).map(Some).map_err(|_| InvalidKey)
}

/// Returns the key that packages must be signed with, if the firmware was built with one.
///
/// # Errors
/// Never fails without the `signature` feature.
#[cfg(not(feature = "signature"))]
pub fn public_key() -> Result<Option<PublicKey>, InvalidKey> {
    Ok(None)
}

/// Returns the number of bytes at the end of the stack that still have the paint of cortex-m-rt's
/// feature `paint-stack`.
#[cfg(all(target_os = "none", target_arch = "arm"))]
#[must_use]
pub fn stack_unused() -> u32 {
    /// `STACK_PAINT_VALUE` of cortex-m-rt.
    const PAINT: u32 = 0xcccc_cccc;
    unsafe extern "C" {
        safe static _stack_end: u32;
        safe static _stack_start: u32;
    }
    let (low, high) = (&raw const _stack_end, &raw const _stack_start);
    let mut word = low;
    // SAFETY: all words between the two addresses are RAM. Nothing uses the painted words, and
    // reading stops at the first word that has been written to.
    while word < high && unsafe { word.read_volatile() } == PAINT {
        word = word.wrapping_add(1);
    }
    (word.addr() - low.addr()) as u32
}

/// The record of resets, in RAM that the start-up code leaves alone.
#[cfg(all(target_os = "none", target_arch = "arm"))]
#[unsafe(link_section = ".uninit.boot_record")]
static mut BOOT_RECORD: core::mem::MaybeUninit<[u32; BootRecord::WORDS]> =
    core::mem::MaybeUninit::uninit();

/// Returns what there is to report about this start, whose reset had `cause` according to the chip. To be
/// called once, before interrupts are enabled.
#[cfg(all(target_os = "none", target_arch = "arm"))]
pub fn start(cause: ResetCause) -> Start {
    change_record(|record| record.start(cause))
}

/// Keeps epochs for the next start: [`Settings::keep_epochs`](crate::Settings::keep_epochs).
#[cfg(all(target_os = "none", target_arch = "arm"))]
pub fn keep_epochs(epochs: Epochs) {
    change_record(|record| record.keep_epochs(epochs));
}

/// Records a panic at `place` \[file, line\], or a fault of the processor, for the next start. To be
/// called before a reset.
#[cfg(all(target_os = "none", target_arch = "arm"))]
pub fn record_failure(place: Option<(&str, u32)>) {
    let place = place.map(|(file, line)| PanicPlace::new(file, line));
    change_record(|record| record.fail(place));
}

#[cfg(all(target_os = "none", target_arch = "arm"))]
fn change_record<R>(change: impl FnOnce(&mut BootRecord) -> R) -> R {
    let place = (&raw mut BOOT_RECORD).cast::<[u32; BootRecord::WORDS]>();
    // SAFETY: the static is aligned and as large as the array, any words are valid, and only the start
    // and handlers that never return use it.
    let mut record = BootRecord::from_words(&unsafe { place.read_volatile() });
    let result = change(&mut record);
    // SAFETY: as above.
    unsafe { place.write_volatile(record.to_words()) };
    result
}

/// Defines handlers that reset the processor after a panic or a fault, and record it
/// for `start`. The program needs the crates
/// `cortex-m` and `cortex-m-rt`.
#[macro_export]
macro_rules! reset_on_fault {
    () => {
        // SAFETY: it touches only the record of resets, whose words may have any value.
        #[cortex_m_rt::exception]
        unsafe fn HardFault(_: &cortex_m_rt::ExceptionFrame) -> ! {
            $crate::on_chip::record_failure(None);
            cortex_m::peripheral::SCB::sys_reset()
        }

        #[panic_handler]
        fn panic(info: &core::panic::PanicInfo<'_>) -> ! {
            let place = info.location().map(|place| (place.file(), place.line()));
            $crate::on_chip::record_failure(place);
            cortex_m::peripheral::SCB::sys_reset()
        }
    };
}

#[cfg(test)]
mod tests {
    use agent_core::store::Layout;

    use super::*;

    /// Returns a region of eight aligned bytes.
    fn region(memory: &mut [u32; 2]) -> MappedRegion {
        let layout = Layout { slots: [0, 0], slot_length: 0, commit: 0, commit_length: 0 };
        let origin = memory.as_mut_ptr().expose_provenance();
        // SAFETY: the borrow is exclusive, and the test does not use the memory otherwise.
        unsafe { MappedRegion::new(&WeightsRegion { origin, length: 8, layout }) }
    }

    #[test]
    fn only_bytes_within_the_region_are_read() {
        let mut memory = [u32::from_le_bytes([1, 2, 3, 4]), u32::from_le_bytes([5, 6, 7, 8])];
        let region = region(&mut memory);
        assert_eq!(region.bytes(), [1, 2, 3, 4, 5, 6, 7, 8]);
        let mut bytes = [0; 3];
        assert_eq!(region.read(5, &mut bytes), Ok(()));
        assert_eq!(bytes, [6, 7, 8]);
        assert_eq!(region.read(6, &mut bytes), Err(NorFlashErrorKind::OutOfBounds));
        assert_eq!(region.read(u32::MAX, &mut bytes), Err(NorFlashErrorKind::OutOfBounds));
        assert_eq!(bytes, [6, 7, 8]);
    }

    #[test]
    fn words_have_consecutive_addresses() {
        let mut memory = [0; 2];
        let mut region = region(&mut memory);
        let start = region.address(0);
        let words: heapless::Vec<_, 4> = region
            .words(4, &[1, 0, 0, 0, 0, 2, 0, 0, 9])
            .map(|(place, word)| (place.addr() - start, word))
            .collect();
        assert_eq!(words, [(4, 1), (8, 0x200)]);
    }

    #[test]
    fn shared_state_has_one_user_at_a_time() {
        let shared = Shared::new();
        assert_eq!(shared.with(|value: &mut u8| *value), None);
        shared.set(1_u8);
        let inner = shared.with(|value| {
            *value += 1;
            (*value, shared.with(|_| ()))
        });
        assert_eq!(inner, Some((2, None)));
        assert_eq!((shared.take(), shared.take()), (Some(2), None));
    }
}
