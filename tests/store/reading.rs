//! A weight store whose flash driver temporarily or permanently cannot read a journal entry.

use agent_core::store::{Loaded, MappedFlash, Opening, RECORD_LENGTH, Slot, Store, StoreError};

use test_support::nor_flash::{SimulatedFlash, Tear};
use test_support::store_model::{check, erased_flash, layout, length, package};

const UNIT: usize = 64;
/// Start of the commit area: after two slots of two units. Two entries per half.
const COMMIT: usize = 4 * UNIT;

type Flash = SimulatedFlash<4, UNIT>;

fn open(flash: &mut Flash) -> (Store<&mut Flash>, Loaded<u16, &'static str>) {
    let mut store = Store::open(flash, layout(UNIT, 2)).unwrap();
    let loaded = store.load(check);
    (store, loaded)
}

fn install<F: MappedFlash>(store: &mut Store<F>, number: u16) -> Result<(), StoreError> {
    store.begin(70)?;
    store.write(0, &package(number, 70)).unwrap();
    store.stage(check).unwrap();
    store.activate(check).unwrap();
    store.confirm().unwrap();
    Ok(())
}

/// Returns flash in which this many packages were installed, with four records each.
fn installed(packages: u16) -> Flash {
    let mut flash: Flash = erased_flash(2, Tear::Prefix, 0);
    for number in 1..=packages {
        install(&mut open(&mut flash).0, number).unwrap();
    }
    flash
}

/// Returns the positions of the newest record and the one before.
fn last_places(flash: &Flash) -> [usize; 2] {
    let sequence = |place: &usize| {
        let record = &flash.mapped()[COMMIT + place * RECORD_LENGTH..];
        // An erased entry comes first.
        u32::from_le_bytes(record[..4].try_into().unwrap()).wrapping_add(1)
    };
    let mut places = [0, 1, 2, 3];
    places.sort_by_key(sequence);
    [COMMIT + places[3] * RECORD_LENGTH, COMMIT + places[2] * RECORD_LENGTH]
}

fn unreadable(offset: usize) -> StoreError {
    StoreError::Unreadable { offset: offset as u32 }
}

#[test]
fn one_failed_read_is_repeated() {
    for others in 0..4 {
        let mut flash = installed(2);
        flash.arm_reads(others, 1);
        let (store, loaded) = open(&mut flash);
        assert_eq!(loaded.in_use, Some((Slot::B, 2)));
        let expected =
            Opening { recorded: true, torn_places: 0, unreadable_places: 0, trial_ended: None };
        assert_eq!(store.opening(), &expected);
    }
}

#[test]
fn a_temporarily_unreadable_journal_is_not_erased() {
    let mut flash = installed(2);
    let before = flash.mapped().to_vec();
    flash.arm_reads(0, usize::MAX);
    let (mut store, loaded) = open(&mut flash);
    assert_eq!((loaded.in_use, store.opening().recorded), (None, false));
    assert_eq!(store.opening().unreadable_places, 4);
    // No record says what to load, but packages can be salvaged.
    assert_eq!(store.salvage(length, check, |one, other| one > other), Some((Slot::B, 2)));
    store.flash().arm_reads(0, 0);
    assert_eq!(install(&mut store, 3), Err(unreadable(COMMIT)));
    assert_eq!(flash.mapped(), before);
    let (mut store, loaded) = open(&mut flash);
    assert_eq!(loaded.in_use, Some((Slot::B, 2)));
    install(&mut store, 3).unwrap();
    assert_eq!(open(&mut flash).1.in_use, Some((Slot::A, 3)));
}

#[test]
fn a_half_with_an_unreadable_only_record_is_not_erased() {
    // The seventh record: that of the second confirmation.
    let mut flash = installed(2);
    let [newest, trial] = last_places(&flash);
    assert!(newest % UNIT == 0 && newest / UNIT != trial / UNIT);
    let before = flash.mapped().to_vec();
    let place = (newest - COMMIT) / RECORD_LENGTH;
    flash.arm_reads(place, 2);
    let (mut store, loaded) = open(&mut flash);
    assert_eq!(store.opening().unreadable_places, 1);
    // The readable records end with the trial.
    assert_eq!(loaded.in_use, Some((Slot::A, 1)));
    assert_eq!(store.opening().trial_ended, Some(Err(unreadable(newest))));
    for _ in 0..2 {
        assert_eq!(install(&mut store, 3), Err(unreadable(newest)));
    }
    assert_eq!(flash.mapped(), before);
    assert_eq!(open(&mut flash).1.in_use, Some((Slot::B, 2)));
    // If it is permanently unreadable, it can be given up.
    flash.spoil(newest, RECORD_LENGTH);
    let (mut store, _) = open(&mut flash);
    assert_eq!(install(&mut store, 3), Err(unreadable(newest)));
    store.forget_unreadable();
    install(&mut store, 3).unwrap();
    let (store, loaded) = open(&mut flash);
    assert_eq!((loaded.in_use, store.opening().unreadable_places), (Some((Slot::B, 3)), 0));
}

#[test]
fn a_temporarily_unreadable_confirmation_is_not_undone() {
    let mut flash = installed(1);
    let [newest, trial] = last_places(&flash);
    assert_eq!(newest / UNIT, trial / UNIT);
    flash.arm_reads((newest - COMMIT) / RECORD_LENGTH, 2);
    let (store, loaded) = open(&mut flash);
    // The readable records end with the trial of the first package.
    assert_eq!(loaded.in_use, None);
    assert_eq!(store.opening().trial_ended, Some(Err(unreadable(newest))));
    assert_eq!(open(&mut flash).1.in_use, Some((Slot::A, 1)));
}

#[test]
fn an_interrupted_record_that_reads_as_an_error_blocks_nothing() {
    // The newest record, with one before it in its half: as after a torn one.
    for packages in 2..6 {
        let mut flash = installed(packages);
        open(&mut flash).0.begin(70).unwrap();
        let [newest, before] = last_places(&flash);
        assert_eq!(newest, before + RECORD_LENGTH);
        flash.spoil(newest, RECORD_LENGTH);
        for number in 10..20 {
            let (mut store, _) = open(&mut flash);
            install(&mut store, number).unwrap();
            assert_eq!(open(&mut flash).1.in_use.unwrap().1, number);
        }
    }
}
