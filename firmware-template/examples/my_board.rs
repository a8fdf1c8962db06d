//! A complete board with every trait that a node needs, simulated on the host.
//!
//! `cargo run -p firmware-template --example my_board`
//!
//! The plant is an oscillator, `x1' = x2`, `x2' = -x1`. This node measures `x1`; a neighbour,
//! simulated by the link, measures `x2` and broadcasts its estimate every 10 ms. The node has no
//! package, so it runs its fallback, and still estimates both components.
//!
//! On a real board, each of the five parts below accesses hardware instead; everything else stays
//! the same.

use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::convert::Infallible;
use std::num::NonZeroU32;
use std::rc::Rc;

use agent_core::agent::exchange::ExchangeParams;
use agent_core::health::HealthSettings;
use agent_core::math::symmetric::SymmetricMatrix;
use agent_core::observer::outer_law::OuterLawParams;
use agent_core::observer::projection::ProjectionParams;
use agent_core::observer::trigger::TriggerParams;
use agent_core::package::{AgentConfig, NeighbourIds, StepRange};
use agent_core::service::{Numbers, Request, Response, Subscription, receive, send};
use agent_core::store::{Layout, MappedFlash};
use agent_core::wire::cobs::Decoder;
use agent_core::wire::frame::Frame;
use embedded_io::{Read, ReadReady, Write};
use embedded_storage::nor_flash::{NorFlash, NorFlashErrorKind, ReadNorFlash};
use firmware_template::{Clock, Hardware, Link, LinkErrorKind, Memory, Node, Sensor, Settings};

/// The sampling period. \[s\]
const PERIOD: f32 = 1e-3;

/// The number of elapsed periods, shared by all parts of this board.
type Now = Rc<Cell<u32>>;

/// The plant's state.
fn plant(now: u32) -> [f32; 2] {
    let t = f64::from(now) * f64::from(PERIOD);
    [t.sin() as f32, t.cos() as f32]
}

/// 1. The sensor. A real one reads a bus; see `RegisterSensor` and the board `stm32f405`.
struct Position(Now);

impl Sensor for Position {
    type Error = Infallible;

    fn outputs(&self) -> usize {
        1
    }

    fn read(&mut self, measurement: &mut [f32]) -> Result<(), Infallible> {
        measurement.copy_from_slice(&plant(self.0.get())[..1]);
        Ok(())
    }
}

/// 2. The link. A real one passes frames to a radio; over a serial line it is `SerialLink`.
struct Neighbour {
    now: Now,
    heard: Rc<Cell<u32>>,
    told: u32,
}

impl Link for Neighbour {
    type Error = LinkErrorKind;

    fn send(&mut self, _frame: &[u8]) -> Result<(), LinkErrorKind> {
        self.heard.set(self.heard.get() + 1);
        Ok(())
    }

    fn poll<'buffer>(
        &mut self,
        buffer: &'buffer mut [u8],
    ) -> Result<Option<&'buffer [u8]>, LinkErrorKind> {
        let now = self.now.get();
        if now < 10 * self.told {
            return Ok(None);
        }
        let estimate = plant(now).into();
        let frame = Frame::new(2, self.told, now.into(), estimate);
        self.told += 1;
        let bytes = frame.encode();
        let place = buffer.get_mut(..bytes.len()).ok_or(LinkErrorKind::Overflow)?;
        place.copy_from_slice(&bytes);
        Ok(Some(place))
    }
}

/// 3. The clock. A real one reads a timer (see `Periods`) and rests until an interrupt.
struct Simulated {
    now: Now,
    counted: u32,
}

impl Clock for Simulated {
    fn start(&mut self, period: f32) {
        assert_eq!(period, PERIOD);
    }

    fn elapsed(&mut self) -> u32 {
        let now = self.now.get();
        now - std::mem::replace(&mut self.counted, now)
    }

    fn rest(&mut self) {
        self.now.set(self.now.get() + 1);
    }
}

/// 4. The service port. A real one is a serial port; see `QueuedPort`.
struct Console {
    now: Now,
    steps: u32,
    input: VecDeque<u8>,
    output: Rc<RefCell<Vec<u8>>>,
}

impl embedded_io::ErrorType for Console {
    type Error = Infallible;
}

impl ReadReady for Console {
    fn read_ready(&mut self) -> Result<bool, Infallible> {
        // Requests a reset once the node has completed its steps.
        if self.now.get() >= self.steps && self.input.is_empty() {
            send(&Request::Reset, |bytes| self.input.extend(bytes));
        }
        Ok(!self.input.is_empty())
    }
}

impl Read for Console {
    fn read(&mut self, buffer: &mut [u8]) -> Result<usize, Infallible> {
        let length = buffer.len().min(self.input.len());
        buffer.iter_mut().zip(self.input.drain(..length)).for_each(|(place, byte)| *place = byte);
        Ok(length)
    }
}

impl Write for Console {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, Infallible> {
        self.output.borrow_mut().extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> Result<(), Infallible> {
        Ok(())
    }
}

/// 5. The flash. A real one erases and writes through registers; see the boards.
struct Ram([u8; Ram::LENGTH]);

impl Ram {
    const LENGTH: usize = 6 * Self::ERASE_SIZE;
    /// On a real board, `memory_map!` reads this from `memory.x`.
    const LAYOUT: Layout =
        Layout { slots: [0, 2048], slot_length: 2048, commit: 4096, commit_length: 2048 };
}

impl embedded_storage::nor_flash::ErrorType for Ram {
    type Error = NorFlashErrorKind;
}

impl ReadNorFlash for Ram {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), NorFlashErrorKind> {
        let place = self.0.get(offset as usize..).and_then(|rest| rest.get(..bytes.len()));
        bytes.copy_from_slice(place.ok_or(NorFlashErrorKind::OutOfBounds)?);
        Ok(())
    }

    fn capacity(&self) -> usize {
        Self::LENGTH
    }
}

impl NorFlash for Ram {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = 1024;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), NorFlashErrorKind> {
        let place = self.0.get_mut(from as usize..to as usize);
        place.ok_or(NorFlashErrorKind::OutOfBounds)?.fill(0xff);
        Ok(())
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), NorFlashErrorKind> {
        let place = self.0.get_mut(offset as usize..).and_then(|rest| rest.get_mut(..bytes.len()));
        let place = place.ok_or(NorFlashErrorKind::OutOfBounds)?;
        place.iter_mut().zip(bytes).for_each(|(place, byte)| *place &= byte);
        Ok(())
    }
}

impl MappedFlash for Ram {
    fn mapped(&self) -> &[u8] {
        &self.0
    }
}

/// The agent that runs until the node gets a package.
fn fallback() -> Option<AgentConfig<'static>> {
    Some(AgentConfig {
        agent: 1,
        output_matrix: &[1.0, 0.0],
        gain: SymmetricMatrix::Scalar(100.0),
        neighbours: NeighbourIds::new(&[2]),
        edge_weights: &[1.0],
        outer_law: OuterLawParams {
            gain: SymmetricMatrix::Scalar(1.0),
            projection: ProjectionParams {
                radius: 10.0,
                boundary_layer: 1.0,
                smoothing: 0.1,
                smoothness: 1,
            },
        },
        trigger: TriggerParams { hold_error_weight: 1e4, consensus_weight: 0.5, threshold: 0.1 },
        step_size: PERIOD,
        exchange: ExchangeParams::PAPER,
        field: &[],
    })
}

/// Runs a node for `steps` steps on this board; returns its output and the number of broadcasts.
fn run(steps: u32) -> (Vec<u8>, u32) {
    let now = Now::default();
    let (heard, output) = (Rc::new(Cell::new(0)), Rc::new(RefCell::new(Vec::new())));
    let sensor = Position(now.clone());
    let link = Neighbour { now: now.clone(), heard: heard.clone(), told: 0 };
    let clock = Simulated { now: now.clone(), counted: 0 };
    let port = Console { now, steps, input: VecDeque::new(), output: output.clone() };
    let mut board = Hardware::new(sensor, link, clock, port);

    let settings = Settings {
        layout: Ram::LAYOUT,
        public_key: None,
        step_range: StepRange::DEFAULT,
        health: HealthSettings::RECOMMENDED,
        update_limit: agent_core::store::RateLimit::DEFAULT,
        trial: firmware_template::RECOMMENDED_TRIAL,
        sample_stride: NonZeroU32::MIN,
        subscription: Subscription { state_every: NonZeroU32::new(500), outer_weights: false },
        fallback: fallback(),
        stack_unused: None,
        start: firmware_template::Start::default(),
        keep_epochs: None,
        factory_reset: false,
        version: [0, 1, 0],
    };
    // State dimension 2; capacity for 1 feature, 1 neighbour, 8 samples.
    let mut memory = Memory::new();
    let mut node = Node::<_, 2, 1, 1, 8>::new(Ram([0xff; _]), settings, &mut memory)
        .expect("the layout is valid");
    node.run(&mut board);
    (output.take(), heard.get())
}

/// Decodes the responses in `bytes`, as `monitor` does.
fn responses(bytes: &[u8], mut show: impl FnMut(Response<'_, Numbers>)) {
    let mut decoder = Decoder::<512>::new();
    for byte in bytes {
        if let Some(Ok(message)) = decoder.push(*byte)
            && let Some(response) = receive(message)
        {
            show(response);
        }
    }
}

fn main() {
    let (bytes, broadcasts) = run(5_000);
    responses(&bytes, |response| match response {
        Response::State(state) => {
            let truth = plant(state.tick as u32 + 1);
            println!("tick {:4}: estimate {:?}, truth {truth:?}", state.tick, state.estimate);
        }
        other => println!("{other:?}"),
    });
    println!("{broadcasts} broadcasts in 5000 steps");
}

#[test]
fn the_node_estimates_what_it_does_not_measure() {
    let (bytes, broadcasts) = run(5_000);
    let (mut states, mut done) = (0, false);
    responses(&bytes, |response| match response {
        Response::State(state) if state.tick > 0 => {
            states += 1;
            assert_eq!(state.outcome, agent_core::service::Outcome::Stepped);
            // The node's step `k` sees the plant after `k + 1` periods.
            let truth = plant(state.tick as u32 + 1);
            let error = state.estimate.iter().zip(truth).map(|(x, y)| (x - y).abs());
            let error = error.fold(0.0, f32::max);
            assert!(error < 0.05, "tick {}: {error}", state.tick);
        }
        Response::Done => done = true,
        _ => {}
    });
    assert_eq!((states, done), (9, true));
    assert!((10..2_500).contains(&broadcasts), "{broadcasts} broadcasts");
}
