//! The records of the journal, and the state of the store as the record of kind 0.
//!
//! | offset | field | encoding |
//! | --- | --- | --- |
//! | 0 | number | `u32`, higher than that of every record before, wraps |
//! | 4 | format | one byte, [`FORMAT`] |
//! | 5 | kind | one byte: 0 is the state, 1 to 31 are notes |
//! | 6 | void | one byte: how many pairs right before this one do not count, whatever they hold; 255: the other half does not |
//! | 7 | length | one byte: length of the payload, 0 to 52 |
//! | 8 | payload | 52 bytes, padded with zeros |
//! | 60 | checksum | `u32`, CRC-32 of the 60 bytes before |
//!
//! The state's payload has 52 bytes:
//!
//! | offset | field | encoding |
//! | --- | --- | --- |
//! | 8 | slot in use | one byte: 0 is A, 1 is B, 0xFF none |
//! | 9 | phase | one byte: 0 confirmed, 1 staged, 2 trial |
//! | 10 | reason for the last revert | one byte |
//! | 11 | flags | bit 0: a package was activated; bit 1: one was reverted; others 0 |
//! | 12, 16 | package in slot A: length, checksum | two `u32`; length 0 means no package |
//! | 20, 24 | package in slot B | likewise |
//! | 28, 32 | highest serial ever activated: epoch, version | two `u32` |
//! | 36, 40 | serial on trial | likewise |
//! | 44, 48 | serial of the last revert | likewise |
//! | 52 | reserved | 0 |
//!
//! The last four bytes of the payload of a record with void 255 are the kinds of which its half holds
//! a record, one bit each.
//!
//! All little-endian. Each record is complete and stored twice, so one valid copy is enough. Its
//! length is a multiple of every supported word, so no two records share a word. Erased or zeroed
//! flash is not a valid record.
//!
//! # Format 1
//! Records of format 1 have 32 bytes and hold only a state. They are read, and the next record of
//! format 2 replaces them:
//!
//! | offset | field |
//! | --- | --- |
//! | 0 | number |
//! | 4, 5, 6 | format: 1; slot in use; phase |
//! | 8, 12, 16, 20 | packages in slot A and slot B |
//! | 28 | CRC-32 of the 28 bytes before |

use super::layout::{HEADER_LENGTH, NOTE_LENGTH_MAX, RECORD_LENGTH};
use super::{Revert, Slot};
use crate::package::Serial;
use crate::wire::crc::{CHECKSUM_LENGTH, crc32};

/// Version of the record format that this crate writes.
pub const FORMAT: u8 = 2;

/// Length of a record of format 1, and the unit in which the journal is read. \[byte\]
pub(super) const UNIT_LENGTH: usize = 32;
/// Kinds of records are less than this.
pub(super) const KINDS: u8 = 32;
/// The kind of the state.
pub(super) const STATE: u8 = 0;

/// A note that only declares what is before it void.
pub(super) const VOID: u8 = KINDS - 1;
/// Instead of a count of void pairs: the copies into this half are complete, and the other half
/// no longer counts, whatever it holds.
pub(super) const OTHER_HALF: u8 = u8::MAX;

const FORMAT_1: u8 = 1;
/// Offset of the format's number in records of both formats. \[byte\]
const FORMAT_OFFSET: usize = 4;
const BODY_LENGTH: usize = RECORD_LENGTH - CHECKSUM_LENGTH;
const NO_SLOT: u8 = 0xff;
const WAS_ACTIVATED: u8 = 1;
const WAS_REVERTED: u8 = 2;

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

/// Contents and purpose of both slots, and what is remembered of earlier packages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Contents {
    pub(super) in_use: Option<Slot>,
    pub(super) phase: Phase,
    /// The packages in slot A and slot B.
    pub(super) packages: [Option<Extent>; 2],
    /// The highest serial ever activated.
    pub(super) activated: Option<Serial>,
    /// The serial that went on trial last.
    pub(super) tried: Serial,
    pub(super) last_revert: Option<Revert>,
}

/// A record without its number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Record {
    pub(super) kind: u8,
    /// Pairs right before this one that do not count.
    pub(super) void: u8,
    pub(super) length: u8,
    pub(super) payload: [u8; NOTE_LENGTH_MAX],
}

impl Extent {
    /// Describes `bytes`; `None` if they are empty or longer than any flash.
    pub(super) fn of(bytes: &[u8]) -> Option<Self> {
        let length = u32::try_from(bytes.len()).ok().filter(|&length| length > 0)?;
        Some(Self { length, checksum: crc32(&[bytes]) })
    }
}

impl Record {
    /// Creates a note; `None` if the kind is not one of a note or the payload is too long.
    pub(super) fn note(kind: u8, payload: &[u8]) -> Option<Self> {
        let length = u8::try_from(payload.len()).ok()?;
        let is_valid = kind != STATE && kind < KINDS && payload.len() <= NOTE_LENGTH_MAX;
        is_valid.then_some(())?;
        let mut note = Self { kind, void: 0, length, payload: [0; NOTE_LENGTH_MAX] };
        note.payload.iter_mut().zip(payload).for_each(|(place, byte)| *place = *byte);
        Some(note)
    }

    /// Returns whether it says the same, wherever it is stored.
    pub(super) fn says_the_same(&self, other: &Self) -> bool {
        let both_are_empty = self.length == 0 && other.length == 0;
        self.kind == other.kind
            && self.length == other.length
            && (both_are_empty
                || match (self.state(), other.state()) {
                    (None, None) => self.payload == other.payload,
                    (one, another) => one == another,
                })
    }

    /// Returns the record with `void` 255, and the kinds that its half holds.
    pub(super) fn voiding(mut self, kinds: u32) -> Self {
        self.void = OTHER_HALF;
        if let Some(place) = self.payload.last_chunk_mut() {
            *place = kinds.to_le_bytes();
        }
        self
    }

    /// Returns the kinds that its half holds, if it declares the other half void.
    pub(super) fn complete_with(&self) -> Option<u32> {
        let is_last_copy = self.void == OTHER_HALF && matches!(self.kind, STATE | VOID);
        let kinds = self.payload.last_chunk().filter(|_| is_last_copy)?;
        Some(u32::from_le_bytes(*kinds))
    }

    /// Encodes the record with a number.
    pub(super) fn encode(&self, number: u32) -> [u8; RECORD_LENGTH] {
        let Self { kind, void, length, payload } = self;
        let mut record = [0; RECORD_LENGTH];
        let (body, checksum) = record.split_at_mut(BODY_LENGTH);
        let header = number.to_le_bytes().into_iter().chain([FORMAT, *kind, *void, *length]);
        let bytes = header.chain(payload.iter().copied());
        body.iter_mut().zip(bytes).for_each(|(place, byte)| *place = byte);
        checksum.copy_from_slice(&crc32(&[body]).to_le_bytes());
        record
    }

    /// Decodes the number and the record; `None` if the bytes are not a record of this format, or if they
    /// are a state that contradicts itself.
    pub(super) fn decode(record: &[u8; RECORD_LENGTH]) -> Option<(u32, Self)> {
        let body = checked(record, FORMAT)?;
        let (header, payload) = body.split_first_chunk::<HEADER_LENGTH>()?;
        let &[n0, n1, n2, n3, _, kind, void, length] = header;
        let payload = *payload.first_chunk::<NOTE_LENGTH_MAX>()?;
        let record = Self { kind, void, length, payload };
        let is_valid = match kind {
            STATE => record.state().is_some(),
            _ => kind < KINDS && usize::from(length) <= NOTE_LENGTH_MAX,
        };
        is_valid.then_some((u32::from_le_bytes([n0, n1, n2, n3]), record))
    }

    /// Decodes a record of format 1.
    pub(super) fn decode_format_1(record: &[u8; UNIT_LENGTH]) -> Option<(u32, Self)> {
        let mut words = Words(checked(record, FORMAT_1)?);
        let number = words.next()?;
        let [_, in_use, phase, _] = words.next()?.to_le_bytes();
        let contents = Contents::of(in_use, phase, [words.extent()?, words.extent()?])?;
        Some((number, contents.record()))
    }

    /// Returns the state that it holds, if it is one and does not contradict itself.
    pub(super) fn state(&self) -> Option<Contents> {
        (self.kind == STATE && usize::from(self.length) == NOTE_LENGTH_MAX).then_some(())?;
        let mut words = Words(&self.payload);
        let [in_use, phase, reason, flags] = words.next()?.to_le_bytes();
        let contents = Contents::of(in_use, phase, [words.extent()?, words.extent()?])?;
        let activated = words.serial()?;
        let tried = words.serial()?;
        let last_revert = Revert { serial: words.serial()?, reason };
        Some(Contents {
            activated: (flags & WAS_ACTIVATED != 0).then_some(activated),
            tried,
            last_revert: (flags & WAS_REVERTED != 0).then_some(last_revert),
            ..contents
        })
    }
}

/// Returns the bytes before the checksum, if that and the format match.
fn checked(record: &[u8], format: u8) -> Option<&[u8]> {
    // Most places of a journal are erased; computing a checksum of each would take most of a boot.
    (record.get(FORMAT_OFFSET) == Some(&format)).then_some(())?;
    let (body, checksum) = record.split_last_chunk::<CHECKSUM_LENGTH>()?;
    (crc32(&[body]) == u32::from_le_bytes(*checksum)).then_some(body)
}

/// Little-endian words, one after the other.
struct Words<'a>(&'a [u8]);

impl Words<'_> {
    fn next(&mut self) -> Option<u32> {
        let (word, rest) = self.0.split_first_chunk::<4>()?;
        self.0 = rest;
        Some(u32::from_le_bytes(*word))
    }

    #[expect(
        clippy::option_option,
        reason = "whether there are words, and whether they name a package"
    )]
    fn extent(&mut self) -> Option<Option<Extent>> {
        let (length, checksum) = (self.next()?, self.next()?);
        Some((length > 0).then_some(Extent { length, checksum }))
    }

    fn serial(&mut self) -> Option<Serial> {
        Some(Serial { epoch: self.next()?, version: self.next()? })
    }
}

impl Contents {
    /// No packages, now or before.
    pub(super) const NOTHING: Self = Self {
        in_use: None,
        phase: Phase::Confirmed,
        packages: [None; 2],
        activated: None,
        tried: Serial { epoch: 0, version: 0 },
        last_revert: None,
    };

    /// Returns the contents with these codes; `None` if a code is unknown or a slot that is in use,
    /// staged or on trial is empty.
    fn of(in_use: u8, phase: u8, packages: [Option<Extent>; 2]) -> Option<Self> {
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
        let contents = Self { in_use, phase, packages, ..Self::NOTHING };
        let named = match phase {
            Phase::Confirmed => in_use,
            Phase::Staged => Some(contents.spare()),
            Phase::Trial => Some(in_use?),
        };
        let mut all_there = [in_use, named].into_iter().flatten();
        all_there.all(|slot| contents.package(slot).is_some()).then_some(contents)
    }

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

    /// Returns the contents with the staged package in `slot` on trial.
    pub(super) fn on_trial(self, slot: Slot, serial: Serial, highest: Serial) -> Self {
        let activated = self.activated.max(Some(serial)).max(Some(highest));
        Self { in_use: Some(slot), phase: Phase::Trial, tried: serial, activated, ..self }
    }

    /// Returns the contents after a failed trial: what was in use before is in use again, if
    /// anything. The package on trial is removed, so that nothing falls back to it.
    pub(super) fn reverted(self, reason: u8) -> Self {
        let before = self.in_use.map(Slot::other).filter(|&slot| self.package(slot).is_some());
        let failed = self.in_use.map_or(self, |failed| self.with_package(failed, None));
        let last_revert = Some(Revert { serial: self.tried, reason });
        Self { in_use: before, phase: Phase::Confirmed, last_revert, ..failed }
    }

    /// Returns the contents after a reboot.
    pub(super) fn rebooted(self) -> Self {
        if self.phase == Phase::Trial { self.reverted(Revert::BY_RESET) } else { self }
    }

    /// Returns the record of this state.
    pub(super) fn record(&self) -> Record {
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
        let mut flags = 0;
        if self.activated.is_some() {
            flags |= WAS_ACTIVATED;
        }
        if self.last_revert.is_some() {
            flags |= WAS_REVERTED;
        }
        let revert = self.last_revert.unwrap_or_default();
        let [a, b] = self.packages.map(|package| match package {
            Some(Extent { length, checksum }) => [length, checksum],
            None => [0, 0],
        });
        let activated = self.activated.unwrap_or_default();
        let words = [
            u32::from_le_bytes([in_use, phase, revert.reason, flags]),
            a[0],
            a[1],
            b[0],
            b[1],
            activated.epoch,
            activated.version,
            self.tried.epoch,
            self.tried.version,
            revert.serial.epoch,
            revert.serial.version,
        ];
        let mut payload = [0; NOTE_LENGTH_MAX];
        for (bytes, word) in payload.chunks_exact_mut(4).zip(words) {
            bytes.copy_from_slice(&word.to_le_bytes());
        }
        Record { kind: STATE, void: 0, length: NOTE_LENGTH_MAX as u8, payload }
    }
}

/// Returns the start of a factory image's commit area, one record in two copies: `package`, of the
/// serial `activated`, is at the start of `slot`, in use and confirmed, and the other slot is
/// empty. The rest of the commit area must be erased, because a leftover record could be newer. If
/// `package` is empty, nothing is in use.
#[must_use]
pub fn factory_record(
    slot: Slot,
    package: &[u8],
    activated: Option<Serial>,
) -> [u8; 2 * RECORD_LENGTH] {
    let extent = Extent::of(package);
    let in_use = extent.map(|_| slot);
    let contents = Contents { in_use, activated, ..Contents::NOTHING }.with_package(slot, extent);
    let record = contents.record().encode(1);
    let mut both = [0; 2 * RECORD_LENGTH];
    both.iter_mut().zip(record.iter().chain(&record)).for_each(|(place, byte)| *place = *byte);
    both
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
            activated: Some(Serial { epoch: 2, version: 9 }),
            tried: Serial { epoch: 1, version: 7 },
            last_revert: Some(Revert { serial: Serial { epoch: 3, version: 4 }, reason: 5 }),
        }
    }

    fn decode(record: [u8; RECORD_LENGTH]) -> Option<(u32, Contents)> {
        let (number, record) = Record::decode(&record)?;
        Some((number, record.state()?))
    }

    /// Returns the record after `change`, with a matching checksum.
    fn resealed(change: impl FnOnce(&mut [u8; RECORD_LENGTH])) -> [u8; RECORD_LENGTH] {
        let mut record = contents().record().encode(7);
        change(&mut record);
        let checksum = crc32(&[&record[..BODY_LENGTH]]);
        record[BODY_LENGTH..].copy_from_slice(&checksum.to_le_bytes());
        record
    }

    #[test]
    fn the_format_matches_the_table() {
        let mut record = contents().record();
        record.void = 6;
        let record = record.encode(0x0a0b_0c0d);
        let body = [
            0x0d, 0x0c, 0x0b, 0x0a, 2, 0, 6, 52, 1, 2, 5, 3, 4, 3, 2, 1, 0x44, 0x33, 0x22, 0x11,
            0x98, 0x08, 0, 0, 0xff, 0xff, 0xff, 0xff, 2, 0, 0, 0, 9, 0, 0, 0, 1, 0, 0, 0, 7, 0, 0,
            0, 3, 0, 0, 0, 4, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0,
        ];
        assert_eq!(record[..BODY_LENGTH], body);
        assert_eq!(record[BODY_LENGTH..], crc32(&[&body]).to_le_bytes());
    }

    #[test]
    fn records_of_format_1_are_read() {
        let mut record = [0; UNIT_LENGTH];
        record[..8].copy_from_slice(&[0x0d, 0x0c, 0x0b, 0x0a, 1, 1, 2, 0]);
        record[8..16].copy_from_slice(&[4, 3, 2, 1, 0x44, 0x33, 0x22, 0x11]);
        record[16..24].copy_from_slice(&[0x98, 0x08, 0, 0, 0xff, 0xff, 0xff, 0xff]);
        let checksum = crc32(&[&record[..28]]);
        record[28..].copy_from_slice(&checksum.to_le_bytes());
        let (number, found) = Record::decode_format_1(&record).unwrap();
        let expected =
            Contents { activated: None, tried: Serial::default(), last_revert: None, ..contents() };
        assert_eq!((number, found.state()), (0x0a0b_0c0d, Some(expected)));
        for bit in 0..UNIT_LENGTH * 8 {
            let mut flipped = record;
            flipped[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(Record::decode_format_1(&flipped), None);
        }
        assert_eq!(Record::decode_format_1(&[0xff; UNIT_LENGTH]), None);
    }

    #[test]
    fn flipped_bits_and_erased_or_zeroed_flash_are_not_records() {
        let record = contents().record().encode(7);
        for bit in 0..RECORD_LENGTH * 8 {
            let mut flipped = record;
            flipped[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(Record::decode(&flipped), None);
        }
        assert_eq!(Record::decode(&[0xff; RECORD_LENGTH]), None);
        assert_eq!(Record::decode(&[0; RECORD_LENGTH]), None);
    }

    #[test]
    fn a_contradictory_record_is_invalid() {
        assert_eq!(decode(resealed(|_| ())), Some((7, contents())));
        // Another format or kind, a short state, unknown slot, unknown phase.
        assert_eq!(decode(resealed(|record| record[4] = 3)), None);
        assert_eq!(Record::decode(&resealed(|record| record[5] = KINDS)), None);
        assert_eq!(Record::decode(&resealed(|record| record[7] = 51)), None);
        assert_eq!(decode(resealed(|record| record[8] = 2)), None);
        assert_eq!(decode(resealed(|record| record[9] = 3)), None);
        // No package in the slot in use; nothing in use but on trial.
        assert_eq!(decode(resealed(|record| record[20..24].fill(0))), None);
        assert_eq!(decode(resealed(|record| record[8] = NO_SLOT)), None);
        // Staged without a package; a trial needs no package to revert to.
        let emptied = |phase| {
            resealed(|record| {
                record[9] = phase;
                record[12..16].fill(0);
            })
        };
        assert_eq!(decode(emptied(1)), None);
        assert!(decode(emptied(2)).is_some());
        // A note that is longer than its room.
        let note = resealed(|record| record[5..8].copy_from_slice(&[9, 0, 53]));
        assert_eq!(Record::decode(&note), None);
    }

    #[test]
    fn a_factory_record_names_its_package() {
        let package = b"123456789";
        let activated = Some(Serial { epoch: 1, version: 2 });
        for slot in [Slot::A, Slot::B] {
            let both = factory_record(slot, package, activated);
            let (first, second) = both.split_first_chunk::<RECORD_LENGTH>().unwrap();
            assert_eq!(first, second);
            let (number, contents) = decode(*first).unwrap();
            assert_eq!((number, contents.in_use), (1, Some(slot)));
            assert_eq!((contents.phase, contents.activated), (Phase::Confirmed, activated));
            let extent = Extent { length: 9, checksum: 0xcbf4_3926 };
            assert_eq!(contents.package(slot), Some(extent));
            assert_eq!(contents.package(slot.other()), None);
            let nothing = factory_record(slot, &[], None);
            assert_eq!(decode(*nothing.first_chunk().unwrap()), Some((1, Contents::NOTHING)));
        }
    }

    #[test]
    fn a_failed_trial_is_remembered_and_the_highest_edition_stays() {
        let (low, high) = (Serial { epoch: 1, version: 0 }, Serial { epoch: 0, version: 9 });
        assert!(low > high);
        let tried = contents().on_trial(Slot::A, low, low);
        assert_eq!(tried.activated, Some(Serial { epoch: 2, version: 9 }));
        assert_eq!(
            tried.rebooted().last_revert,
            Some(Revert { serial: low, reason: Revert::BY_RESET })
        );
        assert_eq!(
            Contents::NOTHING.on_trial(Slot::A, high, high).on_trial(Slot::B, low, low).activated,
            Some(low)
        );
    }

    proptest! {
        #[test]
        fn decoding_undoes_encoding(
            number: u32,
            in_use: Option<bool>,
            phase in 0..3,
            packages: [(u32, u32); 2],
            serials: [(u32, u32); 3],
            known: [bool; 2],
            reason: u8,
        ) {
            let [activated, tried, reverted] =
                serials.map(|(epoch, version)| Serial { epoch, version });
            let contents = Contents {
                in_use: in_use.map(|b| if b { Slot::B } else { Slot::A }),
                phase: match phase {
                    0 => Phase::Confirmed,
                    1 => Phase::Staged,
                    _ if in_use.is_some() => Phase::Trial,
                    _ => Phase::Confirmed,
                },
                packages: packages.map(|(length, checksum)| Some(Extent { length: length.max(1), checksum })),
                activated: known[0].then_some(activated),
                tried,
                last_revert: known[1].then_some(Revert { serial: reverted, reason }),
            };
            prop_assert_eq!(decode(contents.record().encode(number)), Some((number, contents)));
        }

        #[test]
        fn notes_keep_their_bytes(kind in 1..KINDS, payload in proptest::collection::vec(any::<u8>(), 0..=NOTE_LENGTH_MAX)) {
            let note = Record::note(kind, &payload).unwrap();
            let (number, found) = Record::decode(&note.encode(3)).unwrap();
            prop_assert_eq!((number, found), (3, note));
            prop_assert_eq!(&found.payload[..usize::from(found.length)], &payload[..]);
        }
    }
}
