//! Positions of the slots and the journal in flash, and lengths in the journal.

use super::Slot;
use crate::wire::crc::CHECKSUM_LENGTH;

/// Length of a record in bytes; it is stored twice.
pub const RECORD_LENGTH: usize = 64;

/// Length of the part of a record before its content. \[byte\]
pub(super) const HEADER_LENGTH: usize = 8;

/// Greatest length of a note's payload. \[byte\]
pub const NOTE_LENGTH_MAX: usize = RECORD_LENGTH - HEADER_LENGTH - CHECKSUM_LENGTH;

/// Length of a pair of places. \[byte\]
pub(super) const PAIR_LENGTH: u32 = 2 * RECORD_LENGTH as u32;

/// Positions of the slots and the journal. Offsets count from the start of the flash driver's
/// region.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Layout {
    /// Offsets of slot A and slot B. \[byte\]
    pub slots: [u32; 2],
    /// Length of each slot. \[byte\]
    pub slot_length: u32,
    /// Offset of the commit area. \[byte\]
    pub commit: u32,
    /// Length of the commit area, whose halves are erased alternately; at least 1024. \[byte\]
    pub commit_length: u32,
}

/// A part of the region.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// A slot.
    Slot(Slot),
    /// The commit area.
    Commit,
}

/// Why a layout is invalid.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum LayoutError {
    /// A part, or half of the commit area, does not start and end at an erase unit.
    Unaligned {
        /// Which part.
        part: Part,
        /// Required alignment of offset and length; twice this for the commit area's length.
        /// \[byte\]
        erase_size: u32,
    },
    /// A slot does not start at a multiple of 4 bytes, which is required to use a package's numbers
    /// in place.
    UnalignedPackage {
        /// Which slot.
        part: Part,
    },
    /// A part is too short.
    TooShort {
        /// Which part.
        part: Part,
    },
    /// A part ends beyond the region.
    OutOfRegion {
        /// Which part.
        part: Part,
        /// Length of the region. \[byte\]
        capacity: u32,
    },
    /// Two parts overlap.
    Overlap {
        /// The first part.
        first: Part,
        /// The second part.
        second: Part,
    },
}

impl core::fmt::Display for Part {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Slot(slot) => write!(f, "{slot}"),
            Self::Commit => write!(f, "the commit area"),
        }
    }
}

impl core::fmt::Display for LayoutError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match *self {
            Self::Unaligned { part: Part::Commit, erase_size } => {
                write!(
                    f,
                    "the halves of the commit area are not multiples of the erase size, {erase_size} bytes"
                )
            }
            Self::Unaligned { part, erase_size } => {
                write!(f, "{part} is not aligned to the erase size, {erase_size} bytes")
            }
            Self::UnalignedPackage { part } => {
                write!(f, "{part} does not start at a multiple of {PACKAGE_ALIGNMENT} bytes")
            }
            Self::TooShort { part } => write!(f, "{part} is too short"),
            Self::OutOfRegion { part, capacity } => {
                write!(f, "{part} ends beyond the region of {capacity} bytes")
            }
            Self::Overlap { first, second } => write!(f, "{first} and {second} overlap"),
        }
    }
}

impl core::error::Error for LayoutError {}

/// Fewest records that each half of the commit area must hold: the state, two notes, and one that has
/// to be written twice.
const PAIRS_MIN: u32 = 4;

/// Required alignment of a slot: the size of a package's numbers. \[byte\]
const PACKAGE_ALIGNMENT: u32 = size_of::<f32>() as u32;

impl Layout {
    /// Checks that all parts are disjoint, inside a region of `capacity` bytes, and aligned to
    /// erase units of `erase_size` bytes, and the slots also to 4 bytes.
    ///
    /// # Errors
    /// The first violation found.
    pub fn validate(&self, erase_size: u32, capacity: u32) -> Result<(), LayoutError> {
        let [a, b] = self.slots;
        let parts = [
            (Part::Slot(Slot::A), a, self.slot_length, erase_size),
            (Part::Slot(Slot::B), b, self.slot_length, erase_size),
            (Part::Commit, self.commit, self.commit_length, erase_size.saturating_mul(2)),
        ];
        for (part, start, length, multiple) in parts {
            if !start.is_multiple_of(erase_size) || !length.is_multiple_of(multiple) {
                return Err(LayoutError::Unaligned { part, erase_size });
            }
            if part != Part::Commit && !start.is_multiple_of(PACKAGE_ALIGNMENT) {
                return Err(LayoutError::UnalignedPackage { part });
            }
            if length == 0 || (part == Part::Commit && self.pairs() < PAIRS_MIN) {
                return Err(LayoutError::TooShort { part });
            }
            if start.checked_add(length).is_none_or(|end| end > capacity) {
                return Err(LayoutError::OutOfRegion { part, capacity });
            }
        }
        let [a, b, commit] = parts;
        for (one, other) in [(a, b), (a, commit), (b, commit)] {
            let ((first, start, length, _), (second, other_start, other_length, _)) = (one, other);
            // Neither end overflows, as checked above.
            if start < other_start.wrapping_add(other_length)
                && other_start < start.wrapping_add(length)
            {
                return Err(LayoutError::Overlap { first, second });
            }
        }
        Ok(())
    }

    /// Returns the offset of a slot.
    pub(super) fn slot(&self, slot: Slot) -> u32 {
        slot.of(self.slots)
    }

    /// Returns the length of half of the commit area.
    pub(super) fn half_length(&self) -> u32 {
        self.commit_length / 2
    }

    /// Returns the number of records, of two copies each, that fit into half of the commit area.
    pub(super) fn pairs(&self) -> u32 {
        self.half_length() / PAIR_LENGTH
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The default board's layout.
    const LAYOUT: Layout =
        Layout { slots: [0, 0x7000], slot_length: 0x7000, commit: 0xe000, commit_length: 0x2000 };
    const A: Part = Part::Slot(Slot::A);
    const B: Part = Part::Slot(Slot::B);

    #[test]
    fn the_default_boards_layout_is_valid_in_any_order() {
        assert_eq!(LAYOUT.validate(4096, 0x10000), Ok(()));
        assert_eq!(LAYOUT.pairs(), 32);
        let turned = Layout { slots: [0x9000, 0x2000], commit: 0, ..LAYOUT };
        assert_eq!(turned.validate(4096, 0x10000), Ok(()));
    }

    #[test]
    fn each_defect_has_its_own_error() {
        let validate = |layout: Layout| layout.validate(4096, 0x10000);
        let unaligned = |part| Err(LayoutError::Unaligned { part, erase_size: 4096 });
        assert_eq!(validate(Layout { slots: [1, 0x7000], ..LAYOUT }), unaligned(A));
        assert_eq!(validate(Layout { slots: [0, 0x7800], ..LAYOUT }), unaligned(B));
        assert_eq!(validate(Layout { slot_length: 0x6800, ..LAYOUT }), unaligned(A));
        assert_eq!(validate(Layout { commit: 0xe020, ..LAYOUT }), unaligned(Part::Commit));
        assert_eq!(validate(Layout { commit_length: 0x1000, ..LAYOUT }), unaligned(Part::Commit));
        let too_short = |part| Err(LayoutError::TooShort { part });
        assert_eq!(validate(Layout { slot_length: 0, ..LAYOUT }), too_short(A));
        assert_eq!(validate(Layout { commit_length: 0, ..LAYOUT }), too_short(Part::Commit));
        let small = Layout { slots: [0, 16], slot_length: 16, commit: 32, commit_length: 1008 };
        assert_eq!(small.validate(8, 1040), too_short(Part::Commit));
        let odd = Layout { slots: [0, 6], slot_length: 6, commit: 12, commit_length: 1024 };
        assert_eq!(odd.validate(2, 1036), Err(LayoutError::UnalignedPackage { part: B }));
        assert_eq!(
            Layout { slots: [0, 8], slot_length: 6, commit: 14, ..odd }.validate(2, 1038),
            Ok(())
        );
        let outside = |part| Err(LayoutError::OutOfRegion { part, capacity: 0x10000 });
        assert_eq!(validate(Layout { slots: [0, 0xa000], ..LAYOUT }), outside(B));
        assert_eq!(validate(Layout { commit_length: 0x4000, ..LAYOUT }), outside(Part::Commit));
        assert_eq!(validate(Layout { slots: [0, 0xffff_f000], ..LAYOUT }), outside(B));
        let overlap = |first, second| Err(LayoutError::Overlap { first, second });
        assert_eq!(validate(Layout { slots: [0, 0x6000], ..LAYOUT }), overlap(A, B));
        assert_eq!(validate(Layout { slots: [0x7000, 0], ..LAYOUT }), Ok(()));
        assert_eq!(validate(Layout { commit: 0x6000, ..LAYOUT }), overlap(A, Part::Commit));
        assert_eq!(validate(Layout { commit: 0xd000, ..LAYOUT }), overlap(B, Part::Commit));
    }
}
