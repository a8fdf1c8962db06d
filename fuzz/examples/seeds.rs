//! Writes real packages, frames and signatures into the corpus as seeds for the fuzzers:
//!
//! ```sh
//! cargo run --manifest-path fuzz/Cargo.toml --example seeds
//! ```
//!
//! Their names start with `seed-`; the fuzzers found all other inputs in the corpus.

use std::{fs, io, path::Path};

use agent_core::math::activation::Activation::{Gaussian, Logistic, Tanh};
use agent_core::math::symmetric::MatrixForm;
use agent_core::observer::field::{Announced, Disturbance, HoldKind};
use agent_core::package::{CHECKED_FIRST, Format, HEADER2_LENGTH, signature_block};
use agent_core::wire::frame::Frame;
use fuzz::{Event, SamplePackage};

fn main() -> io::Result<()> {
    let two = |package: &SamplePackage| SamplePackage { format: Format::Two, ..package.clone() };
    let signed = SamplePackage {
        version: 5,
        agent: 7,
        layers: vec![(3, Tanh)],
        neighbours: vec![3, 265],
        gain: MatrixForm::Full,
        test_vectors: 2,
        recipe: "better",
        ..SamplePackage::smallest()
    };
    let mut signed2 = two(&signed).encode::<2>();
    signed2[HEADER2_LENGTH..CHECKED_FIRST].copy_from_slice(&signature_block(&[0x5a; 64]));
    let signed = [&signed.encode::<2>()[..], &signature_block(&[0x5a; 64])].concat();
    let deep = SamplePackage {
        layers: vec![(2, Tanh), (1, Logistic), (3, Gaussian)],
        outputs: 2,
        gain: MatrixForm::Diagonal,
        outer_gain: MatrixForm::Full,
        ..SamplePackage::smallest()
    };
    let wide = SamplePackage {
        format: Format::One,
        version: 300,
        agent: 70,
        layers: vec![(13, Logistic), (17, Gaussian)],
        outputs: 4,
        neighbours: vec![1, 2, 69, 71],
        gain: MatrixForm::Diagonal,
        outer_gain: MatrixForm::Diagonal,
        test_vectors: 8,
        recipe: "wide",
        has_field: false,
    };
    let field = SamplePackage { outputs: 1, neighbours: vec![4, 9], has_field: true, ..two(&deep) };
    for (name, bytes) in [
        ("smallest", SamplePackage::smallest().encode::<1>()),
        ("signed", signed),
        ("deep", deep.encode::<3>()),
        ("wide", wide.encode::<4>()),
        ("largest-state", SamplePackage::smallest().encode::<12>()),
        ("smallest-2", two(&SamplePackage::smallest()).encode::<1>()),
        ("signed-2", signed2),
        ("deep-2", two(&deep).encode::<3>()),
        ("wide-2", two(&wide).encode::<4>()),
        ("field-2", field.encode::<3>()),
    ] {
        write("package", name, &bytes)?;
    }

    let frame = Frame::new(4, 0, 1, [0.5, -1.0, 2.0].into());
    let newer = Frame { sequence: 1, tick: 200, ..frame };
    let other = Frame { sender: 300, sequence: u32::MAX, tick: u64::MAX, ..frame };
    let wrapped = Frame { sequence: 0, ..other };
    let unknown = Frame { sender: 5, ..frame };
    let far = Frame { sender: 9, estimate: [3e38, -3e38, 1e-45].into(), ..frame };
    let announced = Announced {
        digest: 0x1234,
        hold: HoldKind::Rate,
        has_harmonics: true,
        is_half: false,
        directions: 0b101,
        rate: [1.0, -0.5, 0.25].into(),
        disturbances: [
            Disturbance { bias: 0.5, cosine: 1.0, sine: -1.0 },
            Disturbance::NONE,
            Disturbance { bias: f32::MAX, cosine: f32::MAX, sine: f32::MIN },
        ],
    };
    let rate = Frame { announced: Some(announced), ..frame };
    let model =
        Announced { hold: HoldKind::Model, is_half: true, rate: [0.0; 3].into(), ..announced };
    let model = Frame { announced: Some(model), ..other };
    let constant = Announced { hold: HoldKind::ZeroOrder, ..Announced::NONE };
    let constant = Frame { announced: Some(constant), ..newer };
    for (name, frames) in [
        ("field-rate", &[rate][..]),
        ("field-model", &[model]),
        ("field-all", &[rate, model, far, constant]),
        ("one", &[frame]),
        ("newer", &[frame, newer]),
        ("duplicate", &[newer, frame]),
        ("wrapped", &[other, wrapped]),
        ("unknown", &[unknown]),
        ("far", &[frame, far]),
        ("all", &[frame, other, far]),
        ("farewell", &[Frame::farewell(4, 1, 2)]),
        ("farewell-old", &[newer, Frame::farewell(4, 0, 1)]),
    ] {
        let mut input = vec![];
        for frame in frames {
            Event::Received(frame.encode().to_vec()).write(&mut input);
        }
        Event::Step.write(&mut input);
        Event::Step.write(&mut input);
        write("frame", name, &input)?;
    }
    let mut input = vec![];
    for frame in [frame, Frame::farewell(4, 1, 2), newer, Frame { sequence: 2, ..newer }] {
        Event::Received(frame.encode().to_vec()).write(&mut input);
        Event::Step.write(&mut input);
    }
    write("frame", "farewell-and-back", &input)?;

    let other_dimension = Frame::<12>::new(4, 0, 1, [0.5; 12].into());
    let mut input = vec![];
    Event::Received(other_dimension.encode().to_vec()).write(&mut input);
    write("frame", "other-dimension", &input)?;

    let signed = [&RFC_8032_KEY[..], &RFC_8032_SIGNATURE, &[0x72]].concat();
    write("signature", "rfc-8032", &signed)
}

/// The second example of RFC 8032, section 7.1, signs the byte 0x72.
const RFC_8032_KEY: [u8; 32] = [
    0x3d, 0x40, 0x17, 0xc3, 0xe8, 0x43, 0x89, 0x5a, 0x92, 0xb7, 0x0a, 0xa7, 0x4d, 0x1b, 0x7e, 0xbc,
    0x9c, 0x98, 0x2c, 0xcf, 0x2e, 0xc4, 0x96, 0x8c, 0xc0, 0xcd, 0x55, 0xf1, 0x2a, 0xf4, 0x66, 0x0c,
];
const RFC_8032_SIGNATURE: [u8; 64] = [
    0x92, 0xa0, 0x09, 0xa9, 0xf0, 0xd4, 0xca, 0xb8, 0x72, 0x0e, 0x82, 0x0b, 0x5f, 0x64, 0x25, 0x40,
    0xa2, 0xb2, 0x7b, 0x54, 0x16, 0x50, 0x3f, 0x8f, 0xb3, 0x76, 0x22, 0x23, 0xeb, 0xdb, 0x69, 0xda,
    0x08, 0x5a, 0xc1, 0xe4, 0x3e, 0x15, 0x99, 0x6e, 0x45, 0x8f, 0x36, 0x13, 0xd0, 0xf1, 0x1d, 0x8c,
    0x38, 0x7b, 0x2e, 0xae, 0xb4, 0x30, 0x2a, 0xee, 0xb0, 0x0d, 0x29, 0x16, 0x12, 0xbb, 0x0c, 0x00,
];

fn write(target: &str, name: &str, bytes: &[u8]) -> io::Result<()> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus").join(target);
    fs::create_dir_all(&folder)?;
    fs::write(folder.join(format!("seed-{name}")), bytes)
}
