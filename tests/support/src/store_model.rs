//! A minimal model of the weight store, and packages for it.

use agent_core::store::{
    CheckedError, Layout, MappedFlash, RECORD_LENGTH, Revert, Serial, Slot, Store, StoreError,
};
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

/// Returns the serial of a package; a higher number is not always a higher serial.
#[must_use]
pub fn serial(number: &u16) -> Serial {
    Serial { epoch: u32::from(number % 5), version: u32::from(number % 7) }
}

/// Returns what [`Store::activate`] records of a package: its serial is the highest one if none
/// before was higher.
#[must_use]
pub fn serials(number: &u16) -> (Serial, Serial) {
    (serial(number), serial(number))
}

/// Accepts every header.
///
/// # Errors
/// Never.
pub fn any_header(_: &[u8]) -> Result<(), CheckedError<&'static str>> {
    Ok(())
}

/// The reason of every revert by a call.
pub const REVERTED: u8 = 9;

/// Returns the length of the package at the start of these bytes, if there is one.
#[must_use]
pub fn length(bytes: &[u8]) -> Option<u32> {
    let (length, _) = bytes.split_first_chunk::<2>()?;
    Some(u32::from(u16::from_le_bytes(*length))).filter(|&length| length >= 8)
}

/// Erase units of each half of the commit area: the fewest that hold four records of two copies.
#[must_use]
pub const fn half_units(erase_size: usize) -> usize {
    (4 * 2 * RECORD_LENGTH).div_ceil(erase_size)
}

/// Returns a layout with two slots of `units` erase units each, and a short commit area.
#[must_use]
pub fn layout(erase_size: usize, units: usize) -> Layout {
    let slot_length = (erase_size * units) as u32;
    Layout {
        slots: [0, slot_length],
        slot_length,
        commit: 2 * slot_length,
        commit_length: (2 * half_units(erase_size) * erase_size) as u32,
    }
}

/// Returns erased flash for such a layout.
#[must_use]
pub fn erased_flash<const WRITE: usize, const ERASE: usize>(
    units: usize,
    tear: Tear,
    seed: u64,
) -> SimulatedFlash<WRITE, ERASE> {
    SimulatedFlash::new(ERASE * 2 * (units + half_units(ERASE)), tear, seed)
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
    /// The highest serial ever activated.
    pub activated: Option<Serial>,
    /// The last trial that was not passed.
    pub last_revert: Option<Revert>,
}

/// A call that changes what survives a reboot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Change {
    /// The header of an upload is accepted.
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
                activated: self.activated.max(self.staged.as_ref().map(serial)),
                ..self
            },
            Change::Confirm => Self { way_back: None, reserve: self.way_back.flatten(), ..self },
            Change::Revert => self.reverted(REVERTED),
        }
    }

    /// Returns what the store holds after a reboot: a package on trial is gone, and it is not a
    /// reserve either.
    #[must_use]
    pub fn rebooted(self) -> Self {
        self.reverted(Revert::BY_RESET)
    }

    fn reverted(self, reason: u8) -> Self {
        let Some(before) = self.way_back else { return self };
        let last_revert = self.in_use.map(|number| Revert { serial: serial(&number), reason });
        Self { in_use: before, activated: self.activated, last_revert, ..Self::default() }
    }

    /// Returns the contents reported by a store; every package it names must be intact.
    pub fn of<F: MappedFlash>(store: &Store<F>) -> Self {
        let number = |slot| check(store.bytes(slot).unwrap()).unwrap();
        for slot in [Slot::A, Slot::B] {
            if let Some(bytes) = store.bytes(slot) {
                assert_eq!(check(bytes).map(|_| ()), Ok(()), "{slot} is named but damaged");
            }
        }
        let spare = store.in_use().map_or(Slot::A, Slot::other);
        let other = store.bytes(spare).map(|bytes| check(bytes).unwrap());
        let is_reserve = !store.is_on_trial() && store.staged().is_none();
        Self {
            in_use: store.in_use().map(number),
            staged: store.staged().map(number),
            way_back: store.is_on_trial().then_some(other),
            reserve: other.filter(|_| is_reserve),
            activated: store.activated(),
            last_revert: store.last_revert(),
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

    /// Records that the contents are now known to be these, whatever they were.
    pub fn overruled(&mut self, found: Model) {
        self.now = found;
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

/// Returns a record of the journal's format 1, which older firmware wrote: slot in use and phase by
/// their codes, length and checksum of the packages in both slots.
#[must_use]
pub fn format_1_record(number: u32, in_use: u8, phase: u8, packages: [&[u8]; 2]) -> [u8; 32] {
    let mut record = [0; 32];
    record[..4].copy_from_slice(&number.to_le_bytes());
    record[4..7].copy_from_slice(&[1, in_use, phase]);
    for (place, package) in record[8..24].chunks_exact_mut(8).zip(packages) {
        if !package.is_empty() {
            place[..4].copy_from_slice(&(package.len() as u32).to_le_bytes());
            place[4..].copy_from_slice(&crc32(&[package]).to_le_bytes());
        }
    }
    let checksum = crc32(&[&record[..28]]);
    record[28..].copy_from_slice(&checksum.to_le_bytes());
    record
}
