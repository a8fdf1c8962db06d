//! Writes the real packages and frames that the fuzzers begin with into the corpus:
//!
//! ```sh
//! cargo run --manifest-path fuzz/Cargo.toml --example seeds
//! ```
//!
//! Their names begin with `seed-`; all other inputs in the corpus were found by the fuzzers.

use std::{fs, io, path::Path};

use agent_core::activation::Activation::{Gaussian, Logistic, Tanh};
use agent_core::frame::Frame;
use agent_core::package::signature_block;
use fuzz::{Event, Form, SamplePackage};

fn main() -> io::Result<()> {
    let signed = SamplePackage {
        version: 5,
        agent: 7,
        layers: vec![(3, Tanh)],
        neighbours: vec![3, 265],
        gain: Form::Full,
        test_vectors: 2,
        recipe: "better",
        ..SamplePackage::smallest()
    }
    .encode::<2>();
    let signed = [&signed[..], &signature_block(&[0x5a; 64])].concat();
    let deep = SamplePackage {
        layers: vec![(2, Tanh), (1, Logistic), (3, Gaussian)],
        outputs: 2,
        gain: Form::Diagonal,
        outer_gain: Form::Full,
        ..SamplePackage::smallest()
    };
    let wide = SamplePackage {
        version: 300,
        agent: 70,
        layers: vec![(13, Logistic), (17, Gaussian)],
        outputs: 4,
        neighbours: vec![1, 2, 69, 71],
        gain: Form::Diagonal,
        outer_gain: Form::Diagonal,
        test_vectors: 8,
        recipe: "wide",
    };
    for (name, bytes) in [
        ("smallest", SamplePackage::smallest().encode::<1>()),
        ("signed", signed),
        ("deep", deep.encode::<3>()),
        ("wide", wide.encode::<4>()),
        ("largest-state", SamplePackage::smallest().encode::<12>()),
    ] {
        write("package", name, &bytes)?;
    }

    let frame = Frame { sender: 4, sequence: 0, tick: 1, estimate: [0.5, -1.0, 2.0].into() };
    let newer = Frame { sequence: 1, tick: 200, ..frame };
    let other = Frame { sender: 300, sequence: u32::MAX, tick: u64::MAX, ..frame };
    let wrapped = Frame { sequence: 0, ..other };
    let unknown = Frame { sender: 5, ..frame };
    let far = Frame { sender: 9, estimate: [3e38, -3e38, 1e-45].into(), ..frame };
    for (name, frames) in [
        ("one", &[frame][..]),
        ("newer", &[frame, newer]),
        ("duplicate", &[newer, frame]),
        ("wrapped", &[other, wrapped]),
        ("unknown", &[unknown]),
        ("far", &[frame, far]),
        ("all", &[frame, other, far]),
    ] {
        let mut input = vec![];
        for frame in frames {
            Event::Received(frame.encode().to_vec()).write(&mut input);
        }
        Event::Step.write(&mut input);
        Event::Step.write(&mut input);
        write("frame", name, &input)?;
    }
    let other_dimension =
        Frame::<12> { sender: 4, sequence: 0, tick: 1, estimate: [0.5; 12].into() };
    let mut input = vec![];
    Event::Received(other_dimension.encode().to_vec()).write(&mut input);
    write("frame", "other-dimension", &input)
}

fn write(target: &str, name: &str, bytes: &[u8]) -> io::Result<()> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus").join(target);
    fs::create_dir_all(&folder)?;
    fs::write(folder.join(format!("seed-{name}")), bytes)
}
