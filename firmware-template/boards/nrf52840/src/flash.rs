//! Driver for the internal flash.

use agent_core::store::MappedFlash;
use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashErrorKind, ReadNorFlash, check_erase, check_write,
};
use firmware_template::WeightsRegion;
use firmware_template::on_chip::MappedRegion;
use nrf52840_hal::pac::NVMC;

/// The internal flash. The HAL's driver is not used, because it borrows the region exclusively and
/// packages could not be read in place.
pub(crate) struct Flash {
    nvmc: NVMC,
    region: MappedRegion,
}

impl Flash {
    /// # Safety
    /// The region must be flash, in whole pages, with no other owner.
    pub(crate) unsafe fn new(nvmc: NVMC, region: &WeightsRegion) -> Self {
        // SAFETY: guaranteed by the caller.
        Self { nvmc, region: unsafe { MappedRegion::new(region) } }
    }

    fn finish(&self) {
        // Also tells the compiler that memory has changed.
        cortex_m::asm::dsb();
        while self.nvmc.ready.read().ready().bit_is_clear() {}
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
    const ERASE_SIZE: usize = 4096;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), NorFlashErrorKind> {
        check_erase(self, from, to)?;
        self.nvmc.config.write(|w| w.wen().een());
        for page in (from..to).step_by(Self::ERASE_SIZE) {
            let address = self.region.address(page) as u32;
            // SAFETY: the page is in the region, which this driver owns.
            self.nvmc.erasepage().write(|w| unsafe { w.bits(address) });
            self.finish();
        }
        self.nvmc.config.write(|w| w.wen().ren());
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), NorFlashErrorKind> {
        check_write(self, offset, bytes.len())?;
        let words = self.region.words(offset, bytes);
        self.nvmc.config.write(|w| w.wen().wen());
        for (place, word) in words {
            // SAFETY: the word is aligned and in the region, which this driver owns; nothing borrows
            // from it, because `self` is borrowed exclusively.
            unsafe { place.write_volatile(word) };
            self.finish();
        }
        self.nvmc.config.write(|w| w.wen().ren());
        Ok(())
    }
}

impl MappedFlash for Flash {
    /// In the loop, time is that of the simulation.
    const STALLS: bool = !cfg!(feature = "in-the-loop");

    fn mapped(&self) -> &[u8] {
        self.region.bytes()
    }
}
