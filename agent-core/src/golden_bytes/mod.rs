//! Golden bytes of everything that nodes and laptops exchange, and of what a node accepts and
//! refuses.
//!
//! `bytes.txt` was written by the first implementation, which encoded and decoded by hand. Each
//! line has a name, the bytes of one frame, request, response or package, and a hash of the results
//! of decoding some thousand modified copies: every value of every byte, one byte more or fewer,
//! and overlong integers. Deployed nodes use this format, so the file only grows; the verdicts on two
//! frames changed when agent numbers got 32 bits. A failing test prints the line for a new entry.

extern crate std;

use core::num::NonZeroU32;
use std::{format, string::String, vec, vec::Vec};

use embedded_storage::nor_flash::NorFlashErrorKind;

use crate::health::{BoardErrors, HealthCounters};
use crate::math::activation::Activation;
use crate::math::symmetric::SymmetricMatrix;
use crate::observer::network::{Architecture, InnerNetwork, Layer};
use crate::package::tests::{Aligned, Content, encoded, example_limits};
use crate::package::{
    CHECKED_FIRST, Format, HEADER2_LENGTH, OnSwitch, Package, PackageError, Requirements, Serial,
    accept_header, signature_block,
};
use crate::service::{
    BoardFault, CHUNK_LENGTH_MAX, Event, Firmware, Numbers, Outcome, PROTOCOL_VERSION,
    PackageStatus, Problem, RefusalKind, RefusalReport, Request, Response, State, Status,
    Subscription, Upload, receive, send,
};
use crate::store::{Slot, StoreError};
use crate::wire::cobs::Decoder;
use crate::wire::crc::{CHECKSUM_LENGTH, crc32};
use crate::wire::frame::{FRAME_LENGTH_MAX, Frame, FrameError, WORDS_MAX};
use crate::{AgentId, NODE_DIMENSION_MAX, StateVector};

/// FNV-1a, 64 bits.
struct Hash(u64);

/// Length of the longest frame with an estimate. \[byte\]
const LONGEST_ESTIMATE: usize = FRAME_LENGTH_MAX - 4 * (WORDS_MAX - NODE_DIMENSION_MAX);

impl Hash {
    fn add(&mut self, bytes: &[u8]) {
        for &byte in bytes.iter().chain(&(bytes.len() as u32).to_le_bytes()) {
            self.0 = (self.0 ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
        }
    }
}

/// Returns a hash of the results of `decode` on copies of `bytes` that are changed in the first
/// `reach` bytes.
fn verdicts(bytes: &[u8], reach: usize, decode: impl Fn(&[u8]) -> Vec<u8>) -> u64 {
    let mut hash = Hash(0xcbf2_9ce4_8422_2325);
    hash.add(&decode(bytes));
    for place in 0..bytes.len().min(reach) {
        let mut changed = bytes.to_vec();
        for value in 0..=u8::MAX {
            changed[place] = value;
            hash.add(&decode(&changed));
        }
        // An integer that ends here, written with one and with nine extra bytes.
        for zeros in [1, 9] {
            let longer = [&[bytes[place] | 0x80][..], &vec![0x80; zeros - 1], &[0]].concat();
            changed.splice(place..=place, longer.iter().copied());
            hash.add(&decode(&changed));
            changed = bytes.to_vec();
        }
        changed.remove(place);
        hash.add(&decode(&changed));
        hash.add(&decode(&bytes[..place]));
    }
    hash.add(&decode(&[bytes, &[0]].concat()));
    hash.0
}

/// Returns the bytes inside the framing, as a receiver gets them.
fn sent(message: &impl serde::Serialize) -> Vec<u8> {
    let mut decoder = Decoder::<4096>::new();
    let mut found = Vec::new();
    send(message, |block| {
        for &byte in block {
            if let Some(message) = decoder.push(byte) {
                found.extend_from_slice(message.unwrap());
            }
        }
    });
    found
}

/// Decodes a request and encodes it again; empty if it is invalid.
fn heard(bytes: &[u8]) -> Vec<u8> {
    receive::<Request<'_>>(bytes).map_or(vec![], |request| sent(&request))
}

/// Decodes a frame with a matching checksum on a node with three state components.
fn frame_taken(body: &[u8]) -> Vec<u8> {
    let frame = [body, &crc32(&[body]).to_le_bytes()].concat();
    match Frame::<3>::decode(&frame) {
        Ok(frame) => frame.encode().to_vec(),
        Err(FrameError::Length { .. }) => vec![1],
        Err(FrameError::Checksum) => vec![2],
        Err(FrameError::Malformed) => vec![3],
        Err(FrameError::Version { found }) => vec![4, found],
        Err(FrameError::Dimension { found, .. }) => vec![5, found as u8],
        Err(FrameError::NotFinite { sender }) => vec![6, sender as u8, (sender >> 8) as u8],
        Err(_) => vec![7],
    }
}

/// Returns a frame without its checksum.
fn body<const N: usize>(sender: AgentId, sequence: u32, tick: u64, first: f32) -> Vec<u8> {
    let mut estimate = StateVector::<N>::repeat(-2.5);
    estimate[0] = first;
    let frame = Frame::new(sender, sequence, tick, estimate);
    let mut bytes = frame.encode().to_vec();
    bytes.truncate(bytes.len() - CHECKSUM_LENGTH);
    bytes
}

/// Decodes the header at the start of a package of format 2 with the checksum that it should have;
/// returns its fields, or the error.
fn start_taken(bytes: &[u8]) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    if let Some((covered, checksum)) = bytes.split_at_mut_checked(HEADER2_LENGTH - CHECKSUM_LENGTH)
        && let Some(checksum) = checksum.first_chunk_mut()
    {
        *checksum = crc32(&[covered]).to_le_bytes();
    }
    match accept_header::<2>(&bytes, &Requirements::ANY) {
        Ok(None) => vec![],
        Ok(Some(header)) => {
            let Serial { epoch, version } = header.serial;
            let step = header.step_size.to_bits();
            let fields = [header.agent, epoch, version, header.length, step, header.checksum];
            let layers = header
                .architecture
                .layers()
                .iter()
                .flat_map(|layer| [layer.width, layer.activation as u8]);
            let sizes = [header.architecture.inputs(), header.outputs, header.neighbours]
                .map(|size| size as u32);
            let is_replaced = u8::from(header.outer_weights_on_switch == OnSwitch::Replace);
            let sizes = sizes.iter().flat_map(|size| size.to_le_bytes()).chain([is_replaced]);
            fields.into_iter().flat_map(u32::to_le_bytes).chain(sizes).chain(layers).collect()
        }
        Err(refusal) => sent(&RefusalReport::from(&refusal)),
    }
}

/// Decodes a package with this body and encodes it again, or returns the error.
fn package_taken(body: &[u8]) -> Vec<u8> {
    let header = crate::package::tests::header_of(body);
    let bytes = Aligned::new(&[&header[..], body].concat());
    match Package::decode(bytes.bytes()) {
        Ok(package) => encoded(Format::One, &package).bytes().to_vec(),
        Err(error) => refused(error),
    }
}

fn refused(error: PackageError) -> Vec<u8> {
    sent(&RefusalReport::from(&error))
}

fn status() -> Status {
    Status {
        protocol: PROTOCOL_VERSION,
        firmware: Firmware {
            version: [0, 1, 255],
            dimension: 3,
            features: 8,
            neighbours: 2,
            signed_only: true,
            sample_stride: 20,
        },
        tick: 70_000,
        package: Some(PackageStatus {
            agent: 300,
            version: 3,
            checksum: 0xdead_beef,
            step_size: 1e-3,
            slot: Slot::B,
            trial: Some((17, 1_000)),
            network_in_use: true,
        }),
        staged: true,
        upload: Some(Upload { received: 256 }),
        refused_at_start: [Some(RefusalReport::SLOT), None],
        stack_unused: Some(120_000),
        samples: 12,
        messages_damaged: 1,
        measurements_missing: u32::MAX,
        broadcasts_lost: 128,
        health: HealthCounters {
            outside_box: 1,
            implausible: 300,
            projection_active: u32::MAX,
            restarts: 127,
            ..HealthCounters::default()
        },
    }
}

fn numbers(values: &[f32]) -> Numbers {
    Numbers::from_slice(values).unwrap()
}

/// One line per entry.
#[derive(Default)]
struct Lines(Vec<String>);

impl Lines {
    fn add(&mut self, name: &str, bytes: &[u8], verdicts: u64) {
        let hex: String = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
        self.0.push(format!("{name} {hex} {verdicts:016x}"));
    }

    fn requests(&mut self) {
        let every = NonZeroU32::new(300);
        let all = [
            Request::Query,
            Request::Begin { length: u32::MAX },
            Request::Begin { length: 2_096 },
            Request::Chunk { offset: 300, bytes: &[0, 1, 0x80, 0xff] },
            Request::Chunk { offset: u32::MAX, bytes: &[0xa5; CHUNK_LENGTH_MAX] },
            Request::Stage,
            Request::Activate,
            Request::Confirm,
            Request::Revert,
            Request::Reset,
            Request::Subscribe(Subscription { state_every: every, outer_weights: true }),
            Request::Subscribe(Subscription { state_every: None, outer_weights: false }),
            Request::Samples { from: u64::MAX, most: u8::MAX },
            Request::Samples { from: 70_000, most: 3 },
            Request::StartAt { estimate: numbers(&[1.0, -2.5, f32::MIN_POSITIVE]) },
            Request::StartAt { estimate: numbers(&[f32::MAX; NODE_DIMENSION_MAX]) },
            Request::StartAt { estimate: numbers(&[]) },
            // The longest frame when agents had numbers of 16 bits.
            Request::Frame { bytes: &[0xa5; 73] },
            Request::Tick { periods: u32::MAX, measurement: Some(numbers(&[0.5, -0.0])) },
            Request::Tick { periods: 1, measurement: None },
        ];
        for (index, request) in all.iter().enumerate() {
            let bytes = sent(request);
            assert_eq!(receive(&bytes).as_ref(), Some(request));
            self.add(&format!("request-{index}"), &bytes, verdicts(&bytes, usize::MAX, heard));
        }
    }

    fn responses(&mut self) {
        for (index, response) in responses().iter().enumerate() {
            let bytes = sent(response);
            assert_eq!(receive(&bytes).as_ref(), Some(response));
            self.add(&format!("response-{index}"), &bytes, 0);
        }
    }

    fn frames(&mut self) {
        let all = [
            body::<3>(2, 0, 0, 1.0),
            body::<3>(300, 70_000, u64::MAX, -0.0),
            body::<3>(u16::MAX.into(), u32::MAX, 1 << 35, f32::MIN_POSITIVE / 2.0),
            body::<3>(1, 127, 128, f32::INFINITY),
            body::<1>(1, 2, 3, 0.5),
            body::<12>(u16::MAX.into(), u32::MAX, u64::MAX, f32::MAX),
        ];
        for (index, bytes) in all.iter().enumerate() {
            self.add(&format!("frame-{index}"), bytes, verdicts(bytes, usize::MAX, frame_taken));
        }
    }

    fn packages(&mut self) {
        // The metadata is the first 40 to 70 bytes.
        const REACH: usize = 80;
        for (index, package) in packages(&Content::new()).iter().enumerate() {
            let bytes = encoded(Format::One, package);
            let bytes = bytes.bytes();
            let name = format!("package-{index}");
            self.add(&name, bytes, verdicts(&bytes[12..], REACH, package_taken));
        }
        self.add("signature", &signature_block(&[0x5a; 64]), 0);
    }

    /// What agent numbers of 32 bits brought.
    fn wide_numbers(&mut self) {
        let frame = body::<12>(AgentId::MAX, u32::MAX, u64::MAX, f32::MAX);
        assert_eq!(frame.len() + CHECKSUM_LENGTH, LONGEST_ESTIMATE);
        self.add("frame-wide", &frame, verdicts(&frame, usize::MAX, frame_taken));
        let bytes = sent(&Request::Frame { bytes: &[0xa5; LONGEST_ESTIMATE] });
        self.add("request-wide", &bytes, verdicts(&bytes, usize::MAX, heard));
    }

    /// Packages of format 2; the rest of each follows from its first part, by checksum and digest.
    fn packages_of_format_2(&mut self) {
        let content = Content::new();
        let [mut plain, mut other, _] = <[_; 3]>::try_from(packages(&content)).unwrap();
        plain.trial = Some(example_limits());
        other.epoch = u32::MAX;
        other.replaces = None;
        other.node.agent = AgentId::MAX;
        for (index, package) in [plain, other].iter().enumerate() {
            let bytes = encoded(Format::Two, package);
            let bytes = bytes.bytes();
            let name = format!("package2-{index}");
            self.add(&name, bytes, verdicts(bytes, CHECKED_FIRST, start_taken));
        }
    }

    fn refusals_of_format_2(&mut self) {
        let kinds = [
            RefusalKind::Epoch,
            RefusalKind::Repeated,
            RefusalKind::Step,
            RefusalKind::Inputs,
            RefusalKind::UnknownSection,
            RefusalKind::Section,
            RefusalKind::Digest,
        ];
        for kind in kinds {
            let report = RefusalReport { kind, expected: 1, found: 300 };
            let response = Response::<Numbers>::Refused(Problem::Package(report));
            let bytes = sent(&response);
            assert_eq!(receive(&bytes), Some(response));
            self.add(&format!("refusal-{kind:?}"), &bytes, 0);
        }
    }
}

fn responses() -> Vec<Response<'static, Numbers>> {
    let mut all = vec![
        Response::Status(status()),
        Response::Hello(Status {
            package: None,
            upload: None,
            stack_unused: None,
            refused_at_start: [None; 2],
            ..status()
        }),
        Response::Upload(Upload { received: 300 }),
        Response::Staged { version: 7 },
        Response::InUse { version: None },
        Response::InUse { version: Some(u32::MAX) },
        Response::Done,
        Response::Sample { tick: 5, estimate: numbers(&[1.5]), derivative: numbers(&[-2.0, 0.0]) },
        Response::SamplesEnd { next: u64::MAX },
        Response::Health { tick: 1 << 40, counters: status().health },
        Response::Event(Event::Confirmed { tick: 5, version: 7 }),
        Response::Broadcast { bytes: &[1, 0, 3, 0xff] },
        Response::Refused(Problem::Unknown),
        Response::Refused(Problem::NotInTheLoop),
        Response::Refused(Problem::NoPackage),
        Response::Refused(Problem::Estimate),
    ];
    for outcome in [
        Outcome::Stepped,
        Outcome::Restarted,
        Outcome::NoPackage,
        Outcome::NoMeasurement,
        Outcome::MeasurementLength,
        Outcome::MeasurementNotFinite,
        Outcome::Diverged,
        Outcome::Refused,
    ] {
        all.push(Response::State(State {
            tick: 5,
            outcome,
            estimate: numbers(&[1.0, 2.0]),
            derivative: numbers(&[]),
            outer_weights: numbers(&[-1.0; 12]),
        }));
    }
    let store = [
        StoreError::Flash(NorFlashErrorKind::NotAligned),
        StoreError::Flash(NorFlashErrorKind::OutOfBounds),
        StoreError::Flash(NorFlashErrorKind::Other),
        StoreError::Verify { offset: 1 },
        StoreError::Unreadable { offset: 2 },
        StoreError::NotLoaded,
        StoreError::OnTrial,
        StoreError::NotOnTrial,
        StoreError::Length { found: 3, maximum: 300 },
        StoreError::NoUpload,
        StoreError::Gap { received: 4 },
        StoreError::PastEnd { length: 5 },
        StoreError::Conflict { offset: 6 },
        StoreError::Incomplete { received: 7, length: 8 },
        StoreError::NothingStaged,
        StoreError::Damaged,
    ];
    all.extend(store.map(|error| Response::Refused(Problem::Store(error))));
    let kinds = [
        RefusalKind::Length,
        RefusalKind::Magic,
        RefusalKind::FormatVersion,
        RefusalKind::Checksum,
        RefusalKind::SignatureChecksum,
        RefusalKind::Malformed,
        RefusalKind::Alignment,
        RefusalKind::Outputs,
        RefusalKind::TestVectorCount,
        RefusalKind::NumberCount,
        RefusalKind::NotFinite,
        RefusalKind::TrainingErrorNotFinite,
        RefusalKind::Network,
        RefusalKind::Unsigned,
        RefusalKind::Signature,
        RefusalKind::Dimension,
        RefusalKind::Capacity,
        RefusalKind::Parameter,
        RefusalKind::NeighbourOrder,
        RefusalKind::EmptyBox,
        RefusalKind::Agent,
        RefusalKind::Older,
        RefusalKind::NoTestVectors,
        RefusalKind::TestVector,
        RefusalKind::Slot,
        RefusalKind::Other,
    ];
    all.extend(kinds.map(|kind| {
        let report = RefusalReport { kind, expected: 1, found: 300 };
        Response::Refused(Problem::Package(report))
    }));
    all.push(Response::Event(Event::BoardFault(BoardFault::Clock)));
    let counters = BoardErrors::from_array([1, 2, 300, 0, u32::MAX, 5, 6, 7, 8]);
    all.push(Response::BoardErrors { tick: 70_000, counters });
    all
}

/// One package per form of its metadata.
fn packages(content: &Content) -> Vec<Package<'_>> {
    let plain = content.package();
    let mut other = plain.clone();
    other.replaces = Some(300);
    other.outer_weights_on_switch = OnSwitch::Replace;
    other.version = u32::MAX;
    other.node.agent = u16::MAX.into();
    other.node.gain = SymmetricMatrix::Diagonal(&content.gain[..2]);
    other.node.outer_law.gain = SymmetricMatrix::Diagonal(&content.gain[1..]);
    other.provenance.errors = None;
    other.provenance.seed = u64::MAX;
    other.provenance.recipe = "größer";
    let mut deep = plain.clone();
    let layers = [
        Layer { width: 1, activation: Activation::Gaussian },
        Layer { width: 1, activation: Activation::Logistic },
        Layer { width: 1, activation: Activation::Tanh },
    ];
    let architecture = Architecture::new(2, &layers).unwrap();
    deep.network = InnerNetwork::new(architecture, &content.inner[..7]).unwrap();
    deep.outer_weights = &content.outer_weights[..2];
    deep.node.gain = SymmetricMatrix::Scalar(5.0);
    deep.node.outer_law.gain = SymmetricMatrix::Full(&content.gain[..1]);
    deep.node.output_matrix = &[1.0, 0.0, 0.0, 1.0];
    deep.test_vectors = &[];
    deep.provenance.recipe = "";
    vec![plain, other, deep]
}

#[test]
fn bytes_and_verdicts_match_the_first_implementation() {
    let mut lines = Lines::default();
    lines.requests();
    lines.responses();
    lines.frames();
    lines.packages();
    lines.wide_numbers();
    lines.packages_of_format_2();
    lines.refusals_of_format_2();
    let golden: Vec<&str> = include_str!("bytes.txt").lines().collect();
    for (found, expected) in lines.0.iter().zip(&golden) {
        assert_eq!(found, expected);
    }
    let new = lines.0.get(golden.len()..).unwrap_or_default();
    assert!(new.is_empty() && golden.len() == lines.0.len(), "{}", new.join("\n"));
}
