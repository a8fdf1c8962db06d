//! What the store reports: what it found, and what it remembers.

use serde::{Deserialize, Serialize};

use super::{Refusal, Slot, StoreError};
use crate::package::Serial;

/// The end of a trial that a package has not passed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Revert {
    /// The package that was on trial.
    pub serial: Serial,
    /// Why: [`Self::BY_RESET`], or the code passed to [`Store::revert`](super::Store::revert).
    pub reason: u8,
}

impl Revert {
    /// The reason given when the operator has ended a trial.
    pub const BY_OPERATOR: u8 = 0;
    /// The reason given when a reset has ended a trial.
    pub const BY_RESET: u8 = 1;
}

/// What the journal held besides whole records when it was opened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Damage {
    /// Places that are neither free nor valid, as after an interrupted write or a flipped bit.
    pub torn_places: u32,
    /// Places that the driver cannot read.
    pub unreadable_places: u32,
    /// Records of which only one of the two copies is valid.
    pub single_copies: u32,
}

impl Damage {
    pub(super) fn add(&mut self, other: &Self) {
        self.torn_places = self.torn_places.wrapping_add(other.torn_places);
        self.unreadable_places = self.unreadable_places.wrapping_add(other.unreadable_places);
        self.single_copies = self.single_copies.wrapping_add(other.single_copies);
    }
}

/// Result of [`Store::open`](super::Store::open).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Opening {
    /// Whether a valid state was found.
    pub recorded: bool,
    /// What the journal held besides whole records.
    pub damage: Damage,
    /// If a trial was in progress, the result of recording its end. Even after an error the store
    /// continues with what was in use before the trial.
    pub trial_ended: Option<Result<(), StoreError>>,
    /// If another boot might have found something else, the result of recording what this one has
    /// found.
    pub settled: Option<Result<(), StoreError>>,
}

/// Result of [`Store::load`](super::Store::load).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Loaded<T, E> {
    /// The slot now in use, and the result of the check.
    pub in_use: Option<(Slot, T)>,
    /// Why the packages in slot A and slot B were refused. The one that is not in use is only
    /// compared with its record, and stays recorded.
    pub refusals: [Option<Refusal<E>>; 2],
}

/// A note: bytes that the store keeps and does not interpret.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Note {
    pub(super) length: u8,
    pub(super) bytes: [u8; super::NOTE_LENGTH_MAX],
}

impl Note {
    /// Returns the bytes.
    #[must_use]
    pub fn as_bytes(&self) -> &[u8] {
        self.bytes.get(..usize::from(self.length)).unwrap_or(&self.bytes)
    }
}
