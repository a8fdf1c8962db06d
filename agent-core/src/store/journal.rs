//! The journal of records in the two halves of the commit area.
//!
//! ```text
//! half 0  | record 7 | record 8 | torn | record 9 | free | free |
//! half 1  | record 3 | record 4 | record 5 | torn | record 6 | torn |
//! ```
//!
//! The valid record with the highest number counts, whatever surrounds it. The next record goes
//! after the last written entry in the newest record's half or, if that half is full or refuses the
//! write, to the start of the other half, which is erased first.
//!
//! Invariants: the half with the newest record is never erased, so a record exists at every
//! instant; no word is written twice, because an entry counts as free only if it and all following
//! entries are erased; a number that a torn entry may contain is not reused, because an entry that
//! reads as torn now may read as valid later.
//!
//! # Unreadable entries
//! An entry that the driver fails to read twice in a row is not treated as torn: it may be the
//! newest record, affected by a transient fault. Until a record has been appended, the contents are
//! in doubt, and a half is erased only if no unreadable entry in it can be the newest record: a
//! record was found, and that half contains one too, which is then older. (A half is filled
//! completely before the other, so its records are either all older or all newer.) Appending after
//! the newest record found is allowed: flash with error correction reports interrupted writes as
//! unreadable, and a node must be able to continue.
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

    /// Returns the element that belongs to this half.
    fn of<T>(self, [first, second]: &mut [T; 2]) -> &mut T {
        match self {
            Self::First => first,
            Self::Second => second,
        }
    }
}

/// The newest record, and where the next one is written.
#[derive(Clone, Debug)]
pub(super) struct Journal {
    /// The last sequence number that was, or may have been, used.
    sequence: u32,
    newest: Option<(Half, Contents)>,
    /// Index of the first free entry in the newest record's half.
    next_place: u32,
    /// Entries that are neither free nor valid.
    torn: u32,
    /// Number of unreadable entries, and the first of them.
    unreadable: u32,
    first_unreadable: Option<u32>,
    /// An unreadable entry that may be the newest record and would be erased next.
    blocked_by: Option<u32>,
    /// Whether the last write failed or an entry was unreadable, so that flash may contain a newer
    /// record than known here.
    in_doubt: bool,
}

/// Sequence numbers skipped for each torn or unreadable entry. More than were used in a row by
/// failed writes.
const SKIPPED_NUMBERS: u32 = 0x1_0000;

/// Contents of an entry.
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
        // For each half: the first unreadable entry, and whether it contains a record.
        let mut seen = [(None, false); 2];
        for half in [Half::First, Half::Second] {
            // The entry after the last one that is not free.
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
        // Whatever these entries contain, their numbers are not higher, even if numbers were
        // skipped before each of them.
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

    /// Returns the contents of the newest record.
    pub(super) fn newest(&self) -> Option<Contents> {
        self.newest.map(|(_, contents)| contents)
    }

    /// Returns whether the newest record in flash names, or may name, bytes in `slot`. Without any
    /// record this is in doubt for all slots.
    pub(super) fn may_name(&self, slot: Slot) -> bool {
        self.in_doubt || self.newest().is_none_or(|newest| newest.package(slot).is_some())
    }

    /// Returns the number of unreadable entries found.
    pub(super) fn unreadable(&self) -> u32 {
        self.unreadable
    }

    /// Returns the offset of the first unreadable entry.
    pub(super) fn first_unreadable(&self) -> Option<u32> {
        self.first_unreadable
    }

    /// Treats unreadable entries as torn from now on.
    pub(super) fn forget_unreadable(&mut self) {
        self.blocked_by = None;
    }

    /// Returns the number of entries found neither free nor valid.
    pub(super) fn torn(&self) -> u32 {
        self.torn
    }

    /// Writes `contents` durably. After an error they may or may not survive a reboot.
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
        // An entry can look free and still refuse a write, if an earlier write was interrupted
        // before it changed any readable bit. An erasure repairs that.
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
            // Used up, whether or not the write succeeds.
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
        // Its number is higher than that of any unreadable entry.
        self.blocked_by = None;
        Ok(())
    }
}

/// Returns the offset of an entry. The layout has been validated, so nothing wraps.
fn place_offset(layout: &Layout, half: Half, place: u32) -> u32 {
    let start = match half {
        Half::First => layout.commit,
        Half::Second => layout.commit.wrapping_add(layout.half_length()),
    };
    start.wrapping_add(place.wrapping_mul(RECORD_LENGTH as u32))
}

/// Reads an entry; tries again once if that fails.
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
