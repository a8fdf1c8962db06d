//! Weight packages in flash: two slots, and a journal that records their contents.
//!
//! Packages are opaque here, except to a check supplied by the caller. A package goes through these
//! states; each arrow that changes flash appends one record, in two copies, to the journal, and
//! power loss at any instant leaves either the state before the arrow or the state after it:
//!
//! ```text
//!        begin, write ...    stage              activate            confirm
//! empty ----------------> uploaded ----> staged ---------> on trial --------> confirmed
//!   ^                                                          |
//!   +----------- revert, or a reboot during the trial ---------+
//! ```
//!
//! # What holds at every instant
//! - Bytes named by the newest record are never erased or written. An upload therefore first
//!   records that the slot is empty, if a record still names its contents.
//! - An upload changes nothing until the caller has accepted the package's first bytes, so a package
//!   that is refused by its header leaves both slots and the journal as they were.
//! - During a trial no upload begins, so the package to revert to stays.
//! - A record is written only after the bytes it names have been read back and checked, so the
//!   effect of every call that returned `Ok` survives any reboot. (An upload survives only once it
//!   is staged.)
//! - If a package is in use, or was before a trial, a reboot finds it again, whatever was
//!   interrupted. Only corrupted flash can change that, and then the other slot is used.
//!
//! # Corrupted or overwritten flash
//! [`Store::load`] accepts a package only if length, checksum and check agree. If the slot in use
//! is refused, the other recorded package is loaded, even if it is older or only staged: a network
//! that was checked once is better than none. A package that failed its trial is no longer
//! recorded, because it may be what resets the node. If no record helps, because the journal is
//! lost or a debugger has replaced the packages, [`Store::salvage`] accepts a slot whose bytes pass
//! the check without a record. It does not override a record that says that nothing is in use, or
//! that the slot is empty. Both functions only change the store's memory; the next record makes the
//! change durable, and until then every boot arrives at the same result.
//!
//! A single flipped bit costs at most one of the two copies of a record, which the next boot
//! replaces. [`Store::damage`] counts what was found. What two boots could read differently is
//! recorded again before anything acts on it ([`Opening::settled`]). The journal's records of format
//! 1 are read; a boot replaces them in the same way.
//!
//! A record that the driver cannot read may become readable again. Loading continues with what was
//! found, but a boot then records nothing, and if no record at all can be read, nothing is recorded
//! ([`StoreError::Unreadable`]) until the operator decides ([`Store::forget_unreadable`]).
//!
//! An older record restored by bit rot names bytes that have since been replaced, which their
//! checksum reveals. Flash that erases to values other than 0xFF is not supported.
//!
//! # Notes
//! The journal also keeps notes: up to 52 bytes of each of 30 kinds, of which the newest counts. The
//! store does not interpret them, except its own count of boots.
//!
//! # Cost
//! Opening reads the commit area; loading reads both packages. Memory: less than 560 bytes plus the
//! driver, of which 196 hold the header of an upload. No call erases more than the units that its
//! bytes touch and one half of the commit area. [`Store::bytes`] only slices, and can be
//! called in every step.

mod error;
mod flash;
mod journal;
#[cfg(feature = "authentic-frames")]
mod keys;
mod layout;
mod limiter;
mod record;
mod report;
mod upload;

pub use error::{CheckedError, Refusal, StoreError};
pub use flash::MappedFlash;
#[cfg(feature = "authentic-frames")]
pub use keys::{
    KEYED_HALF_MIN, NETWORK_KEYS_MAX, NetworkKeys, OperatorKeys, network_keys, operator_keys,
};
pub use layout::{Layout, LayoutError, NOTE_LENGTH_MAX, Part, RECORD_LENGTH};
pub use limiter::{Limiter, RateLimit};
pub use record::{FORMAT, factory_record};
pub use report::{Damage, Loaded, Note, Opening, Revert};

pub use crate::package::Serial;

use crate::wire::crc::crc32;
use flash::{assert_units, bytes_at};
use journal::Journal;
use record::{Contents, Extent, Phase, Record};
use serde::{Deserialize, Serialize};

use upload::Upload;

/// How many of a package's first bytes are checked before anything is erased: a header of 128 bytes
/// and the signature block after it.
pub const HEADER_LENGTH: usize = crate::package::CHECKED_FIRST;

/// The kind of the note that counts boots; other users choose kinds from 2 to 30.
const BOOTS: u8 = 1;
/// A board that keeps the count of boots in memory during a reset has it recorded every so often.
const BOOTS_BETWEEN_NOTES: u32 = 16;

/// One of the two slots for packages.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum Slot {
    /// The first slot.
    A,
    /// The second slot.
    B,
}

impl Slot {
    /// Returns the other slot.
    #[must_use]
    pub const fn other(self) -> Self {
        match self {
            Self::A => Self::B,
            Self::B => Self::A,
        }
    }

    /// Returns the element that belongs to this slot.
    fn of<T>(self, [a, b]: [T; 2]) -> T {
        match self {
            Self::A => a,
            Self::B => b,
        }
    }
}

impl core::fmt::Display for Slot {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(self.of(["slot A", "slot B"]))
    }
}

/// What is about to be done with a store.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Change {
    /// This many records are appended to the journal: one by [`Store::activate`], [`Store::confirm`],
    /// [`Store::revert`] and each note.
    Records(u32),
    /// [`Store::write`] gets this many bytes at this offset.
    Bytes {
        /// Where they begin.
        offset: u32,
        /// How many they are.
        length: usize,
    },
    /// [`Store::stage`] ends the upload.
    Stage,
}

/// The slots, the journal, and the current upload.
///
/// ```
/// # use embedded_storage::nor_flash::{
/// #     check_erase, check_read, check_write, ErrorType, NorFlash, NorFlashErrorKind, ReadNorFlash,
/// # };
/// # use agent_core::store::MappedFlash;
/// # struct Ram([u32; 288]);
/// # impl ErrorType for Ram {
/// #     type Error = NorFlashErrorKind;
/// # }
/// # impl ReadNorFlash for Ram {
/// #     const READ_SIZE: usize = 1;
/// #     fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), NorFlashErrorKind> {
/// #         check_read(self, offset, bytes.len())?;
/// #         bytes.copy_from_slice(&self.mapped()[offset as usize..][..bytes.len()]);
/// #         Ok(())
/// #     }
/// #     fn capacity(&self) -> usize {
/// #         1152
/// #     }
/// # }
/// # impl NorFlash for Ram {
/// #     const WRITE_SIZE: usize = 4;
/// #     const ERASE_SIZE: usize = 64;
/// #     fn erase(&mut self, from: u32, to: u32) -> Result<(), NorFlashErrorKind> {
/// #         check_erase(self, from, to)?;
/// #         self.0[from as usize / 4..to as usize / 4].fill(u32::MAX);
/// #         Ok(())
/// #     }
/// #     fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), NorFlashErrorKind> {
/// #         check_write(self, offset, bytes.len())?;
/// #         bytemuck::cast_slice_mut(&mut self.0)[offset as usize..][..bytes.len()]
/// #             .copy_from_slice(bytes);
/// #         Ok(())
/// #     }
/// # }
/// # impl MappedFlash for Ram {
/// #     fn mapped(&self) -> &[u8] {
/// #         bytemuck::cast_slice(&self.0)
/// #     }
/// # }
/// use agent_core::Store;
/// use agent_core::package::Serial;
/// use agent_core::store::{CheckedError, Layout, Slot};
///
/// // `Ram` implements `MappedFlash`. A node's check is `agent_core::package::accept`.
/// let flash = Ram([u32::MAX; 288]);
/// let layout = Layout { slots: [0, 64], slot_length: 64, commit: 128, commit_length: 1024 };
/// let check = |bytes: &[u8]| if bytes == b"package" { Ok(()) } else { Err("refused") };
/// let serial = Serial { epoch: 0, version: 1 };
/// let serials = |_: &()| (serial, serial);
///
/// let mut store = Store::open(flash, layout)?;
/// assert_eq!(store.load(check).in_use, None);
/// store.begin(7).unwrap();
/// store.write(0, b"package", |header| Ok::<_, CheckedError<&str>>(assert_eq!(header, b"package"))).unwrap();
/// store.stage(check).unwrap();
/// store.activate(check, serials).unwrap();
/// store.confirm().unwrap();
///
/// // A reboot finds the package again.
/// let mut store = Store::open(store.into_flash(), layout)?;
/// assert_eq!(store.load(check).in_use, Some((Slot::A, ())));
/// assert_eq!(store.bytes(Slot::A), Some(&b"package"[..]));
/// # Ok::<(), agent_core::store::LayoutError>(())
/// ```
#[derive(Debug)]
pub struct Store<F> {
    flash: F,
    layout: Layout,
    journal: Journal,
    /// Contents of the slots. They differ from the newest record where that was refused.
    contents: Contents,
    upload: Option<Upload>,
    opening: Opening,
    loaded: bool,
}

impl<F: MappedFlash> Store<F> {
    /// Reads the journal. If a trial was in progress, the reboot has ended it: what was in use
    /// before is in use again, and this is recorded. What another boot could read differently is
    /// recorded again.
    ///
    /// Neither the contents of the flash nor a driver error makes this fail; see
    /// [`Store::opening`]. Flash with words of more than 32 bytes does not compile.
    ///
    /// # Errors
    /// Any error of [`Layout::validate`].
    pub fn open(flash: F, layout: Layout) -> Result<Self, LayoutError> {
        let mut store = Self::closed(flash, layout)?;
        store.read();
        Ok(store)
    }

    /// Creates a store that has not read its journal yet: it is empty, and refuses to write, until [`Store::read`]. For
    /// programs that create it where it stays and read it there, which takes less stack.
    ///
    /// # Errors
    /// Any error of [`Layout::validate`].
    pub fn closed(flash: F, layout: Layout) -> Result<Self, LayoutError> {
        const { assert_units::<F>() };
        let capacity = flash.capacity().min(flash.mapped().len());
        let capacity = u32::try_from(capacity).unwrap_or(u32::MAX);
        layout.validate(F::ERASE_SIZE as u32, capacity)?;
        let opening = Opening {
            recorded: false,
            damage: Damage::default(),
            trial_ended: None,
            settled: None,
        };
        let (journal, contents) = (Journal::UNREAD, Contents::NOTHING);
        Ok(Self { flash, layout, journal, contents, upload: None, opening, loaded: false })
    }

    /// Reads the journal, as [`Store::open`] does.
    pub fn read(&mut self) {
        self.journal = Journal::read(&mut self.flash, &self.layout);
        let newest = self.journal.newest();
        self.opening.recorded = newest.is_some();
        self.opening.damage = self.journal.damage();
        self.contents = newest.unwrap_or(Contents::NOTHING);
        if self.contents.phase == Phase::Trial {
            let reverted = self.contents.rebooted();
            // The unreadable place may be the confirmation.
            self.opening.trial_ended = Some(match self.journal.held_by() {
                Some(offset) => Err(StoreError::Unreadable { offset }),
                None => self.commit(reverted),
            });
            self.contents = reverted;
        }
        self.opening.settled = self.journal.settle(&mut self.flash, &self.layout);
    }

    /// Returns the result of opening.
    #[must_use]
    pub fn opening(&self) -> &Opening {
        &self.opening
    }

    /// Returns what the journal held besides whole records when it was opened.
    #[must_use]
    pub fn damage(&self) -> Damage {
        self.opening.damage
    }

    /// Returns the highest serial ever activated, if any is known; the journal's format 1 had none.
    #[must_use]
    pub fn activated(&self) -> Option<Serial> {
        self.contents.activated
    }

    /// Makes the highest serial at least `serial`, for a package in use that was activated before
    /// serials were recorded. The next record makes it durable.
    pub fn raise_activated(&mut self, serial: Serial) {
        let highest = self.contents.activated.map_or(serial, |highest| highest.max(serial));
        self.contents.activated = Some(highest);
    }

    /// Returns the last trial that was not passed.
    #[must_use]
    pub fn last_revert(&self) -> Option<Revert> {
        self.contents.last_revert
    }

    /// Checks the package in use and, if it is refused, the other recorded one. The package
    /// returned is in use from now on; if there is none, continue with [`Store::salvage`]. An
    /// unfinished upload is dropped.
    pub fn load<T, E>(&mut self, mut check: impl FnMut(&[u8]) -> Result<T, E>) -> Loaded<T, E> {
        self.loaded = true;
        self.upload = None;
        let mut refusals = [None, None];
        let Some(first) = self.contents.in_use else { return Loaded { in_use: None, refusals } };
        for slot in [first, first.other()] {
            let Some(extent) = self.contents.package(slot) else { continue };
            let refusal = match self.recorded_bytes(slot, extent).map(&mut check) {
                Some(Ok(package)) => {
                    self.contents.in_use = Some(slot);
                    let other = slot.other();
                    let [a, b] = &mut refusals;
                    let refusal = other.of([a, b]);
                    if let Some(extent) = self.contents.package(other)
                        && self.recorded_bytes(other, extent).is_none()
                    {
                        *refusal = Some(Refusal::Checksum);
                    }
                    return Loaded { in_use: Some((slot, package)), refusals };
                }
                Some(Err(error)) => Refusal::Check(error),
                None => Refusal::Checksum,
            };
            let [a, b] = &mut refusals;
            *slot.of([a, b]) = Some(refusal);
            // Neither a trial nor a staged package outlives the slot it relies on.
            self.contents = self.contents.with_package(slot, None);
            self.contents.phase = Phase::Confirmed;
        }
        self.contents.in_use = None;
        Loaded { in_use: None, refusals }
    }

    /// Looks for a package without a valid record, after [`Store::load`] found none. `length`
    /// returns the length of the package at the start of a slot, if there is one, and `check` must
    /// accept it. If both slots have such a package, the slot that the journal says is in use is
    /// preferred; without any record it is slot A, unless `newer` says that the check's result for
    /// its first argument is newer than for its second.
    ///
    /// Nothing is recorded. The result is `None` if a package is in use or if the journal says that
    /// none is to be used; slots that are empty according to the journal are skipped.
    pub fn salvage<T, E>(
        &mut self,
        mut length: impl FnMut(&[u8]) -> Option<u32>,
        mut check: impl FnMut(&[u8]) -> Result<T, E>,
        newer: impl FnOnce(&T, &T) -> bool,
    ) -> Option<(Slot, T)> {
        if self.contents.in_use.is_some() || !self.loaded || self.upload.is_some() {
            return None;
        }
        let newest = self.journal.newest().map(Contents::rebooted);
        let first_slot = newest.map_or(Some(Slot::A), |newest| newest.in_use)?;
        let mut candidate = |slot| {
            if newest.is_some_and(|newest| newest.package(slot).is_none()) {
                return None;
            }
            let whole = bytes_at(&self.flash, self.layout.slot(slot), self.layout.slot_length)?;
            let bytes = whole.get(..usize::try_from(length(whole)?).ok()?)?;
            Some((slot, Extent::of(bytes)?, check(bytes).ok()?))
        };
        let (slot, extent, package) = match (candidate(first_slot), candidate(first_slot.other())) {
            (Some(first), Some(second)) => {
                if newest.is_none() && newer(&second.2, &first.2) {
                    second
                } else {
                    first
                }
            }
            (first, second) => first.or(second)?,
        };
        let phase = Phase::Confirmed;
        let emptied = Contents { in_use: Some(slot), phase, packages: [None; 2], ..self.contents };
        self.contents = emptied.with_package(slot, Some(extent));
        Some((slot, package))
    }

    /// Returns whether [`StoreError::Unreadable`] keeps the store from recording anything, until
    /// another boot can read the journal or [`Self::forget_unreadable`] gives it up.
    #[must_use]
    pub fn is_blocked(&self) -> bool {
        self.journal.is_blocked()
    }

    /// Gives up the unreadable records of the journal, for flash that will not recover:
    /// [`StoreError::Unreadable`] no longer prevents the next record. If one of them was the newest
    /// record, what the store found at boot replaces it. Packages are not touched.
    pub fn forget_unreadable(&mut self) {
        self.journal.forget_unreadable();
    }

    /// Starts the upload of a package of `length` bytes into the slot that is not in use, and drops
    /// any unfinished one. Nothing is erased or recorded before the package's header is accepted;
    /// see [`Self::write`].
    ///
    /// # Errors
    /// [`StoreError::NotLoaded`], [`StoreError::OnTrial`], or [`StoreError::Length`].
    pub fn begin(&mut self, length: u32) -> Result<(), StoreError> {
        let maximum = self.layout.slot_length;
        if !self.loaded {
            return Err(StoreError::NotLoaded);
        }
        if self.is_on_trial() {
            return Err(StoreError::OnTrial);
        }
        if length == 0 || length > maximum {
            return Err(StoreError::Length { found: length, maximum });
        }
        let slot = self.contents.spare();
        self.upload = Some(Upload::new(slot, self.layout.slot(slot), length));
        Ok(())
    }

    /// Returns whether this change is going to erase flash, if it is not refused. It does not account
    /// for the bytes that complete a header: as soon as the check of [`Self::write`] has accepted it,
    /// something is erased. Nor can it foresee that flash refuses a write and has to be erased for that.
    #[must_use]
    pub fn is_to_erase(&self, change: Change) -> bool {
        let reaches = |end| self.upload.as_ref().is_some_and(|upload| upload.erases_for::<F>(end));
        let records = match change {
            Change::Records(records) => records,
            Change::Bytes { offset, length } => {
                let end =
                    u32::try_from(length).map_or(u32::MAX, |length| offset.saturating_add(length));
                // The bytes after the last whole word wait.
                return reaches(end - end % F::WRITE_SIZE as u32);
            }
            Change::Stage if reaches(u32::MAX) => return true,
            Change::Stage => 1,
        };
        self.journal.is_full_for(&self.layout, records)
    }

    /// Takes the bytes of the package from `offset` on, some or all of which may repeat earlier
    /// ones. Returns the number of bytes received so far. They survive a reboot only once they are
    /// staged.
    ///
    /// Once the first [`HEADER_LENGTH`] bytes, or all of a shorter package, are there, `check`
    /// accepts or rejects them. Only then is the package in the slot discarded. If `check` returns
    /// [`StoreError::TooOften`], the upload stays, and the call can be repeated later; any other
    /// error drops it.
    ///
    /// # Errors
    /// [`StoreError::NoUpload`], [`StoreError::Gap`], [`StoreError::PastEnd`],
    /// [`StoreError::Conflict`], an error of `check`, or a failure to write the journal or the slot,
    /// which ends the upload.
    pub fn write<E>(
        &mut self,
        offset: u32,
        bytes: &[u8],
        check: impl FnOnce(&[u8]) -> Result<(), CheckedError<E>>,
    ) -> Result<u32, CheckedError<E>> {
        let upload = self.upload.as_mut().ok_or(StoreError::NoUpload)?;
        let mut new = upload.unseen(&self.flash, offset, bytes)?;
        if !upload.is_started {
            new = upload.take_header(new);
            let Some(header) = upload.header() else { return Ok(upload.received) };
            let checked = check(header);
            if matches!(checked, Err(CheckedError::Store(StoreError::TooOften { .. }))) {
                return checked.map(|()| 0);
            }
            if let Err(error) = checked.and_then(|()| Ok(self.start_upload()?)) {
                self.upload = None;
                return Err(error);
            }
        }
        Ok(self.append(new)?)
    }

    /// Discards the package in the spare slot and writes the header there.
    fn start_upload(&mut self) -> Result<(), StoreError> {
        let slot = self.contents.spare();
        let emptied = self.contents.without_spare();
        // Also if the journal does not yet name the package that was loaded or salvaged, so that a
        // package that was never activated is never salvaged.
        let is_told = self.journal.newest().is_some_and(|newest| newest.in_use == emptied.in_use);
        if !is_told || self.journal.may_name(slot) {
            self.commit(emptied)?;
        }
        self.contents = emptied;
        let upload = self.upload.as_mut().ok_or(StoreError::NoUpload)?;
        upload.begin(&mut self.flash)
    }

    fn append(&mut self, new: &[u8]) -> Result<u32, StoreError> {
        let upload = self.upload.as_mut().ok_or(StoreError::NoUpload)?;
        let outcome = upload.append(&mut self.flash, new);
        let received = upload.received;
        if outcome.is_err() {
            self.upload = None;
        }
        outcome.map(|()| received)
    }

    /// Returns whether an upload is complete and can be staged.
    #[must_use]
    pub fn is_complete(&self) -> bool {
        let upload = self.upload.as_ref();
        upload.is_some_and(|upload| upload.is_started && upload.received == upload.length)
    }

    /// Returns how many bytes of the unfinished upload have been received.
    #[must_use]
    pub fn received(&self) -> Option<u32> {
        self.upload.as_ref().map(|upload| upload.received)
    }

    /// Ends a complete upload: the bytes in flash are checked and recorded, and the package stays
    /// staged, even across a reboot. Returns the result of the check.
    ///
    /// # Errors
    /// [`StoreError::NoUpload`], [`StoreError::Incomplete`], a refusal by `check`, or a failure to
    /// write flash. If only the journal failed, the call can be repeated.
    pub fn stage<T, E>(
        &mut self,
        check: impl FnOnce(&[u8]) -> Result<T, E>,
    ) -> Result<T, CheckedError<E>> {
        let upload = self.upload.as_mut().ok_or(StoreError::NoUpload)?;
        let (slot, length, received) = (upload.slot, upload.length, upload.received);
        if received < length || !upload.is_started {
            return Err(StoreError::Incomplete { received, length }.into());
        }
        let offset = self.layout.slot(slot);
        if let Err(error) = upload.finish(&mut self.flash) {
            self.upload = None;
            return Err(error.into());
        }
        // The checksum of the bytes as received, even if flash has changed since: activation
        // compares it.
        let extent = upload.extent();
        // Not missing: the slot holds `length` bytes.
        let bytes = bytes_at(&self.flash, offset, length).ok_or(StoreError::Damaged)?;
        let package = check(bytes).map_err(CheckedError::Refused)?;
        let staged = self.contents.with_package(slot, Some(extent));
        self.commit(Contents { phase: Phase::Staged, ..staged })?;
        self.upload = None;
        Ok(package)
    }

    /// Returns the slot of the staged package.
    #[must_use]
    pub fn staged(&self) -> Option<Slot> {
        (self.contents.phase == Phase::Staged).then_some(self.contents.spare())
    }

    /// Puts the staged package in use, on trial: it stays in use only if it is confirmed before the
    /// next reboot. `serials` extracts, from what `check` returned, the package's serial and the
    /// highest one from then on; both are recorded. Any unfinished upload is dropped. Returns the
    /// result of the check.
    ///
    /// # Errors
    /// [`StoreError::NotLoaded`], [`StoreError::NothingStaged`], [`StoreError::Damaged`], a refusal
    /// by `check`, or a failure to write the journal. The package stays staged.
    pub fn activate<T, E>(
        &mut self,
        check: impl FnOnce(&[u8]) -> Result<T, E>,
        serials: impl FnOnce(&T) -> (Serial, Serial),
    ) -> Result<T, CheckedError<E>> {
        if !self.loaded {
            return Err(StoreError::NotLoaded.into());
        }
        let slot = self.staged().ok_or(StoreError::NothingStaged)?;
        let extent = self.contents.package(slot).ok_or(StoreError::NothingStaged)?;
        let bytes = self.recorded_bytes(slot, extent).ok_or(StoreError::Damaged)?;
        let package = check(bytes).map_err(CheckedError::Refused)?;
        let (serial, highest) = serials(&package);
        self.commit(self.contents.on_trial(slot, serial, highest))?;
        // It would go to the slot that is in use now.
        self.upload = None;
        Ok(package)
    }

    /// Ends the trial and keeps the package in use.
    ///
    /// # Errors
    /// [`StoreError::NotOnTrial`], or a failure to write the journal; the trial then continues.
    pub fn confirm(&mut self) -> Result<(), StoreError> {
        if !self.is_on_trial() {
            return Err(StoreError::NotOnTrial);
        }
        self.commit(Contents { phase: Phase::Confirmed, ..self.contents })
    }

    /// Ends the trial and returns to what was in use before, if anything. The reason is recorded;
    /// the store uses [`Revert::BY_RESET`].
    ///
    /// # Errors
    /// [`StoreError::NotOnTrial`], or a failure to write the journal; the trial then continues.
    pub fn revert(&mut self, reason: u8) -> Result<Option<Slot>, StoreError> {
        if !self.is_on_trial() {
            return Err(StoreError::NotOnTrial);
        }
        self.commit(self.contents.reverted(reason))?;
        Ok(self.contents.in_use)
    }

    /// Returns the newest note of a kind, if there is one that is not empty.
    pub fn note(&mut self, kind: u8) -> Option<Note> {
        let Record { length, payload, .. } =
            self.journal.note(&mut self.flash, &self.layout, kind)?;
        Some(Note { length, bytes: payload })
    }

    /// Records a note of a kind from 2 to 30, which replaces the previous one; an empty one removes
    /// it. Kinds 2 to 5 are a node's keys and epochs (feature `authentic-frames`).
    ///
    /// # Errors
    /// [`StoreError::Note`], or a failure to write the journal.
    pub fn record_note(&mut self, kind: u8, bytes: &[u8]) -> Result<(), StoreError> {
        let note = Record::note(kind, bytes).ok_or(StoreError::Note)?;
        let before = self.journal.note(&mut self.flash, &self.layout, kind);
        if before.map_or(bytes.is_empty(), |before| before.says_the_same(&note)) {
            return Ok(());
        }
        if !self.journal.has_room_for(&self.layout, kind) {
            return Err(StoreError::Note);
        }
        self.journal.append(&mut self.flash, &self.layout, &note)
    }

    /// Counts a boot, once after [`Self::open`], and returns how many there have been with this one.
    /// `starts` is the number of starts since the supply was switched on, this one included, if the
    /// board can tell: then only the first and every 16th after it is recorded, and a loss of power
    /// forgets up to 15.
    ///
    /// A boot that is recorded costs one record of the journal. A commit area of two pages of 4 KiB
    /// that last for 10,000 erasures takes 600,000 of them.
    pub fn count_boot(&mut self, starts: Option<u32>) -> u32 {
        let note = self.note(BOOTS);
        let recorded =
            note.and_then(|note| note.as_bytes().try_into().ok()).map_or(0, u32::from_le_bytes);
        // Starts since the last one that was recorded.
        let warm = starts.and_then(|starts| starts.checked_sub(2));
        let since = warm.map_or(1, |warm| warm % BOOTS_BETWEEN_NOTES + 1);
        let boots = recorded.saturating_add(since);
        if warm.is_none_or(|_| since == BOOTS_BETWEEN_NOTES) && self.journal.held_by().is_none() {
            // If that fails, this boot is not counted; a later one may succeed.
            let _ = self.record_note(BOOTS, &boots.to_le_bytes());
        }
        boots
    }

    /// Returns the slot of the package in use.
    #[must_use]
    pub fn in_use(&self) -> Option<Slot> {
        self.contents.in_use
    }

    /// Returns whether the package in use is on trial.
    #[must_use]
    pub fn is_on_trial(&self) -> bool {
        self.contents.phase == Phase::Trial
    }

    /// Returns the recorded package in a slot, in place. Its checksum is not verified again.
    #[must_use]
    #[inline]
    pub fn bytes(&self, slot: Slot) -> Option<&[u8]> {
        bytes_at(&self.flash, self.layout.slot(slot), self.contents.package(slot)?.length)
    }

    /// Returns the recorded CRC-32 of the package in a slot.
    #[must_use]
    pub fn checksum(&self, slot: Slot) -> Option<u32> {
        Some(self.contents.package(slot)?.checksum)
    }

    /// Returns the flash driver.
    #[must_use]
    pub fn flash(&self) -> &F {
        &self.flash
    }

    /// Consumes the store and returns the flash driver.
    #[must_use]
    pub fn into_flash(self) -> F {
        self.flash
    }

    /// Returns the package in a slot if its bytes still match the record.
    fn recorded_bytes(&self, slot: Slot, extent: Extent) -> Option<&[u8]> {
        let room = Some(extent.length).filter(|&length| length <= self.layout.slot_length)?;
        let bytes = bytes_at(&self.flash, self.layout.slot(slot), room)?;
        (crc32(&[bytes]) == extent.checksum).then_some(bytes)
    }

    /// Records `contents` and makes them current.
    fn commit(&mut self, contents: Contents) -> Result<(), StoreError> {
        self.journal.append(&mut self.flash, &self.layout, &contents.record())?;
        self.contents = contents;
        Ok(())
    }
}
