//! Tests of what is new in format 2: header, sections, and what a node refuses early.

extern crate std;

use std::vec::Vec;

use proptest::prelude::*;

use super::header::digest;
use super::sections::{REQUIRED, kind};
use super::tests::{
    ANY, Aligned, Content, encoded, example_limits, refusal, with_signature, without_origin,
};
use super::*;
use crate::math::parameter::ParameterError;
use crate::observer::network::{Architecture, NetworkError, Scratch};
use crate::wire::crc::crc32;

fn bytes_of(package: &Package<'_>) -> Vec<u8> {
    encoded(Format::Two, package).bytes().to_vec()
}

/// Returns the package with header fields that match its sections again.
pub(super) fn resealed(mut bytes: Vec<u8>) -> Aligned {
    let sections = bytes[CHECKED_FIRST..].to_vec();
    let length = bytes.len() as u32;
    bytes[16..20].copy_from_slice(&length.to_le_bytes());
    bytes[48..52].copy_from_slice(&crc32(&[&sections]).to_le_bytes());
    bytes[52..84].copy_from_slice(&digest(&sections));
    let sum = crc32(&[&bytes[..124]]);
    bytes[124..128].copy_from_slice(&sum.to_be_bytes());
    Aligned::new(&bytes)
}

/// Returns the sections of a package, each with its header and padding.
pub(super) fn sections(bytes: &[u8]) -> Vec<Vec<u8>> {
    let mut rest = &bytes[CHECKED_FIRST..];
    let mut all = Vec::new();
    while !rest.is_empty() {
        let length = u32::from_le_bytes(rest[4..8].try_into().unwrap()) as usize;
        let (section, after) = rest.split_at(8 + length.next_multiple_of(4));
        all.push(section.to_vec());
        rest = after;
    }
    all
}

pub(super) fn section(kind: u16, content: &[u8]) -> Vec<u8> {
    let mut bytes =
        [&kind.to_le_bytes()[..], &[0, 0], &(content.len() as u32).to_le_bytes()].concat();
    bytes.extend(content);
    bytes.resize(bytes.len().next_multiple_of(4), 0);
    bytes
}

/// Returns the package with other sections.
pub(super) fn with_sections(bytes: &[u8], sections: &[Vec<u8>]) -> Aligned {
    resealed([&bytes[..CHECKED_FIRST], &sections.concat()].concat())
}

fn verdict(bytes: &Aligned) -> Result<(), PackageError> {
    Package::decode(bytes.bytes()).map(|_| ())
}

#[test]
fn what_only_format_2_can_hold_survives_the_round_trip() {
    let content = Content::new();
    let mut package = content.package();
    package.epoch = 3;
    package.version = u32::MAX;
    package.node.agent = 70_000;
    package.node.neighbours = NeighbourIds::new(&[70_001, u32::MAX]);
    for trial in [None, Some(TrialLimits::NONE), Some(example_limits())] {
        package.trial = trial;
        let bytes = encoded(Format::Two, &package);
        assert_eq!(Package::decode(bytes.bytes()), Ok(package.clone()));
    }
    package.provenance = Provenance::NONE;
    let bytes = encoded(Format::Two, &package);
    assert_eq!(Package::decode(bytes.bytes()), Ok(package.clone()));
    assert_eq!(sections(bytes.bytes()).len(), 7);
    let mut buffer = [0; 1000];
    let mut first = |package: &Package<'_>| package.encode(Format::One, &mut buffer).unwrap_err();
    assert_eq!(first(&package), EncodeError::Epoch { epoch: 3 });
    package.epoch = 0;
    assert_eq!(first(&package), EncodeError::Agent { id: 70_001 });
    package.node.neighbours = NeighbourIds::new(&[1, 2]);
    assert_eq!(first(&package), EncodeError::Agent { id: 70_000 });
    package.replaces = Some(1);
    assert_eq!(package.encode(Format::Two, &mut buffer), Err(EncodeError::Replaces));
    for length in [0, 127, 195, 196, 300] {
        package.replaces = None;
        let short = package.encode(Format::Two, &mut buffer[..length]);
        assert_eq!(short, Err(EncodeError::Space), "{length}");
    }
}

/// Also without what a package may leave out, so that its last sections are empty.
#[test]
fn a_buffer_of_exactly_the_length_is_large_enough() {
    let content = Content::new();
    let whole = content.package();
    let mut bare = Package { provenance: Provenance::NONE, trial: None, ..whole.clone() };
    bare.test_vectors = &[];
    for (place, package) in [whole, bare].iter().enumerate() {
        for format in [Format::One, Format::Two] {
            let length = encoded(format, package).bytes().len();
            let mut room = [0x55; 1000];
            let buffer = &mut room[..length];
            assert_eq!(package.encode(format, buffer), Ok(length), "{place}");
            let short = package.encode(format, &mut buffer[..length - 1]);
            assert_eq!(short, Err(EncodeError::Space), "{place}");
        }
    }
}

/// Nodes tell packages apart by the CRC-32 of all of their bytes.
#[test]
fn packages_that_differ_in_their_header_only_have_different_checksums() {
    let content = Content::new();
    let bytes = bytes_of(&content.package());
    let mut found = Vec::new();
    for place in [4, 8, 12, 42] {
        let mut other = bytes.clone();
        other[place] ^= 1;
        found.push(crc32(&[resealed(other).bytes()]));
    }
    let mut renumbered = bytes.clone();
    set_serial(&mut renumbered, Serial { epoch: 1, version: 0 }).unwrap();
    found.extend([crc32(&[&renumbered]), crc32(&[&bytes])]);
    let count = found.len();
    found.sort_unstable();
    found.dedup();
    assert_eq!(found.len(), count);
}

#[test]
fn a_network_can_have_known_inputs_that_most_nodes_refuse() {
    let content = Content::new();
    let base = content.package();
    let layers = base.network.architecture().layers().to_vec();
    let architecture = Architecture::new(3, &layers).unwrap();
    let inner: Vec<f32> = (0..12).map(|k| 0.1 * k as f32 - 0.5).collect();
    let (low, high) = ([-1.0, -2.0, -9.0], [1.0, 2.0, 9.0]);
    let mut package = Package {
        network: InnerNetwork::new(architecture, &inner[..]).unwrap(),
        known_inputs: 1,
        trained_box: StateBox { low: &low, high: &high },
        test_vectors: &[],
        ..base
    };
    let mut scratch = Scratch::NEW;
    let input = [0.5, -0.25, 7.0];
    let (features, output) = package.evaluate::<2>(&input, &mut scratch).unwrap();
    let vectors = [&input[..], features, output.as_slice()].concat();
    package.test_vectors = &vectors;
    // Neither is the shape of the state.
    assert_eq!(package.evaluate::<2>(&input[..2], &mut scratch), None);
    assert_eq!(package.evaluate::<3>(&input, &mut scratch), None);

    let mut buffer = [0; 4096];
    assert_eq!(package.encode(Format::One, &mut buffer), Err(EncodeError::KnownInputs));
    let bytes = Aligned::new(&bytes_of(&package));
    let decoded = Package::decode(bytes.bytes()).unwrap();
    assert_eq!(decoded, package);
    assert_eq!((decoded.dimension(), decoded.trained_states().high), (2, &high[..2]));
    assert_eq!(decoded.test_vectors().map(|vector| vector.input).collect::<Vec<_>>(), [&input]);
    let place = NetworkPlace::new(&decoded, bytes.bytes()).unwrap();
    assert_eq!(place.outer_weights(bytes.bytes()), Some(package.outer_weights));

    let node = |known_inputs| Requirements {
        capacity: Capacity { known_inputs, ..Capacity::UNLIMITED },
        ..Requirements::ANY
    };
    let refusal = Refusal::Capacity { what: "known inputs", capacity: 0, found: 1 };
    let whole = |known| {
        let mut scratch = Scratch::NEW;
        accept::<2>(bytes.bytes(), &node(known), &mut scratch).map(|_| ())
    };
    let early = |known| accept_header::<2>(bytes.bytes(), &node(known)).map(|_| ());
    assert_eq!((whole(0), early(0)), (Err(refusal), Err(refusal)));
    assert_eq!((whole(1), early(1)), (Ok(()), Ok(())));
    let other = accept_header::<3>(bytes.bytes(), &node(1)).map(|_| ());
    assert_eq!(other, Err(Refusal::Dimension { expected: 3, found: 2 }));
}

#[test]
fn each_defect_of_the_header_is_refused() {
    let content = Content::new();
    let bytes = bytes_of(&content.package());
    let changed = |place: usize, value: u8| {
        let mut bytes = bytes.clone();
        bytes[place] = value;
        verdict(&resealed(bytes))
    };
    assert_eq!(changed(20, 2), Ok(()));
    let inputs = |inputs, dimension| Err(PackageError::Inputs { inputs, dimension });
    assert_eq!(changed(20, 3), inputs(2, 3));
    assert_eq!(changed(21, 1), inputs(1, 2));
    // Another known input needs more weights.
    assert!(matches!(changed(21, 3), Err(PackageError::SectionLength { kind: kind::INNER, .. })));
    let network = |error| Err(PackageError::Network(error));
    assert_eq!(changed(21, 13), network(NetworkError::Inputs { found: 13 }));
    assert_eq!(changed(22, 0), Err(PackageError::Outputs { found: 0 }));
    assert_eq!(changed(22, 3), Err(PackageError::Outputs { found: 3 }));
    assert_eq!(changed(23, 0), Err(PackageError::Malformed)); // a layer that is not counted
    assert_eq!(changed(23, 9), network(NetworkError::LayerCount { found: 9 }));
    assert_eq!(changed(23, 2), network(NetworkError::Width { layer: 1, found: 0 }));
    assert_eq!(changed(24, 65), network(NetworkError::Width { layer: 0, found: 65 }));
    assert_eq!(changed(25, 3), Err(PackageError::Malformed)); // an unknown activation
    assert_eq!(changed(26, 1), Err(PackageError::Malformed));
    assert_eq!(changed(42, 1), Ok(()));
    assert_eq!(changed(42, 2), Err(PackageError::Malformed)); // an unknown flag
    assert_eq!(changed(47, 0x7e), Ok(()));
    let mut infinite = bytes.clone();
    infinite[44..48].copy_from_slice(&f32::INFINITY.to_le_bytes());
    assert_eq!(verdict(&resealed(infinite)), Err(PackageError::NotFinite { index: 11 }));
    for place in (43..44).chain(84..124) {
        assert_eq!(changed(place, 1), Err(PackageError::Malformed), "reserved byte {place}");
    }
    for place in 40..42 {
        let refused = changed(place, 1);
        assert!(matches!(refused, Err(PackageError::SectionLength { .. })), "{refused:?}");
    }
    // The length and what it counts.
    let mut longer = bytes.clone();
    longer.extend([0; 4]);
    let (expected, found) = (bytes.len(), longer.len());
    let wrong = Err(PackageError::Length { expected, found });
    assert_eq!(verdict(&Aligned::new(&longer)), wrong);
    assert_eq!(verdict(&resealed(longer)), Err(PackageError::Malformed));
}

#[test]
fn sections_are_there_once_in_order_and_whole() {
    let content = Content::new();
    let bytes = bytes_of(&content.package());
    let original = sections(&bytes);
    assert_eq!(verdict(&with_sections(&bytes, &original)), Ok(()));
    let malformed = Err(PackageError::Malformed);
    for index in 0..original.len() {
        let mut missing = original.clone();
        let gone = missing.remove(index);
        let found = verdict(&with_sections(&bytes, &missing));
        match u16::from_le_bytes([gone[0], gone[1]]) {
            kind::PROVENANCE | kind::TEST_VECTORS => assert_eq!(found, Ok(())),
            kind => assert!(
                matches!(found, Err(PackageError::SectionLength { kind: k, found: 0, .. }) if k == kind),
                "section {index}: {found:?}"
            ),
        }
        let mut repeated = original.clone();
        repeated.insert(index, original[index].clone());
        assert_eq!(verdict(&with_sections(&bytes, &repeated)), malformed, "section {index}");
        for other in 0..index {
            let mut swapped = original.clone();
            swapped.swap(index, other);
            assert_eq!(verdict(&with_sections(&bytes, &swapped)), malformed);
        }
        // A word or a byte more or less than the header requires, and lengths beyond the end.
        let kind = u16::from_le_bytes([original[index][0], original[index][1]]);
        let stated = u32::from_le_bytes(original[index][4..8].try_into().unwrap()) as usize;
        let whole = &original[index][8..8 + stated];
        for resized in [
            &whole[..whole.len() - 4],
            &whole[..whole.len() - 1],
            &[whole, &[0; 4]].concat(),
            &[whole, &[0]].concat(),
            &[],
        ] {
            let mut changed = original.clone();
            changed[index] = section(kind, resized);
            let refused = verdict(&with_sections(&bytes, &changed));
            assert!(refused.is_err(), "section {index}, {} bytes", resized.len());
        }
        for length in [stated + 4, usize::from(u16::MAX), u32::MAX as usize] {
            let mut changed = original.clone();
            changed[index][4..8].copy_from_slice(&(length as u32).to_le_bytes());
            assert!(verdict(&with_sections(&bytes, &changed)).is_err(), "{index}: {length}");
        }
        let mut reserved = original.clone();
        reserved[index][2] = 1;
        assert_eq!(verdict(&with_sections(&bytes, &reserved)), malformed);
    }
}

#[test]
fn unknown_sections_are_skipped_unless_they_are_required() {
    let content = Content::new();
    let bytes = bytes_of(&content.package());
    let original = sections(&bytes);
    for (number, content_length) in [(11, 1), (300, 4), (0x7fff, 21)] {
        let content_bytes = std::vec![0xa5; content_length];
        let with = |kind| {
            let mut all = original.clone();
            all.push(section(kind, &content_bytes));
            with_sections(&bytes, &all)
        };
        let optional = with(number);
        assert_eq!(Package::decode(optional.bytes()), Ok(content.package()));
        // A node takes it, and its padding is zero like that of all others.
        let accepted = accept::<2>(optional.bytes(), &ANY, &mut Scratch::NEW.clone());
        assert_eq!(accepted, Ok(without_origin(content.package())));
        if content_length % 4 != 0 {
            let mut padded = optional.bytes().to_vec();
            *padded.last_mut().unwrap() = 1;
            assert_eq!(verdict(&resealed(padded)), Err(PackageError::Malformed));
        }
        let kind = REQUIRED | number;
        assert_eq!(verdict(&with(kind)), Err(PackageError::UnknownSection { kind }));
        let required = with(kind);
        let refused = accept::<2>(required.bytes(), &ANY, &mut Scratch::NEW.clone());
        assert_eq!(refused, Err(Refusal::Package(PackageError::UnknownSection { kind })));
    }
    // Section 0 does not exist.
    let mut all = original.clone();
    all.insert(0, section(0, &[1]));
    assert_eq!(verdict(&with_sections(&bytes, &all)), Err(PackageError::Malformed));
    // A known section with the wrong bit is another, unknown one.
    for index in 0..original.len() {
        let mut all = original.clone();
        all[index][1] ^= 0x80;
        let kind = u16::from_le_bytes([all[index][0], all[index][1]]);
        let refused = verdict(&with_sections(&bytes, &all));
        assert_eq!(refused, Err(PackageError::UnknownSection { kind }));
    }
}

#[cfg(feature = "exchange")]
#[test]
fn an_exchange_is_carried_by_format_2() {
    use crate::agent::exchange::ExchangeParams;

    let content = Content::new();
    let mut package = content.package();
    let plain = bytes_of(&package);
    package.node.exchange = ExchangeParams {
        heartbeat: 1,
        gap: 1,
        repeat: 3,
        fade_from: 4,
        fade_to: 5,
        delay: 6,
        smoothing: u32::MAX,
    };
    let bytes = bytes_of(&package);
    assert_eq!(bytes.len(), plain.len() + 8 + 7 * 4);
    let decoded = Aligned::new(&bytes);
    assert_eq!(Package::decode(decoded.bytes()), Ok(package.clone()));
    let accepted = accept::<2>(decoded.bytes(), &ANY, &mut Scratch::NEW.clone());
    assert_eq!(accepted, Ok(without_origin(package.clone())));
    let mut gain = [0.0; 9];
    let mut neighbours = [Neighbour { id: 0, weight: 0.0 }; 2];
    let params = package.node.params::<2>(&mut neighbours, &mut gain).unwrap();
    assert_eq!(*params.exchange(), package.node.exchange);
    let first = package.encode(Format::One, &mut [0; 1000]);
    assert_eq!(first, Err(EncodeError::Exchange));
    // One byte string for each content: the paper's exchange is left out.
    let kind = kind::EXCHANGE;
    let with = |words: &[u8]| {
        let mut all = sections(&plain);
        all.push(section(kind, words));
        verdict(&with_sections(&plain, &all))
    };
    assert_eq!(with(&[0; 28]), Err(PackageError::Malformed));
    assert_eq!(with(&[1; 27]), Err(PackageError::Malformed));
    let short = PackageError::SectionLength { kind, expected: 7, found: 6 };
    assert_eq!(with(&[1; 24]), Err(short));
    // A gap above the heartbeat, and a fading that ends before it begins.
    let refused = |package: &Package<'_>, parameter, value, expected| {
        let bytes = encoded(Format::Two, package);
        let found = accept::<2>(bytes.bytes(), &ANY, &mut Scratch::NEW.clone()).unwrap_err();
        let error = ParameterError::OutOfRange { parameter, value, expected };
        assert_eq!(found, Refusal::Parameter(error));
    };
    package.node.exchange.gap = 2;
    refused(&package, "exchange.gap", 2.0, "at most exchange.heartbeat");
    package.node.exchange = ExchangeParams { gap: 0, fade_from: 6, ..package.node.exchange };
    refused(&package, "exchange.fade_from", 6.0, "at most exchange.fade_to");
}

#[test]
fn there_is_one_byte_string_for_each_content() {
    let content = Content::new();
    let mut package = content.package();
    package.trial = Some(example_limits());
    package.provenance = Provenance::NONE;
    let bytes = bytes_of(&package);
    let original = sections(&bytes);
    // An unknown origin is written as no section.
    let mut explicit = original.clone();
    let mut room = [0; 40];
    let origin = postcard::to_slice(&Provenance::NONE, &mut room).unwrap();
    explicit.push(section(kind::PROVENANCE, origin));
    assert_eq!(verdict(&with_sections(&bytes, &explicit)), Err(PackageError::Malformed));
    // A limit of 0 restarts, written with a superfluous byte.
    let limits = &original[6];
    assert_eq!(u16::from_le_bytes([limits[0], limits[1]]), kind::TRIAL);
    let length = u32::from_le_bytes(limits[4..8].try_into().unwrap()) as usize;
    let mut overlong = limits[8..8 + length].to_vec();
    let restarts = overlong.len() - 3;
    assert_eq!(overlong[restarts..], [0, 0, 0]);
    overlong[restarts] = 0x80;
    overlong.insert(restarts + 1, 0);
    let mut all = original.clone();
    all[6] = section(kind::TRIAL, &overlong);
    assert_eq!(verdict(&with_sections(&bytes, &all)), Err(PackageError::Malformed));
}

#[test]
fn numbers_that_are_not_finite_are_refused_wherever_they_are() {
    let content = Content::new();
    let mut package = content.package();
    package.trial = Some(example_limits());
    let bytes = bytes_of(&package);
    let original = sections(&bytes);
    for number in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        for (index, words) in [(0, 0..9), (1, 0..6), (2, 1..10), (3, 0..7), (4, 0..4), (5, 0..14)] {
            for word in words {
                let mut all = original.clone();
                all[index][8 + 4 * word..][..4].copy_from_slice(&number.to_le_bytes());
                let refused = verdict(&with_sections(&bytes, &all));
                let not_finite = matches!(refused, Err(PackageError::SectionNotFinite { .. }));
                assert!(not_finite, "section {index}, word {word}: {refused:?}");
            }
        }
        for limits in [
            TrialLimits { innovation_rms: Some(number), ..TrialLimits::NONE },
            TrialLimits { broadcasts_per_second: Some(number), ..TrialLimits::NONE },
        ] {
            package.trial = Some(limits);
            let refused = verdict(&encoded(Format::Two, &package));
            assert_eq!(refused, Err(PackageError::TrialLimitNotFinite));
        }
    }
}

#[test]
fn harmful_parameters_are_refused() {
    let content = Content::new();
    let package = content.package();
    let out = |parameter, value, expected| {
        Refusal::Parameter(ParameterError::OutOfRange { parameter, value, expected })
    };
    let blind = |output_matrix| {
        let node = AgentConfig { output_matrix, ..package.node };
        Package { node, ..package.clone() }
    };
    let row = out("output_matrix", 0.0, "an entry other than 0 in every row");
    assert_eq!(refusal(&blind(&[0.0, 0.0])), row);
    assert_eq!(refusal(&blind(&[0.0, -0.0])), row);
    assert_eq!(refusal(&blind(&[1.0, 0.0, 0.0, 0.0])), row);
    let above = |value| out("observer.gain", value, "a finite number above 0");
    for entry in [0.0, -0.0, -500.0, -1e-40] {
        let (diagonal, full) = ([50.0, entry], [50.0, 1.0, 1.0, entry]);
        for gain in [
            SymmetricMatrix::Scalar(entry),
            SymmetricMatrix::Diagonal(&diagonal),
            SymmetricMatrix::Full(&full),
        ] {
            let node = AgentConfig { gain, ..package.node };
            assert_eq!(refusal(&Package { node, ..package.clone() }), above(entry));
        }
    }
    for (limits, parameter) in [
        (TrialLimits { innovation_rms: Some(-1.0), ..TrialLimits::NONE }, "trial.innovation_rms"),
        (
            TrialLimits { broadcasts_per_second: Some(-1.0), ..TrialLimits::NONE },
            "trial.broadcasts_per_second",
        ),
    ] {
        let package = Package { trial: Some(limits), ..package.clone() };
        let bytes = encoded(Format::Two, &package);
        let refused = accept::<2>(bytes.bytes(), &ANY, &mut Scratch::NEW.clone()).unwrap_err();
        assert_eq!(refused, out(parameter, -1.0, "a finite number, 0 or above"));
    }
}

#[test]
fn a_step_beyond_the_boards_range_is_refused() {
    let content = Content::new();
    let node = Requirements { step_range: StepRange::DEFAULT, ..ANY };
    let verdict = |format, step_size| {
        let mut package = content.package();
        package.node.step_size = step_size;
        let bytes = encoded(format, &package);
        let early = accept_header::<2>(bytes.bytes(), &node).map(|_| ());
        let accepted = accept::<2>(bytes.bytes(), &node, &mut Scratch::NEW.clone()).map(|_| ());
        if format == Format::Two {
            assert_eq!(early, accepted);
        }
        accepted
    };
    for format in [Format::One, Format::Two] {
        for step in [1e-6, 1e-3, 10.0] {
            assert_eq!(verdict(format, step), Ok(()));
        }
        for step in [1e-45, 9.9e-7, 10.01, f32::MAX] {
            let range = StepRange::DEFAULT;
            assert_eq!(verdict(format, step), Err(Refusal::Step { range, found: step }));
        }
        assert!(matches!(verdict(format, -1e-3), Err(Refusal::Parameter(_))));
    }
}

#[test]
fn the_first_bytes_tell_whether_a_package_is_for_this_node() {
    let content = Content::new();
    let package = Package { epoch: 2, ..content.package() };
    let bytes = bytes_of(&package);
    let first = &bytes[..CHECKED_FIRST];
    let accepted = accept_header::<2>(first, &ANY).unwrap().unwrap();
    assert_eq!((accepted.agent, accepted.length), (7, bytes.len() as u32));
    assert_eq!(accepted.serial, Serial { epoch: 2, version: 5 });
    assert_eq!((accepted.outputs, accepted.neighbours, accepted.step_size), (1, 2, 1e-3));
    let with = |requirements| accept_header::<2>(first, &requirements).map(|_| ());
    let highest = Serial { epoch: 2, version: 6 };
    let older = Refusal::Older { highest, found: package.serial() };
    assert_eq!(with(Requirements { highest: Some(highest), ..ANY }), Err(older));
    let repeated = Refusal::Repeated { serial: package.serial() };
    let highest = Some(package.serial());
    assert_eq!(with(Requirements { highest, ..ANY }), Err(repeated));
    let agent = Refusal::Agent { expected: 8, found: 7 };
    assert_eq!(with(Requirements { agent: Some(8), ..ANY }), Err(agent));
    let capacity = Capacity { neighbours: 1, ..Capacity::UNLIMITED };
    assert!(matches!(
        with(Requirements { capacity, ..ANY }),
        Err(Refusal::Capacity { capacity: 1, found: 2, .. })
    ));
    let dimension = Refusal::Dimension { expected: 3, found: 2 };
    assert_eq!(accept_header::<3>(first, &ANY), Err(dimension));
    for length in 0..CHECKED_FIRST {
        let refused = accept_header::<2>(&first[..length], &ANY);
        assert!(matches!(refused, Err(Refusal::Package(PackageError::Length { .. }))));
    }
    for bit in 0..8 * CHECKED_FIRST {
        let mut changed = first.to_vec();
        changed[bit / 8] ^= 1 << (bit % 8);
        let refused = accept_header::<2>(&changed, &ANY);
        assert!(matches!(refused, Err(Refusal::Package(_))), "bit {bit}: {refused:?}");
    }
    // Of format 1 nothing is known yet.
    let old = encoded(Format::One, &content.package());
    assert_eq!(accept_header::<2>(old.bytes(), &ANY), Ok(None));
}

#[test]
fn another_serial_changes_only_header_and_signature() {
    let content = Content::new();
    let mut package = content.package();
    package.trial = Some(example_limits());
    let signed = with_signature(&bytes_of(&package), [0x5a; 64]);
    let mut bytes = signed.clone();
    set_serial(&mut bytes, Serial { epoch: 4, version: 1 }).unwrap();
    (package.epoch, package.version) = (4, 1);
    assert_eq!(bytes, bytes_of(&package));
    assert!(set_serial(&mut bytes[..100], Serial { epoch: 4, version: 1 }).is_err());
}

#[cfg(feature = "signature")]
mod signed {
    use ed25519_dalek::{Signer, SigningKey};

    use super::*;
    use crate::package::signature::PublicKey;

    #[test]
    fn a_signature_covers_the_header_and_by_it_everything() {
        let signer = SigningKey::from_bytes(&[3; 32]);
        let key = PublicKey::from_bytes(signer.verifying_key().as_bytes()).unwrap();
        let node = Requirements { public_keys: &[key], ..ANY };
        let content = Content::new();
        let unsigned = bytes_of(&content.package());
        let signature = signer.sign(&unsigned[..HEADER2_LENGTH]).to_bytes();
        let signed = with_signature(&unsigned, signature);
        let early = |bytes: &[u8]| accept_header::<2>(&bytes[..CHECKED_FIRST], &node).map(|_| ());
        let full = |bytes: &[u8]| {
            let bytes = Aligned::new(bytes);
            accept::<2>(bytes.bytes(), &node, &mut Scratch::NEW.clone()).map(|_| ())
        };
        assert_eq!((early(&signed), full(&signed)), (Ok(()), Ok(())));
        let refused = Err(Refusal::Unsigned);
        assert_eq!((early(&unsigned), full(&unsigned)), (refused, refused));
        // Another epoch under the old signature, and a signature by another key.
        let mut moved = unsigned.clone();
        set_serial(&mut moved, Serial { epoch: 1, version: 5 }).unwrap();
        let stranger = SigningKey::from_bytes(&[4; 32]).sign(&unsigned[..HEADER2_LENGTH]);
        for forged in
            [with_signature(&moved, signature), with_signature(&unsigned, stranger.to_bytes())]
        {
            let refused = Err(Refusal::Signature);
            assert_eq!((early(&forged), full(&forged)), (refused, refused));
        }
        // Other content of the same checksum under the signed header: only the digest tells.
        let mut other = signed.clone();
        let place = CHECKED_FIRST + 8;
        other[place] ^= 1;
        let wanted = crc32(&[&signed[CHECKED_FIRST..]]);
        let tail = other.len() - 4;
        forge_checksum(&mut other[CHECKED_FIRST..], tail - CHECKED_FIRST, wanted);
        assert_eq!(crc32(&[&other[CHECKED_FIRST..]]), wanted);
        assert_eq!(early(&other), Ok(()));
        assert_eq!(full(&other), Err(Refusal::Package(PackageError::Digest)));
    }

    /// Changes the four bytes at `place` so that the checksum of `bytes` becomes `wanted`: the
    /// checksum is affine in them, so 32 trials and an elimination give them.
    fn forge_checksum(bytes: &mut [u8], place: usize, wanted: u32) {
        let sum_with = |bytes: &mut [u8], word: u32| {
            bytes[place..place + 4].copy_from_slice(&word.to_le_bytes());
            crc32(&[bytes])
        };
        let base = sum_with(bytes, 0);
        let mut rows: Vec<(u32, u32)> =
            (0..32).map(|bit| (sum_with(bytes, 1 << bit) ^ base, 1 << bit)).collect();
        let (mut missing, mut word) = (base ^ wanted, 0);
        for bit in 0..32 {
            let Some(pivot) = rows.iter().position(|(sum, _)| sum >> bit & 1 == 1) else {
                continue;
            };
            let (sum, source) = rows.swap_remove(pivot);
            for row in &mut rows {
                if row.0 >> bit & 1 == 1 {
                    *row = (row.0 ^ sum, row.1 ^ source);
                }
            }
            if missing >> bit & 1 == 1 {
                (missing, word) = (missing ^ sum, word ^ source);
            }
        }
        assert_eq!(sum_with(bytes, word), wanted);
    }
}

proptest! {
    #[test]
    fn arbitrary_sections_are_a_package_or_an_error(
        body in prop::collection::vec(any::<u8>(), 0..300),
        place in 0usize..1000, byte: u8,
    ) {
        let content = Content::new();
        let mut package = content.package();
        package.trial = Some(example_limits());
        let bytes = bytes_of(&package);
        let mut changed = bytes.clone();
        let place = place % bytes.len();
        changed[place] = byte;
        let foreign = [&bytes[..CHECKED_FIRST], &body].concat();
        for bytes in [Aligned::new(&body), resealed(foreign), resealed(changed)] {
            let _ = accept_header::<2>(bytes.bytes(), &ANY);
            if let Ok(package) = Package::decode(bytes.bytes()) {
                // One byte string for each content, unless there are unknown sections.
                let again = bytes_of(&package);
                let unknown = sections(bytes.bytes()).len() > sections(&again).len();
                let unsigned = Envelope::open(bytes.bytes()).unwrap().signature.is_none();
                prop_assert!(unknown || !unsigned || again == bytes.bytes());
                let _ = accept::<2>(bytes.bytes(), &ANY, &mut Scratch::NEW.clone());
            }
        }
    }
}
