//! Cuts the power at every byte that the weight store writes or erases, and again at every byte of
//! its actions after the reboot: there is always a working package, and always the right one.
//!
//! By default every byte is the position of a first cut, and every [`STRIDE`]-th byte, with a
//! different offset for each first cut, that of a second; `STORE_CUTS=all` tests all pairs.

use std::sync::atomic::{AtomicU64, Ordering};

use agent_core::store::Store;
use rayon::prelude::*;

use test_support::nor_flash::{SimulatedFlash, Tear};
use test_support::store_model::{
    Change, Ledger, Model, check, erased_flash, layout, package, plain,
};

/// Distance between the second cuts for one first cut.
const STRIDE: usize = 37;
/// Lengths of packages, in turn; none is a multiple of a word.
const LENGTHS: [usize; 3] = [50, 41, 58];
/// Length of the chunks of an upload. \[byte\]
const CHUNK: usize = 23;

/// An action with a package other than the first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Deed {
    /// Upload, stage, activate, confirm.
    Install,
    /// Upload, stage, activate, and revert.
    Reject,
    /// Upload and stage.
    Stage,
    /// Upload, stage, activate, and leave it on trial.
    Try,
    /// Upload half of it.
    Half,
    /// Activate the staged package, and confirm.
    Finish,
}

/// A node: its flash, its expected state, and the next package's number.
#[derive(Clone, Debug)]
struct Node<const WRITE: usize, const ERASE: usize> {
    flash: SimulatedFlash<WRITE, ERASE>,
    ledger: Ledger,
    number: u16,
}

impl<const WRITE: usize, const ERASE: usize> Node<WRITE, ERASE> {
    /// Every package fits into this many units.
    const UNITS: usize = 64_usize.div_ceil(ERASE);

    fn new(tear: Tear) -> Self {
        let flash = erased_flash(Self::UNITS, tear, 7);
        Self { flash, ledger: Ledger::default(), number: 0 }
    }

    /// Boots and performs `deeds`, until all are done or the power fails.
    fn run(&mut self, deeds: &[Deed]) {
        let Self { flash, ledger, number } = self;
        let mut store = Store::open(flash, layout(ERASE, Self::UNITS)).unwrap();
        store.load(check);
        if store.flash().power_lost {
            // Opening changes nothing that a reboot would not change in the same way.
            return;
        }
        assert!(matches!(store.opening().trial_ended, None | Some(Ok(()))));
        ledger.reboot(Model::of(&store));
        for &deed in deeds {
            if !Self::act(&mut store, ledger, number, deed) {
                assert!(store.flash().power_lost);
                return;
            }
            assert_eq!(Model::of(&store), ledger.now);
        }
    }

    /// Returns whether all of `deed` was done.
    fn act(
        store: &mut Store<&mut SimulatedFlash<WRITE, ERASE>>,
        ledger: &mut Ledger,
        number: &mut u16,
        deed: Deed,
    ) -> bool {
        let mut book = |change, outcome: Result<(), _>| {
            ledger.book(change, outcome);
            outcome.is_ok()
        };
        if deed != Deed::Finish {
            *number += 1;
            let bytes = package(*number, LENGTHS[usize::from(*number) % LENGTHS.len()]);
            if !book(Change::Begin, store.begin(bytes.len() as u32)) {
                return false;
            }
            let sent = if deed == Deed::Half { &bytes[..bytes.len() / 2] } else { &bytes };
            for (index, chunk) in sent.chunks(CHUNK).enumerate() {
                if store.write((index * CHUNK) as u32, chunk).is_err() {
                    return false;
                }
            }
            if deed == Deed::Half {
                return true;
            }
            if !book(Change::Stage(*number), plain(store.stage(check))) || deed == Deed::Stage {
                return deed == Deed::Stage && store.staged().is_some();
            }
        }
        if !book(Change::Activate, plain(store.activate(check))) || deed == Deed::Try {
            return deed == Deed::Try && store.is_on_trial();
        }
        match deed {
            Deed::Reject => book(Change::Revert, store.revert().map(|_| ())),
            _ => book(Change::Confirm, store.confirm()),
        }
    }
}

/// Cuts every action from every state, and then the following installation. Returns how many runs
/// were cut once and twice.
fn cut_everywhere<const WRITE: usize, const ERASE: usize>(tear: Tear, stride: usize) -> [u64; 2] {
    use Deed::{Finish, Half, Install, Reject, Stage, Try};
    // Enough installations that every journal entry is the next one at some start.
    let starts: [&[Deed]; 12] = [
        &[],
        &[Half],
        &[Reject],
        &[Stage],
        &[Install],
        &[Install, Install],
        &[Install, Install, Install],
        &[Install, Reject],
        &[Install, Install, Reject],
        &[Install, Stage],
        &[Install, Half],
        &[Install, Try],
    ];
    let counts = [const { AtomicU64::new(0) }; 2];
    starts.par_iter().for_each(|start| {
        let mut prepared = Node::<WRITE, ERASE>::new(tear);
        prepared.run(start);
        let deeds: &[Deed] = match start.last() {
            Some(Stage) => &[Finish, Install, Reject],
            _ => &[Install, Reject],
        };
        for first in 0.. {
            let mut node = prepared.clone();
            node.flash.power_on(Some(first));
            node.run(deeds);
            if !node.flash.power_lost {
                break;
            }
            counts[0].fetch_add(1, Ordering::Relaxed);
            for second in (first % stride..).step_by(stride) {
                let mut node = node.clone();
                node.flash.power_on(Some(second));
                node.run(&[Install]);
                let cut = node.flash.power_lost;
                counts[1].fetch_add(u64::from(cut), Ordering::Relaxed);
                node.flash.power_on(None);
                node.run(&[Install]);
                assert_eq!(node.ledger.now.in_use, Some(node.number), "cuts {first}, {second}");
                assert_eq!(node.flash.misuses, 0);
                // Only a word that looks erased but is not can mislead the store.
                assert!(tear == Tear::Unseen || node.flash.rewrites == 0);
                if !cut {
                    break;
                }
            }
        }
    });
    counts.map(AtomicU64::into_inner)
}

fn cut_every_way<const WRITE: usize, const ERASE: usize>() {
    let stride =
        if std::env::var("STORE_CUTS").is_ok_and(|cuts| cuts == "all") { 1 } else { STRIDE };
    for tear in Tear::ALL {
        let [once, twice] = cut_everywhere::<WRITE, ERASE>(tear, stride);
        println!(
            "words of {WRITE}, erase units of {ERASE} bytes, {tear:?}: {once} runs cut once, {twice} twice"
        );
        assert!(once > 1000 && twice > 5 * once);
    }
}

#[test]
fn words_of_one_byte() {
    cut_every_way::<1, 32>();
    cut_every_way::<1, 128>();
}

#[test]
fn words_of_four_bytes() {
    cut_every_way::<4, 32>();
    cut_every_way::<4, 128>();
}

#[test]
fn words_of_eight_bytes() {
    cut_every_way::<8, 32>();
    cut_every_way::<8, 128>();
}

#[test]
fn words_of_thirty_two_bytes() {
    cut_every_way::<32, 64>();
}
