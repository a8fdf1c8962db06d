//! A node whose chip stalls while it erases: it says farewell first, and its first step afterwards
//! broadcasts.
#![cfg(feature = "exchange")]

use std::cell::RefCell;
use std::collections::VecDeque;
use std::num::NonZeroU32;
use std::rc::Rc;

use agent_core::agent::exchange::ExchangeParams;
use agent_core::health::HealthSettings;
use agent_core::math::symmetric::SymmetricMatrix;
use agent_core::observer::outer_law::OuterLawParams;
use agent_core::observer::projection::ProjectionParams;
use agent_core::observer::trigger::TriggerParams;
use agent_core::package::{AgentConfig, CHECKED_FIRST, NeighbourIds, StepRange};
use agent_core::service::{Numbers, Report, Request, Response, Subscription, receive, send};
use agent_core::store::{Layout, MappedFlash, RateLimit};
use agent_core::wire::cobs::{Decoder, SerialError};
use agent_core::wire::frame::Frame;
use embedded_storage::nor_flash::{ErrorType, NorFlash, NorFlashErrorKind, ReadNorFlash};
use firmware_template::board::RequestBuffer;
use firmware_template::{Board, LinkErrorKind, Memory, Node, Progress, SensorErrorKind, Settings};

/// Periods that begin while a unit is erased.
const STALL: u32 = 40;
/// Length of a chunk. \[byte\]
const CHUNK: usize = 128;

/// What neighbours and flash see, in order.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Seen {
    Sample { sequence: u32, tick: u64 },
    Farewell { sequence: u32, tick: u64 },
    Erased,
}

/// What happens outside of the node.
#[derive(Default)]
struct World {
    seen: Vec<Seen>,
    periods: u32,
}

type SeenWorld = Rc<RefCell<World>>;

/// Flash in memory that takes its time if it `STALLS`.
struct Ram<const STALLS: bool> {
    bytes: Vec<u8>,
    world: SeenWorld,
}

const UNIT: usize = 1024;
const LAYOUT: Layout =
    Layout { slots: [0, 4096], slot_length: 4096, commit: 8192, commit_length: 2048 };

impl<const STALLS: bool> ErrorType for Ram<STALLS> {
    type Error = NorFlashErrorKind;
}

impl<const STALLS: bool> ReadNorFlash for Ram<STALLS> {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), NorFlashErrorKind> {
        bytes.copy_from_slice(&self.bytes[offset as usize..][..bytes.len()]);
        Ok(())
    }

    fn capacity(&self) -> usize {
        self.bytes.len()
    }
}

impl<const STALLS: bool> NorFlash for Ram<STALLS> {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = UNIT;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), NorFlashErrorKind> {
        self.bytes[from as usize..to as usize].fill(0xff);
        let mut world = self.world.borrow_mut();
        world.seen.push(Seen::Erased);
        world.periods += if STALLS { STALL } else { 0 };
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), NorFlashErrorKind> {
        let places = self.bytes[offset as usize..].iter_mut().zip(bytes);
        places.for_each(|(place, byte)| *place &= byte);
        Ok(())
    }
}

impl<const STALLS: bool> MappedFlash for Ram<STALLS> {
    const STALLS: bool = STALLS;

    fn mapped(&self) -> &[u8] {
        &self.bytes
    }
}

/// A board without surprises; its plant rests.
struct Desk {
    world: SeenWorld,
    requests: VecDeque<Vec<u8>>,
    said: Vec<u8>,
}

impl Board for Desk {
    fn start(&mut self, _: f32) {}

    fn elapsed(&mut self) -> u32 {
        std::mem::take(&mut self.world.borrow_mut().periods)
    }

    fn rest(&mut self) {}

    fn measure(&mut self, measurement: &mut [f32]) -> Result<usize, SensorErrorKind> {
        measurement[0] = 0.0;
        Ok(1)
    }

    fn broadcast(&mut self, frame: &[u8]) -> Result<(), LinkErrorKind> {
        let Frame { sender, sequence, tick, is_farewell, .. } = Frame::<2>::decode(frame).unwrap();
        assert_eq!(sender, 1);
        let seen = if is_farewell {
            Seen::Farewell { sequence, tick }
        } else {
            Seen::Sample { sequence, tick }
        };
        self.world.borrow_mut().seen.push(seen);
        Ok(())
    }

    fn frame<'buffer>(
        &mut self,
        _: &'buffer mut [u8],
    ) -> Option<Result<&'buffer [u8], LinkErrorKind>> {
        None
    }

    fn request<'buffer>(
        &mut self,
        buffer: &'buffer mut RequestBuffer,
    ) -> Option<Result<&'buffer mut [u8], SerialError>> {
        let request = self.requests.pop_front()?;
        let place = &mut buffer[..request.len()];
        place.copy_from_slice(&request);
        Some(Ok(place))
    }

    fn respond(&mut self, bytes: &[u8]) {
        self.said.extend_from_slice(bytes);
    }

    fn flush(&mut self) {}
}

/// An agent whose trigger never fires.
fn agent() -> Option<AgentConfig<'static>> {
    let projection =
        ProjectionParams { radius: 10.0, boundary_layer: 1.0, smoothing: 0.1, smoothness: 1 };
    Some(AgentConfig {
        agent: 1,
        output_matrix: &[1.0, 0.0],
        gain: SymmetricMatrix::Scalar(100.0),
        neighbours: NeighbourIds::new(&[2]),
        edge_weights: &[1.0],
        outer_law: OuterLawParams { gain: SymmetricMatrix::Scalar(1.0), projection },
        trigger: TriggerParams { hold_error_weight: 1.0, consensus_weight: 0.5, threshold: 1e6 },
        step_size: 1e-3,
        exchange: ExchangeParams::PAPER,
        field: &[],
    })
}

struct Rig<'m, const STALLS: bool> {
    node: Node<'m, Ram<STALLS>, 2, 1, 1, 8>,
    board: Desk,
}

impl<'m, const STALLS: bool> Rig<'m, STALLS> {
    /// Starts a node and lets it say its first sample.
    fn new(memory: &'m mut Memory<2, 1, 1, 8>) -> Self {
        let settings = Settings {
            layout: LAYOUT,
            public_key: None,
            step_range: StepRange::DEFAULT,
            health: HealthSettings::RECOMMENDED,
            update_limit: RateLimit::NONE,
            trial: firmware_template::RECOMMENDED_TRIAL,
            sample_stride: NonZeroU32::MIN,
            subscription: Subscription { state_every: None, outer_weights: false },
            fallback: agent(),
            stack_unused: None,
            start: firmware_template::Start::default(),
            keep_epochs: None,
            factory_reset: false,
            version: [0, 1, 0],
        };
        let world = SeenWorld::default();
        let flash = Ram { bytes: vec![0xff; 10 * UNIT], world: world.clone() };
        let node = Node::new(flash, settings, memory).unwrap();
        let board = Desk { world, requests: VecDeque::new(), said: Vec::new() };
        let mut rig = Self { node, board };
        assert_eq!(rig.turn(), [Seen::Sample { sequence: 0, tick: 0 }]);
        assert_eq!(rig.turn(), []);
        rig
    }

    /// Works until nothing is left; returns what has been seen.
    fn work(&mut self) -> Vec<Seen> {
        while self.node.poll(&mut self.board) == Progress::Worked {}
        std::mem::take(&mut self.board.world.borrow_mut().seen)
    }

    /// Lets a period begin.
    fn turn(&mut self) -> Vec<Seen> {
        self.board.world.borrow_mut().periods += 1;
        self.work()
    }

    /// Sends a request and lets the node answer it, but not yet take a step; returns what has been seen.
    fn ask(&mut self, request: &Request<'_>) -> Vec<Seen> {
        let mut decoder = Decoder::<512>::new();
        send(request, |bytes| {
            for byte in bytes {
                if let Some(Ok(message)) = decoder.push(*byte) {
                    self.board.requests.push_back(message.to_vec());
                }
            }
        });
        self.board.said.clear();
        while !self.board.requests.is_empty() {
            assert_eq!(self.node.poll(&mut self.board), Progress::Worked);
        }
        std::mem::take(&mut self.board.world.borrow_mut().seen)
    }

    fn push(&mut self, offset: usize, bytes: &[u8]) -> Vec<Seen> {
        self.ask(&Request::Chunk { offset: offset as u32, bytes })
    }

    fn report(&mut self) -> Report {
        let _ = self.ask(&Request::Report);
        let mut decoder = Decoder::<512>::new();
        for byte in &self.board.said {
            if let Some(Ok(message)) = decoder.push(*byte)
                && let Some(Response::Report(report)) = receive::<Response<'_, Numbers>>(message)
            {
                return report;
            }
        }
        panic!("it does not report");
    }
}

/// Bytes whose header is accepted: that of format 1 is checked with the package.
fn upload() -> Vec<u8> {
    let mut bytes = vec![0x5a; 3_000];
    bytes[..4].copy_from_slice(b"OWP\x01");
    bytes
}

#[test]
fn a_farewell_comes_before_each_erasure_and_a_sample_right_after_it() {
    let mut memory = Memory::new();
    let mut rig = Rig::<true>::new(&mut memory);
    let bytes = upload();
    assert_eq!(rig.ask(&Request::Begin { length: bytes.len() as u32 }), []);
    let (mut tick, mut sequence, mut stalls) = (2, 0, 0);
    for (index, chunk) in bytes.chunks(CHUNK).enumerate() {
        let offset = index * CHUNK;
        let seen = rig.push(offset, chunk);
        let end = offset + chunk.len();
        // The unit of the header is erased when it is complete, the others when their first word comes.
        let completes_header = offset < CHECKED_FIRST && end >= CHECKED_FIRST;
        let enters_unit = offset >= CHECKED_FIRST && offset.is_multiple_of(UNIT);
        if !completes_header && !enters_unit {
            assert_eq!(seen, [], "{offset}");
            assert_eq!(rig.turn(), [], "{offset}");
            tick += 1;
            continue;
        }
        assert_eq!(seen, [Seen::Farewell { sequence: sequence + 1, tick }, Seen::Erased]);
        // The step after the stall belongs to the newest of the periods that have begun.
        tick += u64::from(STALL);
        assert_eq!(rig.work(), [Seen::Sample { sequence: sequence + 2, tick }]);
        assert_eq!(rig.turn(), []);
        tick += 1;
        sequence += 2;
        stalls += 1;
    }
    assert_eq!(stalls, 3);
    assert_eq!(rig.report().stalled_ticks, stalls * (STALL - 1));
}

#[test]
fn a_header_that_is_refused_erases_nothing_and_nothing_is_said() {
    let mut memory = Memory::new();
    let mut rig = Rig::<true>::new(&mut memory);
    let mut bytes = upload();
    bytes[0] = b'X';
    assert_eq!(rig.ask(&Request::Begin { length: bytes.len() as u32 }), []);
    for (index, chunk) in bytes.chunks(CHUNK).take(4).enumerate() {
        assert_eq!(rig.push(index * CHUNK, chunk), []);
        assert_eq!(rig.turn(), []);
    }
    // Nor before what the store refuses anyway.
    for request in [Request::Stage, Request::Activate, Request::Confirm, Request::Revert] {
        assert_eq!(rig.ask(&request), []);
        assert_eq!(rig.turn(), []);
    }
}

#[test]
fn a_node_whose_flash_does_not_stall_says_nothing() {
    let mut memory = Memory::new();
    let mut rig = Rig::<false>::new(&mut memory);
    let bytes = upload();
    let _ = rig.ask(&Request::Begin { length: bytes.len() as u32 });
    let mut erasures = 0;
    for (index, chunk) in bytes.chunks(CHUNK).enumerate() {
        let seen = rig.push(index * CHUNK, chunk);
        assert!(seen.iter().all(|seen| *seen == Seen::Erased), "{seen:?}");
        erasures += seen.len();
        assert_eq!(rig.turn(), []);
    }
    assert_eq!(erasures, 3);
    assert_eq!(rig.report().stalled_ticks, 0);
}

#[test]
fn one_farewell_does_for_all_erasures_until_the_next_step() {
    let mut memory = Memory::new();
    let mut rig = Rig::<true>::new(&mut memory);
    let bytes = upload();
    let mut seen = Vec::new();
    for _ in 0..2 {
        seen.extend(rig.ask(&Request::Begin { length: bytes.len() as u32 }));
        for (index, chunk) in bytes.chunks(CHUNK).take(2).enumerate() {
            seen.extend(rig.push(index * CHUNK, chunk));
            // No time passes for the node.
            rig.board.world.borrow_mut().periods = 0;
        }
    }
    let farewell = Seen::Farewell { sequence: 1, tick: 2 };
    assert_eq!(seen, [farewell, Seen::Erased, Seen::Erased]);
    assert_eq!(rig.turn().len(), 1);
    assert_eq!(rig.turn(), []);
}
