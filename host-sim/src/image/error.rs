//! Image errors.

use agent_core::store::{LayoutError, StoreError};

use super::uf2_format::{PAYLOAD, UF2_FAMILIES};

/// Why an image cannot be created or encoded.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ImageError {
    /// The package is empty or longer than the slot.
    #[error(
        "the package has {found} bytes and each slot in memory.x {slot_length}; use a package of at least 1 byte, \
             train a smaller network, or increase the length of the slots in memory.x"
    )]
    PackageLength {
        /// Length of the package. \[bytes\]
        found: usize,
        /// Length of a slot. \[bytes\]
        slot_length: u32,
    },
    /// The commit record has an invalid length.
    #[error(
        "the commit record has {found} bytes; its length must be a multiple of 8, at least 8 and at \
             most half the commit area, {half_length}"
    )]
    RecordLength {
        /// Length of the record. \[bytes\]
        found: usize,
        /// Length of half of the commit area. \[bytes\]
        half_length: u32,
    },
    /// A segment leaves the region or overlaps another one.
    #[error(
        "{name} would occupy {start:#x} to {end:#x}, outside its part of WEIGHTS, {free_start:#x} to \
             {free_end:#x}; correct the symbols in memory.x"
    )]
    Outside {
        /// Name of the segment.
        name: &'static str,
        /// Its first address.
        start: u64,
        /// End address, exclusive.
        end: u64,
        /// First address available to it.
        free_start: u64,
        /// End of the available addresses, exclusive.
        free_end: u64,
    },
    /// The firmware is where the weights or other parts of it are.
    #[error(
        "the firmware has bytes at {start:#x} to {end:#x}, which overlap WEIGHTS or other bytes of the firmware; \
             pass the memory.x that it is linked with"
    )]
    FirmwareOverlaps {
        /// The first address of the bytes.
        start: u64,
        /// End address, exclusive.
        end: u64,
    },
    /// The firmware is not a program of a microcontroller.
    #[error(
        "the firmware is not a 32-bit ELF program: {problem}; pass the file that `cargo xtask firmware` \
             names"
    )]
    Firmware {
        /// What is wrong.
        problem: String,
    },
    /// The firmware is linked with another memory map.
    #[error(
        "the firmware has {symbol} at {found:#x}, but the memory map has it at {expected:#x}; pass the memory.x \
             that it is linked with"
    )]
    OtherMemoryMap {
        /// The symbol.
        symbol: &'static str,
        /// Its value in the firmware.
        found: u64,
        /// Its value in the memory map.
        expected: u64,
    },
    /// The journal has no room for keys.
    #[error(
        "each half of the commit area has {found} bytes, but a node with keys needs {needed}; increase \
             _weights_commit_length in memory.x"
    )]
    NoRoomForKeys {
        /// Length of half of the commit area. \[bytes\]
        found: u32,
        /// Length that is needed. \[bytes\]
        needed: u32,
    },
    /// The store does not fit the region.
    #[error("{0}; correct the symbols in memory.x")]
    Layout(LayoutError),
    /// The node's store does not record the keys.
    #[error("cannot record the keys: {0}; check the commit area in memory.x")]
    Keys(StoreError),
    /// The segments of a UF2 file must start and end on block boundaries.
    #[error(
        "{name} would be at {start:#x} to {end:#x} in a UF2 file, which has blocks of {PAYLOAD} bytes; \
             set _weights_erase_size in memory.x to a multiple of {PAYLOAD}, or use the hex format"
    )]
    Uf2Alignment {
        /// Name of the segment.
        name: &'static str,
        /// Its first address.
        start: u64,
        /// End address, exclusive.
        end: u64,
    },
    /// A UF2 file requires the family of the chip.
    #[error(
        "a UF2 file requires the family of the chip, which the bootloader checks; use {}",
        families()
    )]
    FamilyMissing,
    /// A part of the store is outside the chip's flash.
    #[error(
        "{name} is at {start:#x} to {end:#x}, outside the flash of {chip} at {flash_start:#x} to \
             {flash_end:#x}; pass the memory map of that chip, or the chip of that memory map"
    )]
    NotFlash {
        /// Name of the part.
        name: &'static str,
        /// Its first address.
        start: u64,
        /// End address, exclusive.
        end: u64,
        /// The chip or series.
        chip: &'static str,
        /// First address of its flash.
        flash_start: u64,
        /// End of its flash, exclusive.
        flash_end: u64,
    },
    /// The chip cannot erase the part without erasing something else.
    #[error(
        "{name} is at {start:#x} to {end:#x}, but {chip} can only erase all of {sector:#x} to \
             {sector_end:#x}, including whatever else is stored there; align every part in memory.x to the \
             chip's sectors and set _weights_erase_size to their length"
    )]
    Sector {
        /// Name of the part.
        name: &'static str,
        /// Its first address.
        start: u64,
        /// End address, exclusive.
        end: u64,
        /// The chip or series.
        chip: &'static str,
        /// First address of the sector that it shares.
        sector: u64,
        /// End of that sector, exclusive.
        sector_end: u64,
    },
    /// The file would be far longer than its data.
    #[error(
        "a file of this format would have {length} bytes, most of them blank; use the hex format, or \
             move the slots and the commit area closer together in memory.x"
    )]
    TooLong {
        /// Length of the image. \[bytes\]
        length: u64,
    },
    /// Unknown UF2 family.
    #[error("unknown UF2 family {found:?}; use {}", families())]
    Family {
        /// The name given.
        found: String,
    },
    /// The image cannot be encoded as Intel HEX.
    #[error("cannot encode the image as Intel HEX: {0}; use the bin format")]
    Hex(String),
}

fn families() -> String {
    let names: Vec<_> = UF2_FAMILIES.iter().map(|(name, _)| *name).collect();
    format!("one of {}, or its number such as 0xe48bff56", names.join(", "))
}
