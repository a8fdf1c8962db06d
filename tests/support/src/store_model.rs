//! A minimal model of the weight store, and packages for it.

use agent_core::store::{CheckedError, Layout, MappedFlash, Store, StoreError};
use agent_core::wire::crc::crc32;

use crate::nor_flash::{SimulatedFlash, Tear};

/// Returns a self-checking package: length, number, filling, checksum.
#[must_use]
pub fn package(number: u16, length: usize) -> Vec<u8> {
    let length_field = u16::try_from(length).unwrap().to_le_bytes();
    let mut bytes = [length_field, number.to_le_bytes()].concat();
    bytes.extend((0..length - 8).map(|i| (usize::from(number).wrapping_mul(31) + i * 7) as u8));
    bytes.extend(crc32(&[&bytes]).to_le_bytes());
    bytes
}

/// Returns the number of a package whose checksum matches.
pub fn check(bytes: &[u8]) -> Result<u16, &'static str> {
    let (body, checksum) = bytes.split_last_chunk::<4>().ok_or("too short")?;
    if crc32(&[body]) != u32::from_le_bytes(*checksum) {
        return Err("checksum");
    }
    Ok(u16::from_le_bytes([*body.get(2).ok_or("too short")?, *body.get(3).ok_or("too short")?]))
}

/// Returns the length of the package at the start of these bytes, if there is one.
#[must_use]
pub fn length(bytes: &[u8]) -> Option<u32> {
    let (length, _) = bytes.split_first_chunk::<2>()?;
    Some(u32::from(u16::from_le_bytes(*length))).filter(|&length| length >= 8)
}

/// Returns a layout with two slots of `units` erase units each, and a commit area of two units.
#[must_use]
pub fn layout(erase_size: usize, units: usize) -> Layout {
    let (erase_size, slot_length) = (erase_size as u32, (erase_size * units) as u32);
    Layout {
        slots: [0, slot_length],
        slot_length,
        commit: 2 * slot_length,
        commit_length: 2 * erase_size,
    }
}

/// Returns erased flash for such a layout.
#[must_use]
pub fn erased_flash<const WRITE: usize, const ERASE: usize>(
    units: usize,
    tear: Tear,
    seed: u64,
) -> SimulatedFlash<WRITE, ERASE> {
    SimulatedFlash::new(ERASE * (2 * units + 2), tear, seed)
}

/// The contents of a store, as package numbers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Model {
    /// The package in use.
    pub in_use: Option<u16>,
    /// The staged package.
    pub staged: Option<u16>,
    /// During a trial: what was in use before.
    pub way_back: Option<Option<u16>>,
    /// The confirmed package's predecessor, which is used if the confirmed one is lost.
    pub reserve: Option<u16>,
}

/// A call that changes what survives a reboot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Change {
    /// An upload begins.
    Begin,
    /// The upload is complete and checked.
    Stage(u16),
    /// The staged package goes on trial.
    Activate,
    /// The package on trial is kept.
    Confirm,
    /// The previous package is used again.
    Revert,
}

impl Model {
    /// Returns what the store holds after `change`.
    #[must_use]
    pub fn after(self, change: Change) -> Self {
        match change {
            Change::Begin => Self { staged: None, reserve: None, ..self },
            Change::Stage(number) => Self { staged: Some(number), ..self },
            Change::Activate => Self {
                in_use: self.staged,
                staged: None,
                way_back: Some(self.in_use),
                reserve: None,
            },
            Change::Confirm => Self { way_back: None, reserve: self.way_back.flatten(), ..self },
            Change::Revert => self.rebooted(),
        }
    }

    /// Returns what the store holds after a reboot: a package on trial is gone, and it is not a
    /// reserve either.
    #[must_use]
    pub fn rebooted(self) -> Self {
        match self.way_back {
            Some(before) => Self { in_use: before, ..Self::default() },
            None => self,
        }
    }

    /// Returns the contents reported by a store; every package it names must be intact.
    pub fn of<F: MappedFlash>(store: &Store<F>) -> Self {
        let number = |slot| check(store.bytes(slot).unwrap()).unwrap();
        for slot in [agent_core::store::Slot::A, agent_core::store::Slot::B] {
            if let Some(bytes) = store.bytes(slot) {
                assert_eq!(check(bytes).map(|_| ()), Ok(()), "{slot} is named but damaged");
            }
        }
        let spare = store.in_use().map_or(agent_core::store::Slot::A, |slot| slot.other());
        let other = store.bytes(spare).map(|bytes| check(bytes).unwrap());
        let is_reserve = !store.is_on_trial() && store.staged().is_none();
        Self {
            in_use: store.in_use().map(number),
            staged: store.staged().map(number),
            way_back: store.is_on_trial().then_some(other),
            reserve: other.filter(|_| is_reserve),
        }
    }
}

/// The known contents of a store, and the contents possible after failed calls.
#[derive(Clone, Debug, Default)]
pub struct Ledger {
    /// Contents after the last successful change.
    pub now: Model,
    /// Contents that calls that failed since the last success would have led to.
    attempted: Vec<Model>,
}

/// Whether the error was caused by the flash, not by the caller.
#[must_use]
pub fn is_flash_error(error: StoreError) -> bool {
    use StoreError::{Flash, Unreadable, Verify};
    matches!(error, Flash(_) | Verify { .. } | Unreadable { .. })
}

impl Ledger {
    /// Records the outcome of a change; `Ok` is final, a flash error leaves both outcomes possible.
    pub fn book(&mut self, change: Change, outcome: Result<(), StoreError>) {
        match outcome {
            Ok(()) => {
                self.now = self.now.after(change);
                self.attempted.clear();
            }
            Err(error) if is_flash_error(error) => {
                self.attempted.push(self.now.after(change));
            }
            Err(refused) => panic!("{change:?} is refused in {:?}: {refused}", self.now),
        }
    }

    /// Records the installation of a package after `before`, whatever the state was.
    pub fn installed(&mut self, number: u16, before: Option<u16>) {
        self.now = Model { in_use: Some(number), reserve: before, ..Model::default() };
        self.attempted.clear();
    }

    /// Records a reboot that found `found`.
    pub fn reboot(&mut self, found: Model) {
        let attempted = self.attempted.drain(..);
        let possible: Vec<_> =
            [self.now].into_iter().chain(attempted).map(Model::rebooted).collect();
        assert!(possible.contains(&found), "found {found:?} after {possible:?}");
        self.now = found;
    }
}

/// Returns an outcome without the check's result.
pub fn plain<T>(outcome: Result<T, CheckedError<&'static str>>) -> Result<(), StoreError> {
    outcome.map(|_| ()).map_err(|error| match error {
        CheckedError::Store(error) => error,
        refused => panic!("{refused:?}"),
    })
}
