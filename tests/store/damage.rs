//! A weight store whose flash is corrupted, overwritten or factory-programmed, and the calls it
//! refuses.

use agent_core::store::{
    CheckedError, Damage, LayoutError, Loaded, MappedFlash, Part, RECORD_LENGTH, Refusal, Revert,
    Slot, Store, StoreError, factory_record,
};

use test_support::nor_flash::{Fault, SimulatedFlash, Tear};
use test_support::store_model::{
    REVERTED, any_header, check, erased_flash, format_1_record, half_units, layout, length,
    package, serial, serials,
};

const WORD: usize = 4;
const UNIT: usize = 64;
/// Erase units of a slot.
const UNITS: usize = 2;
/// Start of slot B and of the commit area.
const SLOT_B: usize = UNITS * UNIT;
const COMMIT: usize = 2 * UNITS * UNIT;
/// Length of half of the commit area.
const HALF: usize = half_units(UNIT) * UNIT;
/// Length of a record in its two copies.
const PAIR: usize = 2 * RECORD_LENGTH;

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
    store.write(0, bytes, any_header).unwrap();
}

fn install<F: MappedFlash>(store: &mut Store<F>, number: u16) {
    upload(store, &package(number, 70));
    store.stage(check).unwrap();
    store.activate(check, serials).unwrap();
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

/// Flips every bit of two packages and of the journal. Returns the number of bits, of changes of what is
/// in use except to the other package, and of flips that are told.
pub(crate) fn flipped_bits() -> [u64; 3] {
    let mut flash = two_packages();
    // In the first half of a journal that has been through both, and with a note.
    install(&mut boot(&mut flash).0, 3);
    boot(&mut flash).0.record_note(9, b"sixteen bytes of").unwrap();
    let flash = flash;
    let mut sound = flash.clone();
    let (store, loaded) = boot(&mut sound);
    assert_eq!(loaded.in_use, Some((Slot::A, 3)));
    assert_eq!((store.damage(), loaded.refusals), (Damage::default(), [None; 2]));
    let (mut changed, mut told, mut other) = (0, 0, 0);
    let end = COMMIT + 2 * HALF;
    let slots = [0..70, SLOT_B..SLOT_B + 70];
    let places = slots.into_iter().flatten().chain(COMMIT..end);
    for bit in places.flat_map(|byte| (0..8).map(move |bit| 8 * byte + bit)) {
        let mut flash = flash.clone();
        let byte = flash.mapped()[bit / 8] ^ (1 << (bit % 8));
        flash.overwrite(bit / 8, &[byte]);
        let (mut store, loaded) = boot(&mut flash);
        let damage = store.damage();
        assert_eq!(damage.unreadable_places, 0);
        let refused = loaded.refusals.iter().any(Option::is_some);
        told += usize::from(refused || damage.torn_places == 1);
        // The package in use itself is the only loss, and the other one replaces it.
        match loaded.in_use.unwrap() {
            (Slot::A, 3) => {}
            (Slot::B, 2) => {
                assert!(bit / 8 < 70 && loaded.refusals[0] == Some(Refusal::Checksum));
                other += 1;
            }
            _ => changed += 1,
        }
        assert_eq!(store.note(9).unwrap().as_bytes(), b"sixteen bytes of");
        assert_eq!(store.activated(), Some(serial(&2).max(serial(&3)).max(serial(&1))));
        let found = store.in_use();
        assert_eq!(boot(&mut flash).0.in_use(), found);
        install(&mut boot(&mut flash).0, 4);
        assert_eq!(boot(&mut flash).1.in_use.unwrap().1, 4);
    }
    let bits = 8 * (2 * 70 + 2 * HALF);
    println!(
        "{bits} bits flipped: {changed} changes of what is in use, {other} by the other package, {told} told"
    );
    assert_eq!(other, 70 * 8);
    [bits as u64, changed, told as u64]
}

#[test]
fn every_flipped_bit_of_the_journal_and_of_both_slots_is_told_and_loses_nothing() {
    let [bits, changed, told] = flipped_bits();
    assert_eq!((changed, told), (0, bits));
}

#[test]
fn a_rotten_copy_is_replaced_before_the_other_one_rots_too() {
    let mut flash = two_packages();
    let places = (COMMIT..COMMIT + 2 * HALF).step_by(RECORD_LENGTH);
    for _ in 0..20 {
        // The first copy of every record, then the second one of those that are left.
        for copy in 0..2 {
            for place in places.clone().skip(copy).step_by(2) {
                if flash.mapped()[place] != 0xff {
                    let byte = flash.mapped()[place + 20] ^ 0x10;
                    flash.overwrite(place + 20, &[byte]);
                }
            }
            let (store, loaded) = boot(&mut flash);
            if copy == 0 {
                assert!(store.damage().single_copies > 0);
                assert_eq!(store.opening().settled, Some(Ok(())));
            }
            assert_eq!(loaded.in_use, Some((Slot::B, 2)));
            let (store, _) = boot(&mut flash);
            assert_eq!(store.opening().settled, None);
        }
    }
}

#[test]
fn only_what_is_behind_the_newest_record_costs_numbers() {
    let mut flash = two_packages();
    let number = |flash: &Flash| {
        let places = (COMMIT..COMMIT + 2 * HALF).step_by(PAIR);
        let numbers = places
            .map(|place| u32::from_le_bytes(flash.mapped()[place..place + 4].try_into().unwrap()));
        numbers.filter(|&number| number != u32::MAX).max().unwrap()
    };
    let before = number(&flash);
    // Damage in front of the newest record, at every boot.
    for _ in 0..50 {
        for place in (COMMIT..COMMIT + 2 * HALF).step_by(PAIR) {
            if flash.mapped()[place] != 0xff
                && flash.mapped()[place..place + 4] != number(&flash).to_le_bytes()
            {
                flash.overwrite(place + 8, &[0, 0]);
            }
        }
        let (mut store, _) = boot(&mut flash);
        store.record_note(9, &store.in_use().map_or(0, |_| 1_u8).to_le_bytes()).unwrap();
        store.record_note(9, b"another").unwrap();
    }
    assert!(number(&flash) < before + 1000, "{before} to {}", number(&flash));
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
    store.activate(check, serials).unwrap();
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
    store.activate(check, serials).unwrap();
    assert_eq!(store.revert(REVERTED), Ok(Some(Slot::B)));
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
    flash.overwrite(COMMIT, &[0; 2 * HALF]);
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
    store.activate(check, serials).unwrap();
    store.revert(REVERTED).unwrap();
    assert_eq!(boot(&mut flash).1.in_use, Some((Slot::A, 10)));
}

#[test]
fn unconfirmed_packages_are_not_salvaged() {
    // The first package ever, uploaded, and then one that failed its trial.
    let mut flash = new_flash();
    let (mut store, _) = boot(&mut flash);
    upload(&mut store, &package(1, 70));
    store.write(0, &package(1, 70), any_header).unwrap();
    assert_eq!(salvaged(&mut flash), None);
    let (mut store, _) = boot(&mut flash);
    upload(&mut store, &package(2, 70));
    store.stage(check).unwrap();
    store.activate(check, serials).unwrap();
    assert_eq!(salvaged(&mut flash), None);
    // One that was uploaded and staged but not recorded, after all records were lost.
    let mut flash = two_packages();
    flash.overwrite(0, &[0; 2 * SLOT_B]);
    let (mut store, loaded) = boot(&mut flash);
    assert_eq!((loaded.in_use, store.salvage(length, check, newer)), (None, None));
    upload(&mut store, &package(3, 70));
    store.write(0, &package(3, 70), any_header).unwrap();
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
        assert_eq!(store.write(60, &bytes[60..], any_header), Ok(70));
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
        flash.overwrite(COMMIT, &factory_record(slot, &bytes, Some(serial(&1))));
        let (mut store, loaded) = boot(&mut flash);
        assert_eq!(loaded.in_use, Some((slot, 1)));
        assert!(store.opening().recorded);
        assert_eq!((store.damage(), store.opening().settled), (Damage::default(), None));
        assert_eq!(store.activated(), Some(serial(&1)));
        install(&mut store, 2);
        assert_eq!(boot(&mut flash).1.in_use, Some((slot.other(), 2)));
    }
}

#[test]
fn record_numbers_wrap() {
    // A factory record, renumbered.
    let bytes = package(1, 61);
    let mut record = factory_record(Slot::A, &bytes, None);
    for copy in record.chunks_exact_mut(RECORD_LENGTH) {
        copy[..4].copy_from_slice(&(u32::MAX - 2).to_le_bytes());
        let checksum = agent_core::wire::crc::crc32(&[&copy[..60]]);
        copy[60..].copy_from_slice(&checksum.to_le_bytes());
    }
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
    // The last record confirms package 2, and is torn: the boot ends a trial.
    let flash = two_packages();
    let number = |place: &usize| {
        let number = u32::from_le_bytes(flash.mapped()[*place..][..4].try_into().unwrap());
        (number != u32::MAX).then_some(number)
    };
    let confirmation = (COMMIT..COMMIT + 2 * HALF).step_by(PAIR).max_by_key(number).unwrap();
    let whole = flash.mapped()[confirmation..][..RECORD_LENGTH].to_vec();
    for word in (0..RECORD_LENGTH).step_by(WORD) {
        let mut flash = flash.clone();
        flash.overwrite(confirmation + word, &vec![0xff; PAIR - word]);
        if word == 0 {
            continue;
        }
        let (store, loaded) = boot(&mut flash);
        assert_eq!((store.damage().torn_places, store.damage().single_copies), (1, 0));
        assert_eq!(store.opening().trial_ended, Some(Ok(())));
        assert_eq!(loaded.in_use, Some((Slot::A, 1)));
        flash.overwrite(confirmation, &whole);
        let (store, loaded) = boot(&mut flash);
        assert_eq!((store.damage().torn_places, store.opening().settled), (0, None));
        assert_eq!(loaded.in_use, Some((Slot::A, 1)));
    }
}

#[test]
fn a_boot_converts_a_journal_of_format_1_and_keeps_it_working() {
    let packages = [package(1, 70), package(2, 70)];
    let mut flash = new_flash();
    flash.overwrite(0, &packages[0]);
    flash.overwrite(SLOT_B, &packages[1]);
    flash.overwrite(COMMIT, &format_1_record(1, 0, 0, [&packages[0], &[]]));
    flash.overwrite(COMMIT + 32, &format_1_record(2, 1, 0, [&packages[0], &packages[1]]));
    let before = flash.mapped().to_vec();
    let (mut store, loaded) = boot(&mut flash);
    assert_eq!((loaded.in_use, store.activated()), (Some((Slot::B, 2)), None));
    assert_eq!(store.opening().settled, Some(Ok(())));
    store.raise_activated(serial(&2));
    assert_eq!(store.count_boot(None), 1);
    assert_eq!(flash.mapped()[..COMMIT + PAIR], before[..COMMIT + PAIR]);
    assert_eq!(flash.mapped()[COMMIT + PAIR + 4], agent_core::store::FORMAT);
    let (mut store, loaded) = boot(&mut flash);
    assert_eq!((loaded.in_use, store.opening().settled), (Some((Slot::B, 2)), None));
    store.raise_activated(serial(&2));
    install(&mut store, 3);
    let (store, loaded) = boot(&mut flash);
    assert_eq!(loaded.in_use, Some((Slot::A, 3)));
    assert_eq!(store.activated(), Some(serial(&2).max(serial(&3))));
}

#[test]
fn a_refused_header_changes_nothing() {
    let mut flash = two_packages();
    let (mut store, _) = boot(&mut flash);
    upload(&mut store, &package(3, 70));
    store.stage(check).unwrap();
    let before = (store.flash().spent, store.flash().erasures);
    let bytes = package(4, 120);
    for length in [120, 80] {
        store.begin(length).unwrap();
        assert_eq!(store.write(0, &bytes[..40], any_header), Ok(40));
        let seen = |header: &[u8]| {
            assert_eq!(header, &bytes[..length as usize]);
            Err(CheckedError::Refused("not this one"))
        };
        let refused = store.write(40, &bytes[40..length as usize], seen);
        assert_eq!(refused, Err(CheckedError::Refused("not this one")));
        assert_eq!(store.received(), None);
        // What was staged still is.
        assert_eq!(store.staged(), Some(Slot::A));
    }
    // One that comes too early is kept, and can be continued later.
    store.begin(120).unwrap();
    let wait = StoreError::TooOften { retry_after_seconds: 5 };
    let too_often = |_: &[u8]| Err::<(), CheckedError<&str>>(wait.into());
    for _ in 0..2 {
        assert_eq!(store.write(0, &bytes, too_often), Err(CheckedError::Store(wait)));
    }
    assert_eq!((store.staged(), store.is_complete()), (Some(Slot::A), false));
    assert_eq!((store.flash().spent, store.flash().erasures), before);
    assert_eq!(store.write(0, &bytes, any_header), Ok(120));
    assert_eq!((store.staged(), store.stage(check)), (None, Ok(4)));
    // An upload that waits for its header is dropped when the other slot is put in use.
    store.begin(80).unwrap();
    assert_eq!(store.write(0, &bytes[..10], any_header), Ok(10));
    store.activate(check, serials).unwrap();
    let lost = Err(CheckedError::Store(StoreError::NoUpload));
    assert_eq!(store.write(10, &bytes[10..80], any_header), lost);
    assert_eq!(store.begin(80), Err(StoreError::OnTrial));
}

#[test]
fn nothing_removes_the_way_back_during_a_trial() {
    let mut flash = two_packages();
    let (mut store, _) = boot(&mut flash);
    upload(&mut store, &package(3, 70));
    store.stage(check).unwrap();
    store.activate(check, serials).unwrap();
    let way_back = store.bytes(Slot::B).unwrap().to_vec();
    for number in 0..100_u8 {
        assert_eq!(store.begin(70), Err(StoreError::OnTrial));
        let lost = Err(CheckedError::Store(StoreError::NoUpload));
        assert_eq!(store.write(0, &package(4, 70), any_header), lost);
        assert_eq!(store.stage(check), Err(CheckedError::Store(StoreError::NoUpload)));
        store.forget_unreadable();
        assert_eq!(store.salvage(length, check, newer), None);
        // Moves the journal from half to half.
        store.record_note(9, &[number]).unwrap();
        assert_eq!(store.bytes(Slot::B), Some(&way_back[..]));
    }
    let (store, loaded) = boot(&mut flash);
    assert_eq!(loaded.in_use, Some((Slot::B, 2)));
    let revert = Revert { serial: serial(&3), reason: Revert::BY_RESET };
    assert_eq!(store.last_revert(), Some(revert));
}

#[test]
fn notes_survive_every_change_of_halves_until_they_are_removed() {
    let mut flash = two_packages();
    let (mut store, _) = boot(&mut flash);
    // Four records fit into a half: the state, two notes, and one to spare.
    let key = [0xa5; 32];
    store.record_note(30, &key).unwrap();
    assert_eq!(store.record_note(29, b"b"), Ok(()));
    assert_eq!(store.record_note(28, b"c"), Err(StoreError::Note));
    for (kind, bytes) in [(0, &b""[..]), (32, b""), (5, &[0; 53])] {
        assert_eq!(store.record_note(kind, bytes), Err(StoreError::Note), "kind {kind}");
    }
    for number in 3..40 {
        install(&mut store, number);
        assert_eq!(store.note(30).unwrap().as_bytes(), key);
        store.record_note(29, &[number as u8]).unwrap();
    }
    let spent = store.flash().spent;
    store.record_note(30, &key).unwrap();
    assert_eq!(store.flash().spent, spent, "the same again writes nothing");
    store.record_note(29, b"").unwrap();
    let (mut store, _) = boot(&mut flash);
    assert_eq!((store.note(29), store.note(30).unwrap().as_bytes()), (None, &key[..]));
    install(&mut store, 40);
    install(&mut store, 41);
    assert_eq!(store.note(29), None);
    // The removed one has made room.
    assert_eq!(store.record_note(28, b"c"), Ok(()));
}

/// A driver that reports an erasure that did not happen leaves old records behind the new ones.
#[test]
fn an_erasure_that_silently_fails_brings_nothing_old_back() {
    for others in 0..200 {
        let mut flash = two_packages();
        let (mut store, _) = boot(&mut flash);
        store.flash().arm(others, 1, Fault::Silent);
        let (mut last, mut attempted) = (0, vec![]);
        for number in 1..=20 {
            if store.record_note(9, &[number]).is_ok() {
                (last, attempted) = (number, vec![]);
            } else {
                attempted.push(number);
            }
        }
        let found = boot(&mut flash).0.note(9).map_or(0, |note| note.as_bytes()[0]);
        assert!(found == last || attempted.contains(&found), "{others}: {found} after {last}");
    }
}

#[test]
fn boots_are_counted_and_a_board_that_remembers_writes_less() {
    let mut flash = two_packages();
    for expected in 1..100 {
        assert_eq!(boot(&mut flash).0.count_boot(None), expected);
    }
    // The supply is switched on, and the chip is then reset 33 times.
    let spent = flash.spent;
    for starts in 1..=34 {
        assert_eq!(boot(&mut flash).0.count_boot(Some(starts)), 99 + starts);
    }
    // The first and every 16th after it are recorded, and at most every second time a half is erased
    // and takes two copies.
    assert!(flash.spent - spent <= 3 * PAIR + 2 * (HALF + 2 * PAIR));
    // The supply fails: the last one is forgotten.
    assert_eq!(boot(&mut flash).0.count_boot(Some(1)), 133);
    assert_eq!(boot(&mut flash).0.count_boot(Some(2)), 134);
}

#[test]
fn an_upload_accepts_repetitions_and_reports_gaps() {
    let mut flash = new_flash();
    let (mut store, _) = boot(&mut flash);
    assert_eq!(store.write(0, &[1], any_header), Err(CheckedError::Store(StoreError::NoUpload)));
    let bytes = package(1, 70);
    store.begin(70).unwrap();
    assert_eq!(store.write(0, &bytes[..10], any_header), Ok(10));
    assert_eq!(
        store.write(11, &bytes[11..20], any_header),
        Err(CheckedError::Store(StoreError::Gap { received: 10 }))
    );
    assert_eq!(store.write(3, &bytes[3..9], any_header), Ok(10));
    // Across flash, the buffered word, and new bytes.
    assert_eq!(store.write(3, &bytes[3..13], any_header), Ok(13));
    for wrong in [4, 9, 12] {
        let mut repeated = bytes[..20].to_vec();
        repeated[wrong] ^= 1;
        assert_eq!(
            store.write(0, &repeated, any_header),
            Err(CheckedError::Store(StoreError::Conflict { offset: 0 }))
        );
        assert_eq!(store.received(), Some(13));
    }
    assert_eq!(
        store.write(13, &[0; 58], any_header),
        Err(CheckedError::Store(StoreError::PastEnd { length: 70 }))
    );
    let incomplete = StoreError::Incomplete { received: 13, length: 70 };
    assert_eq!(store.stage(check), Err(CheckedError::Store(incomplete)));
    assert_eq!(store.write(13, &bytes[13..], any_header), Ok(70));
    // The last word is complete only once the package is staged; repetitions are accepted before
    // and after.
    assert_eq!(store.stage(|_| Err::<(), _>("no")), Err(CheckedError::Refused("no")));
    assert_eq!(store.write(50, &bytes[50..], any_header), Ok(70));
    assert_eq!(store.stage(check), Ok(1));
    assert_eq!(store.bytes(Slot::A), Some(&bytes[..]));
    assert_eq!(store.flash().mapped()[70..SLOT_B], [0xff; SLOT_B - 70]);
    // Units after the package are untouched: one erasure for each unit entered, and none of a journal
    // that has room.
    assert_eq!(store.flash().erasures, 2);
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
    assert_eq!(store.activate(check, serials), Err(CheckedError::Store(StoreError::Damaged)));
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
    assert_eq!(store.activate(check, serials), Err(CheckedError::Store(StoreError::NotLoaded)));
    assert_eq!(store.salvage(length, check, newer), None);
    store.load(check);
    assert_eq!(store.activate(check, serials), Ok(3));
    assert_eq!(store.begin(70), Err(StoreError::OnTrial));
}

#[test]
fn an_invalid_layout_is_refused() {
    let mut flash = new_flash();
    let short =
        agent_core::store::Layout { commit_length: (4 * HALF) as u32, ..layout(UNIT, UNITS) };
    let expected =
        LayoutError::OutOfRegion { part: Part::Commit, capacity: (COMMIT + 2 * HALF) as u32 };
    assert_eq!(Store::open(&mut flash, short).err(), Some(expected));
}

#[test]
fn a_store_is_small() {
    let size = size_of::<Store<()>>();
    println!("the store without its flash driver: {size} bytes");
    assert!(size < 560, "{size} bytes");
}
