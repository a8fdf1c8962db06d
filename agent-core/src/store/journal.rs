//! The journal of records in the two halves of the commit area.
//!
//! ```text
//! half 0  | state 7 | state 7 | note 8 | note 8 | torn |  free  | free | free |
//! half 1  | state 3 | state 3 | state 5 | state 5 | note 6 | note 6 | torn | torn |
//!              one pair            one pair
//! ```
//!
//! Each record is stored twice, in the two places of a pair, and each record has a kind. Of each kind
//! the last one counts, whatever surrounds it. The next record goes to the first pair after
//! everything ever written in the active half, the one that holds the last record of every kind. If
//! that half is full or refuses the write, the other half is erased and takes a copy of the last
//! record of every kind. The copy of the state is the last one and says that all are there. Until
//! then both halves say the same. The new record follows the copies.
//!
//! Invariants:
//! - A half is erased only while the other one holds the last record of every kind, so every one of
//!   them exists at every instant, in two copies.
//! - No word is written twice, because a pair counts as free only if it and all following pairs are
//!   erased.
//! - No number that a torn place after the last record may contain is used again.
//!
//! # What power cuts leave behind
//! A word whose write was cut can read differently each time. Therefore a boot settles what it has
//! found before anything acts on it:
//! - A record of which there is only one copy, as after a cut between the two, is written again.
//! - A pair after the last record that holds something else may read as a record at a later boot.
//!   The state is then written again after it, and says how many pairs right before it are void.
//! - If the record that says that the copies are complete has one copy itself, the other half still
//!   counts, and a half that has to be erased is the one with the copies as long as nothing follows
//!   them. If a copy is missing, the half is being erased again, and that record does not count.
//! - A half that may read as anything, since its erasure was interrupted, is erased at once.
//!
//! # Unreadable places
//! A place that the driver fails to read twice in a row may hold a record behind a fault that
//! passes. What a call has returned `Ok` for is stored in both places of a pair, so a pair with a free
//! place holds nothing of the kind: it is a write that was cut, which flash with error correction
//! reports as unreadable. A pair without a record, without a free place and with an unreadable one
//! is in doubt. After the last record it keeps a boot from writing anything; calls still append.
//! A half without any record, or with incomplete copies, is the remainder of an interrupted erasure,
//! if the other half has records: that was full when the erasure began. A boot erases it. Only if no
//! record is found at all and a pair is in doubt does the store refuse to record anything.
//!
//! Cost: opening reads the commit area once, and again for each kind that both halves have;
//! appending writes two records, or all kinds and the record twice after erasing one half.

use super::flash::{MappedFlash, driver_error, erase_unit};
use super::layout::{PAIR_LENGTH, RECORD_LENGTH};
use super::record::{Contents, KINDS, OTHER_HALF, Record, STATE, UNIT_LENGTH, VOID};
use super::{Damage, Layout, Slot, StoreError};
use crate::wire::sequence::is_newer;

/// Numbers skipped for each unit of a pair that may hold a record: more than failed writes in a row
/// have used.
const SKIPPED_NUMBERS: u32 = 0x1_0000 * (PAIR_LENGTH / UNIT_LENGTH as u32);

/// Which half of the commit area.
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
}

/// The last record of each kind, and where the next one is written.
#[derive(Clone, Debug)]
pub(super) struct Journal {
    /// The last number that was, or may have been, used.
    number: u32,
    newest: Option<Contents>,
    active: Half,
    /// The first free pair in the active half.
    next_pair: u32,
    /// Pairs right before it that hold no record that counts.
    void: u8,
    /// Whether the other half does not count.
    is_alone: bool,
    /// Kinds of which the active half holds a record, one bit each.
    kinds: u32,
    /// Notes of which there is only one copy, or none in the active half.
    to_repeat: u32,
    damage: Damage,
    /// Whether the record that declares the other half void has lost a copy.
    is_half_void: bool,
    /// Whether the other half holds something that may read as a record at another boot.
    is_there_unknown: bool,
    /// Whether another boot may find another state.
    is_unsettled: bool,
    /// An unreadable place that keeps a boot from writing.
    held_by: Option<u32>,
    /// An unreadable place that may hold the only record.
    blocked_by: Option<u32>,
    /// Whether flash may contain a newer state than known here.
    in_doubt: bool,
}

/// A record, where it was found.
struct Found {
    number: u32,
    record: Record,
    /// Whether both copies are valid.
    is_whole: bool,
    is_format_1: bool,
}

/// Contents of a pair.
enum Pair {
    Free,
    /// The offset is that of an unreadable place.
    Unknown {
        unreadable: Option<u32>,
        is_in_doubt: bool,
    },
    Record {
        found: Found,
        unreadable: Option<u32>,
    },
}

/// What one half holds.
#[derive(Default)]
struct Scan {
    /// Number of the last record.
    newest: Option<u32>,
    /// The pair after the last one that is not free.
    end: u32,
    /// Pairs after the last record that hold something else.
    unknown: u32,
    /// How many of them are right before the end and not in doubt.
    void: u8,
    /// An unreadable place after the last record that may hold a newer one.
    in_doubt: Option<u32>,
    kinds: u32,
    /// Kinds whose last record has one copy.
    single: u32,
    /// The last state and its number.
    state: Option<(u32, Contents)>,
    is_format_1: bool,
    /// Whether a record says that the other half does not count, and whether it has both copies.
    voids_other: Option<bool>,
    /// Kinds that it says are copied, and those of them whose last record is a copy with one copy.
    copied: u32,
    single_copied: u32,
}

impl Journal {
    /// A journal that has not been read: it holds nothing and writes nothing.
    pub(super) const UNREAD: Self = Self {
        number: 0,
        newest: None,
        active: Half::First,
        next_pair: 0,
        void: 0,
        is_alone: false,
        kinds: 0,
        to_repeat: 0,
        damage: Damage { torn_places: 0, unreadable_places: 0, single_copies: 0 },
        is_half_void: false,
        is_there_unknown: false,
        is_unsettled: true,
        held_by: Some(0),
        blocked_by: Some(0),
        in_doubt: true,
    };

    /// Reads the whole commit area.
    pub(super) fn read<F: MappedFlash>(flash: &mut F, layout: &Layout) -> Self {
        let mut damage = Damage::default();
        let first = Scan::of(flash, layout, Half::First, &mut damage);
        let second = Scan::of(flash, layout, Half::Second, &mut damage);
        let is_second_newer = match (first.newest, second.newest) {
            (Some(first), Some(second)) => is_newer(second, first),
            (None, None) => {
                // Behind what the halves hold, as long as there is room.
                first.end >= layout.pairs() && second.end < layout.pairs()
            }
            (first, _) => first.is_none(),
        };
        let newer = if is_second_newer { Half::Second } else { Half::First };
        let kinds = first.kinds | second.kinds;
        let (older, newest) = if is_second_newer { (&first, &second) } else { (&second, &first) };
        // If a copy is missing or damaged, the newer half may be being erased again.
        let is_complete = newest.copied & !newest.kinds == 0 && newest.single_copied == 0;
        let voids_other = newest.voids_other.filter(|_| is_complete);
        let is_alone = older.kinds == 0 || voids_other == Some(true);
        // Copies into the newer half count from the moment on at which they are complete.
        let is_copying =
            !is_alone && voids_other.is_none() && holds_all(flash, layout, newer.other(), kinds);
        let active = if is_copying { newer.other() } else { newer };
        let has_records = kinds != 0;
        let number = newest.newest;
        let is_there_cut = newest.voids_other.is_some();
        let newest = match (newest.state, older.state) {
            (Some(newest), Some(older)) if !is_alone && is_newer(older.0, newest.0) => Some(older),
            (newest, older) => newest.or(older),
        };
        let (here, there) = match active {
            Half::First => (first, second),
            Half::Second => (second, first),
        };
        // A half whose records are older has nothing newer behind them.
        let is_there_unknown = (there.newest.is_none() && there.unknown > 0)
            || (is_copying && (there.unknown > 0 || is_there_cut));
        let mut unknown = here.unknown;
        if is_copying || there.newest.is_none() {
            unknown = unknown.saturating_add(there.unknown);
        }
        if here.is_format_1 || there.is_format_1 {
            // Four records of format 1 share the place of a pair.
            unknown = unknown.saturating_add(1);
        }
        let number = number.unwrap_or(0).wrapping_add(unknown.wrapping_mul(SKIPPED_NUMBERS));
        let state_bit = bit(STATE);
        let is_repeated = newest.is_none()
            || (here.single & state_bit == 0
                && here.state.map(|(_, state)| state) == newest.map(|(_, state)| state));
        let is_half_void = voids_other == Some(false) && !is_alone && !is_copying;
        let is_unsettled = !is_repeated || here.unknown > 0 || is_there_unknown || is_half_void;
        let lonely = here.in_doubt.or(there.in_doubt);
        let blocked_by = if has_records { None } else { lonely };
        let held_by = if has_records { here.in_doubt } else { lonely };
        let mut journal = Self {
            number,
            newest: newest.map(|(_, contents)| contents),
            active,
            next_pair: here.end,
            void: here.void,
            is_alone,
            kinds: here.kinds,
            to_repeat: here.single & !state_bit,
            damage,
            is_half_void,
            is_there_unknown,
            is_unsettled,
            held_by,
            blocked_by,
            in_doubt: is_unsettled || lonely.is_some(),
        };
        if !is_alone && !is_copying {
            for kind in kinds_in(there.kinds & !state_bit) {
                if !holds_all(flash, layout, active, bit(kind)) {
                    journal.to_repeat |= bit(kind);
                }
            }
        }
        journal
    }

    /// Returns the last state.
    pub(super) fn newest(&self) -> Option<Contents> {
        self.newest
    }

    /// Returns whether the last state in flash names, or may name, bytes in `slot`. Without any
    /// record this is in doubt for all slots.
    pub(super) fn may_name(&self, slot: Slot) -> bool {
        self.in_doubt || self.newest.is_none_or(|newest| newest.package(slot).is_some())
    }

    /// Returns what reading has found besides whole records.
    pub(super) fn damage(&self) -> Damage {
        self.damage
    }

    /// Returns the unreadable place that keeps a boot from writing.
    pub(super) fn held_by(&self) -> Option<u32> {
        self.held_by
    }

    /// Returns whether nothing can be recorded.
    pub(super) fn is_blocked(&self) -> bool {
        self.blocked_by.is_some()
    }

    /// Takes unreadable places for torn ones from now on.
    pub(super) fn forget_unreadable(&mut self) {
        self.blocked_by = None;
    }

    /// Makes sure that every other boot finds the same: repeats what has only one copy, and the
    /// state after anything that may become readable. Returns `None` if there is nothing to do.
    #[inline(never)]
    pub(super) fn settle<F: MappedFlash>(
        &mut self,
        flash: &mut F,
        layout: &Layout,
    ) -> Option<Result<(), StoreError>> {
        if self.held_by.is_some() || (!self.is_unsettled && self.to_repeat == 0) {
            return None;
        }
        // Before the state declares the other half void: that may hold the only durable copy.
        for kind in kinds_in(self.to_repeat) {
            // What reads differently now counts as it reads now.
            let note = self.note(flash, layout, kind).or_else(|| Record::note(kind, &[]));
            if let Some(Err(error)) = note.map(|note| self.append(flash, layout, &note)) {
                return Some(Err(error));
            }
        }
        self.to_repeat = 0;
        // The second time, if there were torn pairs before the first one.
        for _ in 0..2 {
            if !self.is_unsettled {
                break;
            }
            if self.is_there_unknown {
                // Only an erasure says what that half holds.
                self.next_pair = layout.pairs();
            }
            let again = self.newest_record();
            if let Some(Err(error)) = again.map(|again| self.append(flash, layout, &again)) {
                return Some(Err(error));
            }
        }
        Some(Ok(()))
    }

    /// Returns the last note of a kind.
    #[inline(never)]
    pub(super) fn note<F: MappedFlash>(
        &self,
        flash: &mut F,
        layout: &Layout,
        kind: u8,
    ) -> Option<Record> {
        let here = last_of(flash, layout, self.active, kind);
        let there =
            if self.is_alone { None } else { last_of(flash, layout, self.active.other(), kind) };
        let last = match (here, there) {
            (Some(here), Some(there)) if is_newer(there.number, here.number) => there,
            (here, there) => here.or(there)?,
        };
        (last.record.length > 0).then_some(last.record)
    }

    /// Returns whether a half has room for one more kind.
    pub(super) fn has_room_for(&self, layout: &Layout, kind: u8) -> bool {
        // A note that says nothing stands where a state would.
        let kinds = ((self.kinds & !bit(VOID)) | bit(STATE) | bit(kind)).count_ones();
        // One pair is for a record that has to be written twice.
        kinds < layout.pairs()
    }

    /// Returns whether that many more records do not fit into the active half, so that the other one will
    /// be erased for them.
    pub(super) fn is_full_for(&self, layout: &Layout, records: u32) -> bool {
        self.next_pair.saturating_add(records) > layout.pairs()
    }

    /// Writes `record` durably, in two copies. After an error it may or may not survive a reboot.
    #[inline(never)]
    pub(super) fn append<F: MappedFlash>(
        &mut self,
        flash: &mut F,
        layout: &Layout,
        record: &Record,
    ) -> Result<(), StoreError> {
        let outcome = self.write_somewhere(flash, layout, record);
        if record.kind == STATE {
            self.in_doubt = outcome.is_err();
        }
        if outcome.is_ok() {
            self.newest = record.state().or(self.newest);
            // Its number is higher than that of any unreadable record.
            (self.held_by, self.blocked_by) = (None, None);
            if matches!(record.kind, STATE | VOID) {
                self.is_unsettled = self.is_there_unknown || self.is_half_void;
            }
            self.kinds |= bit(record.kind);
        }
        outcome
    }

    fn write_somewhere<F: MappedFlash>(
        &mut self,
        flash: &mut F,
        layout: &Layout,
        record: &Record,
    ) -> Result<(), StoreError> {
        if let Some(offset) = self.blocked_by {
            return Err(StoreError::Unreadable { offset });
        }
        // A pair can look free and still refuse a write, if an earlier write was interrupted before
        // it changed any readable bit. An erasure repairs that.
        if self.next_pair < layout.pairs() && self.write_next(flash, layout, record).is_ok() {
            return Ok(());
        }
        if self.is_half_void && holds_all(flash, layout, self.active.other(), self.kinds) {
            // What says that the copies are complete may be gone at the next boot.
            self.active = self.active.other();
            (self.next_pair, self.void, self.is_half_void) = (layout.pairs(), 0, false);
        }
        self.change_halves(flash, layout)?;
        self.write_next(flash, layout, record)
    }

    /// Writes a record to the next pair.
    fn write_next<F: MappedFlash>(
        &mut self,
        flash: &mut F,
        layout: &Layout,
        record: &Record,
    ) -> Result<(), StoreError> {
        let pair = self.next_pair;
        // Used up, whether or not the write succeeds.
        self.next_pair = pair.wrapping_add(1);
        // Torn pairs before it, and notes in the other half, count until they are settled.
        let voids_other = self.is_half_void
            && self.void == 0
            && self.to_repeat == 0
            && matches!(record.kind, STATE | VOID);
        let record = if voids_other {
            record.voiding(self.kinds & !bit(STATE))
        } else {
            Record { void: self.void, ..*record }
        };
        let outcome = self.write(flash, layout, (self.active, pair), &record);
        if outcome.is_ok() {
            self.void = 0;
            self.is_alone |= voids_other;
            self.is_half_void &= !voids_other;
        } else if self.void < OTHER_HALF - 1 {
            // At most one less than `OTHER_HALF`, which stays as it is.
            self.void = self.void.wrapping_add(1);
        }
        outcome
    }

    /// Erases the half that is not active, copies the last record of every kind into it, and makes
    /// it the active one. Until the last copy, which says that all are there, both halves say the
    /// same, so it does not matter which of them a boot after a power cut believes.
    #[inline(never)]
    fn change_halves<F: MappedFlash>(
        &mut self,
        flash: &mut F,
        layout: &Layout,
    ) -> Result<(), StoreError> {
        let target = self.active.other();
        let start = place_offset(layout, target, 0);
        let mut erased = 0;
        while erased < layout.half_length() {
            erase_unit(flash, start.wrapping_add(erased))?;
            erased = erased.wrapping_add(F::ERASE_SIZE as u32);
        }
        // What an erasure has left behind the copies would count as written after them.
        for pair in 0..layout.half_length().div_ceil(PAIR_LENGTH) {
            if !matches!(read_pair(flash, layout, target, pair).0, Pair::Free) {
                return Err(StoreError::Verify { offset: place_offset(layout, target, pair) });
            }
        }
        let (mut pair, mut kinds) = (0_u32, bit(STATE));
        for kind in kinds_in(self.kinds & !bit(STATE)) {
            let Some(Found { record, .. }) = last_of(flash, layout, self.active, kind) else {
                continue;
            };
            // The last two pairs are for the state and the record that follows. More notes than that are
            // not recorded, but an image can hold them.
            if record.length > 0 && pair.wrapping_add(2) < layout.pairs() {
                self.write(flash, layout, (target, pair), &Record { void: 0, ..record })?;
                pair = pair.wrapping_add(1);
                kinds |= bit(kind);
            }
        }
        if let Some(last) = self.newest_record() {
            self.write(flash, layout, (target, pair), &last.voiding(kinds & !bit(STATE)))?;
            pair = pair.wrapping_add(1);
        }
        self.active = target;
        (self.is_alone, self.is_half_void, self.is_there_unknown) = (true, false, false);
        self.next_pair = pair;
        (self.void, self.kinds) = (0, kinds);
        Ok(())
    }

    /// Returns the state, or a note that says nothing if there is none.
    fn newest_record(&self) -> Option<Record> {
        match &self.newest {
            Some(newest) => Some(newest.record()),
            None => Record::note(VOID, &[]),
        }
    }

    /// Writes both copies of a record with the next number and reads them back.
    #[inline(never)]
    fn write<F: MappedFlash>(
        &mut self,
        flash: &mut F,
        layout: &Layout,
        (half, pair): (Half, u32),
        record: &Record,
    ) -> Result<(), StoreError> {
        self.number = self.number.wrapping_add(1);
        let bytes = record.encode(self.number);
        let first = place_offset(layout, half, pair);
        for offset in [first, first.wrapping_add(RECORD_LENGTH as u32)] {
            flash.write(offset, &bytes).map_err(driver_error)?;
            let mut found = [0; RECORD_LENGTH];
            read(flash, offset, &mut found).map_err(driver_error)?;
            if found != bytes {
                return Err(StoreError::Verify { offset });
            }
        }
        Ok(())
    }
}

impl Scan {
    #[inline(never)]
    fn of<F: MappedFlash>(flash: &mut F, layout: &Layout, half: Half, damage: &mut Damage) -> Self {
        let mut scan = Self::default();
        let mut unreadable_behind = None;
        let mut is_void_counted = false;
        let mut pairs = Pairs::backwards(layout, half);
        while let Some((index, pair, counts)) = pairs.previous(flash) {
            damage.add(&counts);
            if !matches!(pair, Pair::Free) && scan.end == 0 {
                scan.end = index.wrapping_add(1);
            }
            match pair {
                Pair::Free => {}
                Pair::Unknown { unreadable, is_in_doubt } => {
                    if scan.newest.is_none() {
                        scan.unknown = scan.unknown.saturating_add(1);
                        unreadable_behind = unreadable.or(unreadable_behind);
                        if is_in_doubt {
                            scan.in_doubt = unreadable;
                        }
                    }
                    if !is_in_doubt && !is_void_counted {
                        scan.void = scan.void.saturating_add(1).min(OTHER_HALF - 1);
                        continue;
                    }
                }
                Pair::Record {
                    found: Found { number, record, is_whole, is_format_1 },
                    unreadable,
                } => {
                    if scan.newest.is_none() {
                        scan.newest = Some(number);
                        scan.is_format_1 = is_format_1;
                        if is_format_1 {
                            // One unreadable place could be a record.
                            let behind = unreadable.or(unreadable_behind);
                            scan.in_doubt = scan.in_doubt.or(behind);
                        }
                    }
                    let kind = bit(record.kind);
                    if scan.kinds & kind == 0 {
                        scan.kinds |= kind;
                        if !is_whole {
                            scan.single |= kind;
                            scan.single_copied |= kind & scan.copied;
                        }
                        if let Some(contents) = record.state() {
                            scan.state = Some((number, contents));
                        }
                    }
                    if let Some(copied) = record.complete_with() {
                        if scan.voids_other.is_none() {
                            scan.copied = copied;
                        }
                        let is_whole = is_whole || scan.voids_other == Some(true);
                        scan.voids_other = Some(is_whole);
                    }
                }
            }
            is_void_counted = scan.end != 0;
        }
        scan
    }
}

/// The pairs of a half, the last one first.
struct Pairs<'a> {
    layout: &'a Layout,
    half: Half,
    /// The pair after the next one.
    end: u32,
    /// How many of the next ones are void.
    void: u8,
}

impl<'a> Pairs<'a> {
    fn backwards(layout: &'a Layout, half: Half) -> Self {
        // A remainder may hold records of format 1.
        Self { layout, half, end: layout.half_length().div_ceil(PAIR_LENGTH), void: 0 }
    }

    /// Returns index and contents of the next pair; a void record is unknown content.
    #[inline(never)]
    fn previous<F: MappedFlash>(&mut self, flash: &mut F) -> Option<(u32, Pair, Damage)> {
        self.end = self.end.checked_sub(1)?;
        let (pair, damage) = read_pair(flash, self.layout, self.half, self.end);
        let is_void = self.void > 0;
        self.void = self.void.saturating_sub(1);
        let pair = match pair {
            Pair::Record { .. } if is_void => {
                Pair::Unknown { unreadable: None, is_in_doubt: false }
            }
            Pair::Record { ref found, .. } => {
                self.void = match found.record.void {
                    OTHER_HALF => 0,
                    void => void,
                };
                pair
            }
            pair => pair,
        };
        Some((self.end, pair, damage))
    }
}

/// Contents of a place.
enum Place {
    Free,
    Torn,
    Unreadable,
    Record(u32, Record),
    /// One or two records of format 1; this is the last one.
    Format1(u32, Record),
}

#[inline(never)]
fn read_pair<F: MappedFlash>(
    flash: &mut F,
    layout: &Layout,
    half: Half,
    pair: u32,
) -> (Pair, Damage) {
    let offset = place_offset(layout, half, pair);
    let next = offset.wrapping_add(RECORD_LENGTH as u32);
    let first = read_place(flash, layout, half, offset);
    let second = read_place(flash, layout, half, next);
    let mut damage = Damage::default();
    for place in [&first, &second] {
        match place {
            Place::Torn => damage.torn_places = damage.torn_places.wrapping_add(1),
            Place::Unreadable => {
                damage.unreadable_places = damage.unreadable_places.wrapping_add(1);
            }
            _ => {}
        }
    }
    let unreadable = match (&first, &second) {
        (Place::Unreadable, _) => Some(offset),
        (_, Place::Unreadable) => Some(next),
        _ => None,
    };
    let pair = match (first, second) {
        (Place::Free, Place::Free) => Pair::Free,
        (Place::Record(number, record), Place::Record(other, _)) if number == other => {
            let found = Found { number, record, is_whole: true, is_format_1: false };
            Pair::Record { found, unreadable }
        }
        (_, Place::Format1(number, record)) | (Place::Format1(number, record), _) => {
            let found = Found { number, record, is_whole: false, is_format_1: true };
            Pair::Record { found, unreadable }
        }
        (_, Place::Record(number, record)) | (Place::Record(number, record), _) => {
            damage.single_copies = 1;
            let found = Found { number, record, is_whole: false, is_format_1: false };
            Pair::Record { found, unreadable }
        }
        (Place::Free, _) | (_, Place::Free) => Pair::Unknown { unreadable, is_in_doubt: false },
        _ => Pair::Unknown { unreadable, is_in_doubt: unreadable.is_some() },
    };
    (pair, damage)
}

fn read_place<F: MappedFlash>(flash: &mut F, layout: &Layout, half: Half, offset: u32) -> Place {
    let end = place_offset(layout, half, 0).wrapping_add(layout.half_length());
    let mut bytes = [0xff; RECORD_LENGTH];
    let mut is_readable = true;
    let mut record = None;
    for (unit, offset) in bytes
        .as_chunks_mut::<UNIT_LENGTH>()
        .0
        .iter_mut()
        .zip([offset, offset.wrapping_add(UNIT_LENGTH as u32)])
    {
        if offset < end {
            if read(flash, offset, unit).is_err() {
                is_readable = false;
            } else {
                record = Record::decode_format_1(unit).or(record);
            }
        }
    }
    if let Some((number, record)) = record {
        return Place::Format1(number, record);
    }
    if !is_readable {
        return Place::Unreadable;
    }
    if bytes == [0xff; RECORD_LENGTH] {
        return Place::Free;
    }
    match Record::decode(&bytes) {
        Some((number, record)) => Place::Record(number, record),
        None => Place::Torn,
    }
}

/// Returns the last record of a kind in a half.
#[inline(never)]
fn last_of<F: MappedFlash>(flash: &mut F, layout: &Layout, half: Half, kind: u8) -> Option<Found> {
    let mut pairs = Pairs::backwards(layout, half);
    while let Some((_, pair, _)) = pairs.previous(flash) {
        if let Pair::Record { found, .. } = pair
            && found.record.kind == kind
        {
            return Some(found);
        }
    }
    None
}

/// Returns whether a half says the same as the last record of each of these kinds.
#[inline(never)]
fn holds_all<F: MappedFlash>(flash: &mut F, layout: &Layout, half: Half, kinds: u32) -> bool {
    kinds_in(kinds).all(|kind| {
        let here = last_of(flash, layout, half, kind);
        let there = last_of(flash, layout, half.other(), kind);
        match (here, there) {
            (_, None) => true,
            (None, Some(there)) => kind != STATE && there.record.length == 0,
            (Some(here), Some(there)) => {
                is_newer(here.number, there.number) || here.record.says_the_same(&there.record)
            }
        }
    })
}

fn bit(kind: u8) -> u32 {
    1_u32.wrapping_shl(kind.into())
}

/// The state first.
fn kinds_in(kinds: u32) -> impl Iterator<Item = u8> {
    (0..KINDS).filter(move |&kind| kinds & bit(kind) != 0)
}

/// Returns the offset of a pair. The layout has been validated, so nothing wraps.
fn place_offset(layout: &Layout, half: Half, pair: u32) -> u32 {
    let start = match half {
        Half::First => layout.commit,
        Half::Second => layout.commit.wrapping_add(layout.half_length()),
    };
    start.wrapping_add(pair.wrapping_mul(PAIR_LENGTH))
}

/// Reads; tries again once if that fails.
fn read<F: MappedFlash>(flash: &mut F, offset: u32, bytes: &mut [u8]) -> Result<(), F::Error> {
    flash.read(offset, bytes).or_else(|_| flash.read(offset, bytes))
}
