//! Nodes under everything that can go wrong, for a long time: the firmware in emulators and its twin,
//! the same code compiled for this machine, get the same bytes, have to say the same bytes, and
//! have to keep what an independent judge knows that a node must keep.
//!
//! ```text
//!            plant, links, operators, bad luck: one seed
//!                    |  the same bytes  |
//!         firmware in QEMU           twin in a thread
//!                    |                  |
//!                    +----- equal? -----+----> judge
//! ```
//!
//! | module | what it is |
//! | --- | --- |
//! | `drive` | the driver: three nodes of the paper's scenario, step by step |
//! | `rates` | how often what goes wrong |
//! | `line`, `links` | messages to a node, frames between nodes, and what befalls them |
//! | `operator`, `supply` | packages, good and bad, and whoever pushes them |
//! | `judge`, `store` | what a node has to answer |
//! | `peer`, `emulator`, `twin` | a node, and what it runs on |
//! | `report` | the figures |
//!
//! # What holds
//! - Every byte of the firmware is its twin's, but for what only a board knows of itself (how much of
//!   its stack it never used); and after every loss of power the content of the flash.
//! - Every request that arrives whole gets exactly one answer, the right one, within the deadline.
//! - Only packages that were made for the agent, not below the version in use, are ever staged. What
//!   was confirmed is in use after every reset, what was on trial is not.
//! - Estimates, derivatives and outer weights are finite; counters only rise.
//! - After faults have ended, the error of every estimate is below twice the largest of fault-free
//!   running.
//!
//! # What it does not do
//! The power fails between two answers, not within a write to flash: `store::power_cuts` tears every
//! single write. Nobody forges plausible frames with a neighbour's number: frames are not signed.
//!
//! `cargo xtask soak` runs [`emulated`] on the firmware that it builds; as an ordinary test there is
//! [`twins`], the same without the emulator.

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

/// The judge himself: one right answer to each request passes, and nothing else does.
#[test]
fn the_judge_lets_nothing_wrong_pass() {
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

/// For `cargo xtask soak`, which says by the environment what to run, and for how long.
#[test]
#[ignore = "takes the firmware: cargo xtask soak"]
fn emulated() {
    let setting = |name: &str| {
        std::env::var(name).unwrap_or_else(|_| panic!("{name} is not set; use cargo xtask soak"))
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
