//! Kinds of bad packages, each of which looks valid: checksums, digest and lengths match. A node
//! refuses them all before it activates anything. What only running them can show is the trial's.

extern crate std;

use std::string::{String, ToString};
use std::vec::Vec;
use std::{format, println};

use super::format2_tests::{resealed, section, sections, with_sections};
use super::sections::{REQUIRED, kind};
use super::tests::{Aligned, Content, encoded};
use super::*;
use crate::observer::network::Scratch;

/// A node that runs agent 7 and has activated version 4 of epoch 1.
const NODE: Requirements<'static> = Requirements {
    agent: Some(7),
    highest: Some(Serial { epoch: 1, version: 4 }),
    step_range: StepRange::DEFAULT,
    capacity: Capacity { features: 8, neighbours: 4, gain_entries: 64, known_inputs: 0 },
    ..Requirements::ANY
};

fn accepted(bytes: &Aligned) -> Result<(), Refusal> {
    accept::<2>(bytes.bytes(), &NODE, &mut Scratch::NEW.clone()).map(|_| ())
}

/// All packages so far, by name.
struct Bad(Vec<(String, Aligned)>);

impl Bad {
    /// Adds the package after `change`.
    fn package(&mut self, name: &str, change: impl FnOnce(&mut Package<'_>)) {
        let content = Content::new();
        let mut package = good(&content);
        change(&mut package);
        self.0.push((name.to_string(), encoded(Format::Two, &package)));
    }

    /// Adds the package after the change of its content, which the test vectors follow.
    fn content(&mut self, name: &str, change: impl FnOnce(&mut Content)) {
        let mut content = Content::new();
        change(&mut content);
        self.0.push((name.to_string(), encoded(Format::Two, &good(&content))));
    }

    /// Adds the package with other bytes, under matching checksums.
    fn bytes(&mut self, name: String, change: impl FnOnce(&mut Vec<u8>)) {
        let content = Content::new();
        let mut bytes = encoded(Format::Two, &good(&content)).bytes().to_vec();
        change(&mut bytes);
        self.0.push((name, resealed(bytes)));
    }

    /// Adds the package with other sections.
    fn sections(&mut self, name: String, change: impl FnOnce(&mut Vec<Vec<u8>>)) {
        let content = Content::new();
        let bytes = encoded(Format::Two, &good(&content)).bytes().to_vec();
        let mut all = sections(&bytes);
        change(&mut all);
        self.0.push((name, with_sections(&bytes, &all)));
    }
}

fn good(content: &Content) -> Package<'_> {
    Package { epoch: 1, ..content.package() }
}

const NOT_POSITIVE: [f32; 6] = [0.0, -0.0, -1.0, -1e-40, f32::MIN, f32::NEG_INFINITY];
const NEGATIVE: [f32; 3] = [-1.0, -1e-40, f32::MIN];
const NOT_FINITE: [f32; 3] = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY];

fn parameters(bad: &mut Bad) {
    for value in NOT_POSITIVE.into_iter().chain([f32::NAN, f32::INFINITY]) {
        let diagonal = [50.0, value];
        let first = [value, 50.0];
        let full = [50.0, 1.0, 1.0, value];
        for (form, gain) in [
            ("scalar", SymmetricMatrix::Scalar(value)),
            ("diagonal", SymmetricMatrix::Diagonal(&diagonal)),
            ("first of the diagonal", SymmetricMatrix::Diagonal(&first)),
            ("full", SymmetricMatrix::Full(&full)),
        ] {
            bad.package(&format!("K1 {form} {value:e}"), |package| {
                package.node.gain = match gain {
                    SymmetricMatrix::Scalar(value) => SymmetricMatrix::Scalar(value),
                    SymmetricMatrix::Diagonal(_) => SymmetricMatrix::Diagonal(&[0.0; 2]),
                    SymmetricMatrix::Full(_) => SymmetricMatrix::Full(&[0.0; 4]),
                };
            });
            let entries: Vec<u8> =
                gain.entries().iter().flat_map(|entry| entry.to_le_bytes()).collect();
            patch(bad, 2, 3, &entries);
        }
        bad.package(&format!("Gamma {value:e}"), |package| {
            package.node.outer_law.gain = SymmetricMatrix::Scalar(value);
        });
        bad.package(&format!("step {value:e}"), |package| package.node.step_size = value);
        bad.package(&format!("threshold {value:e}"), |package| {
            package.node.trigger.threshold = value;
        });
        for neighbour in 0..2 {
            bad.package(&format!("edge weight {neighbour} {value:e}"), |_| {});
            patch(bad, 2, 8 + neighbour, &value.to_le_bytes());
        }
        for (index, name) in ["theta_0", "beta", "delta"].into_iter().enumerate() {
            bad.package(&format!("{name} {value:e}"), |_| {});
            patch(bad, 3, index, &value.to_le_bytes());
        }
    }
    for value in NEGATIVE.into_iter().chain(NOT_FINITE) {
        bad.package(&format!("phi_1 {value:e}"), |package| {
            package.node.trigger.hold_error_weight = value;
        });
        bad.package(&format!("phi_2 {value:e}"), |package| {
            package.node.trigger.consensus_weight = value;
        });
        bad.package(&format!("least interval {value:e}"), |package| {
            package.broadcast_interval_min = value;
        });
        bad.package(&format!("limit of the innovation {value:e}"), |package| {
            package.trial = Some(TrialLimits { innovation_rms: Some(value), ..TrialLimits::NONE });
        });
        bad.package(&format!("limit of broadcasts {value:e}"), |package| {
            let broadcasts_per_second = Some(value);
            package.trial = Some(TrialLimits { broadcasts_per_second, ..TrialLimits::NONE });
        });
    }
    for value in [1e-45, 9e-7, 11.0, 1e30] {
        bad.package(&format!("step {value:e}"), |package| package.node.step_size = value);
    }
    for value in [1e-16, 1e16] {
        bad.package(&format!("theta_0 {value:e}"), |package| {
            package.node.outer_law.projection.radius = value;
        });
        bad.package(&format!("beta {value:e}"), |package| {
            package.node.outer_law.projection.boundary_layer = value;
        });
        bad.package(&format!("delta {value:e}"), |package| {
            package.node.outer_law.projection.smoothing = value;
        });
    }
    for smoothness in [8, 100, 255] {
        bad.package(&format!("smoothness {smoothness}"), |package| {
            package.node.outer_law.projection.smoothness = smoothness;
        });
    }
    bad.package("C of zeros", |package| package.node.output_matrix = &[0.0, -0.0]);
    bad.package("a row of C of zeros", |package| {
        package.node.output_matrix = &[1.0, 0.0, 0.0, 0.0];
    });
    bad.content("K1 not symmetric", |content| content.gain[1] = 2.0);
    bad.content("outer weights beyond the bound", |content| content.outer_weights = [9.0; 6]);
    for (name, ids) in [
        ("itself as a neighbour", [3, 7]),
        ("neighbours repeated", [3, 3]),
        ("neighbours not in order", [9, 3]),
    ] {
        bad.content(name, |content| content.neighbours = ids);
    }
    for component in 0..2 {
        bad.content(&format!("empty box in component {component}"), |content| {
            content.low[component] = content.high[component] + 1.0;
        });
    }
}

/// Writes `bytes` into a word of a section of the last package.
fn patch(bad: &mut Bad, index: usize, word: usize, bytes: &[u8]) {
    let Some((_, package)) = bad.0.last_mut() else { return };
    let whole = package.bytes().to_vec();
    let mut all = sections(&whole);
    all[index][8 + 4 * word..][..bytes.len()].copy_from_slice(bytes);
    *package = with_sections(&whole, &all);
}

fn results(bad: &mut Bad) {
    bad.package("no test vectors", |package| package.test_vectors = &[]);
    // A network that computes something other than what was tested, by the last bit of one number.
    for index in 0..9 {
        bad.package(&format!("inner parameter {index}"), |_| {});
        let bits = Content::new().inner[index].to_bits() ^ 1 << 20;
        patch(bad, 0, index, &bits.to_le_bytes());
    }
    for index in 0..6 {
        bad.package(&format!("outer weight {index}"), |_| {});
        let bits = Content::new().outer_weights[index].to_bits() ^ 1 << 20;
        patch(bad, 1, index, &bits.to_le_bytes());
    }
    for word in 0..14 {
        bad.package(&format!("number {word} of the test vectors"), |_| {});
        let bits = Content::new().test_vectors[word].to_bits() ^ 1 << 20;
        patch(bad, 5, word, &bits.to_le_bytes());
    }
    for (index, words) in [(0, 9), (1, 6), (5, 14)] {
        for word in 0..words {
            bad.package(&format!("section {}, number {word} is NaN", index + 1), |_| {});
            patch(bad, index, word, &f32::NAN.to_le_bytes());
        }
    }
}

fn identities(bad: &mut Bad) {
    bad.package("another agent", |package| package.node.agent = 8);
    bad.package("an agent of 32 bits whose low ones match", |package| {
        package.node.agent = 7 + (1 << 16);
    });
    for (epoch, version) in [(1, 4), (1, 3), (1, 0), (0, 5), (0, u32::MAX)] {
        bad.package(&format!("version {version} of package epoch {epoch}"), |package| {
            (package.epoch, package.version) = (epoch, version);
        });
    }
    let content = Content::new();
    for replaces in [None, Some(u32::MAX)] {
        let package = Package { replaces, ..content.package() };
        bad.0.push((format!("format 1, replaces {replaces:?}"), encoded(Format::One, &package)));
    }
}

fn structures(bad: &mut Bad) {
    for (name, place, value) in [
        ("3 state components", 20, 3),
        ("1 state component", 20, 1),
        ("3 network inputs", 21, 3),
        ("no outputs", 22, 0),
        ("3 outputs", 22, 3),
        ("2 outputs", 22, 2),
        ("no layers", 23, 0),
        ("2 layers", 23, 2),
        ("255 layers", 23, 255),
        ("a layer of no nodes", 24, 0),
        ("a layer of 2 nodes", 24, 2),
        ("a layer of 65 nodes", 24, 65),
        ("another activation", 25, 1),
        ("an unknown activation", 25, 200),
        ("a layer that is not counted", 26, 1),
        ("1 neighbour", 40, 1),
        ("3 neighbours", 40, 3),
        ("258 neighbours", 41, 1),
        ("an unknown flag", 42, 0x80),
        ("a reserved byte", 43, 1),
        ("the first reserved byte", 84, 1),
        ("the last reserved byte", 123, 1),
    ] {
        bad.bytes(name.to_string(), |bytes| bytes[place] = value);
    }
    for index in 0..7 {
        bad.sections(format!("section {} twice", index + 1), |all| {
            all.insert(index, all[index].clone());
        });
        bad.sections(format!("section {} first", index + 1), |all| {
            let moved = all.remove(index);
            all.insert(0, moved);
            // Section 1 is first already: put it last.
            all.rotate_left(usize::from(index == 0));
        });
        bad.sections(format!("section {} with the wrong bit", index + 1), |all| {
            all[index][1] ^= 0x80;
        });
        bad.sections(format!("section {} without its last word", index + 1), |all| {
            let length = all[index].len() - 4;
            all[index].truncate(length);
            let stated = (length - 8) as u32;
            all[index][4..8].copy_from_slice(&stated.to_le_bytes());
        });
        if index < 6 {
            bad.sections(format!("section {} missing", index + 1), |all| {
                all.remove(index);
            });
        }
    }
    for number in [9, 300, 0x7fff] {
        bad.sections(format!("required section {number}"), |all| {
            all.push(section(REQUIRED | number, &[1; 4]));
        });
    }
    bad.sections("9 test vectors".to_string(), |all| {
        all[5] = section(kind::TEST_VECTORS, &[0; 4 * 7 * 9]);
    });
    bad.sections("sections that end early".to_string(), |all| all.push(Vec::from([9, 0, 0, 0])));
}

#[test]
fn two_hundred_kinds_of_bad_packages_that_look_valid_are_refused() {
    assert_eq!(accepted(&encoded(Format::Two, &good(&Content::new()))), Ok(()));
    let mut bad = Bad(Vec::new());
    parameters(&mut bad);
    results(&mut bad);
    identities(&mut bad);
    structures(&mut bad);
    let kinds: std::collections::BTreeSet<_> = bad.0.iter().map(|(name, _)| name).collect();
    assert!(kinds.len() >= 200, "{} kinds", kinds.len());
    let taken: Vec<_> =
        bad.0.iter().filter(|(_, bytes)| accepted(bytes).is_ok()).map(|(name, _)| name).collect();
    println!("{} kinds, {} accepted", kinds.len(), taken.len());
    assert!(taken.is_empty(), "{taken:?}");
}
