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
//! Cost: opening reads the commit area once; appending writes [`RECORD_LENGTH`] bytes, at most
//! twice, and erases at most one half.

use super::flash::{MappedFlash, driver_error, erase_unit};
use super::record::{Contents, RECORD_LENGTH};
use super::{Layout, Slot, StoreError};
use crate::sequence::is_newer;

/// A half of the commit area.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Half {
    First,
    Second,
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
    /// Whether the last write failed, so that flash may hold a newer record than is known here.
    in_doubt: bool,
}

/// What a place holds.
enum Place {
    Free,
    Torn,
    Record(u32, Contents),
}

impl Journal {
    /// Reads the whole commit area. A place that cannot be read counts as torn: flash with error
    /// correction reports a word that way whose write was cut.
    pub(super) fn read<F: MappedFlash>(flash: &mut F, layout: &Layout) -> Self {
        let mut journal =
            Self { sequence: 0, newest: None, next_place: 0, torn: 0, in_doubt: false };
        for half in [Half::First, Half::Second] {
            // The place behind the last that is not free.
            let mut end = 0;
            let mut holds_newest = false;
            for place in 0..layout.places() {
                match read_place(flash, place_offset(layout, half, place)) {
                    Place::Free => continue,
                    Place::Torn => journal.torn = journal.torn.wrapping_add(1),
                    Place::Record(sequence, contents) => {
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
        // Whatever the torn places were to become, their numbers were not higher than this.
        journal.sequence = journal.sequence.wrapping_add(journal.torn);
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
        let half = match self.newest {
            Some((Half::First, _)) => Half::Second,
            Some((Half::Second, _)) | None => Half::First,
        };
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
        let mut found = [0; RECORD_LENGTH];
        flash.read(offset, &mut found).map_err(driver_error)?;
        if found != record {
            return Err(StoreError::Verify { offset });
        }
        self.newest = Some((half, contents));
        self.next_place = place.wrapping_add(1);
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

fn read_place<F: MappedFlash>(flash: &mut F, offset: u32) -> Place {
    let mut bytes = [0; RECORD_LENGTH];
    if flash.read(offset, &mut bytes).is_err() {
        return Place::Torn;
    }
    if bytes == [0xff; RECORD_LENGTH] {
        return Place::Free;
    }
    match Contents::decode(&bytes) {
        Some((sequence, contents)) => Place::Record(sequence, contents),
        None => Place::Torn,
    }
}
