//! Fuzzes weight packages of both formats: `Package::decode`, `Package::encode`, `accept` and
//! `accept_header`.
//!
//! The input is a package. It is tried unchanged, with header and checksums corrected and, if that
//! decodes, with correct test vectors, which passes the last check of `accept`.
#![no_main]

use agent_core::StateVector;
use agent_core::agent::inbox::Inbox;
use agent_core::agent::{AgentState, StepError};
use agent_core::math::numeric::all_finite;
use agent_core::observer::feedback::Neighbour;
use agent_core::observer::network::{LAYER_WIDTH_MAX, Scratch};
use agent_core::package::{
    CHECKED_FIRST, Capacity, Envelope, Format, HEADER2_LENGTH, Header, NetworkPlace, Package,
    PackageError, Provenance, Refusal, Requirements, SIGNATURE_BLOCK_LENGTH, Serial, accept,
    accept_header, set_serial, signature_block,
};
use fuzz::{Aligned, correct_package};
use libfuzzer_sys::fuzz_target;

const ANY: Requirements<'static> = Requirements::ANY;

fuzz_target!(|data: &[u8]| {
    let mut bytes = Aligned::new(data);
    check_all(&bytes);
    correct_package(bytes.bytes_mut());
    check_all(&bytes);
});

fn check_all(bytes: &Aligned) {
    let bytes = bytes.bytes();
    // A node does not look at the origin.
    let seen = Envelope::open(bytes).and_then(|envelope| Package::without_origin(&envelope));
    let is_of_origin =
        |error| matches!(error, PackageError::Malformed | PackageError::TrainingErrorNotFinite);
    match (Package::decode(bytes), &seen) {
        (Ok(package), Ok(_)) => check_package(&package, bytes),
        (Err(error), Ok(_)) => assert!(is_of_origin(error), "{error:?}"),
        (Err(error), Err(seen)) => assert!(error == *seen || is_of_origin(error), "{error:?}"),
        (Ok(_), Err(seen)) => panic!("decodes, but not without its origin: {seen:?}"),
    }
    match seen {
        Ok(package) => {
            check_acceptance::<1>(bytes, &package);
            check_acceptance::<2>(bytes, &package);
            check_acceptance::<3>(bytes, &package);
            check_acceptance::<4>(bytes, &package);
            check_acceptance::<12>(bytes, &package);
        }
        Err(error) => {
            assert_eq!(judge::<2>(bytes, &ANY).unwrap_err(), Refusal::Package(error));
        }
    }
}

/// Checks the properties of every package that decodes from `bytes`.
fn check_package(package: &Package<'_>, bytes: &[u8]) {
    let numbers = [
        package.network.parameters(),
        package.outer_weights,
        package.node.output_matrix,
        package.node.gain.entries(),
        package.node.edge_weights,
        package.node.outer_law.gain.entries(),
        package.trained_box.low,
        package.trained_box.high,
        package.test_vectors,
        &[package.node.step_size, package.broadcast_interval_min],
    ];
    assert!(numbers.iter().all(|numbers| numbers.iter().all(|number| number.is_finite())));
    if let Some(errors) = package.provenance.errors {
        assert!(errors.is_finite());
    }
    let (n, features) = (package.dimension(), package.features());
    let inputs = package.network.architecture().inputs();
    assert_eq!(inputs, n + package.known_inputs);
    assert_eq!(package.outer_weights.len(), n * features);
    assert_eq!(package.node.output_matrix.len(), n * package.node.outputs(n));
    assert_eq!(package.node.edge_weights.len(), package.node.neighbours().count());
    assert_eq!(
        package.test_vectors.len(),
        package.test_vectors().count() * (inputs + features + n)
    );
    assert_eq!(package.trained_box.low.len(), inputs);

    let place = NetworkPlace::new(package, bytes).expect("it was decoded from there");
    assert_eq!(place.network(bytes).as_ref(), Some(&package.network));

    // The encoded package decodes to the same package and encodes to the same bytes. Except for a
    // signature, and sections that this version skips, they equal the input, because each package has
    // exactly one encoding.
    let format = Format::of(bytes).expect("it was decoded from there");
    let mut written = Aligned::new(&vec![0xaa; bytes.len()]);
    let length = package.encode(format, written.bytes_mut()).expect("no longer than before");
    let written = Aligned::new(&written.bytes()[..length]);
    match format {
        Format::One => assert!(bytes.starts_with(written.bytes())),
        // The digest is not compared here, nor the checksum of the header above it.
        Format::Two if length == bytes.len() => {
            assert_eq!(bytes[..52], written.bytes()[..52]);
            assert_eq!(bytes[84..124], written.bytes()[84..124]);
            assert_eq!(bytes[CHECKED_FIRST..], written.bytes()[CHECKED_FIRST..]);
        }
        Format::Two => assert!(length < bytes.len()),
    }
    let decoded = Package::decode(written.bytes());
    assert_eq!(decoded.as_ref(), Ok(package));
    let without_origin = Package { provenance: Provenance::NONE, ..package.clone() };
    assert_eq!(Package::decode_unchanged(bytes), Ok(without_origin));
    let mut again = vec![0x55; length];
    assert_eq!(package.encode(format, &mut again), Ok(length));
    assert_eq!(again, written.bytes());
    assert!(package.encode(format, &mut vec![0; length - 1]).is_err());

    // Nothing but a signature may follow, and nothing may be missing.
    let block = signature_block(&[0x5a; 64]);
    let mut signed = again.clone();
    match format {
        Format::One => signed.extend(block),
        Format::Two => signed[HEADER2_LENGTH..CHECKED_FIRST].copy_from_slice(&block),
    }
    let signed = Aligned::new(&signed);
    assert_eq!(Package::decode(signed.bytes()).as_ref(), Ok(package));
    for cut in [1, 4, SIGNATURE_BLOCK_LENGTH - 1] {
        let cut = &signed.bytes()[..signed.bytes().len() - cut];
        assert!(matches!(Package::decode(cut), Err(PackageError::Length { .. })));
    }
    // The start tells the same as the whole.
    if format == Format::Two {
        let header = accept_of_any_dimension(&bytes[..CHECKED_FIRST], package.dimension());
        assert_eq!(header.agent, package.node.agent);
        assert_eq!(header.serial, package.serial());
        assert_eq!(header.step_size, package.node.step_size);
        let mut moved = Aligned::new(bytes);
        let serial = Serial { epoch: 1, version: 2 };
        set_serial(moved.bytes_mut(), serial).expect("a valid header");
        let moved = Package::decode(moved.bytes()).expect("only the serial changed");
        assert_eq!(moved, Package { epoch: 1, version: 2, ..package.clone() });
    }
    // At any other address the numbers cannot be used in place.
    let shifted = Aligned::new(&[&[0], &again[..]].concat());
    assert_eq!(Package::decode(&shifted.bytes()[1..]), Err(PackageError::Alignment));
}

/// Returns the header of a package of this dimension, which has been decoded.
fn accept_of_any_dimension(bytes: &[u8], dimension: usize) -> Header {
    let header = Header::decode(bytes).expect("it was decoded from there");
    assert_eq!(header.dimension, dimension);
    for accepted in [accept_header::<1>(bytes, &ANY), accept_header::<2>(bytes, &ANY)] {
        match accepted {
            Ok(Some(accepted)) => assert_eq!(accepted, header),
            Ok(None) => panic!("format 2"),
            Err(Refusal::Dimension { found, .. }) => assert_eq!(found, dimension),
            Err(Refusal::Parameter(_) | Refusal::Step { .. }) => {}
            Err(refusal) => panic!("{refusal}"),
        }
    }
    header
}

/// Calls `accept` with new scratch memory.
fn judge<'b, const N: usize>(
    bytes: &'b [u8],
    requirements: &Requirements<'_>,
) -> Result<Package<'b>, Refusal> {
    let mut scratch = Scratch::NEW;
    accept::<N>(bytes, requirements, &mut scratch)
}

/// `accept` returns the result of `decode`, or refuses for a reason of its own.
fn check_acceptance<const N: usize>(bytes: &[u8], package: &Package<'_>) {
    match judge::<N>(bytes, &ANY) {
        Ok(accepted) => {
            assert_eq!(accepted, *package);
            check_accepted::<N>(bytes, &accepted);
        }
        Err(Refusal::Dimension { .. }) => assert_ne!(package.dimension(), N),
        Err(Refusal::TestVector { .. }) => {
            let Some(proved) = with_correct_test_vectors::<N>(package, bytes) else { return };
            let accepted = judge::<N>(proved.bytes(), &ANY).expect("nothing else was wrong");
            check_accepted::<N>(proved.bytes(), &accepted);
        }
        Err(Refusal::Package(error)) => panic!("decodes, but is refused: {error}"),
        Err(_) => {}
    }
}

/// Returns the package with the network's outputs for the inputs of its test vectors, if they are
/// finite, in the format of `bytes`, from which it was decoded.
fn with_correct_test_vectors<const N: usize>(
    package: &Package<'_>,
    bytes: &[u8],
) -> Option<Aligned> {
    let mut scratch = Scratch::NEW;
    let mut numbers = vec![];
    for vector in package.test_vectors() {
        let (features, output) = package.evaluate::<N>(vector.input, &mut scratch)?;
        numbers.extend_from_slice(vector.input);
        numbers.extend_from_slice(features);
        numbers.extend_from_slice(output.as_slice());
    }
    let package = Package { test_vectors: &numbers, ..package.clone() };
    let mut buffer = vec![0; bytes.len()];
    let format = Format::of(bytes).ok()?;
    let length = package.encode(format, &mut buffer).expect("as long as before");
    numbers.iter().all(|number| number.is_finite()).then(|| Aligned::new(&buffer[..length]))
}

/// Checks what a node relies on after accepting a package.
fn check_accepted<const N: usize>(bytes: &[u8], package: &Package<'_>) {
    assert_eq!(package.dimension(), N);
    assert!(package.test_vectors().count() > 0);

    // The limits of a node, each exactly sufficient, then one less.
    let (features, entries) = (package.features(), package.node.outer_law.gain.entries().len());
    let places = package.node.neighbours.len();
    let fits = Capacity {
        features,
        neighbours: places,
        gain_entries: entries,
        known_inputs: package.known_inputs,
    };
    let with = |requirements| judge::<N>(bytes, &requirements).map(|_| ());
    assert_eq!(with(Requirements { capacity: fits, ..ANY }), Ok(()));
    for capacity in [
        Capacity { features: features - 1, ..fits },
        Capacity { neighbours: places.wrapping_sub(1), ..fits },
        Capacity { gain_entries: entries - 1, ..fits },
    ] {
        let refused = matches!(
            with(Requirements { capacity, ..ANY }),
            Err(Refusal::Capacity { capacity, found, .. }) if found == capacity + 1
        );
        assert!(refused || capacity.neighbours == usize::MAX);
    }
    let after = |agent, epoch, version| {
        let highest = Some(Serial { epoch, version });
        with(Requirements { agent: Some(agent), highest, ..ANY })
    };
    let (agent, Serial { epoch, version }) = (package.node.agent, package.serial());
    assert!(matches!(after(agent, epoch, version), Err(Refusal::Repeated { .. })));
    if let Some(older) = version.checked_sub(1) {
        assert_eq!(after(agent, epoch, older), Ok(()));
    }
    if let Some(newer) = version.checked_add(1) {
        assert!(matches!(after(agent, epoch, newer), Err(Refusal::Older { .. })));
    }
    if let Some(next) = epoch.checked_add(1) {
        assert!(matches!(after(agent, next, 0), Err(Refusal::Older { .. })));
    }
    assert!(matches!(after(agent ^ 1, epoch, version), Err(Refusal::Agent { .. })));

    // A node does not support inputs.
    if let Some(fewer) = package.known_inputs.checked_sub(1) {
        let capacity = Capacity { known_inputs: fewer, ..fits };
        let refused = with(Requirements { capacity, ..ANY });
        return assert!(matches!(refused, Err(Refusal::Capacity { what: "known inputs", .. })));
    }

    // The parameters form an agent, and it takes steps.
    let mut neighbours = vec![Neighbour { id: 0, weight: 1.0 }; places];
    let mut gain = vec![0.0; entries];
    let params = package.node.params::<N>(&mut neighbours, &mut gain).expect("was accepted");
    let start = package.test_vectors().next().expect("at least one").input;
    let mut state = AgentState::<N, LAYER_WIDTH_MAX, _>::new(
        &params,
        StateVector::from_column_slice(start),
        package.outer_weights,
        vec![None; places],
    )
    .expect("was accepted");
    state.set_field(&params, package.node.field).expect("was accepted");
    let mut inbox = Inbox::<N, _>::new(vec![None; places]);
    let measurement = vec![0.0; package.node.outputs(N)];
    for tick in 0..3 {
        match state.step(&params, Some(&package.network), tick, &measurement, &mut inbox) {
            Ok(output) => assert!(all_finite(&output.sample.derivative)),
            Err(error) => return assert!(matches!(error, StepError::Diverged)),
        }
        assert!(all_finite(state.estimate()));
        assert!(state.outer_weights().rows().iter().all(all_finite));
        assert!(state.outer_weights().norm_squared().is_finite());
    }
}
