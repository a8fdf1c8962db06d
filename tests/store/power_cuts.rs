//! Cuts the power at every word that the weight store writes or erases, and again in its actions
//! after the reboot: there is always a working package, always the right one, every boot finds the
//! same, and the next package can always be installed.
//!
//! By default every word is the position of a first cut, in one out of [`SHARE`] starting states for each
//! kind of flash, and about every [`STRIDE`]-th byte, with a different offset for each first cut,
//! that of a second. `STORE_CUTS=many` takes all starting states and more journals of
//! format 1, `STORE_CUTS=all` all pairs of cuts, also inside words.

use std::sync::atomic::{AtomicU64, Ordering};

use agent_core::store::{NOTE_LENGTH_MAX, Serial, Store};
use embedded_storage::nor_flash::NorFlash;
use rayon::prelude::*;

use test_support::nor_flash::{SimulatedFlash, Tear};
use test_support::store_model::{
    Change, Ledger, Model, REVERTED, check, erased_flash, format_1_record, layout, package, plain,
    serial, serials,
};

/// Distance between the second cuts for one first cut. \[byte\]
const STRIDE: usize = 1900;
/// One of so many starting states is tested with each kind of flash.
const SHARE: usize = 7;
/// Lengths of packages, in turn; none is a multiple of a word, and not all have more than a header.
const LENGTHS: [usize; 3] = [50, 231, 198];
/// Length of the chunks of an upload. \[byte\]
const CHUNK: usize = 61;
/// The kind of a note that is a key.
const KEY: u8 = 7;
/// Boots after a cut, all of which must find the same.
const BOOTS: usize = 3;

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
    /// Replace the key.
    Rotate,
}

/// A node: its flash, and what is expected of it.
#[derive(Clone, Debug)]
struct Node<const WRITE: usize, const ERASE: usize> {
    flash: SimulatedFlash<WRITE, ERASE>,
    books: Books,
}

/// What is expected of a node.
#[derive(Clone, Debug, Default)]
struct Books {
    ledger: Ledger,
    /// The last package's number.
    number: u16,
    /// The count of the last boot that was recorded.
    boots: u32,
    /// The key, or all that it may be after a failed call.
    keys: Vec<u8>,
}

impl<const WRITE: usize, const ERASE: usize> Node<WRITE, ERASE> {
    /// Every package fits into this many units.
    const UNITS: usize = 256_usize.div_ceil(ERASE);
    const COMMIT: usize = 2 * Self::UNITS * ERASE;

    fn new(tear: Tear, has_correction: bool) -> Self {
        let flash = erased_flash(Self::UNITS, tear, 7).with_correction(has_correction);
        Self { flash, books: Books { keys: vec![0], ..Books::default() } }
    }

    /// Returns a node whose journal was written by firmware that knew only format 1: it has the
    /// packages 1 and 2, and `records` were written before the last one.
    fn of_format_1(
        tear: Tear,
        has_correction: bool,
        records: usize,
        phase: u8,
        is_torn: bool,
    ) -> Self {
        let mut node = Self::new(tear, has_correction);
        let packages = [package(1, 90), package(2, 90)];
        node.flash.overwrite(0, &packages[0]);
        node.flash.overwrite(Self::UNITS * ERASE, &packages[1]);
        let half = layout(ERASE, Self::UNITS).commit_length as usize / 2;
        let places = half / 32;
        for index in 0..=records + usize::from(is_torn) {
            let offset = Self::COMMIT + index % (2 * places) * 32;
            if index % places == 0 {
                // A half is erased before it is used again.
                node.flash.erase(offset as u32, (offset + half) as u32).unwrap();
            }
            let phase = if index == records { phase } else { 0 };
            let record = match index {
                torn if torn > records => [0x5a; 32],
                _ => format_1_record(5 + index as u32, 0, phase, [&packages[0], &packages[1]]),
            };
            node.flash.overwrite(offset, &record);
        }
        node.books.ledger.now = match phase {
            0 => Model { in_use: Some(1), reserve: Some(2), ..Model::default() },
            1 => Model { in_use: Some(1), staged: Some(2), ..Model::default() },
            _ => Model { in_use: Some(1), way_back: Some(Some(2)), ..Model::default() },
        };
        node.books.number = 2;
        node
    }

    /// Boots; returns the store unless the power fails.
    fn boot<'f>(
        flash: &'f mut SimulatedFlash<WRITE, ERASE>,
        books: &mut Books,
    ) -> Option<Store<&'f mut SimulatedFlash<WRITE, ERASE>>> {
        let mut store = Store::open(flash, layout(ERASE, Self::UNITS)).unwrap();
        store.load(check);
        if store.flash().power_lost {
            // Opening changes nothing that a reboot would not change in the same way.
            return None;
        }
        assert!(!store.is_blocked(), "the node no longer takes updates");
        let mut found = Model::of(&store);
        if let Some(revert) = &mut found.last_revert
            && revert.serial == Serial::default()
        {
            // Format 1 did not say what was on trial.
            revert.serial = serial(&1);
        }
        books.ledger.reboot(found);
        let boots = store.count_boot(None);
        if store.flash().power_lost {
            return None;
        }
        assert!(boots > books.boots, "boot {boots} after {}", books.boots);
        if store.note(1).is_some_and(|note| note.as_bytes() == boots.to_le_bytes()) {
            books.boots = boots;
        }
        let key = store.note(KEY).map_or(0, |note| {
            assert_eq!(note.as_bytes(), [note.as_bytes()[0]; NOTE_LENGTH_MAX]);
            note.as_bytes()[0]
        });
        assert!(books.keys.contains(&key), "the key is {key}, not one of {:?}", books.keys);
        books.keys = vec![key];
        Some(store)
    }

    /// Boots and performs `deeds`, until all are done or the power fails.
    fn run(&mut self, deeds: &[Deed]) {
        let Self { flash, books } = self;
        let Some(mut store) = Self::boot(flash, books) else { return };
        // With the serial that format 1 did not tell.
        let last_revert = books.ledger.now.last_revert;
        for &deed in deeds {
            if !Self::act(&mut store, books, deed) {
                assert!(store.flash().power_lost, "{deed:?} failed without a power cut");
                return;
            }
            let found = Model::of(&store);
            let known = if found.last_revert.is_some_and(|r| r.serial == Serial::default()) {
                Model { last_revert, ..found }
            } else {
                found
            };
            assert_eq!(known, books.ledger.now);
        }
    }

    /// Returns whether all of `deed` was done.
    fn act(
        store: &mut Store<&mut SimulatedFlash<WRITE, ERASE>>,
        books: &mut Books,
        deed: Deed,
    ) -> bool {
        let Books { ledger, number, keys, .. } = books;
        if deed == Deed::Rotate {
            *number += 1;
            let key = *number as u8;
            keys.push(key);
            let outcome = store.record_note(KEY, &[key; NOTE_LENGTH_MAX]);
            if outcome.is_ok() {
                *keys = vec![key];
            }
            return outcome.is_ok();
        }
        let mut book = |change, outcome: Result<(), _>| {
            ledger.book(change, outcome);
            outcome.is_ok()
        };
        if deed != Deed::Finish {
            *number += 1;
            let bytes = package(*number, LENGTHS[usize::from(*number) % LENGTHS.len()]);
            store.begin(bytes.len() as u32).unwrap();
            let sent = if deed == Deed::Half { &bytes[..bytes.len() / 2] } else { &bytes };
            let mut is_begun = false;
            for (index, chunk) in sent.chunks(CHUNK).enumerate() {
                let mut accepts = |_: &[u8]| {
                    is_begun = true;
                    Ok(())
                };
                let before = store.received();
                let outcome = plain(store.write((index * CHUNK) as u32, chunk, &mut accepts));
                if is_begun && before.is_some_and(|before| (before as usize) < bytes.len().min(196))
                {
                    // Recorded, erased, or neither, if it has failed.
                    if !book(Change::Begin, outcome) {
                        return false;
                    }
                } else if outcome.is_err() {
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
        if !book(Change::Activate, plain(store.activate(check, serials))) || deed == Deed::Try {
            return deed == Deed::Try && store.is_on_trial();
        }
        match deed {
            Deed::Reject => {
                let outcome = store.revert(REVERTED);
                book(Change::Revert, outcome.map(|_| ()))
            }
            _ => book(Change::Confirm, store.confirm()),
        }
    }

    /// Boots some more times, which must all find the same, and then installs a package.
    fn boot_and_install(&mut self) {
        for _ in 0..BOOTS {
            self.flash.power_on(None);
            self.run(&[]);
        }
        self.flash.power_on(None);
        self.run(&[Deed::Install]);
        assert!(!self.flash.power_lost);
        assert_eq!(self.books.ledger.now.in_use, Some(self.books.number));
        assert_eq!(self.flash.misuses, 0);
    }
}

/// Cuts the power in `deeds`, and then in the following boots and installation. Returns how many
/// runs were cut once and twice.
fn cut<const WRITE: usize, const ERASE: usize>(
    prepared: &Node<WRITE, ERASE>,
    deeds: &[Deed],
    tear: Tear,
    (step, stride): (usize, usize),
) -> [u64; 2] {
    let mut counts = [0; 2];
    for first in (0..).step_by(step) {
        let mut node = prepared.clone();
        node.flash.power_on(Some(first));
        node.run(deeds);
        if !node.flash.power_lost {
            break;
        }
        counts[0] += 1;
        let mut once = node.clone();
        once.boot_and_install();
        let offset = (first / step) % stride;
        for second in (offset..).step_by(stride).map(|second| second * step) {
            let mut node = node.clone();
            node.flash.power_on(Some(second));
            node.run(&[Deed::Install]);
            let is_cut = node.flash.power_lost;
            counts[1] += u64::from(is_cut);
            node.boot_and_install();
            // Only a word that looks erased but is not can mislead the store, or one whose bits
            // are half-way.
            assert!(matches!(tear, Tear::Unseen | Tear::Marginal) || node.flash.rewrites == 0);
            if !is_cut {
                break;
            }
        }
    }
    counts
}

/// How much is tested.
#[derive(Clone, Copy, Debug)]
struct Extent {
    /// Distance of first cuts, and of second ones in first ones. \[byte\]
    steps: (usize, usize),
    /// One of so many starting states, and the number of the kind of flash, which says which one.
    share: (usize, usize),
}

impl Extent {
    fn of(word: usize, kind: usize) -> Self {
        let word = word.max(4);
        match std::env::var("STORE_CUTS").as_deref() {
            Ok("all") => Self { steps: (1, 1), share: (1, 0) },
            Ok("many") => Self { steps: (word, STRIDE / word + 1), share: (1, kind) },
            _ => Self { steps: (word, STRIDE / word + 1), share: (SHARE, kind) },
        }
    }

    /// Whether a journal of format 1 is converted.
    fn converts(&self, index: usize, word: usize) -> bool {
        let (share, kind) = self.share;
        match self.steps {
            (1, 1) => true,
            _ if share == 1 => index % SHARE == kind % SHARE,
            // Other ones for each kind of flash and each length of a word.
            _ => index % 97 == SHARE * kind + word,
        }
    }

    fn takes(&self, index: usize) -> bool {
        index % self.share.0 == self.share.1 % self.share.0
    }
}

/// Cuts every action from every state. Returns how many runs were cut once and twice.
fn cut_everywhere<const WRITE: usize, const ERASE: usize>(
    tear: Tear,
    has_correction: bool,
    extent: Extent,
) -> [u64; 2] {
    use Deed::{Finish, Half, Install, Reject, Rotate, Stage, Try};
    // Enough installations that every pair of the journal is the next one at some start.
    let starts: [&[Deed]; 14] = [
        &[],
        &[Half],
        &[Reject],
        &[Stage],
        &[Install],
        &[Install, Rotate],
        &[Install, Install],
        &[Rotate, Install, Install, Install],
        &[Install, Reject],
        &[Install, Install, Reject],
        &[Install, Stage],
        &[Install, Half],
        &[Install, Try],
        &[Rotate, Rotate, Install],
    ];
    let counts = [const { AtomicU64::new(0) }; 2];
    let starts = starts.iter().enumerate().filter(|(index, _)| extent.takes(*index));
    starts.par_bridge().for_each(|(_, start)| {
        let mut prepared = Node::<WRITE, ERASE>::new(tear, has_correction);
        prepared.run(start);
        let deeds: &[Deed] = match start.last() {
            Some(Stage) => &[Finish, Install, Rotate, Reject],
            _ => &[Install, Rotate, Reject],
        };
        let found = cut(&prepared, deeds, tear, extent.steps);
        for (count, found) in counts.iter().zip(found) {
            count.fetch_add(found, Ordering::Relaxed);
        }
    });
    counts.map(AtomicU64::into_inner)
}

/// The same for journals of format 1, at every place of the last record.
fn convert_everywhere<const WRITE: usize, const ERASE: usize>(
    tear: Tear,
    has_correction: bool,
    extent: Extent,
) -> [u64; 2] {
    let places = layout(ERASE, 1).commit_length as usize / 32;
    let cases: Vec<_> = (0..places)
        .flat_map(|records| [0, 1, 2].map(|phase| (records, phase)))
        .flat_map(|(records, phase)| [false, true].map(|is_torn| (records, phase, is_torn)))
        .enumerate()
        .filter(|(index, _)| extent.converts(*index, WRITE))
        .collect();
    cases
        .par_iter()
        .map(|&(_, (records, phase, is_torn))| {
            let prepared =
                Node::<WRITE, ERASE>::of_format_1(tear, has_correction, records, phase, is_torn);
            cut(&prepared, &[Deed::Install], tear, extent.steps)
        })
        .reduce(|| [0; 2], |a, b| [a[0] + b[0], a[1] + b[1]])
}

/// Cuts and converts on flash of these units, with every kind of damage. Returns how many runs were
/// cut.
pub(crate) fn cut_every_way<const WRITE: usize, const ERASE: usize>() -> u64 {
    let mut total = 0;
    let kinds = Tear::ALL.into_iter().flat_map(|tear| [(tear, false), (tear, true)]);
    for (kind, (tear, has_correction)) in kinds.enumerate() {
        let extent = Extent::of(WRITE, kind);
        let [once, twice] = cut_everywhere::<WRITE, ERASE>(tear, has_correction, extent);
        let [converted, again] = convert_everywhere::<WRITE, ERASE>(tear, has_correction, extent);
        println!(
            "words of {WRITE}, erase units of {ERASE} bytes, {tear:?}, error correction \
                 {has_correction}: {once} runs cut once, {twice} twice, of format 1 {converted} and \
                 {again}: 0 bricks, 0 flaps, 0 that take no update"
        );
        let counts = [once, twice, converted, again];
        assert!(counts.iter().all(|&count| count > 40));
        total += counts.iter().sum::<u64>();
    }
    total
}

/// A note, other than the state, exists only in the journal: when the journal changes halves, its
/// earlier value must survive in a whole copy until the later one does.
#[test]
fn notes_survive_marginal_words() {
    let cut = |counts: [u64; 2]| assert!(counts.iter().all(|&count| count > 1_000), "{counts:?}");
    for (tear, has_correction) in [(Tear::Marginal, false), (Tear::Unreadable, true)] {
        let extent = |word| Extent { steps: (word, STRIDE / word + 1), share: (1, 0) };
        cut(cut_everywhere::<16, 256>(tear, has_correction, extent(16)));
        cut(cut_everywhere::<32, 128>(tear, has_correction, extent(32)));
    }
}

#[test]
fn words_of_one_byte() {
    cut_every_way::<1, 256>();
}

#[test]
fn words_of_two_bytes() {
    cut_every_way::<2, 128>();
}

#[test]
fn words_of_four_bytes() {
    cut_every_way::<4, 64>();
}

#[test]
fn words_of_eight_bytes() {
    cut_every_way::<8, 512>();
}

#[test]
fn words_of_sixteen_bytes() {
    cut_every_way::<16, 256>();
}

#[test]
fn words_of_thirty_two_bytes() {
    cut_every_way::<32, 128>();
}
