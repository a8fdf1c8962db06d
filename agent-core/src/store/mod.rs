//! Weight packages in flash: two slots, and a journal that records their contents.
//!
//! Packages are opaque here, except to a check supplied by the caller. A package goes through these
//! states; each arrow that changes flash appends one record to the journal, and power loss at any
//! instant leaves either the state before the arrow or the state after it:
//!
//! ```text
//!        begin, write ...    stage              activate            confirm
//! empty ----------------> uploaded ----> staged ---------> on trial --------> confirmed
//!   ^                                                          |
//!   +----------- revert, or a reboot during the trial ---------+
//! ```
//!
//! # What holds at every instant
//! - Bytes named by the newest record are never erased or written. [`Store::begin`] therefore first
//!   records that the slot is empty, if a record still names its contents.
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
//! A record that the driver cannot read may become readable again. Loading continues with what was
//! found, but the end of a trial is then not recorded, and where an erasure could destroy the
//! newest record the store refuses to record anything ([`StoreError::Unreadable`]).
//!
//! An older record restored by bit rot names bytes that have since been replaced, which their
//! checksum reveals. Flash that erases to values other than 0xFF is not supported.
//!
//! # Cost
//! Opening reads the commit area; loading reads the package in use (and the other one if the first
//! is refused). Memory: less than 220 bytes plus the driver. No call erases more than the units
//! that its bytes touch and one half of the commit area. [`Store::bytes`] only slices, and can be
//! called in every step.

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

/// Result of [`Store::open`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Opening {
    /// Whether a valid record was found.
    pub recorded: bool,
    /// Number of journal entries that are neither free nor valid, as after an interrupted write.
    pub torn_places: u32,
    /// Number of unreadable journal entries. If there are any, a record newer than the one found
    /// may reappear until a record is appended.
    pub unreadable_places: u32,
    /// If a trial was in progress, the result of recording its end. Even after an error the store
    /// continues with what was in use before the trial.
    pub trial_ended: Option<Result<(), StoreError>>,
}

/// Result of [`Store::load`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Loaded<T, E> {
    /// The slot now in use, and the result of the check.
    pub in_use: Option<(Slot, T)>,
    /// Why the packages in slot A and slot B were refused, if they were checked.
    pub refusals: [Option<Refusal<E>>; 2],
}

/// The slots, the journal, and the current upload.
///
/// ```
/// # use embedded_storage::nor_flash::{
/// #     check_erase, check_read, check_write, ErrorType, NorFlash, NorFlashErrorKind, ReadNorFlash,
/// # };
/// # use agent_core::store::MappedFlash;
/// # struct Ram([u32; 64]);
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
/// #         256
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
/// use agent_core::store::{Layout, Slot};
///
/// // `Ram` implements `MappedFlash`. A node's check is `agent_core::package::accept`.
/// let flash = Ram([u32::MAX; 64]);
/// let layout = Layout { slots: [0, 64], slot_length: 64, commit: 128, commit_length: 128 };
/// let check = |bytes: &[u8]| if bytes == b"package" { Ok(()) } else { Err("refused") };
///
/// let mut store = Store::open(flash, layout)?;
/// assert_eq!(store.load(check).in_use, None);
/// store.begin(7).unwrap();
/// store.write(0, b"package").unwrap();
/// store.stage(check).unwrap();
/// store.activate(check).unwrap();
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
    /// before is in use again, and this is recorded.
    ///
    /// Neither the contents of the flash nor a driver error makes this fail; see
    /// [`Store::opening`]. Flash with words of more than 32 bytes does not compile.
    ///
    /// # Errors
    /// Any error of [`Layout::validate`].
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
            // The unreadable entry may be the confirmation.
            store.opening.trial_ended = Some(match store.journal.first_unreadable() {
                Some(offset) => Err(StoreError::Unreadable { offset }),
                None => store.commit(reverted),
            });
            store.contents = reverted;
        }
        Ok(store)
    }

    /// Returns the result of opening.
    #[must_use]
    pub fn opening(&self) -> &Opening {
        &self.opening
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
        self.contents =
            Contents { in_use: Some(slot), ..Contents::NOTHING }.with_package(slot, Some(extent));
        Some((slot, package))
    }

    /// Gives up the unreadable entries of the journal, for flash that will not recover:
    /// [`StoreError::Unreadable`] no longer prevents the next record. If one of them was the newest
    /// record, what the store found at boot replaces it.
    pub fn forget_unreadable(&mut self) {
        self.journal.forget_unreadable();
    }

    /// Starts the upload of a package of `length` bytes into the slot that is not in use. The
    /// package in that slot and any unfinished upload are discarded.
    ///
    /// [`StoreError::NotLoaded`], [`StoreError::OnTrial`], [`StoreError::Length`], or a failure to
    /// write the journal.
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
        // Also if the journal does not yet name the package that was loaded or salvaged, so that a
        // package that was never activated is never salvaged.
        let is_told = self.journal.newest().is_some_and(|newest| newest.in_use == emptied.in_use);
        if !is_told || self.journal.may_name(slot) {
            self.commit(emptied)?;
        }
        self.contents = emptied;
        self.upload = Some(Upload::new(slot, self.layout.slot(slot), length));
        Ok(())
    }

    /// Takes the bytes of the package from `offset` on, some or all of which may repeat earlier
    /// ones. Returns the number of bytes received so far. They survive a reboot only once they are
    /// staged.
    ///
    /// # Errors
    /// [`StoreError::NoUpload`], [`StoreError::Gap`], [`StoreError::PastEnd`],
    /// [`StoreError::Conflict`], or a failure to write the slot, which ends the upload.
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

    /// Returns how many bytes of the unfinished upload have been received.
    #[must_use]
    pub fn received(&self) -> Option<u32> {
        self.upload.as_ref().map(|upload| upload.received)
    }

    /// Ends a complete upload: the bytes in flash are checked and recorded, and the package stays
    /// staged, also across a reboot. Returns the result of the check.
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
        if received < length {
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
    /// next reboot. Returns the result of the check.
    ///
    /// # Errors
    /// [`StoreError::NotLoaded`], [`StoreError::NothingStaged`], [`StoreError::Damaged`], a refusal
    /// by `check`, or a failure to write the journal. The package stays staged.
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

    /// Ends the trial and returns to what was in use before, if anything.
    ///
    /// # Errors
    /// [`StoreError::NotOnTrial`], or a failure to write the journal; the trial then continues.
    pub fn revert(&mut self) -> Result<Option<Slot>, StoreError> {
        if !self.is_on_trial() {
            return Err(StoreError::NotOnTrial);
        }
        self.commit(self.contents.reverted())?;
        Ok(self.contents.in_use)
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
        self.journal.append(&mut self.flash, &self.layout, contents)?;
        self.contents = contents;
        Ok(())
    }
}
