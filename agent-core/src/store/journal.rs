//! The journal of records in the two halves of the commit area.
//!
//! ```text
//! half 0  | record 7 | record 8 | torn | record 9 | free | free |
//! half 1  | record 3 | record 4 | record 5 | torn | record 6 | torn |
//! ```
//!
//! The valid record with the highest number counts, whatever lies around it. The next one goes
//! behind everything that was ever written into the half of the newest, or, if that half is full
//! or refuses the write, to the start of the other half, which is erased just before.
//!
//! Invariants: the half that holds the newest record is never erased, so there is no instant
//! without one; no word is written twice, for a place counts as free only if it and all behind it
//! is erased; a number that a torn place may hold is not given out again, since what reads as torn
//! now may read as whole one day.
//!
//! # Places that cannot be read
//! What the driver refuses to read, twice in a row, is not taken for torn: it may be the newest
//! record behind a disturbance that passes. Until a record has been appended, everything is
//! therefore in doubt, and a half is erased only if no such place in it can be the newest record:
//! if a record was found, and one in that half too, which is then older. (A half is filled in one
//! go, so that its records are all older or all newer than those of the other.) Behind the newest
//! record that was found, appending is allowed: flash with error correction reports words that
//! way whose write was cut, and a node must get on after that.
//!
//!
//! Cost: opening reads the commit area once; appending writes [`RECORD_LENGTH`] bytes, at most
//! twice, and erases at most one half.

use super::flash::{MappedFlash, driver_error, erase_unit};
use super::record::{Contents, RECORD_LENGTH};
use super::{Layout, Slot, StoreError};
use crate::wire::sequence::is_newer;

/// A half of the commit area.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Half {
    First,
    Second,
}

impl Half {
    fn other(self) -> Self {
        match self {
            Self::First => Self::Second,
            Self::Second => Self::First,
        }
    }

    /// This half's of two things.
    fn of<T>(self, [first, second]: &mut [T; 2]) -> &mut T {
        match self {
            Self::First => first,
            Self::Second => second,
        }
    }
}

/// The newest record, and where the next one goes.
#[derive(Clone, Debug)]
pub(super) struct Journal {
    /// The last number that was, or may have been, given out.
    sequence: u32,
    newest: Option<(Half, Contents)>,
    /// The first free place in the half of the newest record.
    next_place: u32,
    /// Places that hold something and yet no record.
    torn: u32,
    /// Places that could not be read, and the first of them.
    unreadable: u32,
    first_unreadable: Option<u32>,
    /// A place that could not be read, may hold the newest record, and would be erased next.
    blocked_by: Option<u32>,
    /// Whether the last write failed or a place could not be read, so that flash may hold a newer
    /// record than is known here.
    in_doubt: bool,
}

/// How many numbers are left out for each place that is torn or cannot be read. More than were
/// spent in a row on writes that failed.
const SKIPPED_NUMBERS: u32 = 0x1_0000;

/// What a place holds.
enum Place {
    Free,
    Torn,
    Unreadable,
    Record(u32, Contents),
}

impl Journal {
    /// Reads the whole commit area.
    pub(super) fn read<F: MappedFlash>(flash: &mut F, layout: &Layout) -> Self {
        let mut journal = Self {
            sequence: 0,
            newest: None,
            next_place: 0,
            torn: 0,
            unreadable: 0,
            first_unreadable: None,
            blocked_by: None,
            in_doubt: false,
        };
        // Of each half: the first place that could not be read, and whether it has a record.
        let mut seen = [(None, false); 2];
        for half in [Half::First, Half::Second] {
            // The place behind the last that is not free.
            let mut end = 0;
            let mut holds_newest = false;
            let (first_unreadable, has_record) = half.of(&mut seen);
            for place in 0..layout.places() {
                let offset = place_offset(layout, half, place);
                match read_place(flash, offset) {
                    Place::Free => continue,
                    Place::Torn => journal.torn = journal.torn.wrapping_add(1),
                    Place::Unreadable => {
                        journal.unreadable = journal.unreadable.wrapping_add(1);
                        first_unreadable.get_or_insert(offset);
                    }
                    Place::Record(sequence, contents) => {
                        *has_record = true;
                        if journal.newest.is_none() || is_newer(sequence, journal.sequence) {
                            journal.newest = Some((half, contents));
                            journal.sequence = sequence;
                            holds_newest = true;
                        }
                    }
                }
                end = place.wrapping_add(1);
            }
            if holds_newest {
                journal.next_place = end;
            }
        }
        // Whatever these places hold or were to become, their numbers were not higher, even if
        // numbers were left out before each of them.
        let unknown = journal.torn.wrapping_add(journal.unreadable);
        journal.sequence = journal.sequence.wrapping_add(unknown.wrapping_mul(SKIPPED_NUMBERS));
        journal.in_doubt = journal.unreadable > 0;
        let [(in_first, _), (in_second, _)] = seen;
        journal.first_unreadable = in_first.or(in_second);
        journal.blocked_by = match journal.newest {
            None => journal.first_unreadable,
            Some((half, _)) => {
                let (first_unreadable, has_record) = *half.other().of(&mut seen);
                first_unreadable.filter(|_| !has_record)
            }
        };
        journal
    }

    /// What the newest record says.
    pub(super) fn newest(&self) -> Option<Contents> {
        self.newest.map(|(_, contents)| contents)
    }

    /// Whether the newest record in flash names, or may name, bytes in `slot`. Without any record
    /// everything is in doubt.
    pub(super) fn may_name(&self, slot: Slot) -> bool {
        self.in_doubt || self.newest().is_none_or(|newest| newest.package(slot).is_some())
    }

    /// How many places could not be read when the journal was.
    pub(super) fn unreadable(&self) -> u32 {
        self.unreadable
    }

    /// The first of them.
    pub(super) fn first_unreadable(&self) -> Option<u32> {
        self.first_unreadable
    }

    /// Takes what could not be read for torn.
    pub(super) fn forget_unreadable(&mut self) {
        self.blocked_by = None;
    }

    /// How many places held something and yet no record when the journal was read.
    pub(super) fn torn(&self) -> u32 {
        self.torn
    }

    /// Makes `contents` survive a reboot. After an error they may or may not.
    pub(super) fn append<F: MappedFlash>(
        &mut self,
        flash: &mut F,
        layout: &Layout,
        contents: Contents,
    ) -> Result<(), StoreError> {
        let outcome = self.write_somewhere(flash, layout, contents);
        self.in_doubt = outcome.is_err();
        outcome
    }

    fn write_somewhere<F: MappedFlash>(
        &mut self,
        flash: &mut F,
        layout: &Layout,
        contents: Contents,
    ) -> Result<(), StoreError> {
        if let Some((half, _)) = self.newest
            && self.next_place < layout.places()
            && self.write(flash, layout, half, self.next_place, contents).is_ok()
        {
            return Ok(());
        }
        // A place can look free and still refuse a write, after one that was cut before it
        // changed any bit that can be read. An erasure heals that.
        let half = self.newest.map_or(Half::First, |(half, _)| half.other());
        if let Some(offset) = self.blocked_by {
            return Err(StoreError::Unreadable { offset });
        }
        let start = place_offset(layout, half, 0);
        let mut erased = 0;
        while erased < layout.half_length() {
            erase_unit(flash, start.wrapping_add(erased))?;
            erased = erased.wrapping_add(F::ERASE_SIZE as u32);
        }
        self.write(flash, layout, half, 0, contents)
    }

    /// Writes a record with the next number and reads it back.
    fn write<F: MappedFlash>(
        &mut self,
        flash: &mut F,
        layout: &Layout,
        half: Half,
        place: u32,
        contents: Contents,
    ) -> Result<(), StoreError> {
        self.sequence = self.sequence.wrapping_add(1);
        if self.newest.is_some_and(|(newest, _)| newest == half) {
            // Spent, whatever becomes of it.
            self.next_place = place.wrapping_add(1);
        }
        let offset = place_offset(layout, half, place);
        let record = contents.encode(self.sequence);
        flash.write(offset, &record).map_err(driver_error)?;
        if read_record(flash, offset).map_err(driver_error)? != record {
            return Err(StoreError::Verify { offset });
        }
        self.newest = Some((half, contents));
        self.next_place = place.wrapping_add(1);
        // It has a higher number than whatever could not be read.
        self.blocked_by = None;
        Ok(())
    }
}

/// Where a place begins. The layout has been validated, so nothing wraps.
fn place_offset(layout: &Layout, half: Half, place: u32) -> u32 {
    let start = match half {
        Half::First => layout.commit,
        Half::Second => layout.commit.wrapping_add(layout.half_length()),
    };
    start.wrapping_add(place.wrapping_mul(RECORD_LENGTH as u32))
}

/// The bytes of a place; a second look if the first one fails.
fn read_record<F: MappedFlash>(
    flash: &mut F,
    offset: u32,
) -> Result<[u8; RECORD_LENGTH], F::Error> {
    let mut bytes = [0; RECORD_LENGTH];
    if flash.read(offset, &mut bytes).is_err() {
        flash.read(offset, &mut bytes)?;
    }
    Ok(bytes)
}

fn read_place<F: MappedFlash>(flash: &mut F, offset: u32) -> Place {
    let Ok(bytes) = read_record(flash, offset) else { return Place::Unreadable };
    if bytes == [0xff; RECORD_LENGTH] {
        return Place::Free;
    }
    match Contents::decode(&bytes) {
        Some((sequence, contents)) => Place::Record(sequence, contents),
        None => Place::Torn,
    }
}
