//! A weight store whose flash driver temporarily or permanently cannot read places of the journal.

use agent_core::store::{
    Change, Damage, Loaded, MappedFlash, Opening, RECORD_LENGTH, Slot, Store, StoreError,
};

use test_support::nor_flash::{SimulatedFlash, Tear};
use test_support::store_model::{
    any_header, check, erased_flash, half_units, layout, length, package, plain, serials,
};

const UNIT: usize = 64;
/// Start of the commit area: after two slots of two units.
const COMMIT: usize = 4 * UNIT;
const HALF: usize = half_units(UNIT) * UNIT;
const PAIR: usize = 2 * RECORD_LENGTH;
const PAIRS: usize = HALF / PAIR;
/// Reads of a pair that succeed at once.
const READS: usize = PAIR / 32;

type Flash = SimulatedFlash<4, UNIT>;

fn open(flash: &mut Flash) -> (Store<&mut Flash>, Loaded<u16, &'static str>) {
    let mut store = Store::open(flash, layout(UNIT, 2)).unwrap();
    let loaded = store.load(check);
    (store, loaded)
}

fn install<F: MappedFlash>(store: &mut Store<F>, number: u16) -> Result<(), StoreError> {
    store.begin(70)?;
    plain(store.write(0, &package(number, 70), any_header))?;
    store.stage(check).unwrap();
    store.activate(check, serials).unwrap();
    store.confirm().unwrap();
    Ok(())
}

/// Returns flash in which this many packages were installed.
fn installed(packages: u16) -> Flash {
    let mut flash: Flash = erased_flash(2, Tear::Prefix, 0);
    for number in 1..=packages {
        install(&mut open(&mut flash).0, number).unwrap();
    }
    flash
}

/// Returns the index of the newest record's pair, from 0 in the first half.
fn newest_pair(flash: &Flash) -> usize {
    let number = |pair: &usize| {
        let record = &flash.mapped()[COMMIT + pair * PAIR..];
        // An erased one comes first.
        u32::from_le_bytes(record[..4].try_into().unwrap()).wrapping_add(1)
    };
    (0..2 * PAIRS).max_by_key(number).unwrap()
}

/// A node tells its neighbours before its chip stalls, so it has to know.
#[test]
fn the_store_foresees_what_erases_flash() {
    const UNITS: usize = 8;
    let mut flash: Flash = erased_flash(UNITS, Tear::Prefix, 0);
    let mut store = Store::open(&mut flash, layout(UNIT, UNITS)).unwrap();
    let _ = store.load(check);
    let (mut foreseen, mut not_foreseen) = (0, 0);
    for number in 1..200 {
        // Whole units, parts of words, and a last word that is padded.
        let length = 8 + usize::from(number) * 37 % (UNIT * UNITS - 8);
        let (bytes, chunk) = (package(number, length), 1 + usize::from(number) % 150);
        let mut watched =
            |store: &mut Store<&mut Flash>,
             change,
             act: &mut dyn FnMut(&mut Store<&mut Flash>) -> bool| {
                let (expected, before) = (store.is_to_erase(change), store.flash().erasures);
                let is_header = act(store);
                let erases = store.flash().erasures > before;
                assert_eq!(erases, expected || is_header, "{number}, {change:?}");
                foreseen += u32::from(erases && expected);
                not_foreseen += u32::from(erases && is_header);
            };
        store.begin(length as u32).unwrap();
        for (index, part) in bytes.chunks(chunk).enumerate() {
            let offset = (index * chunk) as u32;
            let change = Change::Bytes { offset, length: part.len() };
            watched(&mut store, change, &mut |store| {
                let mut is_header = false;
                let accept = |header: &[u8]| {
                    is_header = true;
                    any_header(header)
                };
                plain(store.write(offset, part, accept).map(|_| ())).unwrap();
                is_header
            });
            // A repetition erases nothing.
            watched(&mut store, change, &mut |store| {
                plain(store.write(offset, part, any_header).map(|_| ())).unwrap();
                false
            });
        }
        watched(&mut store, Change::Stage, &mut |store| {
            plain(store.stage(check)).unwrap();
            false
        });
        watched(&mut store, Change::Records(1), &mut |store| {
            plain(store.activate(check, serials)).unwrap();
            false
        });
        watched(&mut store, Change::Records(1), &mut |store| {
            match number % 3 {
                0 => drop(store.revert(0).unwrap()),
                _ => store.confirm().unwrap(),
            }
            false
        });
    }
    assert!(foreseen > 300 && not_foreseen == 199, "{foreseen} {not_foreseen}");
}

/// Makes the next boot unable to read a pair.
fn hide(flash: &Flash, pair: usize) {
    // Each half is read from its end, and each failed read is repeated.
    let others = pair / PAIRS * PAIRS + (PAIRS - 1 - pair % PAIRS);
    flash.arm_reads(others * READS, 2 * READS);
}

fn unreadable(offset: usize) -> StoreError {
    StoreError::Unreadable { offset: offset as u32 }
}

#[test]
fn one_failed_read_is_repeated() {
    for others in 0..2 * PAIRS * READS {
        let mut flash = installed(2);
        flash.arm_reads(others, 1);
        let (store, loaded) = open(&mut flash);
        assert_eq!(loaded.in_use, Some((Slot::B, 2)));
        let expected =
            Opening { recorded: true, damage: Damage::default(), trial_ended: None, settled: None };
        assert_eq!(store.opening(), &expected);
    }
}

#[test]
fn one_unreadable_copy_is_replaced() {
    for packages in 1..9 {
        let flash = installed(packages);
        let place = COMMIT + newest_pair(&flash) * PAIR;
        for copy in [place, place + RECORD_LENGTH] {
            let mut flash = flash.clone();
            flash.spoil(copy, RECORD_LENGTH);
            let (store, loaded) = open(&mut flash);
            assert_eq!(loaded.in_use.unwrap().1, packages);
            let damage = Damage { torn_places: 0, unreadable_places: 1, single_copies: 1 };
            assert_eq!((store.damage(), store.opening().settled), (damage, Some(Ok(()))));
            assert_eq!(open(&mut flash).0.opening().settled, None);
        }
    }
}

#[test]
fn a_temporarily_unreadable_journal_is_not_erased() {
    let mut flash = installed(2);
    let before = flash.mapped().to_vec();
    flash.arm_reads(0, usize::MAX);
    let (mut store, loaded) = open(&mut flash);
    assert_eq!((loaded.in_use, store.opening().recorded), (None, false));
    assert_eq!(store.damage().unreadable_places as usize, 4 * PAIRS);
    // No record says what to load, but packages can be salvaged.
    assert_eq!(store.salvage(length, check, |one, other| one > other), Some((Slot::B, 2)));
    store.count_boot(None);
    store.flash().arm_reads(0, 0);
    assert!(store.is_blocked());
    assert_eq!(install(&mut store, 3), Err(unreadable(COMMIT)));
    assert_eq!(store.record_note(9, &[1]), Err(unreadable(COMMIT)));
    assert_eq!(flash.mapped(), before);
    let (mut store, loaded) = open(&mut flash);
    assert_eq!((loaded.in_use, store.is_blocked()), (Some((Slot::B, 2)), false));
    install(&mut store, 3).unwrap();
    assert_eq!(open(&mut flash).1.in_use, Some((Slot::A, 3)));
}

#[test]
fn the_operator_can_give_up_a_journal_that_stays_unreadable() {
    for packages in 1..9 {
        let mut flash = installed(packages);
        flash.spoil(COMMIT, 2 * HALF);
        for _ in 0..2 {
            let (mut store, _) = open(&mut flash);
            assert!(store.is_blocked());
            assert_eq!(install(&mut store, 30), Err(unreadable(COMMIT)));
        }
        let (mut store, _) = open(&mut flash);
        let found = store.salvage(length, check, |one, other| one > other);
        assert_eq!(found.unwrap().1, packages);
        store.forget_unreadable();
        install(&mut store, 30).unwrap();
        for number in 31..40 {
            let (mut store, loaded) = open(&mut flash);
            assert_eq!((loaded.in_use.unwrap().1, store.is_blocked()), (number - 1, false));
            install(&mut store, number).unwrap();
        }
    }
}

#[test]
fn a_temporarily_unreadable_confirmation_is_not_undone() {
    for packages in 1..9 {
        let mut flash = installed(packages);
        let newest = newest_pair(&flash);
        if newest.is_multiple_of(PAIRS) {
            // No record before it in its half: see the next test.
            continue;
        }
        hide(&flash, newest);
        let before = flash.mapped().to_vec();
        let (store, loaded) = open(&mut flash);
        // The readable records end with the trial.
        assert_eq!(loaded.in_use.map_or(0, |(_, number)| number), packages - 1);
        let held = unreadable(COMMIT + newest * PAIR);
        assert_eq!(store.opening().trial_ended, Some(Err(held)));
        assert_eq!((store.opening().settled, store.damage().unreadable_places), (None, 2));
        assert_eq!(flash.mapped(), before);
        assert_eq!(open(&mut flash).1.in_use.unwrap().1, packages);
        // A new package overrules it.
        hide(&flash, newest);
        let (mut store, _) = open(&mut flash);
        install(&mut store, 20).unwrap();
        assert_eq!(open(&mut flash).1.in_use.unwrap().1, 20);
    }
}

#[test]
fn an_interrupted_erasure_ends_no_updates() {
    // A half that cannot be read, or not all of it, beside one with records.
    for packages in 1..9 {
        for spoiled in (UNIT..=HALF).step_by(UNIT) {
            let mut flash = installed(packages);
            let half = 1 - newest_pair(&flash) / PAIRS;
            let start = COMMIT + half * HALF;
            flash.spoil(start, spoiled);
            flash.overwrite(start + spoiled, &vec![0xff; HALF - spoiled]);
            let (store, loaded) = open(&mut flash);
            assert_eq!((loaded.in_use.unwrap().1, store.is_blocked()), (packages, false));
            for number in 20..25 {
                let (mut store, _) = open(&mut flash);
                install(&mut store, number).unwrap();
                assert_eq!(open(&mut flash).1.in_use.unwrap().1, number);
            }
        }
    }
}

#[test]
fn an_interrupted_record_that_reads_as_an_error_blocks_nothing() {
    for packages in 0..9 {
        let mut flash = installed(packages);
        let next = if packages == 0 { 0 } else { newest_pair(&flash) + 1 };
        if next % PAIRS == 0 && packages > 0 {
            continue;
        }
        // The first copy of the next record.
        flash.spoil(COMMIT + next * PAIR, 32);
        let (store, loaded) = open(&mut flash);
        assert_eq!(loaded.in_use.map_or(0, |(_, number)| number), packages);
        assert_eq!((store.opening().settled, store.is_blocked()), (Some(Ok(())), false));
        for number in 10..20 {
            let (mut store, _) = open(&mut flash);
            install(&mut store, number).unwrap();
            assert_eq!(open(&mut flash).1.in_use.unwrap().1, number);
        }
    }
}
