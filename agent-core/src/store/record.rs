//! The state of the store, and its encoding as a record.
//!
//! | offset | field | encoding |
//! | --- | --- | --- |
//! | 0 | sequence | `u32`, one more than the record before, wraps |
//! | 4 | format | one byte, [`FORMAT`] |
//! | 5 | slot in use | one byte: 0 is A, 1 is B, 0xFF none |
//! | 6 | phase | one byte: 0 confirmed, 1 staged, 2 trial |
//! | 7 | reserved | 0 |
//! | 8, 12 | package in slot A: length, checksum | two `u32`; length 0 is no package |
//! | 16, 20 | package in slot B | likewise |
//! | 24 | reserved | 0 |
//! | 28 | checksum | `u32`, CRC-32 of the 28 bytes before |
//!
//! All little-endian. Each record is complete, so one valid record is enough. Its length is a
//! multiple of every supported word, so no two records share a word. Erased or zeroed flash is not
//! a valid record.

use crate::wire::crc::{CHECKSUM_LENGTH, crc32};

use super::Slot;

/// Length of a record in bytes.
pub const RECORD_LENGTH: usize = 32;

/// Version of the record format that this crate reads and writes.
pub const FORMAT: u8 = 1;

const BODY_LENGTH: usize = RECORD_LENGTH - CHECKSUM_LENGTH;
const NO_SLOT: u8 = 0xff;

/// Progress of the newest package.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Phase {
    /// The package in use is confirmed; the other slot holds a spare.
    Confirmed,
    /// The same, and the package in the other slot is staged.
    Staged,
    /// The package in use is on trial; the other slot holds the one to revert to.
    Trial,
}

/// Length and checksum of a package at the start of its slot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Extent {
    /// At least 1. \[byte\]
    pub(super) length: u32,
    /// CRC-32 of its bytes.
    pub(super) checksum: u32,
}

/// Contents and purpose of both slots.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Contents {
    pub(super) in_use: Option<Slot>,
    pub(super) phase: Phase,
    /// The packages in slot A and slot B.
    pub(super) packages: [Option<Extent>; 2],
}

impl Extent {
    /// Describes `bytes`; `None` if they are empty or longer than any flash.
    pub(super) fn of(bytes: &[u8]) -> Option<Self> {
        let length = u32::try_from(bytes.len()).ok().filter(|&length| length > 0)?;
        Some(Self { length, checksum: crc32(&[bytes]) })
    }
}

impl Contents {
    /// No packages.
    pub(super) const NOTHING: Self =
        Self { in_use: None, phase: Phase::Confirmed, packages: [None; 2] };

    /// Returns the package recorded in a slot.
    pub(super) fn package(&self, slot: Slot) -> Option<Extent> {
        slot.of(self.packages)
    }

    /// Returns the slot that is not in use, where the next package goes.
    pub(super) fn spare(&self) -> Slot {
        self.in_use.map_or(Slot::A, Slot::other)
    }

    /// Returns the same contents with `package` in `slot`.
    pub(super) fn with_package(self, slot: Slot, package: Option<Extent>) -> Self {
        let mut contents = self;
        let [a, b] = &mut contents.packages;
        *slot.of([a, b]) = package;
        contents
    }

    /// Returns the same contents with the spare slot empty.
    pub(super) fn without_spare(self) -> Self {
        Self { phase: Phase::Confirmed, ..self.with_package(self.spare(), None) }
    }

    /// Returns the contents after a failed trial: what was in use before is in use again, if
    /// anything. The package on trial is removed, so that nothing falls back to it.
    pub(super) fn reverted(self) -> Self {
        let before = self.in_use.map(Slot::other).filter(|&slot| self.package(slot).is_some());
        let failed = self.in_use.map_or(self, |failed| self.with_package(failed, None));
        Self { in_use: before, phase: Phase::Confirmed, ..failed }
    }

    /// Returns the contents after a reboot.
    pub(super) fn rebooted(self) -> Self {
        if self.phase == Phase::Trial { self.reverted() } else { self }
    }

    /// Encodes a record with a sequence number.
    pub(super) fn encode(&self, sequence: u32) -> [u8; RECORD_LENGTH] {
        let in_use = match self.in_use {
            Some(Slot::A) => 0,
            Some(Slot::B) => 1,
            None => NO_SLOT,
        };
        let phase = match self.phase {
            Phase::Confirmed => 0,
            Phase::Staged => 1,
            Phase::Trial => 2,
        };
        let [a, b] = self.packages.map(|package| match package {
            Some(Extent { length, checksum }) => [length, checksum],
            None => [0, 0],
        });
        let words =
            [sequence, u32::from_le_bytes([FORMAT, in_use, phase, 0]), a[0], a[1], b[0], b[1], 0];
        let mut record = [0; RECORD_LENGTH];
        let (body, checksum) = record.split_at_mut(BODY_LENGTH);
        for (bytes, word) in body.chunks_exact_mut(4).zip(words) {
            bytes.copy_from_slice(&word.to_le_bytes());
        }
        checksum.copy_from_slice(&crc32(&[body]).to_le_bytes());
        record
    }

    /// Decodes sequence number and contents; `None` if the bytes are not a record of this format,
    /// or if a slot that is in use, staged or on trial is empty.
    pub(super) fn decode(record: &[u8; RECORD_LENGTH]) -> Option<(u32, Self)> {
        let (body, checksum) = record.split_last_chunk::<CHECKSUM_LENGTH>()?;
        if crc32(&[body]) != u32::from_le_bytes(*checksum) {
            return None;
        }
        let mut words = body.chunks_exact(4).map(|word| {
            // Every chunk has four bytes.
            word.try_into().map_or(0, u32::from_le_bytes)
        });
        let sequence = words.next()?;
        let [FORMAT, in_use, phase, _] = words.next()?.to_le_bytes() else { return None };
        let in_use = match in_use {
            0 => Some(Slot::A),
            1 => Some(Slot::B),
            NO_SLOT => None,
            _ => return None,
        };
        let phase = match phase {
            0 => Phase::Confirmed,
            1 => Phase::Staged,
            2 => Phase::Trial,
            _ => return None,
        };
        let mut package = || {
            let (length, checksum) = (words.next()?, words.next()?);
            (length > 0).then_some(Extent { length, checksum })
        };
        let contents = Self { in_use, phase, packages: [package(), package()] };
        let named = match phase {
            Phase::Confirmed => in_use,
            Phase::Staged => Some(contents.spare()),
            Phase::Trial => Some(in_use?),
        };
        let all_there = [in_use, named].into_iter().flatten();
        all_there
            .map(|slot| contents.package(slot))
            .all(|package| package.is_some())
            .then_some((sequence, contents))
    }
}

/// Returns the record for the start of a factory image's commit area: `package` is at the start of
/// `slot`, in use and confirmed, and the other slot is empty. The rest of the commit area must be
/// erased, because a leftover record could be newer. If `package` is empty, nothing is in use.
#[must_use]
pub fn factory_record(slot: Slot, package: &[u8]) -> [u8; RECORD_LENGTH] {
    let extent = Extent::of(package);
    let in_use = extent.map(|_| slot);
    Contents { in_use, ..Contents::NOTHING }.with_package(slot, extent).encode(1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn contents() -> Contents {
        Contents {
            in_use: Some(Slot::B),
            phase: Phase::Trial,
            packages: [
                Some(Extent { length: 0x0102_0304, checksum: 0x1122_3344 }),
                Some(Extent { length: 2200, checksum: 0xffff_ffff }),
            ],
        }
    }

    /// Returns the record after `change`, with a matching checksum.
    fn resealed(change: impl FnOnce(&mut [u8; RECORD_LENGTH])) -> [u8; RECORD_LENGTH] {
        let mut record = contents().encode(7);
        change(&mut record);
        let checksum = crc32(&[&record[..BODY_LENGTH]]);
        record[BODY_LENGTH..].copy_from_slice(&checksum.to_le_bytes());
        record
    }

    #[test]
    fn the_format_matches_the_table() {
        let record = contents().encode(0x0a0b_0c0d);
        let body = [
            0x0d, 0x0c, 0x0b, 0x0a, 1, 1, 2, 0, 4, 3, 2, 1, 0x44, 0x33, 0x22, 0x11, 0x98, 0x08, 0,
            0, 0xff, 0xff, 0xff, 0xff, 0, 0, 0, 0,
        ];
        assert_eq!(record[..BODY_LENGTH], body);
        assert_eq!(record[BODY_LENGTH..], crc32(&[&body]).to_le_bytes());
    }

    #[test]
    fn flipped_bits_and_erased_or_zeroed_flash_are_not_records() {
        let record = contents().encode(7);
        for bit in 0..RECORD_LENGTH * 8 {
            let mut flipped = record;
            flipped[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(Contents::decode(&flipped), None);
        }
        assert_eq!(Contents::decode(&[0xff; RECORD_LENGTH]), None);
        assert_eq!(Contents::decode(&[0; RECORD_LENGTH]), None);
    }

    #[test]
    fn a_contradictory_record_is_invalid() {
        let decode = |record| Contents::decode(&record);
        assert_eq!(decode(resealed(|_| ())), Some((7, contents())));
        // Another format, unknown slot, unknown phase.
        assert_eq!(decode(resealed(|record| record[4] = 2)), None);
        assert_eq!(decode(resealed(|record| record[5] = 2)), None);
        assert_eq!(decode(resealed(|record| record[6] = 3)), None);
        // No package in the slot in use; nothing in use but on trial.
        assert_eq!(decode(resealed(|record| record[16..20].fill(0))), None);
        assert_eq!(decode(resealed(|record| record[5] = NO_SLOT)), None);
        // Staged without a package; a trial needs no package to revert to.
        let emptied = |phase| {
            resealed(|record| {
                record[6] = phase;
                record[8..12].fill(0);
            })
        };
        assert_eq!(decode(emptied(1)), None);
        assert!(decode(emptied(2)).is_some());
    }

    #[test]
    fn a_factory_record_names_its_package() {
        let package = b"123456789";
        for slot in [Slot::A, Slot::B] {
            let (sequence, contents) = Contents::decode(&factory_record(slot, package)).unwrap();
            assert_eq!((sequence, contents.in_use), (1, Some(slot)));
            assert_eq!(contents.phase, Phase::Confirmed);
            let extent = Extent { length: 9, checksum: 0xcbf4_3926 };
            assert_eq!(contents.package(slot), Some(extent));
            assert_eq!(contents.package(slot.other()), None);
            let nothing = Some((1, Contents::NOTHING));
            assert_eq!(Contents::decode(&factory_record(slot, &[])), nothing);
        }
    }

    proptest! {
        #[test]
        fn decoding_undoes_encoding(sequence: u32, in_use: Option<bool>, phase in 0..3, packages: [(u32, u32); 2]) {
            let contents = Contents {
                in_use: in_use.map(|b| if b { Slot::B } else { Slot::A }),
                phase: match phase {
                    0 => Phase::Confirmed,
                    1 => Phase::Staged,
                    _ if in_use.is_some() => Phase::Trial,
                    _ => Phase::Confirmed,
                },
                packages: packages.map(|(length, checksum)| Some(Extent { length: length.max(1), checksum })),
            };
            prop_assert_eq!(Contents::decode(&contents.encode(sequence)), Some((sequence, contents)));
        }
    }
}
