//! Why there is no image.

use super::uf2_format::{PAYLOAD, UF2_FAMILIES};

/// Why an image cannot be made or written as a file.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ImageError {
    /// The package is empty, or longer than the slot.
    #[error(
        "the package has {found} bytes, a slot of the memory map {slot_length}; name a package file \
         of at least 1 byte, train a smaller network, or make the slots in memory.x longer"
    )]
    PackageLength {
        /// Length of the package \[bytes\].
        found: usize,
        /// Length of a slot \[bytes\].
        slot_length: u32,
    },
    /// The commit record does not fit.
    #[error(
        "the commit record has {found} bytes; it takes a multiple of 8, at least 8 and at most \
         one erase unit of {erase_size}"
    )]
    RecordLength {
        /// Length of the record \[bytes\].
        found: usize,
        /// Length of an erase unit \[bytes\].
        erase_size: u32,
    },
    /// A segment leaves the region or overlaps another one.
    #[error(
        "{name} would lie at {start:#x} to {end:#x}, but only {free_start:#x} to {free_end:#x} is \
         free for it in WEIGHTS; correct the symbols in memory.x"
    )]
    Outside {
        /// Which segment.
        name: &'static str,
        /// Its first address.
        start: u64,
        /// The first address behind it.
        end: u64,
        /// First address that is free for it.
        free_start: u64,
        /// First address behind what is free.
        free_end: u64,
    },
    /// A UF2 file needs parts that begin and end with its blocks.
    #[error(
        "{name} would take {start:#x} to {end:#x} of a UF2 file, which is written in blocks of \
         {PAYLOAD} bytes; choose a multiple of {PAYLOAD} for _weights_erase_size in memory.x, or the format hex"
    )]
    Uf2Alignment {
        /// Which segment.
        name: &'static str,
        /// Its first address.
        start: u64,
        /// The first address behind it.
        end: u64,
    },
    /// A UF2 file needs to know for which chips it is.
    #[error(
        "a UF2 file needs the family of the chip, which its bootloader compares; choose {}",
        families()
    )]
    FamilyMissing,
    /// The chip's flash is somewhere else.
    #[error(
        "{name} lies at {start:#x} to {end:#x}, and the flash of {chip} at {flash_start:#x} to \
         {flash_end:#x}; give the memory map of that chip, or the chip of the memory map"
    )]
    NotFlash {
        /// Which part of the store.
        name: &'static str,
        /// Its first address.
        start: u64,
        /// The first address behind it.
        end: u64,
        /// The chip or series.
        chip: &'static str,
        /// First address of its flash.
        flash_start: u64,
        /// First address behind its flash.
        flash_end: u64,
    },
    /// The chip cannot erase a part of the store alone.
    #[error(
        "{name} lies at {start:#x} to {end:#x}, and {chip} erases {sector:#x} to {sector_end:#x} only \
         as a whole, with what else is there; let every part in memory.x begin and end with the \
         chip's sectors, and _weights_erase_size be their length"
    )]
    Sector {
        /// Which part of the store.
        name: &'static str,
        /// Its first address.
        start: u64,
        /// The first address behind it.
        end: u64,
        /// The chip or series.
        chip: &'static str,
        /// First address of the sector that it cuts.
        sector: u64,
        /// First address behind that sector.
        sector_end: u64,
    },
    /// The file would be far longer than what is to be written.
    #[error(
        "a file of this format would have {length} bytes, most of them blank; choose the format hex, \
         or place slots and commit area closer together in memory.x"
    )]
    TooLong {
        /// Bytes of the image.
        length: u64,
    },
    /// There is no such family.
    #[error("{found:?} is not a family of chips for UF2; choose {}", families())]
    Family {
        /// What was given.
        found: String,
    },
    /// Records that Intel HEX cannot hold.
    #[error("the image cannot be written as Intel HEX: {0}; choose the format bin")]
    Hex(String),
}

fn families() -> String {
    let names: Vec<_> = UF2_FAMILIES.iter().map(|(name, _)| *name).collect();
    format!("one of {}, or its number such as 0xe48bff56", names.join(", "))
}
