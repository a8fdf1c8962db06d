//! Driver for the flash chip that the program runs from. It cannot be read while it is erased or
//! written, so the boot ROM does that, called from RAM with interrupts disabled.

use core::cell::UnsafeCell;

use agent_core::store::MappedFlash;
use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashErrorKind, ReadNorFlash, check_erase, check_write,
};
use firmware_template::WeightsRegion;
use firmware_template::on_chip::MappedRegion;
use rp2040_hal::rom_data;

/// Start of the mapped flash.
const START: usize = 0x1000_0000;
/// Length of a write. \[byte\]
const PAGE: usize = 256;
/// Length of the second-stage bootloader in words.
const BOOT2: usize = 64;

/// The region for weights.
pub(crate) struct Flash {
    region: MappedRegion,
    rom: Rom,
}

/// Functions of the boot ROM (RP2040 data sheet, 2.8.3.1.3), looked up while flash can be read.
struct Rom {
    connect: unsafe extern "C" fn(),
    leave_mapped: unsafe extern "C" fn(),
    erase: unsafe extern "C" fn(u32, usize, u32, u8),
    program: unsafe extern "C" fn(u32, *const u8, usize),
    flush: unsafe extern "C" fn(),
}

/// A copy of the second-stage bootloader, which maps the chip into memory again.
struct Loader(UnsafeCell<[u32; BOOT2]>);

// SAFETY: written once, by `Flash::new`, and only executed afterwards.
unsafe impl Sync for Loader {}

static LOADER: Loader = Loader(UnsafeCell::new([0; BOOT2]));

/// A change of the flash, at an offset from its start.
enum Change<'a> {
    /// Erase a sector.
    Erase,
    Program(&'a [u8; PAGE]),
}

impl Flash {
    /// # Safety
    /// The region must be flash, in whole sectors, with no other owner; there must be only one value of
    /// this type, and the second core must sleep.
    pub(crate) unsafe fn new(region: &WeightsRegion) -> Self {
        let loader = core::ptr::with_exposed_provenance::<u32>(START);
        for word in 0..BOOT2 {
            // SAFETY: the loader occupies the first 256 bytes of flash, and only this code writes
            // to the copy.
            unsafe { LOADER.0.get().cast::<u32>().add(word).write(loader.add(word).read()) };
        }
        let rom = Rom {
            connect: rom_data::connect_internal_flash::ptr(),
            leave_mapped: rom_data::flash_exit_xip::ptr(),
            erase: rom_data::flash_range_erase::ptr(),
            program: rom_data::flash_range_program::ptr(),
            flush: rom_data::flash_flush_cache::ptr(),
        };
        // SAFETY: guaranteed by the caller.
        Self { region: unsafe { MappedRegion::new(region) }, rom }
    }

    /// Carries out `change` at `offset` in the region.
    fn change(&mut self, offset: u32, change: &Change<'_>) {
        let place = (self.region.address(offset) - START) as u32;
        critical_section::with(|_| {
            // SAFETY: the address is in the region, which this driver owns; nothing borrows from
            // it, because `self` is borrowed exclusively; interrupts are disabled, and the second
            // core sleeps.
            unsafe { change_from_ram(&self.rom, place, change) };
        });
    }
}

/// Carries out the change. It neither calls functions nor reads constants in flash: the disassembly
/// contains only calls through registers.
///
/// # Safety
/// Nothing else may read flash meanwhile, and `place` must be the start of a sector or of a page in
/// it.
#[inline(never)]
#[unsafe(link_section = ".data.change_from_ram")]
unsafe fn change_from_ram(rom: &Rom, place: u32, change: &Change<'_>) {
    /// The command that erases a sector, and the size of block that the ROM may erase at once
    /// instead.
    const ERASE_BLOCK: u32 = 1 << 16;
    const BLOCK_COMMAND: u8 = 0xd8;
    // The copy is Thumb code, so the lowest bit of its address is set.
    let loader = LOADER.0.get().cast::<u8>().wrapping_add(1);
    // SAFETY: the loader returns to its caller, as the ROM's functions do, and the calls are in the
    // order of the data sheet; the caller guarantees the rest.
    unsafe {
        let loader: unsafe extern "C" fn() = core::mem::transmute(loader);
        (rom.connect)();
        (rom.leave_mapped)();
        match change {
            Change::Erase => {
                (rom.erase)(place, Flash::ERASE_SIZE, ERASE_BLOCK, BLOCK_COMMAND);
            }
            Change::Program(page) => (rom.program)(place, page.as_ptr(), PAGE),
        }
        (rom.flush)();
        loader();
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

    /// Enables interrupts between two sectors.
    fn erase(&mut self, from: u32, to: u32) -> Result<(), NorFlashErrorKind> {
        check_erase(self, from, to)?;
        crate::uart::wait_until_sent();
        for sector in (from..to).step_by(Self::ERASE_SIZE) {
            self.change(sector, &Change::Erase);
        }
        Ok(())
    }

    /// Writes whole pages, padded with ones where nothing changes.
    fn write(&mut self, mut offset: u32, mut bytes: &[u8]) -> Result<(), NorFlashErrorKind> {
        check_write(self, offset, bytes.len())?;
        while !bytes.is_empty() {
            let within = offset as usize % PAGE;
            let (now, later) = bytes.split_at(bytes.len().min(PAGE - within));
            let mut page = [0xff; PAGE];
            page.iter_mut().skip(within).zip(now).for_each(|(place, byte)| *place = *byte);
            self.change(offset - within as u32, &Change::Program(&page));
            offset += now.len() as u32;
            bytes = later;
        }
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
