extern crate std;

use core::num::NonZeroU32;
use std::vec::Vec;

use embedded_storage::nor_flash::NorFlashErrorKind;
use proptest::prelude::*;

use super::*;
use crate::NODE_DIMENSION_MAX;
use crate::StateVector;
use crate::health::{BoardErrors, HealthCounters};
use crate::package::{Refusal, Serial};
use crate::store::{Slot, StoreError};
use crate::wire::cobs::Decoder;
use crate::wire::frame::FRAME_LENGTH_MAX;

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

fn status() -> Status {
    Status {
        protocol: PROTOCOL_VERSION,
        firmware: Firmware {
            version: [0, 1, 0],
            dimension: 3,
            features: 8,
            neighbours: 2,
            signed_only: false,
            sample_stride: 20,
        },
        tick: 70_000,
        package: Some(PackageStatus {
            agent: 2,
            version: 3,
            checksum: 0xdead_beef,
            step_size: 1e-3,
            slot: Slot::B,
            trial: Some((17, 1_000)),
            network_in_use: true,
        }),
        staged: false,
        upload: Some(Upload { received: 256 }),
        refused_at_start: [Some(RefusalReport::SLOT), None],
        stack_unused: Some(120_000),
        samples: 12,
        messages_damaged: 1,
        measurements_missing: 0,
        broadcasts_lost: 0,
        health: HealthCounters { restarts: 1, ..HealthCounters::default() },
    }
}

#[test]
fn every_request_arrives_and_fits() {
    let numbers = || Numbers::from_slice(&[f32::MAX; NODE_DIMENSION_MAX]).unwrap();
    let every = NonZeroU32::new(u32::MAX);
    for request in [
        Request::Query,
        Request::Begin { length: u32::MAX },
        Request::Chunk { offset: u32::MAX, bytes: &[0xa5; CHUNK_LENGTH_MAX] },
        Request::Stage,
        Request::Activate,
        Request::Confirm,
        Request::Revert,
        Request::Reset,
        Request::Subscribe(Subscription { state_every: every, outer_weights: true }),
        Request::Samples { from: u64::MAX, most: u8::MAX },
        Request::StartAt { estimate: numbers() },
        Request::Frame { bytes: &[0xa5; FRAME_LENGTH_MAX] },
        Request::Tick { periods: u32::MAX, measurement: Some(numbers()) },
        Request::Tick { periods: 1, measurement: None },
    ] {
        let bytes = sent(&request);
        assert!(bytes.len() <= REQUEST_LENGTH_MAX, "{request:?}");
        assert_eq!(receive(&bytes), Some(request));
    }
}

#[test]
fn every_response_arrives() {
    let store = |error| Response::Refused(Problem::Store(error));
    let refusal = Refusal::Older {
        highest: Serial { epoch: 0, version: 4 },
        found: Serial { epoch: 0, version: 3 },
    };
    let numbers = || Numbers::from_slice(&[1.5, -2.0, 0.0]).unwrap();
    for response in [
        Response::Status(status()),
        Response::Hello(status()),
        Response::Upload(Upload { received: 3 }),
        Response::Staged { version: 7 },
        Response::InUse { version: None },
        Response::Done,
        store(StoreError::Gap { received: 9 }),
        store(StoreError::Flash(NorFlashErrorKind::OutOfBounds)),
        store(StoreError::Flash(NorFlashErrorKind::Other)),
        Response::Refused(Problem::Package(RefusalReport::from(&refusal))),
        Response::Sample { tick: 5, estimate: numbers(), derivative: numbers() },
        Response::SamplesEnd { next: 6 },
        Response::State(State {
            tick: 5,
            outcome: Outcome::Stepped,
            estimate: numbers(),
            derivative: Numbers::new(),
            outer_weights: numbers(),
        }),
        Response::Health { tick: 5, counters: status().health },
        Response::Event(Event::Confirmed { tick: 5, version: 7 }),
        Response::Event(Event::BoardFault(BoardFault::Clock)),
        Response::Broadcast { bytes: &[1, 2, 3] },
        Response::BoardErrors { tick: 5, counters: board_errors() },
    ] {
        assert_eq!(receive(&sent(&response)), Some(response));
    }
}

fn board_errors() -> BoardErrors {
    BoardErrors::from_array([1, 2, 3, 4, 5, 6, 7, 8, 300])
}

#[test]
fn board_errors_are_a_new_kind_of_message_at_the_end() {
    let message: Response<'_, Numbers> =
        Response::BoardErrors { tick: 5, counters: board_errors() };
    assert!(!message.is_answer());
    // The kind that no version before had, the tick, and one integer for each counter.
    assert_eq!(sent(&message), [13, 5, 1, 2, 3, 4, 5, 6, 7, 8, 0xac, 0x02]);
    let failed = BoardErrors { link_receiver: 1, ..BoardErrors::default() };
    assert!(BoardErrors::default().is_empty() && !failed.is_empty());
}

#[test]
fn rows_are_sent_as_one_sequence_of_numbers() {
    let rows = [StateVector::<2>::new(1.0, 2.0), StateVector::<2>::new(3.0, 4.0)];
    assert_eq!(numbers(&rows), [1.0, 2.0, 3.0, 4.0]);
    let expected = Numbers::from_slice(&[1.0, 2.0, 3.0, 4.0]).unwrap();
    assert_eq!(sent(&numbers(&rows)), sent(&expected));
}

#[test]
fn the_wire_format_of_requests_is_stable() {
    assert_eq!(sent(&Request::Query), [0]);
    assert_eq!(sent(&Request::Chunk { offset: 300, bytes: &[7] }), [2, 0xac, 0x02, 1, 7]);
    assert_eq!(sent(&Request::Tick { periods: 1, measurement: None }), [12, 1, 0]);
}

#[test]
fn a_refusal_keeps_its_numbers_and_text() {
    let report = RefusalReport::from(&Refusal::Agent { expected: 1, found: 2 });
    assert_eq!(std::format!("{report}"), "it is for agent 2, but this node is agent 1");
}

proptest! {
    #[test]
    fn arbitrary_bytes_are_a_request_or_none(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        if let Some(request) = receive::<Request<'_>>(&bytes) {
            // Each request has exactly one encoding.
            prop_assert_eq!(sent(&request), bytes);
        }
    }
}
