//! Firmware in an image, from its ELF file.

use object::elf::{FileHeader32, PT_LOAD};
use object::read::elf::{ElfFile, ProgramHeader};
use object::{LittleEndian, Object, ObjectSymbol};

use super::{ERASED, FIRMWARE, Image, ImageError, Segment};
use crate::memory_map::WeightsRegion;

type Elf<'e> = ElfFile<'e, FileHeader32<LittleEndian>>;

impl Image {
    /// Adds firmware, the content of an ELF file: what it loads into flash, at its load addresses.
    ///
    /// # Errors
    /// If this is not a 32-bit ELF program, if it has been linked with another memory map, or if it
    /// overlaps the weights region.
    pub fn with_firmware(self, elf: &[u8]) -> Result<Self, ImageError> {
        let unreadable = |problem: String| ImageError::Firmware { problem };
        let elf = Elf::parse(elf).map_err(|error| unreadable(error.to_string()))?;
        check_symbols(&elf, self.region())?;
        let mut loaded = Vec::new();
        for header in elf.elf_program_headers() {
            let bytes = header
                .data(LittleEndian, elf.data())
                .map_err(|()| unreadable("a segment is beyond its end".to_owned()))?;
            // Segments without bytes are RAM that the firmware clears.
            if header.p_type(LittleEndian) == PT_LOAD && !bytes.is_empty() {
                let address = header.p_paddr(LittleEndian);
                loaded.push(Segment { name: FIRMWARE, address, bytes: bytes.to_vec() });
            }
        }
        if loaded.is_empty() {
            return Err(unreadable("it loads nothing".to_owned()));
        }
        let erase_size = u64::from(self.region().erase_size);
        self.with(joined(loaded, erase_size))
    }
}

/// Joins segments that share an erase unit, because UF2 files contain whole ones.
fn joined(mut segments: Vec<Segment>, erase_size: u64) -> Vec<Segment> {
    segments.sort_by_key(|segment| segment.address);
    let mut joined: Vec<Segment> = Vec::new();
    for segment in segments {
        let start = segment.span().start;
        match joined.last_mut() {
            Some(last)
                if (last.span().end..=last.span().end.next_multiple_of(erase_size))
                    .contains(&start) =>
            {
                last.bytes.resize((segment.address - last.address) as usize, ERASED);
                last.bytes.extend(segment.bytes);
            }
            _ => joined.push(segment),
        }
    }
    joined
}

/// Compares those symbols of the memory map that the firmware uses.
fn check_symbols(elf: &Elf<'_>, region: &WeightsRegion) -> Result<(), ImageError> {
    for (symbol, expected) in [
        ("_weights_slot_a_origin", region.slot_a),
        ("_weights_slot_b_origin", region.slot_b),
        ("_weights_slot_a_length", region.slot_length),
        ("_weights_commit_origin", region.commit),
        ("_weights_commit_length", region.commit_length),
    ] {
        let found = elf.symbol_by_name(symbol).map(|symbol| symbol.address());
        let expected = expected.into();
        if let Some(found) = found.filter(|&found| found != expected) {
            return Err(ImageError::OtherMemoryMap { symbol, found, expected });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn segments_in_one_erase_unit_are_joined() {
        let segment = |address, length| Segment { name: FIRMWARE, address, bytes: vec![1; length] };
        let found = joined(vec![segment(0x3000, 8), segment(0x100, 16), segment(0, 0x20)], 0x1000);
        let mut first = vec![1; 0x20];
        first.resize(0x100, ERASED);
        first.resize(0x110, 1);
        let spans: Vec<_> = found.iter().map(Segment::span).collect();
        assert_eq!(spans, [0..0x110, 0x3000..0x3008]);
        assert_eq!(found[0].bytes, first);
        // Overlapping ones stay, to be refused.
        assert_eq!(joined(vec![segment(0, 8), segment(7, 8)], 0x1000).len(), 2);
    }
}
