//! UF2, the file format of bootloaders that appear as a USB drive.
//!
//! A file is a sequence of self-contained blocks of 512 bytes. All numbers are 32 bits,
//! little-endian (<https://github.com/microsoft/uf2>, retrieved 2026):
//!
//! ```text
//!   0  magic 0x0A324655      16  bytes of data: 256
//!   4  magic 0x9E5D5157      20  block number, from 0
//!   8  flags 0x2000          24  number of blocks
//!  12  address               28  chip family, as the flag indicates
//!  32  data, then zeros     508  magic 0x0AB16F30
//! ```
//!
//! The bootloader of the RP2040 decides by the block *number* when to erase a sector (erratum E14),
//! so a file with gaps must contain whole sectors. Each segment is therefore padded with 0xFF to
//! whole erase units, which are erased anyway.

use core::fmt;
use core::str::FromStr;

use super::uf2_format::{BLOCK, FAMILY_PRESENT, MAGIC, PAYLOAD, UF2_FAMILIES};
use super::{ERASED, Image, ImageError, Segment, check};

/// A chip family; bootloaders ignore files of other families.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Uf2Family(pub u32);

impl FromStr for Uf2Family {
    type Err = ImageError;

    /// Parses a name of [`UF2_FAMILIES`] or a number, decimal or with `0x`.
    fn from_str(text: &str) -> Result<Self, ImageError> {
        let named = UF2_FAMILIES.iter().find(|(name, _)| name.eq_ignore_ascii_case(text));
        let number = || match text.strip_prefix("0x").or(text.strip_prefix("0X")) {
            Some(digits) => u32::from_str_radix(digits, 16).ok(),
            None => text.parse().ok(),
        };
        named
            .map(|&(_, number)| number)
            .or_else(number)
            .map(Self)
            .ok_or_else(|| ImageError::Family { found: text.to_owned() })
    }
}

impl fmt::Display for Uf2Family {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match UF2_FAMILIES.iter().find(|(_, number)| *number == self.0) {
            Some((name, _)) => f.write_str(name),
            None => write!(f, "{:#010x}", self.0),
        }
    }
}

/// Encodes `image` as a UF2 file.
///
/// # Errors
/// If the erase units of a segment are not multiples of blocks, or segments overlap.
pub(super) fn encode(image: &Image, family: Uf2Family) -> Result<Vec<u8>, ImageError> {
    let erase_size = image.region().erase_size as usize;
    let segments = image.segments().iter().map(|segment| {
        let mut whole = segment.clone();
        whole.bytes.resize(segment.bytes.len().next_multiple_of(erase_size), ERASED);
        whole
    });
    let segments: Vec<Segment> = segments.collect();
    check(image.region(), &segments)?;
    let mut blocks: Vec<(u64, &[u8; PAYLOAD])> = Vec::new();
    for segment in &segments {
        let span = segment.span();
        let (payloads, rest) = segment.bytes.as_chunks::<PAYLOAD>();
        if !span.start.is_multiple_of(PAYLOAD as u64) || !rest.is_empty() {
            let (start, end) = (span.start, span.end);
            return Err(ImageError::Uf2Alignment { name: segment.name, start, end });
        }
        blocks.extend(span.step_by(PAYLOAD).zip(payloads));
    }
    let count = blocks.len() as u32;
    let mut file = Vec::with_capacity(blocks.len() * BLOCK);
    for (number, (address, payload)) in (0..).zip(blocks) {
        let [first, second, last] = MAGIC;
        // The check above ensures that every address fits into 32 bits.
        let address = address as u32;
        let head =
            [first, second, FAMILY_PRESENT, address, PAYLOAD as u32, number, count, family.0];
        let end = file.len() + BLOCK;
        file.extend(head.into_iter().flat_map(u32::to_le_bytes));
        file.extend(payload);
        file.resize(end - size_of::<u32>(), 0);
        file.extend(last.to_le_bytes());
    }
    Ok(file)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parses_families_by_name_and_number() {
        for (name, number) in UF2_FAMILIES {
            assert_eq!(name.parse(), Ok(Uf2Family(number)));
            assert_eq!(Uf2Family(number).to_string(), name);
        }
        assert_eq!("RP2040".parse(), Ok(Uf2Family(0xE48B_FF56)));
        assert_eq!("0x12345678".parse(), Ok(Uf2Family(0x1234_5678)));
        assert_eq!("17".parse(), Ok(Uf2Family(17)));
        assert_eq!(Uf2Family(17).to_string(), "0x00000011");
        let error = "rp2041".parse::<Uf2Family>().unwrap_err().to_string();
        assert!(error.contains("rp2041") && error.contains("stm32f4"), "{error}");
    }
}
