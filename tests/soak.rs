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
//! The power fails between two answers, not within a write to flash: `store_power_cuts` tears every
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

use drive::{Course, Soak};

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
