//! What the boards share below the traits: memory that the linker knows, state that a program and its
//! interrupts share, the operator's key, and what happens after a fault.
//!
//! This is the only module of the library with `unsafe` code. A board adds its own for registers.
//!
//! Cost: none beyond what a board would write by itself.
#![allow(unsafe_code, reason = "flash that is mapped into memory, and the painted stack")]

use core::cell::RefCell;

use agent_core::package::signature::PublicKey;
use critical_section::Mutex;
use embedded_storage::nor_flash::NorFlashErrorKind;

use crate::WeightsRegion;

/// A region of flash that can be read at its addresses.
///
/// Invariant: nothing else has the region, and it changes only through an exclusive borrow of this.
#[derive(Debug)]
pub struct MappedRegion {
    origin: usize,
    length: usize,
}

impl MappedRegion {
    /// The region that `memory.x` reserves for weights.
    ///
    /// # Safety
    /// The region is readable memory of this length, and this is the only value for it.
    #[must_use]
    pub const unsafe fn new(region: &WeightsRegion) -> Self {
        Self { origin: region.origin, length: region.length }
    }

    /// Its length. \[byte\]
    #[must_use]
    pub const fn length(&self) -> usize {
        self.length
    }

    /// The address at `offset` from its start.
    #[must_use]
    pub const fn address(&self, offset: u32) -> usize {
        self.origin + offset as usize
    }

    /// Its bytes.
    #[must_use]
    pub fn bytes(&self) -> &[u8] {
        let first = core::ptr::with_exposed_provenance(self.origin);
        // SAFETY: `new` promised readable memory of this length, in which any content is a valid `u8`;
        // it changes only through an exclusive borrow of `self`.
        unsafe { core::slice::from_raw_parts(first, self.length) }
    }

    /// Copies the bytes at `offset`.
    ///
    /// # Errors
    /// They do not lie within the region.
    pub fn read(&self, offset: u32, bytes: &mut [u8]) -> Result<(), NorFlashErrorKind> {
        let stored = self.bytes().get(offset as usize..).and_then(|rest| rest.get(..bytes.len()));
        let stored = stored.ok_or(NorFlashErrorKind::OutOfBounds)?;
        bytes.iter_mut().zip(stored).for_each(|(byte, stored)| *byte = *stored);
        Ok(())
    }

    /// Where each word of `bytes`, from `offset` on, belongs, for flash that takes 32 bits at once.
    /// Bytes behind the last whole word are left out.
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

/// What an interrupt handler shares with the rest of the program, once it has been set up.
pub struct Shared<T>(Mutex<RefCell<Option<T>>>);

impl<T> Shared<T> {
    /// Nothing yet.
    #[must_use]
    pub const fn new() -> Self {
        Self(Mutex::new(RefCell::new(None)))
    }

    /// Sets it up.
    pub fn set(&self, value: T) {
        critical_section::with(|token| self.0.borrow(token).replace(Some(value)));
    }

    /// Takes it away, until it is set again.
    pub fn take(&self) -> Option<T> {
        critical_section::with(|token| self.0.take(token))
    }

    /// Uses it with interrupts off; `None` if there is nothing, or it is in use already.
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

/// The key that was compiled in is not a public key, so no package can be trusted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct InvalidKey;

/// The key that packages have to be signed with, if the firmware was built for one.
///
/// # Errors
/// [`InvalidKey`]; a node must not take packages then.
#[cfg(feature = "signature")]
pub fn public_key() -> Result<Option<PublicKey>, InvalidKey> {
    const BYTES: [u8; 32] = crate::key_from_hex(env!(
        "NODE_PUBLIC_KEY",
        "set NODE_PUBLIC_KEY to the operator's public key in hexadecimal digits, which \
         `host-sim weights keygen` prints, or build without the feature `signature`"
    ));
    PublicKey::from_bytes(&BYTES).map(Some).map_err(|_| InvalidKey)
}

/// The key that packages have to be signed with, if the firmware was built for one.
///
/// # Errors
/// None without the feature `signature`.
#[cfg(not(feature = "signature"))]
pub fn public_key() -> Result<Option<PublicKey>, InvalidKey> {
    Ok(None)
}

/// Bytes of the stack that still hold what cortex-m-rt, with its feature `paint-stack`, has painted
/// them with.
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
    // SAFETY: all words between the two addresses are RAM. Nothing uses what is painted, and reading
    // stops at the first word that has been written to.
    while word < high && unsafe { word.read_volatile() } == PAINT {
        word = word.wrapping_add(1);
    }
    (word.addr() - low.addr()) as u32
}

/// Defines what follows a panic or a fault of the processor: a reset. The program needs the crates
/// `cortex-m` and `cortex-m-rt`.
#[macro_export]
macro_rules! reset_on_fault {
    () => {
        // SAFETY: it touches no memory, not even what the fault may have left inconsistent.
        #[cortex_m_rt::exception]
        unsafe fn HardFault(_: &cortex_m_rt::ExceptionFrame) -> ! {
            cortex_m::peripheral::SCB::sys_reset()
        }

        #[panic_handler]
        fn panic(_: &core::panic::PanicInfo<'_>) -> ! {
            cortex_m::peripheral::SCB::sys_reset()
        }
    };
}

#[cfg(test)]
mod tests {
    use agent_core::store::Layout;

    use super::*;

    /// Eight bytes, aligned, and the region that they are.
    fn region(memory: &mut [u32; 2]) -> MappedRegion {
        let layout = Layout { slots: [0, 0], slot_length: 0, commit: 0, commit_length: 0 };
        let origin = memory.as_mut_ptr().expose_provenance();
        // SAFETY: the borrow is exclusive, and no test uses the memory besides.
        unsafe { MappedRegion::new(&WeightsRegion { origin, length: 8, layout }) }
    }

    #[test]
    fn bytes_are_read_within_the_region_only() {
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
    fn words_have_addresses_one_after_the_other() {
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
    fn what_is_shared_is_used_by_one_at_a_time() {
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
