//! Tests of the bytes of a package and of what a node must refuse.

extern crate std;

use std::vec;
use std::vec::Vec;

use super::*;
use crate::agent::AgentState;
use crate::agent::inbox::Inbox;
use crate::math::activation::Activation;
use crate::observer::network::{Architecture, Layer, NetworkError, Scratch};
use crate::wire::frame::Frame;
use proptest::prelude::*;

/// A package's bytes, aligned to four bytes.
pub(crate) struct Aligned {
    words: Vec<u32>,
    length: usize,
}

impl Aligned {
    pub(crate) fn new(bytes: &[u8]) -> Self {
        let mut words = vec![0u32; bytes.len().div_ceil(4)];
        bytemuck::cast_slice_mut(&mut words)[..bytes.len()].copy_from_slice(bytes);
        Self { words, length: bytes.len() }
    }

    pub(crate) fn bytes(&self) -> &[u8] {
        &bytemuck::cast_slice(&self.words)[..self.length]
    }
}

/// The data a package borrows: agent 7 of a plant with two states and two neighbours.
#[derive(Clone)]
pub(crate) struct Content {
    pub(crate) inner: [f32; 9],
    pub(crate) outer_weights: [f32; 6],
    pub(super) neighbours: [AgentId; 2],
    edge_weights: [f32; 2],
    pub(crate) gain: [f32; 4],
    pub(super) low: [f32; 2],
    pub(super) high: [f32; 2],
    pub(super) test_vectors: [f32; 14],
}

impl Content {
    pub(crate) fn new() -> Self {
        let mut content = Self {
            inner: [0.1, -0.2, 0.3, 0.5, 0.4, -0.6, -0.1, 0.7, 0.2],
            outer_weights: [1.0, -2.0, 0.5, 0.25, -1.5, 3.0],
            neighbours: [3, 265],
            edge_weights: [1.0, 0.5],
            gain: [50.0, 1.0, 1.0, 60.0],
            low: [-1.0, -2.0],
            high: [1.0, 2.0],
            test_vectors: [0.0; 14],
        };
        for (index, input) in [[0.5, -0.25], [-1.0, 2.0]].into_iter().enumerate() {
            let mut scratch = Scratch::NEW;
            let package = content.package();
            let (features, output) = package.evaluate::<2>(&input, &mut scratch).unwrap();
            let vector = [&input[..], features, output.as_slice()].concat();
            content.test_vectors[7 * index..][..7].copy_from_slice(&vector);
        }
        content
    }

    pub(crate) fn package(&self) -> Package<'_> {
        let layers = [Layer { width: 3, activation: Activation::Tanh }];
        let architecture = Architecture::new(2, &layers).unwrap();
        Package {
            epoch: 0,
            version: 5,
            replaces: None,
            known_inputs: 0,
            outer_weights_on_switch: OnSwitch::Keep,
            network: InnerNetwork::new(architecture, &self.inner[..]).unwrap(),
            outer_weights: &self.outer_weights,
            node: AgentConfig {
                agent: 7,
                output_matrix: &[1.0, 0.0],
                gain: SymmetricMatrix::Full(&self.gain),
                neighbours: NeighbourIds::new(&self.neighbours),
                edge_weights: &self.edge_weights,
                outer_law: OuterLawParams {
                    gain: SymmetricMatrix::Scalar(3.0),
                    projection: crate::observer::projection::ProjectionParams {
                        radius: 9.0,
                        boundary_layer: 1.0,
                        smoothing: 0.1,
                        smoothness: 1,
                    },
                },
                trigger: TriggerParams {
                    hold_error_weight: 1e4,
                    consensus_weight: 0.5,
                    threshold: 10.0,
                },
                step_size: 1e-3,
                exchange: ExchangeParams::PAPER,
                field: &[],
            },
            broadcast_interval_min: 2e-3,
            trained_box: StateBox { low: &self.low, high: &self.high },
            trial: None,
            provenance: Provenance {
                scenario_hash: [1, 2, 3, 4, 5, 6, 7, 8],
                recipe: "better",
                seed: 42,
                samples: 300,
                errors: Some(TrainingErrors { training: 0.5, held_out: 0.75 }),
                tool_version: [0, 1, 0],
            },
            test_vectors: &self.test_vectors,
        }
    }
}

pub(crate) fn encoded(format: Format, package: &Package<'_>) -> Aligned {
    let mut buffer = [0xaa; 1000];
    let length = package.encode(format, &mut buffer).unwrap();
    Aligned::new(&buffer[..length])
}

/// Returns the bytes of a package with this signature.
pub(super) fn with_signature(unsigned: &[u8], signature: [u8; 64]) -> Vec<u8> {
    let block = signature_block(&signature);
    match Format::of(unsigned).unwrap() {
        Format::One => [unsigned, &block].concat(),
        Format::Two => {
            let mut bytes = unsigned.to_vec();
            bytes[HEADER2_LENGTH..CHECKED_FIRST].copy_from_slice(&block);
            bytes
        }
    }
}

pub(super) const FORMATS: [Format; 2] = [Format::One, Format::Two];

pub(super) const ANY: Requirements<'static> = Requirements::ANY;

/// Returns the refusal of the package, which is the same in both formats.
pub(super) fn refusal(package: &Package<'_>) -> Refusal {
    let [first, second] = FORMATS.map(|format| {
        accept::<2>(encoded(format, package).bytes(), &ANY, &mut Scratch::NEW.clone()).unwrap_err()
    });
    assert_eq!(first, second);
    second
}

/// Returns what a node sees of a package.
pub(super) fn without_origin(package: Package<'_>) -> Package<'_> {
    Package { provenance: Provenance::NONE, ..package }
}

#[test]
fn decoding_undoes_encoding_and_a_node_accepts_it() {
    let content = Content::new();
    for format in FORMATS {
        let bytes = encoded(format, &content.package());
        assert_eq!(Package::decode(bytes.bytes()), Ok(content.package()));
        let accepted = accept::<2>(bytes.bytes(), &ANY, &mut Scratch::NEW.clone()).unwrap();
        assert_eq!(accepted, without_origin(content.package()));
        assert_eq!(accepted.test_vectors().count(), 2);
        let ids: Vec<_> = accepted.node.neighbours().map(|n| (n.id, n.weight)).collect();
        assert_eq!(ids, [(3, 1.0), (265, 0.5)]);
    }
}

#[test]
fn every_single_bit_flip_and_every_truncation_is_refused() {
    for format in FORMATS {
        let unsigned = encoded(format, &Content::new().package());
        let signed = with_signature(unsigned.bytes(), [0x5a; 64]);
        for bytes in [unsigned.bytes(), &signed] {
            let mut copy = Aligned::new(bytes);
            assert!(Package::decode(copy.bytes()).is_ok());
            for bit in 0..bytes.len() * 8 {
                let flip = |copy: &mut Aligned| {
                    bytemuck::cast_slice_mut::<u32, u8>(&mut copy.words)[bit / 8] ^= 1 << (bit % 8);
                };
                flip(&mut copy);
                assert!(Package::decode(copy.bytes()).is_err(), "{format:?}: bit {bit}");
                flip(&mut copy);
            }
            let whole = copy.length;
            for length in 0..whole {
                copy.length = length;
                // Without its signature, a signed package of format 1 equals the unsigned one.
                assert_eq!(Package::decode(copy.bytes()).is_ok(), length == unsigned.length);
            }
        }
    }
}

#[test]
fn an_unchanged_package_is_decoded_without_its_checksums() {
    let content = Content::new();
    for format in FORMATS {
        let unsigned = encoded(format, &content.package());
        let signed = with_signature(unsigned.bytes(), [0x5a; 64]);
        for bytes in [unsigned.bytes(), &signed] {
            let copy = Aligned::new(bytes);
            let decoded = Package::decode(copy.bytes()).map(without_origin);
            assert_eq!(Package::decode_unchanged(copy.bytes()), decoded);
            let mut damaged = bytes.to_vec();
            // The header's checksum and the signature's.
            let (header, signature) = match format {
                Format::One => (8, bytes.len() - 1),
                Format::Two => (HEADER2_LENGTH - 1, CHECKED_FIRST - 1),
            };
            damaged[header] ^= 1;
            damaged[signature] ^= 1;
            let damaged = Aligned::new(&damaged);
            assert_eq!(Package::decode(damaged.bytes()), Err(PackageError::Checksum));
            if bytes == signed {
                let decoded = Package::decode_unchanged(damaged.bytes());
                assert_eq!(decoded, Ok(without_origin(content.package())));
            }
            // Everything else is still refused.
            let cut = Aligned::new(&bytes[..bytes.len() - 1]);
            let refused = Package::decode_unchanged(cut.bytes());
            assert!(matches!(refused, Err(PackageError::Length { .. })));
        }
    }
}

#[test]
fn a_package_is_found_at_the_start_of_a_slot() {
    for format in FORMATS {
        let unsigned = encoded(format, &Content::new().package());
        let signed = with_signature(unsigned.bytes(), [0x5a; 64]);
        for (package, rest) in [(unsigned.bytes(), 0xff), (&signed, 0xff), (unsigned.bytes(), 0)] {
            for spare in [0, 1, 67, 500] {
                let slot = [package, &vec![rest; spare]].concat();
                assert_eq!(Envelope::length_in(&slot), Some(package.len()));
            }
            assert_eq!(Envelope::length_in(&package[..package.len() / 2]), None);
        }
    }
    assert_eq!(Envelope::length_in(&[0xff; 400]), None);
    assert_eq!(Envelope::length_in(&[]), None);
}

#[test]
fn numbers_are_aligned_to_four_bytes() {
    for recipe in ["", "a", "ab", "abc", "abcd"] {
        let content = Content::new();
        let mut package = content.package();
        package.provenance.recipe = recipe;
        for format in FORMATS {
            let bytes = encoded(format, &package);
            let decoded = Package::decode(bytes.bytes()).unwrap();
            assert_eq!(decoded, package);
            // At any other address the words cannot be used in place.
            let shifted = Aligned::new(&[&[0], bytes.bytes()].concat());
            assert_eq!(Package::decode(&shifted.bytes()[1..]), Err(PackageError::Alignment));
        }
    }
}

/// Returns the header of a package with this `body`.
pub(crate) fn header_of(body: &[u8]) -> [u8; HEADER_LENGTH] {
    envelope::header(body).unwrap()
}

/// Returns `package` with its body changed and a matching checksum.
fn resealed(package: &Package<'_>, change: impl FnOnce(&mut Vec<u8>)) -> Aligned {
    let mut body = Envelope::open(encoded(Format::One, package).bytes()).unwrap().body.to_vec();
    change(&mut body);
    Aligned::new(&[&envelope::header(&body).unwrap()[..], &body].concat())
}

#[test]
fn each_defect_of_the_bytes_has_its_own_error() {
    let content = Content::new();
    let package = content.package();
    let bytes = encoded(Format::One, &package).bytes().to_vec();
    let decode = |change: &dyn Fn(&mut Vec<u8>)| {
        let mut bytes = bytes.clone();
        change(&mut bytes);
        Package::decode(Aligned::new(&bytes).bytes()).map(|p| p.version).unwrap_err()
    };
    let length = |expected, found| PackageError::Length { expected, found };
    assert_eq!(decode(&|b| b.truncate(11)), length(12, 11));
    assert_eq!(decode(&|b| b[0] = b'o'), PackageError::Magic);
    assert_eq!(decode(&|b| b[3] = 9), PackageError::FormatVersion { found: 9 });
    assert_eq!(decode(&|b| b.push(0)), length(bytes.len(), bytes.len() + 1));
    assert_eq!(decode(&|b| b[20] ^= 1), PackageError::Checksum);
    assert_eq!(decode(&|b| b.extend([0; 68])), PackageError::SignatureChecksum);
    let body = |change: &dyn Fn(&mut Vec<u8>)| {
        Package::decode(resealed(&package, change).bytes()).map(|p| p.version).unwrap_err()
    };
    assert_eq!(body(&|b| b.clear()), PackageError::Malformed);
    assert_eq!(body(&|b| b[3] = 2), PackageError::Malformed); // not a variant of OnSwitch
    assert_eq!(body(&|b| b.push(0)), PackageError::Malformed);
    // Version 5, encoded with a superfluous byte that replaces one of the padding.
    let longer = |b: &mut Vec<u8>| {
        b[0] = 0x85;
        b.insert(1, 0);
        b.splice(b.len()..b.len(), [0; 3]);
    };
    assert_eq!(body(&longer), PackageError::Malformed);
    let network = |error| PackageError::Network(error);
    assert_eq!(body(&|b| b[4] = 13), network(NetworkError::Inputs { found: 13 }));
    assert_eq!(body(&|b| b[6] = 65), network(NetworkError::Width { layer: 0, found: 65 }));
    assert_eq!(body(&|b| b[8] = 3), PackageError::Outputs { found: 3 });
    assert_eq!(body(&|b| b[17] = 9), PackageError::TestVectors { found: 9 });
    let count = body(&|b| b.extend([0; 4]));
    assert!(
        matches!(count, PackageError::NumberCount { expected, found } if found == expected + 1)
    );
    let not_finite = body(&|b| {
        let end = b.len();
        b[end - 4..].copy_from_slice(&f32::NAN.to_le_bytes());
    });
    assert!(matches!(not_finite, PackageError::NotFinite { .. }));
    for (training, test) in [(f32::NAN, 0.5), (0.5, f32::INFINITY)] {
        let mut package = package.clone();
        package.provenance.errors = Some(TrainingErrors { training, held_out: test });
        for format in FORMATS {
            let error = Package::decode(encoded(format, &package).bytes()).map(|p| p.version);
            assert_eq!(error, Err(PackageError::TrainingErrorNotFinite));
        }
    }
}

#[test]
fn each_defect_of_the_content_has_its_own_refusal() {
    let content = Content::new();
    let package = content.package();
    assert_eq!(refusal(&Package { test_vectors: &[], ..package.clone() }), Refusal::NoTestVectors);
    let asymmetric = Content { gain: [50.0, 1.0, 1.5, 60.0], ..content.clone() };
    assert_eq!(
        refusal(&asymmetric.package()),
        Refusal::Parameter(ParameterError::NotSymmetric {
            parameter: "observer.gain",
            row: 1,
            column: 0
        })
    );
    let empty = Content { low: [-1.0, 2.5], ..content.clone() };
    assert_eq!(refusal(&empty.package()), Refusal::EmptyBox { component: 1 });
    let unordered = Content { neighbours: [265, 3], ..content.clone() };
    assert_eq!(refusal(&unordered.package()), Refusal::NeighbourOrder { id: 3 });
    let twice = Content { neighbours: [3, 3], ..content.clone() };
    assert_eq!(refusal(&twice.package()), Refusal::NeighbourOrder { id: 3 });
    let own = Content { neighbours: [3, 7], ..content.clone() };
    let own_neighbour = ParameterError::OwnNeighbour { id: 7 };
    assert_eq!(refusal(&own.package()), Refusal::Parameter(own_neighbour));
    let far = Content { outer_weights: [9.0; 6], ..content.clone() };
    assert!(matches!(refusal(&far.package()), Refusal::Parameter(_)));
    let weightless = Content { edge_weights: [1.0, 0.0], ..content.clone() };
    assert!(matches!(refusal(&weightless.package()), Refusal::Parameter(_)));
    let mut slow = package.clone();
    slow.node.step_size = 0.0;
    assert!(matches!(refusal(&slow), Refusal::Parameter(_)));
    let mut deaf = package.clone();
    deaf.node.trigger.threshold = 0.0;
    assert!(matches!(refusal(&deaf), Refusal::Parameter(_)));
    let negative = Package { broadcast_interval_min: -1.0, ..package.clone() };
    assert!(matches!(refusal(&negative), Refusal::Parameter(_)));
    let bytes = encoded(Format::Two, &package);
    let other = accept::<3>(bytes.bytes(), &ANY, &mut Scratch::NEW.clone()).unwrap_err();
    assert_eq!(other, Refusal::Dimension { expected: 3, found: 2 });
}

#[test]
fn a_node_refuses_what_its_buffers_cannot_hold() {
    let bytes = encoded(Format::Two, &Content::new().package());
    let fits = Capacity { features: 3, neighbours: 2, gain_entries: 1, known_inputs: 0 };
    let with = |capacity| {
        let requirements = Requirements { capacity, ..ANY };
        accept::<2>(bytes.bytes(), &requirements, &mut Scratch::NEW.clone()).map(|_| ())
    };
    assert_eq!(with(fits), Ok(()));
    for (capacity, what) in [
        (Capacity { features: 2, ..fits }, "features"),
        (Capacity { neighbours: 1, ..fits }, "neighbours"),
        (Capacity { gain_entries: 0, ..fits }, "gain entries"),
    ] {
        assert!(matches!(with(capacity), Err(Refusal::Capacity { what: w, .. }) if w == what));
    }
}

#[test]
fn an_older_package_or_one_for_another_agent_is_refused() {
    let content = Content::new();
    let offered = |package: &Package<'_>, format, agent, version| {
        let highest = Some(Serial { epoch: 0, version });
        let requirements = Requirements { agent: Some(agent), highest, ..ANY };
        accept::<2>(encoded(format, package).bytes(), &requirements, &mut Scratch::NEW.clone())
            .map(|p| p.version)
    };
    let package = content.package();
    let serial = |version| Serial { epoch: 0, version };
    let older = Err(Refusal::Older { highest: serial(6), found: serial(5) });
    for format in FORMATS {
        assert_eq!(offered(&package, format, 7, 4), Ok(5));
        let repeated = Err(Refusal::Repeated { serial: serial(5) });
        assert_eq!(offered(&package, format, 7, 5), repeated);
        assert_eq!(offered(&package, format, 7, 6), older);
        let other = Err(Refusal::Agent { expected: 8, found: 7 });
        assert_eq!(offered(&package, format, 8, 1), other);
    }
    // Without a signature, anyone could request the exception.
    let exception = Package { replaces: Some(9), ..package.clone() };
    assert_eq!(offered(&exception, Format::One, 7, 6), older);
    let back = Package { epoch: 1, ..package };
    assert_eq!(offered(&back, Format::Two, 7, 6), Ok(5));
}

#[test]
fn a_network_with_other_results_is_refused() {
    let mut content = Content::new();
    // One unit in the last place of one bias.
    content.inner[1] = f32::from_bits(content.inner[1].to_bits() + 1);
    assert_eq!(refusal(&content.package()), Refusal::TestVector { index: 0 });
    let mut content = Content::new();
    content.outer_weights[3] += 1e-3;
    assert_eq!(refusal(&content.package()), Refusal::TestVector { index: 0 });
    let mut content = Content::new();
    content.test_vectors[13] += 1e-3;
    assert_eq!(refusal(&content.package()), Refusal::TestVector { index: 1 });
}

#[test]
fn parameters_survive_the_round_trip() {
    let content = Content::new();
    let package = content.package();
    let (mut neighbours, mut gain) = ([Neighbour { id: 0, weight: 1.0 }; 4], [0.0; 9]);
    let params = package.node.params::<2>(&mut neighbours, &mut gain).unwrap();
    assert_eq!((params.id(), params.step_size(), params.outputs()), (7, 1e-3, 1));
    assert_eq!(params.gain().as_slice(), content.gain);
    assert_eq!(params.neighbours().len(), 2);
    assert!(package.node.params::<2>(&mut [], &mut [0.0; 9]).is_err());
    assert!(package.node.params::<2>(&mut neighbours, &mut []).is_err());
    assert!(package.node.params::<3>(&mut neighbours, &mut [0.0; 9]).is_err());
}

#[test]
fn an_agent_switches_to_another_package() {
    let places = || ([Neighbour { id: 0, weight: 1.0 }; 2], [0.0; 1]);
    let content = Content::new();
    let package = content.package();
    let (mut neighbours, mut gain) = places();
    let old = package.node.params::<2>(&mut neighbours, &mut gain).unwrap();
    let start = StateVector::<2>::new(0.5, -0.5);
    let mut state =
        AgentState::<2, 3, _>::new(&old, start, package.outer_weights, [None; 2]).unwrap();
    let mut inbox = Inbox::<2, _>::new([None; 2]);
    let from = |sender, sequence| Frame::<2>::new(sender, sequence, 0, [1.0, 2.0].into()).encode();
    for sender in [3, 265] {
        inbox.accept(old.neighbours(), &from(sender, 0)).unwrap();
    }
    state.step(&old, Some(&package.network), 0, &[0.4], &mut inbox).unwrap();
    inbox.accept(old.neighbours(), &from(3, 1)).unwrap();
    let (estimate, adapted) = (*state.estimate(), state.outer_weights().rows().to_vec());

    // Neighbour 4 replaces neighbour 3.
    let other = Content { neighbours: [4, 265], ..content.clone() };
    let mut other = other.package();
    let (mut neighbours, mut gain) = places();
    let new = other.node.params::<2>(&mut neighbours, &mut gain).unwrap();
    state.switch(old.neighbours(), &new, &other, &mut inbox).unwrap();
    assert!(state.neighbour_holds()[0].is_none() && state.neighbour_holds()[1].is_some());
    assert!(inbox.is_empty());
    assert_eq!((*state.estimate(), state.outer_weights().rows()), (estimate, &adapted[..]));
    other.outer_weights_on_switch = OnSwitch::Replace;
    state.switch(new.neighbours(), &new, &other, &mut inbox).unwrap();
    assert_eq!(state.outer_weights().rows()[2].as_slice(), &content.outer_weights[4..]);
    state.step(&new, Some(&other.network), 1, &[0.4], &mut inbox).unwrap();

    // The slots do not match a different number of neighbours.
    let one = Content { neighbours: [3, 265], ..content.clone() };
    let mut one = one.package();
    one.node.neighbours = NeighbourIds::new(&[3]);
    one.node.edge_weights = &[1.0];
    let (mut neighbours, mut gain) = places();
    let fewer = one.node.params::<2>(&mut neighbours, &mut gain).unwrap();
    let before = state.clone();
    assert!(state.switch(new.neighbours(), &fewer, &one, &mut inbox).is_err());
    assert_eq!(state.neighbour_holds(), before.neighbour_holds());
}

#[test]
fn the_specification_shows_the_same_bytes() {
    let specification = include_str!("../../../docs/format.md");
    let examples = specification.split("```text\n0000").skip(1);
    let shown: Vec<Vec<u8>> = examples.map(bytes_shown).collect();
    let content = Content::new();
    let mut package = content.package();
    package.trial = Some(example_limits());
    let found = [(Format::Two, &package), (Format::One, &content.package())];
    let found = found.map(|(format, package)| encoded(format, package).bytes().to_vec());
    for (shown, found) in shown.iter().zip(&found) {
        assert_eq!(shown, found);
    }
    assert_eq!(shown.len(), found.len());
}

/// Returns the bytes of an annotated dump, of which the first offset has been removed.
fn bytes_shown(example: &str) -> Vec<u8> {
    let (example, _) = example.split_once("```").unwrap();
    let mut shown = Vec::new();
    for line in std::format!("0000{example}").lines() {
        let (offset, rest) = line.split_once("  ").unwrap();
        assert_eq!(usize::from_str_radix(offset, 16), Ok(shown.len()), "{line}");
        let (bytes, _) = rest.split_once("  ").unwrap();
        shown.extend(bytes.split(' ').map(|byte| u8::from_str_radix(byte, 16).unwrap()));
    }
    shown
}

/// The limits of the trial in the specification's example.
pub(crate) fn example_limits() -> TrialLimits {
    TrialLimits {
        innovation_rms: Some(0.25),
        broadcasts_per_second: Some(40.0),
        restarts: Some(0),
        ..TrialLimits::NONE
    }
}

#[test]
fn a_network_is_located_in_its_package() {
    for format in FORMATS {
        let bytes = encoded(format, &Content::new().package());
        let package = Package::decode(bytes.bytes()).unwrap();
        let place = NetworkPlace::new(&package, bytes.bytes()).unwrap();
        assert_eq!(place.network(bytes.bytes()).unwrap(), package.network);
        assert_eq!(place.outer_weights(bytes.bytes()), Some(package.outer_weights));
        assert_eq!(place.network(&bytes.bytes()[..80]), None);
        // Other bytes do not contain the package.
        assert_eq!(NetworkPlace::new(&package, &[]), None);
    }
}

proptest! {
    #[test]
    fn arbitrary_bytes_are_a_package_or_an_error(
        body in prop::collection::vec(any::<u8>(), 0..300),
        place in 0usize..80, byte: u8,
    ) {
        // Raw, under a matching header, and a package with one byte changed.
        let headed = [&envelope::header(&body).unwrap()[..], &body].concat();
        let content = Content::new();
        let changed = resealed(&content.package(), |b| b[place] = byte);
        for bytes in [&Aligned::new(&body), &Aligned::new(&headed), &changed] {
            if let Ok(package) = Package::decode(bytes.bytes()) {
                prop_assert!(package.outer_weights.iter().all(|w| w.is_finite()));
                let _ = accept::<2>(bytes.bytes(), &ANY, &mut Scratch::NEW.clone());
            }
        }
    }
}
