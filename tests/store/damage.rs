//! A weight store whose flash is corrupted, overwritten or factory-programmed, and the calls it
//! refuses.

use agent_core::store::{
    CheckedError, LayoutError, Loaded, MappedFlash, Part, RECORD_LENGTH, Refusal, Slot, Store,
    StoreError, factory_record,
};

use test_support::nor_flash::{Fault, SimulatedFlash, Tear};
use test_support::store_model::{check, erased_flash, layout, length, package};

const WORD: usize = 4;
const UNIT: usize = 64;
/// Erase units of a slot.
const UNITS: usize = 2;
/// Start of slot B and of the commit area.
const SLOT_B: usize = UNITS * UNIT;
const COMMIT: usize = 2 * UNITS * UNIT;

type Flash = SimulatedFlash<WORD, UNIT>;

fn new_flash() -> Flash {
    erased_flash(UNITS, Tear::Prefix, 0)
}

/// Opens a store and loads the package in use.
fn boot(flash: &mut Flash) -> (Store<&mut Flash>, Loaded<u16, &'static str>) {
    let mut store = Store::open(flash, layout(UNIT, UNITS)).unwrap();
    let loaded = store.load(check);
    (store, loaded)
}

fn upload<F: MappedFlash>(store: &mut Store<F>, bytes: &[u8]) {
    store.begin(bytes.len() as u32).unwrap();
    store.write(0, bytes).unwrap();
}

fn install<F: MappedFlash>(store: &mut Store<F>, number: u16) {
    upload(store, &package(number, 70));
    store.stage(check).unwrap();
    store.activate(check).unwrap();
    store.confirm().unwrap();
}

/// Returns flash with package 1 in slot A, and package 2 in slot B, in use.
fn two_packages() -> Flash {
    let mut flash = new_flash();
    let (mut store, _) = boot(&mut flash);
    install(&mut store, 1);
    install(&mut store, 2);
    assert_eq!(store.in_use(), Some(Slot::B));
    flash
}

/// Returns what is found without any record.
fn salvaged(flash: &mut Flash) -> Option<(Slot, u16)> {
    let (mut store, loaded) = boot(flash);
    assert_eq!(loaded.in_use, None);
    store.salvage(length, check, newer)
}

/// Whether the first of two package numbers is newer.
fn newer(one: &u16, other: &u16) -> bool {
    one > other
}

#[test]
fn every_flipped_bit_of_a_package_is_detected_and_the_other_slot_is_used() {
    let flash = two_packages();
    for bit in 0..70 * 8 {
        let mut flash = flash.clone();
        let byte = flash.mapped()[SLOT_B + bit / 8] ^ (1 << (bit % 8));
        flash.overwrite(SLOT_B + bit / 8, &[byte]);
        let (mut store, loaded) = boot(&mut flash);
        assert_eq!(loaded.in_use, Some((Slot::A, 1)));
        assert_eq!(loaded.refusals, [None, Some(Refusal::Checksum)]);
        assert_eq!((store.in_use(), store.bytes(Slot::B)), (Some(Slot::A), None));
        // The next package replaces the damaged one.
        install(&mut store, 3);
        assert_eq!(store.in_use(), Some(Slot::B));
        assert_eq!(boot(&mut flash).1.in_use, Some((Slot::B, 3)));
    }
}

#[test]
fn every_flipped_bit_of_the_journal_leaves_a_working_package() {
    let flash = two_packages();
    let mut flipped = [0; 3];
    for bit in 0..2 * UNIT * 8 {
        let mut flash = flash.clone();
        let byte = flash.mapped()[COMMIT + bit / 8] ^ (1 << (bit % 8));
        flash.overwrite(COMMIT + bit / 8, &[byte]);
        let (mut store, loaded) = boot(&mut flash);
        let (_, number) = loaded.in_use.unwrap();
        flipped[usize::from(number)] += 1;
        install(&mut store, 3);
        assert_eq!(boot(&mut flash).1.in_use.unwrap().1, 3);
    }
    // Only the newest record, the confirmation, matters: the one before it is that of the trial,
    // which a boot ends.
    assert_eq!(flipped, [0, RECORD_LENGTH * 8, (2 * UNIT - RECORD_LENGTH) * 8]);
}

#[test]
fn a_package_that_the_check_refuses_is_not_used_and_not_overwritten_before_the_other() {
    let mut flash = two_packages();
    let mut store = Store::open(&mut flash, layout(UNIT, UNITS)).unwrap();
    let only_first =
        |bytes: &[u8]| check(bytes).and_then(|n| if n == 1 { Ok(n) } else { Err("no") });
    let loaded = store.load(only_first);
    assert_eq!(loaded.in_use, Some((Slot::A, 1)));
    assert_eq!(loaded.refusals, [None, Some(Refusal::Check("no"))]);
    // With a check that accepts both again, both are loaded again.
    assert_eq!(boot(&mut flash).1.in_use, Some((Slot::B, 2)));
    let mut store = Store::open(&mut flash, layout(UNIT, UNITS)).unwrap();
    let loaded = store.load(|_| Err::<(), _>("never"));
    assert_eq!(loaded.in_use, None);
    assert_eq!(loaded.refusals, [Some(Refusal::Check("never")); 2]);
}

#[test]
fn a_failed_package_is_not_used_even_if_the_previous_one_is_lost() {
    let mut flash = two_packages();
    let (mut store, _) = boot(&mut flash);
    upload(&mut store, &package(3, 70));
    store.stage(check).unwrap();
    store.activate(check).unwrap();
    let on_trial = flash.clone();
    // The boot that ends the trial, and every later one; the package itself stays intact.
    flash.overwrite(SLOT_B, &[0]);
    for _ in 0..3 {
        let (mut store, loaded) = boot(&mut flash);
        assert_eq!(loaded.in_use, None);
        assert_eq!(loaded.refusals, [None, Some(Refusal::Checksum)]);
        assert_eq!((store.salvage(length, check, newer), store.is_on_trial()), (None, false));
        assert_eq!(store.bytes(Slot::A), None);
    }
    install(&mut boot(&mut flash).0, 4);
    assert_eq!(boot(&mut flash).1.in_use.unwrap().1, 4);
    // Also if the slot is corrupted after the boot that ended the trial.
    let mut flash = on_trial;
    assert_eq!(boot(&mut flash).1.in_use, Some((Slot::B, 2)));
    flash.overwrite(SLOT_B, &[0]);
    assert_eq!(boot(&mut flash).1.in_use, None);
    assert_eq!(salvaged(&mut flash), None);
    // And after a revert without a reboot.
    let mut flash = two_packages();
    let (mut store, _) = boot(&mut flash);
    upload(&mut store, &package(3, 70));
    store.stage(check).unwrap();
    store.activate(check).unwrap();
    assert_eq!(store.revert(), Ok(Some(Slot::B)));
    assert_eq!(store.bytes(Slot::A), None);
    flash.overwrite(SLOT_B, &[0]);
    assert_eq!(boot(&mut flash).1.in_use, None);
    assert_eq!(salvaged(&mut flash), None);
}

#[test]
fn packages_are_salvaged_without_a_record() {
    // Empty flash.
    assert_eq!(salvaged(&mut new_flash()), None);
    // The journal is lost: the newer of two packages, whichever slot it is in, or the only one.
    let mut flash = two_packages();
    flash.overwrite(COMMIT, &[0; 2 * UNIT]);
    assert_eq!(salvaged(&mut flash), Some((Slot::B, 2)));
    flash.overwrite(0, &package(3, 60));
    assert_eq!(salvaged(&mut flash), Some((Slot::A, 3)));
    flash.overwrite(0, &package(2, 60));
    assert_eq!(salvaged(&mut flash), Some((Slot::A, 2)));
    flash.overwrite(0, &[0]);
    assert_eq!(salvaged(&mut flash), Some((Slot::B, 2)));
    // A debugger has replaced both packages; the slot in use is tried first.
    let mut flash = two_packages();
    flash.overwrite(0, &package(8, 60));
    flash.overwrite(SLOT_B, &package(9, 60));
    assert_eq!(salvaged(&mut flash), Some((Slot::B, 9)));
    // A salvaged package is in use like any other, and not overwritten.
    let (mut store, _) = boot(&mut flash);
    store.salvage(length, check, newer).unwrap();
    assert_eq!(store.bytes(Slot::B), Some(&package(9, 60)[..]));
    assert_eq!(store.salvage(length, check, newer), None);
    install(&mut store, 10);
    assert_eq!(store.in_use(), Some(Slot::A));
    let (mut store, loaded) = boot(&mut flash);
    assert_eq!(loaded.in_use, Some((Slot::A, 10)));
    upload(&mut store, &package(11, 70));
    store.stage(check).unwrap();
    store.activate(check).unwrap();
    store.revert().unwrap();
    assert_eq!(boot(&mut flash).1.in_use, Some((Slot::A, 10)));
}

#[test]
fn unconfirmed_packages_are_not_salvaged() {
    // The first package ever, uploaded, and then one that failed its trial.
    let mut flash = new_flash();
    let (mut store, _) = boot(&mut flash);
    upload(&mut store, &package(1, 70));
    store.write(0, &package(1, 70)).unwrap();
    assert_eq!(salvaged(&mut flash), None);
    let (mut store, _) = boot(&mut flash);
    upload(&mut store, &package(2, 70));
    store.stage(check).unwrap();
    store.activate(check).unwrap();
    assert_eq!(salvaged(&mut flash), None);
    // One that was uploaded and staged but not recorded, after all records were lost.
    let mut flash = two_packages();
    flash.overwrite(0, &[0; 2 * SLOT_B]);
    let (mut store, loaded) = boot(&mut flash);
    assert_eq!((loaded.in_use, store.salvage(length, check, newer)), (None, None));
    upload(&mut store, &package(3, 70));
    store.write(0, &package(3, 70)).unwrap();
    store.flash().arm(1, 1, Fault::Nothing);
    let _ = store.stage(check);
    assert_eq!(salvaged(&mut flash), None);
}

#[test]
fn repeating_the_end_of_a_refused_package_writes_nothing() {
    let mut flash = two_packages();
    let (mut store, _) = boot(&mut flash);
    let bytes = package(3, 70);
    upload(&mut store, &bytes);
    assert!(matches!(store.stage(|_| Err::<(), _>("no")), Err(CheckedError::Refused("no"))));
    let before = (store.flash().spent, store.flash().mapped().to_vec());
    for _ in 0..UNITS * UNIT / WORD {
        assert_eq!(store.write(60, &bytes[60..]), Ok(70));
    }
    assert_eq!((store.flash().spent, store.flash().mapped().to_vec()), before);
    assert_eq!(store.stage(check), Ok(3));
}

#[test]
fn a_factory_image_boots_and_takes_updates() {
    for slot in [Slot::A, Slot::B] {
        let bytes = package(1, 61);
        let mut flash = new_flash();
        flash.overwrite(if slot == Slot::A { 0 } else { SLOT_B }, &bytes);
        flash.overwrite(COMMIT, &factory_record(slot, &bytes));
        let (mut store, loaded) = boot(&mut flash);
        assert_eq!(loaded.in_use, Some((slot, 1)));
        assert!(store.opening().recorded && store.opening().torn_places == 0);
        install(&mut store, 2);
        assert_eq!(boot(&mut flash).1.in_use, Some((slot.other(), 2)));
    }
}

#[test]
fn record_numbers_wrap() {
    // Via the other half's record, whose number is near the end: a factory record, renumbered.
    let bytes = package(1, 61);
    let mut record = factory_record(Slot::A, &bytes);
    record[..4].copy_from_slice(&(u32::MAX - 2).to_le_bytes());
    let checksum = agent_core::wire::crc::crc32(&[&record[..28]]);
    record[28..].copy_from_slice(&checksum.to_le_bytes());
    let mut flash = new_flash();
    flash.overwrite(0, &bytes);
    flash.overwrite(COMMIT, &record);
    for number in 2..6 {
        install(&mut boot(&mut flash).0, number);
        assert_eq!(boot(&mut flash).1.in_use.unwrap().1, number);
    }
}

#[test]
fn a_torn_record_that_later_reads_as_valid_undoes_nothing() {
    // A journal of eight entries per half, so that the torn record stays in place.
    type Wide = SimulatedFlash<WORD, 256>;
    fn open(flash: &mut Wide) -> Store<&mut Wide> {
        Store::open(flash, layout(256, 1)).unwrap()
    }
    let mut flash: Wide = erased_flash(1, Tear::Prefix, 0);
    let mut store = open(&mut flash);
    store.load(check);
    install(&mut store, 1);
    install(&mut store, 2);
    // The seventh record confirms package 2, and is torn: the boot ends a trial.
    let confirmation = 2 * 256 + 6 * RECORD_LENGTH;
    let whole = flash.mapped()[confirmation..][..RECORD_LENGTH].to_vec();
    flash.overwrite(confirmation + RECORD_LENGTH - WORD, &[0xff; WORD]);
    let mut store = open(&mut flash);
    assert_eq!(store.opening().torn_places, 1);
    assert_eq!(store.opening().trial_ended, Some(Ok(())));
    assert_eq!(store.load(check).in_use, Some((Slot::A, 1)));
    flash.overwrite(confirmation, &whole);
    let mut store = open(&mut flash);
    assert_eq!(store.opening().torn_places, 0);
    assert_eq!(store.load(check).in_use, Some((Slot::A, 1)));
}

#[test]
fn an_upload_accepts_repetitions_and_reports_gaps() {
    let mut flash = new_flash();
    let (mut store, _) = boot(&mut flash);
    assert_eq!(store.write(0, &[1]), Err(StoreError::NoUpload));
    let bytes = package(1, 70);
    store.begin(70).unwrap();
    assert_eq!(store.write(0, &bytes[..10]), Ok(10));
    assert_eq!(store.write(11, &bytes[11..20]), Err(StoreError::Gap { received: 10 }));
    assert_eq!(store.write(3, &bytes[3..9]), Ok(10));
    // Across flash, the buffered word, and new bytes.
    assert_eq!(store.write(3, &bytes[3..13]), Ok(13));
    for wrong in [4, 9, 12] {
        let mut repeated = bytes[..20].to_vec();
        repeated[wrong] ^= 1;
        assert_eq!(store.write(0, &repeated), Err(StoreError::Conflict { offset: 0 }));
        assert_eq!(store.received(), Some(13));
    }
    assert_eq!(store.write(13, &[0; 58]), Err(StoreError::PastEnd { length: 70 }));
    let incomplete = StoreError::Incomplete { received: 13, length: 70 };
    assert_eq!(store.stage(check), Err(CheckedError::Store(incomplete)));
    assert_eq!(store.write(13, &bytes[13..]), Ok(70));
    // The last word is complete only once the package is staged; repetitions are accepted before
    // and after.
    assert_eq!(store.stage(|_| Err::<(), _>("no")), Err(CheckedError::Refused("no")));
    assert_eq!(store.write(50, &bytes[50..]), Ok(70));
    assert_eq!(store.stage(check), Ok(1));
    assert_eq!(store.bytes(Slot::A), Some(&bytes[..]));
    assert_eq!(store.flash().mapped()[70..SLOT_B], [0xff; SLOT_B - 70]);
    // Units after the package are untouched: one erasure for each unit entered, and the journal's
    // first.
    assert_eq!(store.flash().erasures, 3);
}

#[test]
fn a_staged_package_that_has_changed_is_not_activated() {
    let mut flash = two_packages();
    let (mut store, _) = boot(&mut flash);
    upload(&mut store, &package(3, 70));
    store.stage(check).unwrap();
    flash.overwrite(20, &[0]);
    let (mut store, loaded) = boot(&mut flash);
    assert_eq!((loaded.in_use, store.staged()), (Some((Slot::B, 2)), Some(Slot::A)));
    assert_eq!(store.activate(check), Err(CheckedError::Store(StoreError::Damaged)));
    install(&mut store, 4);
}

#[test]
fn calls_are_refused_before_loading() {
    let mut flash = two_packages();
    let (mut store, _) = boot(&mut flash);
    upload(&mut store, &package(3, 70));
    store.stage(check).unwrap();
    let mut store = Store::open(&mut flash, layout(UNIT, UNITS)).unwrap();
    assert_eq!(store.begin(70), Err(StoreError::NotLoaded));
    assert_eq!(store.activate(check), Err(CheckedError::Store(StoreError::NotLoaded)));
    assert_eq!(store.salvage(length, check, newer), None);
    store.load(check);
    assert_eq!(store.activate(check), Ok(3));
    assert_eq!(store.begin(70), Err(StoreError::OnTrial));
}

#[test]
fn an_invalid_layout_is_refused() {
    let mut flash = new_flash();
    let short = agent_core::store::Layout { commit_length: 4 * UNIT as u32, ..layout(UNIT, UNITS) };
    let expected = LayoutError::OutOfRegion { part: Part::Commit, capacity: 6 * UNIT as u32 };
    assert_eq!(Store::open(&mut flash, short).err(), Some(expected));
}

#[test]
fn a_store_is_small() {
    let size = size_of::<Store<()>>();
    println!("the store without its flash driver: {size} bytes");
    assert!(size < 220, "{size} bytes");
}
