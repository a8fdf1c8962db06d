//! Fuzzes the weight store on flash with arbitrary contents.
//!
//! The input is an image of the flash, assembled from arbitrary bytes, packages and records, and a
//! sequence of calls, failures of flash and power, and reboots. In every case:
//! - no call panics, and none violates the rules of the flash;
//! - a package in use after a load is complete and was accepted by the check;
//! - the effect of a call that returned `Ok` survives a reboot, unless the flash is tampered with;
//! - in the end, on working flash, a valid package can be installed.
#![no_main]

use agent_core::store::{
    CheckedError, Layout, MappedFlash, RECORD_LENGTH, Revert, Slot, Store, StoreError,
};
use agent_core::wire::crc::crc32;
use libfuzzer_sys::arbitrary::{self, Arbitrary};
use libfuzzer_sys::fuzz_target;
use test_support::nor_flash::{Fault, SimulatedFlash, Tear};
use test_support::store_model::{
    any_header, check, erased_flash, format_1_record, layout, length, package, serials,
};

/// Packages with this number or a higher one are intact but refused by every check.
const UNWANTED: u16 = 200;
/// The package installed at the end.
const LAST: u16 = 0;
/// So far away that no fault occurs.
const NEVER: usize = usize::MAX;

#[derive(Arbitrary, Debug)]
struct Input {
    units: Units,
    tear: Damage,
    has_correction: bool,
    image: Vec<Piece>,
    /// The lowest sequence number of a record.
    sequence: u32,
    calls: Vec<Call>,
}

/// The kind of flash.
#[derive(Arbitrary, Debug)]
enum Units {
    Bytes,
    Words,
    DoubleWords,
    Records,
}

#[derive(Arbitrary, Debug)]
enum Damage {
    Prefix,
    Garbage,
    Unseen,
    Unreadable,
    Marginal,
}

#[derive(Arbitrary, Debug)]
enum Piece {
    Bytes { offset: u16, bytes: Vec<u8> },
    Package { slot: bool, number: u8, length: u8 },
    Record { place: u8, shape: Shape, number: u16, in_use: u8, phase: u8, packages: [Recorded; 2] },
}

/// How a record is written.
#[derive(Arbitrary, Debug)]
enum Shape {
    Format1,
    Once { void: u8 },
    Twice { void: u8 },
    Note { void: u8, kind: u8 },
}

/// A record's entry for a slot.
#[derive(Arbitrary, Debug)]
enum Recorded {
    Nothing,
    /// The package stored there, or indicated by its first bytes.
    Package,
    /// This many bytes, with the correct checksum.
    Bytes(u8),
    Anything {
        length: u32,
        checksum: u32,
    },
}

#[derive(Arbitrary, Debug)]
enum Call {
    Load,
    Salvage,
    Begin {
        length: u8,
    },
    Write {
        number: u8,
        length: u8,
        from: u8,
        to: u8,
    },
    Stage,
    Activate,
    Confirm,
    Revert,
    /// Records a note.
    Note {
        kind: u8,
        byte: u8,
    },
    CountBoot,
    /// All calls up to the staged package.
    Upload {
        number: u8,
        length: u8,
        chunk: u8,
    },
    /// Power can fail once more, and cells can lose their contents.
    Reboot {
        energy: Option<u8>,
        forgotten: Option<(u16, u8)>,
    },
    PowerFails {
        energy: u8,
    },
    Fails {
        others: u8,
        how: Failure,
    },
}

#[derive(Arbitrary, Debug)]
enum Failure {
    Nothing,
    Everything,
    Torn,
    Silent,
}

fuzz_target!(|input: Input| {
    match input.units {
        Units::Bytes => run::<1, 32>(&input, 4),
        Units::Words => run::<4, 128>(&input, 1),
        Units::DoubleWords => run::<8, 64>(&input, 3),
        Units::Records => run::<32, 64>(&input, 2),
    }
});

fn run<const WRITE: usize, const ERASE: usize>(input: &Input, units: usize) {
    let tear = match input.tear {
        Damage::Prefix => Tear::Prefix,
        Damage::Garbage => Tear::Garbage,
        Damage::Unseen => Tear::Unseen,
        Damage::Unreadable => Tear::Unreadable,
        Damage::Marginal => Tear::Marginal,
    };
    let flash = erased_flash::<WRITE, ERASE>(units, tear, u64::from(input.sequence));
    let mut flash = flash.with_correction(input.has_correction);
    let layout = layout(ERASE, units);
    for piece in &input.image {
        piece.put(&mut flash, &layout, input.sequence);
    }
    let mut run = Run {
        store: Store::open(flash, layout).expect("the layout is valid"),
        layout,
        is_sound: true,
        in_use: None,
        way_back: None,
        after_reboot: None,
    };
    for call in &input.calls {
        run = run.after(call);
    }
    run.install_another();
}

impl Piece {
    /// Writes it directly to flash, as far as there is space.
    fn put<const WRITE: usize, const ERASE: usize>(
        &self,
        flash: &mut SimulatedFlash<WRITE, ERASE>,
        layout: &Layout,
        lowest_sequence: u32,
    ) {
        match self {
            Self::Bytes { offset, bytes } => put(flash, usize::from(*offset), bytes),
            Self::Package { slot, number, length } => {
                let bytes = package((*number).into(), length_in(layout, *length));
                put(flash, layout.slots[usize::from(*slot)] as usize, &bytes);
            }
            Self::Record { place, shape, number, in_use, phase, packages } => {
                // As specified in agent-core/src/store/record.rs.
                let number = lowest_sequence.wrapping_add((*number).into());
                let mut extents = [[0; 8]; 2];
                for ((recorded, slot), extent) in
                    packages.iter().zip([Slot::A, Slot::B]).zip(&mut extents)
                {
                    // If nothing is in use, the store fills A.
                    if slot == Slot::A || *in_use != 0 {
                        *extent = recorded.extent(flash, layout, slot);
                    }
                }
                let codes = [in_use.wrapping_sub(1), *phase];
                let (void, kind, copies) = match shape {
                    Shape::Format1 => {
                        let mut record = format_1_record(number, codes[0], codes[1], [&[]; 2]);
                        record[8..24].copy_from_slice(&extents.concat());
                        let checksum = crc32(&[&record[..28]]);
                        record[28..].copy_from_slice(&checksum.to_le_bytes());
                        let offset = layout.commit as usize + 32 * usize::from(*place);
                        return put(flash, offset, &record);
                    }
                    Shape::Once { void } => (*void, 0, 1),
                    Shape::Twice { void } => (*void, 0, 2),
                    Shape::Note { void, kind } => (*void, *kind, 2),
                };
                let mut record = [0; RECORD_LENGTH];
                record[..4].copy_from_slice(&number.to_le_bytes());
                record[4..10].copy_from_slice(&[2, kind, void, 52, codes[0], codes[1]]);
                record[12..28].copy_from_slice(&extents.concat());
                let checksum = crc32(&[&record[..RECORD_LENGTH - 4]]);
                record[RECORD_LENGTH - 4..].copy_from_slice(&checksum.to_le_bytes());
                for copy in 0..copies {
                    let place = 2 * usize::from(*place) + copy;
                    put(flash, layout.commit as usize + RECORD_LENGTH * place, &record);
                }
            }
        }
    }
}

impl Recorded {
    /// Returns length and checksum.
    fn extent<F: MappedFlash>(&self, flash: &F, layout: &Layout, slot: Slot) -> [u8; 8] {
        let start = layout.slots[slot as usize] as usize;
        let bytes = &flash.mapped()[start..start + layout.slot_length as usize];
        let of = |length: usize| {
            let length = length.min(bytes.len());
            (length as u32, crc32(&[&bytes[..length]]))
        };
        let (length, checksum) = match *self {
            Self::Nothing => (0, 0),
            Self::Package => of(length(bytes).unwrap_or(0) as usize),
            Self::Bytes(length) => of(length.into()),
            Self::Anything { length, checksum } => (length, checksum),
        };
        let [l0, l1, l2, l3] = length.to_le_bytes();
        let [c0, c1, c2, c3] = checksum.to_le_bytes();
        [l0, l1, l2, l3, c0, c1, c2, c3]
    }
}

/// Overwrites the flash from `offset` on with as many of `bytes` as fit.
fn put<const WRITE: usize, const ERASE: usize>(
    flash: &mut SimulatedFlash<WRITE, ERASE>,
    offset: usize,
    bytes: &[u8],
) {
    let offset = offset % flash.mapped().len();
    let room = flash.mapped().len() - offset;
    flash.overwrite(offset, &bytes[..bytes.len().min(room)]);
}

/// Returns a length that is valid for a package and fits into a slot.
fn length_in(layout: &Layout, length: u8) -> usize {
    usize::from(length).clamp(8, layout.slot_length as usize)
}

/// The check of this node.
fn accept(bytes: &[u8]) -> Result<u16, &'static str> {
    check(bytes).and_then(|number| if number < UNWANTED { Ok(number) } else { Err("unwanted") })
}

/// The package in use: its number, or `None`.
type InUse = Option<u16>;

/// A store with the expected results.
struct Run<const WRITE: usize, const ERASE: usize> {
    store: Store<SimulatedFlash<WRITE, ERASE>>,
    layout: Layout,
    /// Whether neither power nor flash can fail before the next reboot.
    is_sound: bool,
    /// The package in use, once loaded.
    in_use: Option<InUse>,
    /// During a trial, what was in use before.
    way_back: Option<InUse>,
    /// The packages that can be in use after the next reboot, if known.
    after_reboot: Option<Vec<InUse>>,
}

impl<const WRITE: usize, const ERASE: usize> Run<WRITE, ERASE> {
    fn after(mut self, call: &Call) -> Self {
        match *call {
            Call::Reboot { energy, forgotten } => {
                self = self.rebooted(energy.map(usize::from), forgotten);
            }
            Call::PowerFails { energy } => {
                self.is_sound = false;
                self.store.flash().drain(energy.into());
            }
            Call::Fails { others, ref how } => {
                self.is_sound = false;
                let fault = match how {
                    Failure::Nothing => Fault::Nothing,
                    Failure::Everything => Fault::Everything,
                    Failure::Torn => Fault::Torn,
                    Failure::Silent => Fault::Silent,
                };
                self.store.flash().arm((others % 8).into(), 1, fault);
            }
            Call::Load => self.load(),
            Call::Salvage => {
                // The package, if any, was found immediately.
                let found = self.store.salvage(length, accept, |one, other| one > other);
                assert!(found.is_none() || self.in_use.is_none());
            }
            Call::Begin { length } => {
                let _ = self.store.begin(length.into());
            }
            Call::Write { number, length, from, to } => {
                let bytes = package(number.into(), length_in(&self.layout, length));
                let to = usize::from(to).min(bytes.len());
                let from = usize::from(from).min(to);
                let _ = self.store.write(from as u32, &bytes[from..to], any_header);
            }
            Call::Stage => {
                let _ = self.store.stage(accept);
            }
            Call::Upload { number, length, chunk } => self.upload(number.into(), length, chunk),
            Call::Activate => self.activate(),
            Call::Confirm => self.confirm(),
            Call::Revert => self.revert(),
            Call::Note { kind, byte } => {
                if self.store.record_note(kind, &[byte]).is_ok() {
                    assert_eq!(self.store.note(kind).unwrap().as_bytes(), [byte]);
                }
            }
            Call::CountBoot => {
                self.store.count_boot(None);
            }
        }
        self.check_what_is_in_use();
        self
    }

    /// Loads or salvages the package in use, which must match what was in use before a reboot.
    fn load(&mut self) {
        let loaded = self.store.load(accept);
        let mut found = loaded.in_use;
        if found.is_none() {
            found = self.store.salvage(length, accept, |one, other| one > other);
        }
        assert_eq!(self.store.in_use(), found.map(|(slot, _)| slot));
        let number = found.map(|(_, number)| number);
        match (self.in_use, &self.after_reboot) {
            (Some(before), _) => assert_eq!(number, before),
            (None, Some(possible)) => {
                assert!(possible.contains(&number), "{number:?}: {possible:?}");
            }
            (None, None) => {}
        }
        if self.in_use.is_none() {
            self.after_reboot = Some(vec![number]);
        }
        self.in_use = Some(number);
    }

    fn rebooted(self, energy: Option<usize>, forgotten: Option<(u16, u8)>) -> Self {
        let mut flash = self.store.into_flash();
        if let Some((offset, byte)) = forgotten {
            put(&mut flash, offset.into(), &[byte]);
        }
        flash.power_on(energy);
        flash.arm(NEVER, 1, Fault::Nothing);
        Self {
            store: Store::open(flash, self.layout).expect("the layout is valid"),
            is_sound: energy.is_none(),
            in_use: None,
            way_back: None,
            after_reboot: self.after_reboot.filter(|_| forgotten.is_none()),
            ..self
        }
    }

    fn upload(&mut self, number: u16, length: u8, chunk: u8) {
        let bytes = package(number, length_in(&self.layout, length));
        let outcome = self.try_upload(&bytes, usize::from(chunk).max(1));
        // An image may hold no record at all, and a place that could be one.
        let must_succeed = self.is_sound
            && !self.store.is_blocked()
            && self.in_use.is_some()
            && self.way_back.is_none();
        match outcome {
            Ok(staged) => {
                assert_eq!(staged, number);
                let slot = self.store.staged().expect("just staged");
                assert_eq!(self.store.bytes(slot), Some(&bytes[..]));
            }
            Err(CheckedError::Refused(_)) => assert!(number >= UNWANTED),
            Err(error) => assert!(!must_succeed, "{error:?}"),
        }
    }

    fn try_upload(
        &mut self,
        bytes: &[u8],
        chunk: usize,
    ) -> Result<u16, CheckedError<&'static str>> {
        self.store.begin(bytes.len() as u32)?;
        let mut received = 0;
        for bytes in bytes.chunks(chunk) {
            received = self.store.write(received, bytes, any_header)?;
        }
        self.store.stage(accept)
    }

    fn activate(&mut self) {
        let before = self.in_use;
        if let Ok(number) = self.store.activate(accept, serials) {
            assert!(self.store.is_on_trial());
            self.way_back = before;
            self.in_use = Some(Some(number));
            self.after_reboot = before.map(|before| vec![before]);
        }
    }

    fn confirm(&mut self) {
        match self.store.confirm() {
            Ok(()) => {
                self.way_back = None;
                self.after_reboot = self.in_use.map(|number| vec![number]);
            }
            Err(StoreError::NotOnTrial) => assert_eq!(self.way_back, None),
            Err(error) => {
                assert!(!self.is_sound, "{error}");
                if let (Some(possible), Some(number)) = (&mut self.after_reboot, self.in_use) {
                    possible.push(number);
                }
            }
        }
    }

    fn revert(&mut self) {
        match self.store.revert(Revert::BY_OPERATOR) {
            Ok(_) => {
                // The failed package is no longer recorded.
                let spare = self.store.in_use().map_or(Slot::A, Slot::other);
                assert_eq!(self.store.bytes(spare), None);
                self.in_use = self.way_back.take();
                self.after_reboot = self.in_use.map(|number| vec![number]);
            }
            Err(StoreError::NotOnTrial) => assert_eq!(self.way_back, None),
            Err(error) => assert!(!self.is_sound, "{error}"),
        }
    }

    /// The package in use is always complete and accepted, and the rules of the flash are obeyed.
    fn check_what_is_in_use(&self) {
        if let Some(number) = self.in_use {
            let slot = self.store.in_use();
            let bytes =
                slot.map(|slot| self.store.bytes(slot).expect("the package in use is recorded"));
            assert_eq!(bytes.map(accept), number.map(Ok));
            assert_eq!(self.store.is_on_trial(), self.way_back.is_some());
        }
        assert_eq!(self.store.flash().misuses, 0);
    }

    /// On working flash a valid package can always be installed, and stays.
    fn install_another(self) {
        let mut run = self.rebooted(None, None);
        // What no record says and no boot can find out is for the operator to decide.
        run.store.forget_unreadable();
        run.load();
        run.upload(LAST, 20, 7);
        run.activate();
        assert_eq!(run.in_use, Some(Some(LAST)));
        run.confirm();
        run.check_what_is_in_use();
        assert_eq!(run.after_reboot, Some(vec![Some(LAST)]));
        let mut run = run.rebooted(None, None);
        run.load();
        assert_eq!(run.in_use, Some(Some(LAST)));
    }
}
