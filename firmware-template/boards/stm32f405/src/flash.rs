//! Driver for the internal flash.

use agent_core::store::MappedFlash;
use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashErrorKind, ReadNorFlash, check_erase, check_write,
};
use firmware_template::WeightsRegion;
use firmware_template::on_chip::MappedRegion;
use stm32f4xx_hal::pac::FLASH;

/// The internal flash, sectors 5 to 11. The HAL's driver is not used: it writes 8 bits at a time,
/// which doubles the time the processor is halted, it leaves error flags set that make every later
/// operation fail, and it does not clear the cache.
pub(crate) struct Flash {
    flash: FLASH,
    region: MappedRegion,
}

impl Flash {
    /// Unlocks the control register (RM0090, 3.6.1).
    const KEYS: [u32; 2] = [0x4567_0123, 0xCDEF_89AB];
    /// The error flags in the status register: PGSERR, PGPERR, PGAERR, WRPERR, OPERR.
    const ERRORS: u32 = 0b1111_0010;
    /// The error flags and end of operation; all are cleared by writing 1.
    const STATUS: u32 = Self::ERRORS | 1;
    /// Start of sector 5, the first of 128 KiB (3.4, table 5).
    const SECTOR_5: usize = 0x0802_0000;

    /// # Safety
    /// The region must be flash, in whole sectors of 128 KiB, with no other owner.
    pub(crate) unsafe fn new(flash: FLASH, region: &WeightsRegion) -> Self {
        // SAFETY: guaranteed by the caller.
        Self { flash, region: unsafe { MappedRegion::new(region) } }
    }

    /// Performs the flash operation that `begin` starts, and waits for its end.
    fn operate(&mut self, begin: impl FnOnce(&FLASH)) -> Result<(), NorFlashErrorKind> {
        // SAFETY: every value is valid for this register.
        self.flash.sr().write(|w| unsafe { w.bits(Self::STATUS) });
        begin(&self.flash);
        // Also tells the compiler that memory has changed.
        cortex_m::asm::dsb();
        while self.flash.sr().read().bsy().bit_is_set() {}
        cortex_m::asm::dsb();
        let failed = self.flash.sr().read().bits() & Self::ERRORS != 0;
        if failed { Err(NorFlashErrorKind::Other) } else { Ok(()) }
    }

    /// Unlocks the flash for `change`, and locks it again.
    fn unlocked(
        &mut self,
        change: impl FnOnce(&mut Self) -> Result<(), NorFlashErrorKind>,
    ) -> Result<(), NorFlashErrorKind> {
        for key in Self::KEYS {
            // SAFETY: this register takes the keys in this order while it is locked, as it always
            // is outside this function.
            self.flash.keyr().write(|w| unsafe { w.key().bits(key) });
        }
        let outcome = change(self);
        self.flash.cr().write(|w| w.lock().set_bit());
        outcome
    }

    /// Clears erased contents from the cache; writes go through it.
    fn clear_cache(&mut self) {
        let acr = self.flash.acr();
        acr.modify(|_, w| w.dcen().clear_bit());
        acr.modify(|_, w| w.dcrst().set_bit());
        acr.modify(|_, w| w.dcrst().clear_bit());
        acr.modify(|_, w| w.dcen().set_bit());
        cortex_m::asm::dsb();
    }
}

impl ErrorType for Flash {
    type Error = NorFlashErrorKind;
}

impl ReadNorFlash for Flash {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), NorFlashErrorKind> {
        self.region.read(offset, bytes)
    }

    fn capacity(&self) -> usize {
        self.region.length()
    }
}

impl NorFlash for Flash {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = 128 * 1024;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), NorFlashErrorKind> {
        check_erase(self, from, to)?;
        crate::uart::wait_until_sent();
        let first = 5 + (self.region.address(0) - Self::SECTOR_5) / Self::ERASE_SIZE;
        let sectors = from as usize / Self::ERASE_SIZE..to as usize / Self::ERASE_SIZE;
        let outcome = self.unlocked(|flash| {
            for sector in sectors {
                let sector = (first + sector) as u8;
                flash.operate(|flash| {
                    // The register's reset value would lock it.
                    let cr = flash.cr();
                    cr.write(|w| w.lock().clear_bit().psize().psize32().ser().set_bit());
                    // SAFETY: the sector is in the region, which this driver owns.
                    cr.modify(|_, w| unsafe { w.snb().bits(sector).strt().set_bit() });
                })?;
            }
            Ok(())
        });
        self.clear_cache();
        outcome
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), NorFlashErrorKind> {
        check_write(self, offset, bytes.len())?;
        let words = self.region.words(offset, bytes);
        self.unlocked(|flash| {
            for (place, word) in words {
                flash.operate(|flash| {
                    flash.cr().write(|w| w.lock().clear_bit().psize().psize32().pg().set_bit());
                    // SAFETY: the word is aligned and in the region, which this driver owns; nothing
                    // borrows from it, because `self` is borrowed exclusively.
                    unsafe { place.write_volatile(word) };
                })?;
            }
            Ok(())
        })
    }
}

impl MappedFlash for Flash {
    /// In the loop, time is that of the simulation.
    const STALLS: bool = !cfg!(feature = "in-the-loop");

    fn mapped(&self) -> &[u8] {
        self.region.bytes()
    }
}
