//! Random histories of a weight store: uploads in chunks of any size, with lost, repeated and wrong
//! ones, refused packages, confirmed and reverted trials, writes that fail with and without an
//! error, power cuts, reboots. Successful changes survive; refused calls change nothing.
//!
//! `STORE_HISTORIES` sets the number of histories (default [`HISTORIES`]); the seed of a history is
//! its number.

use std::ops::AddAssign;

use agent_core::store::{
    CheckedError, HEADER_LENGTH, MappedFlash, RECORD_LENGTH, Slot, Store, StoreError,
};
use agent_core::wire::crc::crc32;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use test_support::nor_flash::{Fault, SimulatedFlash, Tear};
use test_support::store_model::{
    Change, Ledger, Model, REVERTED, any_header, check, erased_flash, is_flash_error, layout,
    package, plain, serials,
};

const HISTORIES: u64 = 50_000;
/// Calls per history.
const CALLS: usize = 60;
/// Erase units of a slot.
const UNITS: usize = 3;

/// Counts of events.
#[derive(Clone, Copy, Debug, Default)]
struct Tally {
    calls: u64,
    boots: u64,
    cuts: u64,
    faults: u64,
    staged: u64,
    confirmed: u64,
    reverted: u64,
    refused: u64,
    unread: u64,
    blocked: u64,
    overruled: u64,
    settled_wrongly: u64,
}

impl AddAssign for Tally {
    fn add_assign(&mut self, other: Self) {
        self.calls += other.calls;
        self.boots += other.boots;
        self.cuts += other.cuts;
        self.faults += other.faults;
        self.staged += other.staged;
        self.confirmed += other.confirmed;
        self.reverted += other.reverted;
        self.refused += other.refused;
        self.unread += other.unread;
        self.blocked += other.blocked;
        self.overruled += other.overruled;
        self.settled_wrongly += other.settled_wrongly;
    }
}

/// An upload as seen by its sender.
#[derive(Clone, Debug)]
struct Sent {
    number: u16,
    bytes: Vec<u8>,
    received: usize,
    /// Whether the header was accepted.
    is_begun: bool,
}

/// A store between two reboots, with its model.
struct Session<'a, F> {
    store: Store<F>,
    ledger: &'a mut Ledger,
    number: &'a mut u16,
    draw: &'a mut ChaCha8Rng,
    tally: &'a mut Tally,
    sent: Option<Sent>,
    slot_length: usize,
}

impl<F: MappedFlash> Session<'_, F> {
    /// Records a change that the model allows, or a refusal that it requires.
    fn expect(
        &mut self,
        change: Change,
        refusal: Option<StoreError>,
        outcome: Result<(), StoreError>,
    ) {
        match refusal {
            Some(_) => {
                assert_eq!(outcome.err(), refusal, "{change:?} in {:?}", self.ledger.now);
                self.tally.refused += 1;
            }
            None => self.ledger.book(change, outcome),
        }
    }

    /// Makes one call, usually a sensible one.
    fn call(&mut self) {
        self.tally.calls += 1;
        let now = self.ledger.now;
        let sensible = match &self.sent {
            _ if now.way_back.is_some() => self.draw.random_range(3..=4),
            Some(sent) if sent.received < sent.bytes.len() || !sent.is_begun => 1,
            Some(_) => 2,
            None if now.staged.is_some() => 5,
            None => 0,
        };
        let any = self.draw.random_range(0..=5);
        match if self.draw.random_bool(0.9) { sensible } else { any } {
            0 => self.begin(),
            1 => self.write(),
            2 => self.stage(),
            3 => {
                let outcome = self.store.confirm();
                let refusal = now.way_back.is_none().then_some(StoreError::NotOnTrial);
                self.tally.confirmed += u64::from(outcome.is_ok());
                self.expect(Change::Confirm, refusal, outcome);
            }
            4 => {
                let outcome = self.store.revert(REVERTED).map(|_| ());
                let refusal = now.way_back.is_none().then_some(StoreError::NotOnTrial);
                self.tally.reverted += u64::from(outcome.is_ok());
                self.expect(Change::Revert, refusal, outcome);
            }
            _ => self.activate(),
        }
    }

    fn begin(&mut self) {
        let length = self.draw.random_range(8..=self.slot_length);
        let announced = match self.draw.random_range(0..40) {
            0 => 0,
            1 => self.slot_length + 1,
            _ => length,
        };
        let maximum = self.slot_length as u32;
        let refusal = if self.ledger.now.way_back.is_some() {
            Some(StoreError::OnTrial)
        } else if announced != length {
            Some(StoreError::Length { found: announced as u32, maximum })
        } else {
            None
        };
        let outcome = self.store.begin(announced as u32);
        assert_eq!(outcome.err(), refusal);
        self.tally.refused += u64::from(refusal.is_some());
        if outcome.is_ok() {
            *self.number += 1;
            let (number, bytes) = (*self.number, package(*self.number, length));
            self.sent = Some(Sent { number, bytes, received: 0, is_begun: false });
        }
    }

    fn write(&mut self) {
        let Some(sent) = &mut self.sent else {
            let none = Err(CheckedError::Store(StoreError::NoUpload));
            assert_eq!(self.store.write(0, &[1], any_header), none);
            self.tally.refused += 1;
            return;
        };
        let (length, received) = (sent.bytes.len(), sent.received);
        let any = self.draw.random_range(0..=length);
        // Usually the next bytes, sometimes repeated ones, sometimes ones too far ahead.
        let from = if self.draw.random_bool(0.8) { received } else { any };
        let size = self.draw.random_range(0..=(length - from).min(40));
        let mut chunk = sent.bytes[from..from + size].to_vec();
        let mut refusal =
            (from > received).then_some(StoreError::Gap { received: received as u32 });
        match self.draw.random_range(0..20) {
            0 if from < received && size > 0 => {
                chunk[0] ^= 0x10;
                refusal = Some(StoreError::Conflict { offset: from as u32 });
            }
            1 => {
                chunk = [&sent.bytes[from..], &[0]].concat();
                refusal = refusal.or(Some(StoreError::PastEnd { length: length as u32 }));
            }
            _ => {}
        }
        let header = length.min(HEADER_LENGTH);
        let begins = !sent.is_begun && refusal.is_none() && received.max(from + size) >= header;
        if begins && self.draw.random_bool(0.3) {
            // Nothing has changed if the header is refused.
            let spent = self.store.flash().mapped().to_vec();
            let is_early = self.draw.random_bool(0.5);
            let too_often = StoreError::TooOften { retry_after_seconds: 1 };
            let outcome = self.store.write(from as u32, &chunk, |_| {
                Err(if is_early { too_often.into() } else { CheckedError::Refused("no") })
            });
            assert!(self.store.flash().mapped() == spent);
            self.tally.refused += 1;
            if is_early {
                assert_eq!(outcome, Err(CheckedError::Store(too_often)));
                sent.received = received.max(header);
            } else {
                assert_eq!(outcome, Err(CheckedError::Refused("no")));
                self.sent = None;
            }
            return;
        }
        let outcome = plain(self.store.write(from as u32, &chunk, any_header).map(|now| {
            sent.received = received.max(from + size);
            assert_eq!(now as usize, sent.received);
        }));
        if begins {
            sent.is_begun = true;
            // Recorded, even if the erasure after that has failed.
            let emptied = self.ledger.now.after(Change::Begin);
            let is_recorded = emptied != self.ledger.now && Model::of(&self.store) == emptied;
            self.ledger.book(Change::Begin, if is_recorded { Ok(()) } else { outcome });
        }
        match (outcome, refusal) {
            (Ok(()), None) => {}
            (Err(error), None) if is_flash_error(error) => {
                // It may have been recorded before that.
                self.sent = None;
            }
            (outcome, refusal) => {
                assert_eq!(outcome.err(), refusal);
                self.tally.refused += 1;
            }
        }
    }

    fn stage(&mut self) {
        let complete = self
            .sent
            .as_ref()
            .is_some_and(|sent| sent.received == sent.bytes.len() && sent.is_begun);
        if complete && self.draw.random_bool(0.1) {
            match self.store.stage(|_| Err::<(), _>("not today")) {
                Err(CheckedError::Refused("not today")) => self.tally.refused += 1,
                Err(CheckedError::Store(error)) if is_flash_error(error) => {}
                other => panic!("{other:?}"),
            }
        } else {
            let refusal = match &self.sent {
                None => Some(StoreError::NoUpload),
                Some(sent) if !complete => Some(StoreError::Incomplete {
                    received: sent.received as u32,
                    length: sent.bytes.len() as u32,
                }),
                Some(_) => None,
            };
            let number = self.sent.as_ref().map_or(0, |sent| sent.number);
            let outcome = plain(self.store.stage(check));
            self.tally.staged += u64::from(outcome.is_ok());
            self.expect(Change::Stage(number), refusal, outcome);
        }
        // Staged, or dropped because its last word could not be written.
        if self.store.received().is_none() {
            self.sent = None;
        }
    }

    fn activate(&mut self) {
        let refusal = self.ledger.now.staged.is_none().then_some(StoreError::NothingStaged);
        if refusal.is_none() && self.draw.random_bool(0.1) {
            let outcome = self.store.activate(|_| Err("not today"), serials);
            assert_eq!(outcome, Err(CheckedError::Refused("not today")));
            self.tally.refused += 1;
        } else {
            let outcome = plain(self.store.activate(check, serials));
            if outcome.is_ok() {
                self.sent = None;
            }
            self.expect(Change::Activate, refusal, outcome);
        }
    }
}

/// How reading fails in a history.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Reading {
    Fine,
    /// Some reads fail, but the next boot may succeed.
    Transient,
    /// Journal entries without a record are unreadable until they are erased.
    Spoiled,
}

/// Boots while some reads fail: the result may differ, but nothing that the next boot finds
/// changes, unless the store accepts a new package in between, or what it could read ended with an
/// interrupted record. Returns whether the history can go on.
fn boot_in_doubt<const WRITE: usize, const ERASE: usize>(
    flash: &mut SimulatedFlash<WRITE, ERASE>,
    ledger: &mut Ledger,
    number: &mut u16,
    draw: &mut ChaCha8Rng,
    tally: &mut Tally,
) -> bool {
    let units = layout(ERASE, UNITS).commit_length as usize / 32;
    flash.power_on(None);
    flash.arm(usize::MAX, 1, Fault::Nothing);
    flash.arm_reads(draw.random_range(0..2 * units), draw.random_range(1..=2 * units));
    let before = flash.mapped().to_vec();
    let mut store = Store::open(&mut *flash, layout(ERASE, UNITS)).unwrap();
    store.flash().arm_reads(0, 0);
    let loaded = store.load(check).in_use.map(|(_, number)| number);
    assert_eq!(loaded, store.in_use().map(|slot| check(store.bytes(slot).unwrap()).unwrap()));
    if store.damage().unreadable_places == 0 {
        // The second attempt succeeded.
        ledger.reboot(Model::of(&store));
        return true;
    }
    tally.unread += 1;
    let opening = *store.opening();
    let is_written = store.flash().mapped() != before;
    assert!(!is_written || opening.settled.is_some() || opening.trial_ended.is_some());
    if is_written {
        let is_intact = |slot| store.bytes(slot).is_none_or(|bytes| check(bytes).is_ok());
        if !is_intact(Slot::A) || !is_intact(Slot::B) {
            // It has recorded an older state, which names a package that was replaced.
            tally.settled_wrongly += 1;
            return false;
        }
        let found = Model::of(&store);
        let known = ledger.now.rebooted();
        tally.settled_wrongly += u64::from(found != known);
        ledger.overruled(found);
    }
    if draw.random_bool(0.5) {
        return true;
    }
    *number += 1;
    let bytes = package(*number, 20);
    store.begin(20).unwrap();
    let before = store.flash().mapped().to_vec();
    match plain(store.write(0, &bytes, any_header)) {
        Err(StoreError::Unreadable { .. }) => {
            tally.blocked += 1;
            assert!(store.flash().mapped() == before, "something was written after a refusal");
        }
        Ok(()) => {
            tally.overruled += 1;
            store.stage(check).unwrap();
            store.activate(check, serials).unwrap();
            store.confirm().unwrap();
            let mut found = Model::of(&store);
            assert_eq!((found.in_use, found.reserve), (Some(*number), loaded));
            found.reserve = loaded;
            ledger.overruled(found);
        }
        // A word that looks erased but is not, twice in a row.
        Err(error) => panic!("{error}"),
    }
    true
}

/// Makes a place of the journal without a record unreadable.
fn spoil_a_place<const WRITE: usize, const ERASE: usize>(
    flash: &mut SimulatedFlash<WRITE, ERASE>,
    draw: &mut ChaCha8Rng,
) {
    let layout = layout(ERASE, UNITS);
    let places = layout.commit_length as usize / RECORD_LENGTH;
    let offset = layout.commit as usize + RECORD_LENGTH * draw.random_range(0..places);
    let place = &flash.mapped()[offset..offset + RECORD_LENGTH];
    let (body, checksum) = place.split_last_chunk::<4>().unwrap();
    if crc32(&[body]).to_le_bytes() != *checksum {
        flash.spoil(offset, RECORD_LENGTH);
    }
}

fn live<const WRITE: usize, const ERASE: usize>(seed: u64) -> Tally {
    let mut draw = ChaCha8Rng::seed_from_u64(seed);
    let tear = Tear::ALL[draw.random_range(0..5)];
    let has_correction = draw.random_bool(0.5);
    let mut flash: SimulatedFlash<WRITE, ERASE> =
        erased_flash(UNITS, tear, seed).with_correction(has_correction);
    let (mut ledger, mut number, mut tally) = (Ledger::default(), 0, Tally::default());
    // Half of all histories are free of faults, so that faults do not hide other errors.
    let faulty = draw.random_bool(0.5);
    // Only a silently failing erasure can go unnoticed by the store.
    let mut silent = false;
    let reading = match draw.random_range(0..4) {
        0 => Reading::Transient,
        1 => Reading::Spoiled,
        _ => Reading::Fine,
    };
    let mut calls = 0;
    while calls < CALLS {
        match reading {
            Reading::Transient if draw.random_bool(0.5) => {
                let goes_on =
                    boot_in_doubt(&mut flash, &mut ledger, &mut number, &mut draw, &mut tally);
                if !goes_on {
                    return tally;
                }
            }
            Reading::Spoiled if draw.random_bool(0.1) => spoil_a_place(&mut flash, &mut draw),
            _ => {}
        }
        flash.arm_reads(0, 0);
        let energy = draw.random_bool(0.1).then(|| draw.random_range(0..ERASE + 32));
        flash.power_on(energy);
        let mut store = Store::open(&mut flash, layout(ERASE, UNITS)).unwrap();
        store.load(check);
        tally.boots += 1;
        if !store.flash().power_lost {
            ledger.reboot(Model::of(&store));
            if reading == Reading::Spoiled && draw.random_bool(0.5) {
                store.forget_unreadable();
            }
            let mut session = Session {
                store,
                ledger: &mut ledger,
                number: &mut number,
                draw: &mut draw,
                tally: &mut tally,
                sent: None,
                slot_length: ERASE * UNITS,
            };
            while calls < CALLS && !session.draw.random_bool(0.03) {
                calls += 1;
                if session.draw.random_bool(0.04) {
                    session.store.flash().drain(session.draw.random_range(0..2 * ERASE));
                } else if faulty && session.draw.random_bool(0.1) {
                    let faults = [Fault::Nothing, Fault::Everything, Fault::Torn, Fault::Silent];
                    let fault = faults[session.draw.random_range(0..4)];
                    silent |= fault == Fault::Silent;
                    let others = session.draw.random_range(0..4);
                    session.store.flash().arm(others, session.draw.random_range(1..=3), fault);
                    session.tally.faults += 1;
                }
                if reading == Reading::Transient && session.draw.random_bool(0.05) {
                    let others = session.draw.random_range(0..4);
                    session.store.flash().arm_reads(others, session.draw.random_range(1..=3));
                }
                session.call();
                if session.store.flash().power_lost {
                    break;
                }
                assert_eq!(Model::of(&session.store), session.ledger.now);
                let received = session.sent.as_ref().map(|sent| sent.received as u32);
                assert_eq!(session.store.received(), received);
            }
        }
        tally.cuts += u64::from(flash.power_lost);
    }
    assert_eq!(flash.misuses, 0);
    let may_mislead = silent || matches!(tear, Tear::Unseen | Tear::Marginal);
    assert!(may_mislead || flash.rewrites == 0, "a word was written twice");
    tally
}

#[test]
fn successful_changes_survive_all_faults() {
    let histories =
        std::env::var("STORE_HISTORIES").map_or(HISTORIES, |text| text.parse().unwrap());
    let total = (0..histories)
        .into_par_iter()
        .map(|seed| {
            let life = || match seed % 5 {
                0 => live::<1, 32>(seed),
                1 => live::<4, 32>(seed),
                2 => live::<4, 64>(seed),
                3 => live::<8, 128>(seed),
                _ => live::<32, 192>(seed),
            };
            std::panic::catch_unwind(life)
                .unwrap_or_else(|_| panic!("in the history of seed {seed}"))
        })
        .reduce(Tally::default, |mut sum, tally| {
            sum += tally;
            sum
        });
    println!("{histories} histories, seeds 0 to {}: {total:?}", histories.saturating_sub(1));
    let enough = histories / 4;
    assert!(total.unread >= enough / 4 && total.blocked > 0 && total.overruled >= enough / 16);
    assert!(total.cuts >= enough && total.confirmed >= enough && total.reverted >= enough);
}
