//! Runs nodes under all kinds of faults for a long time: the firmware in emulators and its twin,
//! the same code compiled for this machine, receive the same bytes, must send the same bytes, and
//! must satisfy an independent judge.
//!
//! ```text
//!            plant, links, operators, faults: one seed
//!                    |  the same bytes  |
//!         firmware in QEMU           twin in a thread
//!                    |                  |
//!                    +----- equal? -----+----> judge
//! ```
//!
//! | module | contents |
//! | --- | --- |
//! | `drive` | the driver: three nodes of the paper's scenario, step by step |
//! | `rates` | probabilities of faults |
//! | `line`, `links` | messages to a node, frames between nodes, and their faults |
//! | `operator`, `supply` | valid and invalid packages, and their uploads |
//! | `judge`, `store` | the expected answers |
//! | `peer`, `emulator`, `twin` | a node and its platform |
//! | `report` | the statistics |
//!
//! # Checked properties
//! - Every byte of the firmware equals its twin's, except for the fields that only a board has (how
//!   much of its stack was never used); and so does the content of the flash after every power
//!   loss.
//! - Every request that arrives intact gets exactly one correct answer within the deadline.
//! - Only packages that were made for the agent, with at least the version in use, are ever staged.
//!   A confirmed package is in use after every reset, a package on trial is not.
//! - Estimates, derivatives and outer weights are finite; counters only rise.
//! - After faults have ended, the error of every estimate is below twice the largest in fault-free
//!   operation.
//!
//! # Limits
//! The power fails between two answers, not within a write to flash: `store::power_cuts` tears
//! every single write. Plausible frames with a neighbour's number are not forged, because frames
//! are not signed.
//!
//! `cargo xtask soak` runs [`emulated`] on the firmware that it builds; [`twins`] is an ordinary
//! test that does the same without the emulator.

mod drive;
mod emulator;
mod judge;
mod line;
mod links;
mod operator;
mod peer;
mod rates;
mod report;
mod store;
mod supply;
mod twin;

use std::path::PathBuf;

use agent_core::service::{CHUNK_LENGTH_MAX, Problem, Request, Upload, send};
use agent_core::store::StoreError;
use host_sim::service::Message;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use drive::{Course, Soak};
use judge::Judge;
use report::Tally;
use store::Package;
use supply::{Kind, Supply};

/// The long course.
fn course(steps: u64) -> Course {
    Course { steps, calibration: 20_000, faulty: 6_000, calm: 4_000, judged: 1_000, incidents: 1.0 }
}

#[test]
fn twins() {
    let mut soak = Soak::new(None, 1).unwrap();
    let course = Course {
        steps: 2_400,
        calibration: 4_000,
        faulty: 800,
        calm: 1_600,
        judged: 200,
        incidents: 8.0,
    };
    soak.run(&course).unwrap_or_else(|error| panic!("{error}"));
    println!("{}", soak.tally);
    for name in ["reset", "power cut", "stage: done", "activate: done", "broadcast"] {
        assert!(soak.tally.count_of(name) > 0, "{name}");
    }
}

/// The judge accepts exactly one correct answer to each request.
#[test]
fn the_judge_accepts_only_correct_answers() {
    let rng = &mut ChaCha8Rng::seed_from_u64(1);
    let mut supply = Supply::new(&supply::scenario(), rng);
    let factory = supply.factory(0);
    let judged = |requests: &[Request<'_>], said: &[Message<'_>], supply: &Supply| {
        let stream: Vec<u8> = requests.iter().flat_map(line::encoded).collect();
        let mut framed = Vec::new();
        said.iter().for_each(|message| send(message, |bytes| framed.extend_from_slice(bytes)));
        let messages: Vec<_> = line::heard(&framed).into_iter().flatten().collect();
        let mut judge = Judge::new(0, Package::new(2, factory.as_bytes()));
        judge.judge(&stream, &messages, supply, &mut Tally::new()).is_ok()
    };
    let received = |received| Message::Upload(Upload { received });
    let refused = |error| Message::Refused(Problem::Store(error));
    let begin = [Request::Begin { length: 9 }];
    assert!(judged(&begin, &[received(0)], &supply));
    for wrong in [&[][..], &[received(0), received(0)], &[received(1)], &[Message::Done]] {
        assert!(!judged(&begin, wrong, &supply), "{wrong:?}");
    }
    assert!(judged(&[Request::Confirm], &[refused(StoreError::NotOnTrial)], &supply));
    assert!(!judged(&[Request::Confirm], &[Message::Done], &supply));

    for kind in [Kind::Valid, Kind::Older, Kind::OtherAgent, Kind::Flipped, Kind::OtherTestVector] {
        let bytes = supply.package(kind, 0, 2, rng);
        let mut requests = vec![Request::Begin { length: bytes.len() as u32 }];
        let mut said = vec![received(0)];
        for (index, bytes) in bytes.chunks(CHUNK_LENGTH_MAX).enumerate() {
            let offset = (index * CHUNK_LENGTH_MAX) as u32;
            requests.push(Request::Chunk { offset, bytes });
            said.push(received(offset + bytes.len() as u32));
        }
        requests.push(Request::Stage);
        said.push(Message::Staged { version: 3 });
        assert_eq!(judged(&requests, &said, &supply), kind == Kind::Valid, "{kind:?}");
    }
}

/// For `cargo xtask soak`, which passes firmware, length and seed in environment variables.
#[test]
#[ignore = "requires the firmware; run `cargo xtask soak`"]
fn emulated() {
    let setting = |name: &str| {
        std::env::var(name).unwrap_or_else(|_| panic!("{name} is not set; run `cargo xtask soak`"))
    };
    let firmware = PathBuf::from(setting("SOAK_FIRMWARE"));
    let steps = setting("SOAK_STEPS").parse().unwrap();
    let seed = setting("SOAK_SEED").parse().unwrap();
    println!("soak: seed {seed}, {steps} steps");
    let mut soak = Soak::new(Some(&firmware), seed).unwrap_or_else(|error| panic!("{error}"));
    let outcome = soak.run(&course(steps));
    println!("soak: seed {seed}\n{}", soak.tally);
    outcome.unwrap_or_else(|error| panic!("{error}"));
}
