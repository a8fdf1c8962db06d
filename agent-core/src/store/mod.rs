//! Weight packages in flash: two slots and a journal that says what they hold.
//!
//! A package is opaque here, but for a check that the caller brings along. It goes through these
//! states; each arrow that changes flash appends one record to the journal, and a loss of power
//! at any instant leaves the state before the arrow or the one behind it:
//!
//! ```text
//!        begin, write ...    stage              activate            confirm
//! empty ----------------> uploaded ----> staged ---------> on trial --------> confirmed
//!   ^                                                          |
//!   +---- the way back: revert, or a reboot during the trial --+
//! ```
//!
//! # What holds at every instant
//! - Bytes that the newest record names are never erased or written. [`Store::begin`] therefore
//!   first records that the slot is empty, if a record still names something there.
//! - A record is written only when the bytes that it names have been read back and checked, so
//!   what a call returned `Ok` for survives any reboot. (An upload does not, until it is staged.)
//! - If something is in use, or was before a trial, then a reboot finds it again, whatever was
//!   cut. Only flash that forgets can change that, and then the other slot steps in.
//!
//! # When flash forgets, or somebody else has written to it
//! [`Store::load`] takes a package only if length, checksum and check agree. If the slot in use
//! is refused, the other recorded package is loaded, be it older or staged: a network that was
//! once checked is better than none. One that failed its trial is not recorded any more, since it
//! may be what makes the node reset. If no record helps, because the journal is lost or a debugger
//! has replaced the packages, [`Store::salvage`] takes a slot whose bytes prove themselves to the
//! check alone. It does not go against a record that says that nothing is in use, or nothing in
//! that slot. Both only change the store's memory; the next record makes it last, and until then
//! every boot comes to the same result.
//!
//! A record that the driver cannot read may come back. Loading goes on with what was found, but
//! the end of a trial is not recorded then, and where an erasure could destroy the newest record
//! the store refuses to record anything ([`StoreError::Unreadable`]).
//!
//! An older record that bit rot brings back names bytes that have since been replaced, which
//! their checksum tells. Other values of erased flash than 0xFF are out of scope.
//!
//! # Cost
//! Opening reads the commit area, loading the package in use (both only if one is refused).
//! Memory: less than 200 bytes and the driver. No call erases more than the units that its bytes
//! enter and one half of the commit area. [`Store::bytes`] only slices, and can be called at
//! every step.

mod error;
mod flash;
mod journal;
mod layout;
mod record;
mod upload;

pub use error::{CheckedError, Refusal, StoreError};
pub use flash::MappedFlash;
pub use layout::{Layout, LayoutError, Part};
pub use record::{FORMAT, RECORD_LENGTH, factory_record};

use crate::wire::crc::crc32;
use flash::{assert_units, bytes_at};
use journal::Journal;
use record::{Contents, Extent, Phase};
use serde::{Deserialize, Serialize};
use upload::Upload;

/// One of the two places for a package.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub enum Slot {
    /// The first.
    A,
    /// The second.
    B,
}

impl Slot {
    /// The other one.
    #[must_use]
    pub const fn other(self) -> Self {
        match self {
            Self::A => Self::B,
            Self::B => Self::A,
        }
    }

    /// This slot's of two things.
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

/// What [`Store::open`] found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Opening {
    /// Whether there was any valid record.
    pub recorded: bool,
    /// How many places of the journal hold something and yet no record, as after a cut write.
    pub torn_places: u32,
    /// How many places of the journal could not be read. If there are any, a newer record than
    /// was found may come back, until one is appended.
    pub unreadable_places: u32,
    /// Whether a trial was under way, and how recording its end went. After an error the store
    /// goes on with what was in use before the trial all the same.
    pub trial_ended: Option<Result<(), StoreError>>,
}

/// What [`Store::load`] found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Loaded<T, E> {
    /// What is in use now, and what the check made of it.
    pub in_use: Option<(Slot, T)>,
    /// Why the packages in slot A and slot B were refused, if they were tried.
    pub refusals: [Option<Refusal<E>>; 2],
}

/// The slots, the journal, and what is being uploaded.
#[derive(Debug)]
pub struct Store<F> {
    flash: F,
    layout: Layout,
    journal: Journal,
    /// What the slots hold. It differs from what the newest record says where that was refused.
    contents: Contents,
    upload: Option<Upload>,
    opening: Opening,
    loaded: bool,
}

impl<F: MappedFlash> Store<F> {
    /// Reads the journal. If it finds a trial, the reboot has ended that: what was in use before
    /// is so again, and the journal is told.
    ///
    /// No content of the flash and no error of the driver lets this fail; see [`Store::opening`].
    /// Flash with words of more than 32 bytes does not compile.
    ///
    /// # Errors
    /// What [`Layout::validate`] refuses.
    pub fn open(mut flash: F, layout: Layout) -> Result<Self, LayoutError> {
        const { assert_units::<F>() };
        let capacity = flash.capacity().min(flash.mapped().len());
        let capacity = u32::try_from(capacity).unwrap_or(u32::MAX);
        layout.validate(F::ERASE_SIZE as u32, capacity)?;
        let journal = Journal::read(&mut flash, &layout);
        let newest = journal.newest();
        let opening = Opening {
            recorded: newest.is_some(),
            torn_places: journal.torn(),
            unreadable_places: journal.unreadable(),
            trial_ended: None,
        };
        let contents = newest.unwrap_or(Contents::NOTHING);
        let mut store =
            Self { flash, layout, journal, contents, upload: None, opening, loaded: false };
        if contents.phase == Phase::Trial {
            let reverted = contents.reverted();
            // What cannot be read may be the confirmation.
            store.opening.trial_ended = Some(match store.journal.first_unreadable() {
                Some(offset) => Err(StoreError::Unreadable { offset }),
                None => store.commit(reverted),
            });
            store.contents = reverted;
        }
        Ok(store)
    }

    /// What opening found.
    #[must_use]
    pub fn opening(&self) -> &Opening {
        &self.opening
    }

    /// Checks the package in use, and if it is refused, the other recorded one. What is returned
    /// is in use from now on; if that is nothing, go on with [`Store::salvage`]. An unfinished
    /// upload is dropped.
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
                    return Loaded { in_use: Some((slot, package)), refusals };
                }
                Some(Err(error)) => Refusal::Check(error),
                None => Refusal::Checksum,
            };
            let [a, b] = &mut refusals;
            *slot.of([a, b]) = Some(refusal);
            // Neither a trial nor a staged package outlives the slot that it relies on.
            self.contents = self.contents.with_package(slot, None);
            self.contents.phase = Phase::Confirmed;
        }
        self.contents.in_use = None;
        Loaded { in_use: None, refusals }
    }

    /// Looks for a package that no valid record describes, after [`Store::load`] found none: one
    /// that lies where `length` takes the beginning of a slot for a package, returning its length,
    /// and that `check` takes for a good one. Of two such packages the one goes first whose slot
    /// the journal says is in use; without any record slot A, unless `newer` says that what the
    /// check made of its first argument is newer than its second.
    ///
    /// Nothing is recorded. It finds nothing if something is in use, if the journal says that
    /// nothing is to be, or in a slot of which the journal says that it holds nothing.
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
        self.contents =
            Contents { in_use: Some(slot), ..Contents::NOTHING }.with_package(slot, Some(extent));
        Some((slot, package))
    }

    /// Gives up the places of the journal that cannot be read, for flash that will not recover:
    /// [`StoreError::Unreadable`] no longer stands in the way of the next record. If one of them
    /// held the newest record, what the store found at boot replaces it.
    pub fn forget_unreadable(&mut self) {
        self.journal.forget_unreadable();
    }

    /// Begins the upload of a package of `length` bytes into the slot that is not in use. What
    /// was staged there, or was in use before, is given up, as is an unfinished upload.
    ///
    /// # Errors
    /// [`StoreError::NotLoaded`], [`StoreError::OnTrial`], [`StoreError::Length`], or that the
    /// journal cannot be written.
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
        let emptied = self.contents.without_spare();
        // Also where the journal does not know yet what loading or salvaging has brought into use,
        // so that what never was activated is never salvaged.
        let is_told = self.journal.newest().is_some_and(|newest| newest.in_use == emptied.in_use);
        if !is_told || self.journal.may_name(slot) {
            self.commit(emptied)?;
        }
        self.contents = emptied;
        self.upload = Some(Upload::new(slot, self.layout.slot(slot), length));
        Ok(())
    }

    /// Takes the bytes of the package from `offset` on, of which some or all may have come
    /// before. Returns how many there are now. Bytes survive a reboot only once they are staged.
    ///
    /// # Errors
    /// [`StoreError::NoUpload`], [`StoreError::Gap`], [`StoreError::PastEnd`],
    /// [`StoreError::Conflict`], or that the slot cannot be written, which ends the upload.
    pub fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<u32, StoreError> {
        let upload = self.upload.as_mut().ok_or(StoreError::NoUpload)?;
        let new = upload.unseen(&self.flash, offset, bytes)?;
        let outcome = upload.append(&mut self.flash, new);
        let received = upload.received;
        if outcome.is_err() {
            self.upload = None;
        }
        outcome.map(|()| received)
    }

    /// How many bytes of the unfinished upload have been received.
    #[must_use]
    pub fn received(&self) -> Option<u32> {
        self.upload.as_ref().map(|upload| upload.received)
    }

    /// Ends a complete upload: what lies in flash is checked and recorded, and from now on waits
    /// for its activation, also over a reboot. Returns what the check made of it.
    ///
    /// # Errors
    /// [`StoreError::NoUpload`], [`StoreError::Incomplete`], what `check` refuses, or that flash
    /// cannot be written. If only the journal cannot, it is worth another try.
    pub fn stage<T, E>(
        &mut self,
        check: impl FnOnce(&[u8]) -> Result<T, E>,
    ) -> Result<T, CheckedError<E>> {
        let upload = self.upload.as_mut().ok_or(StoreError::NoUpload)?;
        let (slot, length, received) = (upload.slot, upload.length, upload.received);
        if received < length {
            return Err(StoreError::Incomplete { received, length }.into());
        }
        let offset = self.layout.slot(slot);
        if let Err(error) = upload.finish(&mut self.flash) {
            self.upload = None;
            return Err(error.into());
        }
        // What was received, whatever has become of the flash since: activating compares it.
        let extent = upload.extent();
        // Not missing: the slot holds `length` bytes.
        let bytes = bytes_at(&self.flash, offset, length).ok_or(StoreError::Damaged)?;
        let package = check(bytes).map_err(CheckedError::Refused)?;
        let staged = self.contents.with_package(slot, Some(extent));
        self.commit(Contents { phase: Phase::Staged, ..staged })?;
        self.upload = None;
        Ok(package)
    }

    /// The slot whose package waits for its activation.
    #[must_use]
    pub fn staged(&self) -> Option<Slot> {
        (self.contents.phase == Phase::Staged).then_some(self.contents.spare())
    }

    /// Puts the staged package in use, on trial: it stays only if it is confirmed before the next
    /// reboot. Returns what the check made of it.
    ///
    /// # Errors
    /// [`StoreError::NotLoaded`], [`StoreError::NothingStaged`], [`StoreError::Damaged`], what
    /// `check` refuses, or that the journal cannot be written. The package stays staged.
    pub fn activate<T, E>(
        &mut self,
        check: impl FnOnce(&[u8]) -> Result<T, E>,
    ) -> Result<T, CheckedError<E>> {
        if !self.loaded {
            return Err(StoreError::NotLoaded.into());
        }
        let slot = self.staged().ok_or(StoreError::NothingStaged)?;
        let extent = self.contents.package(slot).ok_or(StoreError::NothingStaged)?;
        let bytes = self.recorded_bytes(slot, extent).ok_or(StoreError::Damaged)?;
        let package = check(bytes).map_err(CheckedError::Refused)?;
        self.commit(Contents { in_use: Some(slot), phase: Phase::Trial, ..self.contents })?;
        Ok(package)
    }

    /// Ends the trial: what is in use stays so.
    ///
    /// # Errors
    /// [`StoreError::NotOnTrial`], or that the journal cannot be written; the trial then goes on.
    pub fn confirm(&mut self) -> Result<(), StoreError> {
        if !self.is_on_trial() {
            return Err(StoreError::NotOnTrial);
        }
        self.commit(Contents { phase: Phase::Confirmed, ..self.contents })
    }

    /// Ends the trial: what was in use before is so again, if there was anything.
    ///
    /// # Errors
    /// [`StoreError::NotOnTrial`], or that the journal cannot be written; the trial then goes on.
    pub fn revert(&mut self) -> Result<Option<Slot>, StoreError> {
        if !self.is_on_trial() {
            return Err(StoreError::NotOnTrial);
        }
        self.commit(self.contents.reverted())?;
        Ok(self.contents.in_use)
    }

    /// The slot whose package is in use.
    #[must_use]
    pub fn in_use(&self) -> Option<Slot> {
        self.contents.in_use
    }

    /// Whether what is in use is on trial.
    #[must_use]
    pub fn is_on_trial(&self) -> bool {
        self.contents.phase == Phase::Trial
    }

    /// The recorded package in a slot, in place. Its checksum is not computed again.
    #[must_use]
    #[inline]
    pub fn bytes(&self, slot: Slot) -> Option<&[u8]> {
        bytes_at(&self.flash, self.layout.slot(slot), self.contents.package(slot)?.length)
    }

    /// The CRC-32 of the recorded package in a slot, as it is recorded.
    #[must_use]
    pub fn checksum(&self, slot: Slot) -> Option<u32> {
        Some(self.contents.package(slot)?.checksum)
    }

    /// The flash driver.
    #[must_use]
    pub fn flash(&self) -> &F {
        &self.flash
    }

    /// Gives the flash driver back.
    #[must_use]
    pub fn into_flash(self) -> F {
        self.flash
    }

    /// The package in a slot, if its bytes are still the recorded ones.
    fn recorded_bytes(&self, slot: Slot, extent: Extent) -> Option<&[u8]> {
        let room = Some(extent.length).filter(|&length| length <= self.layout.slot_length)?;
        let bytes = bytes_at(&self.flash, self.layout.slot(slot), room)?;
        (crc32(&[bytes]) == extent.checksum).then_some(bytes)
    }

    /// Records `contents`, and makes them the store's.
    fn commit(&mut self, contents: Contents) -> Result<(), StoreError> {
        self.journal.append(&mut self.flash, &self.layout, contents)?;
        self.contents = contents;
        Ok(())
    }
}
