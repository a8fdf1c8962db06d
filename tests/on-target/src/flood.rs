//! A node with keys whose service port and radio are flooded: how late its steps are.
//!
//! A clock that counts instructions begins a period every 64,000 of them, as a chip of 64 MHz does
//! for steps of 1 ms if it carries out one instruction a cycle. Bytes arrive at the line's rate,
//! without a pause, and in every period more forged frames than the node takes.

use core::cell::RefCell;
use core::convert::Infallible;
use core::num::NonZeroU32;

use agent_core::health::HealthSettings;
use agent_core::service::Subscription;
use agent_core::wire::authentic::{self, Bytes, Header, Kind, NetworkKey, Stamp};
use agent_core::wire::cobs::Encoder;
use agent_core::wire::secret::Secret;
use embedded_io::{ErrorType, Read, ReadReady, Write};
use firmware_template::board::{Clock, Link, Sensor};
use firmware_template::{
    Epochs, Hardware, LinkErrorKind, Memory, Node, SensorErrorKind, Settings, Start,
};

use crate::Unusable;
use crate::meter::{Figure, Figures, Meter};
use crate::node::N;
use crate::turn::{FEATURES, LAYOUT, NEIGHBOURS, ReadOnly, SAMPLES};

/// Between two steps. \[instruction\]
const PERIOD: u32 = 64_000;
/// Periods of each flood.
const TURNS: u32 = 60;
/// Bytes that the port's queue holds; more are lost.
const QUEUE: u64 = 2_048;
/// Between two bytes of ten bits, at 1,000,000 and at 115,200 baud. \[instruction\]
const BYTES: [u64; 2] = [640, 5_556];

/// Two copies of the records of a port key, a network key and 64 epochs, as a store writes them:
/// `tests/keyed/flood_fixture.rs` makes and compares them.
pub(crate) const JOURNAL: [u8; 384] = *include_bytes!("../fixtures/keys.journal");
/// The end of the epochs in that journal.
const EPOCHS_END: u32 = 64;

/// The bytes of a message.
type Message = heapless::Vec<u8, 256>;

/// What arrives at the port.
#[derive(Clone, Copy)]
enum Traffic {
    /// A request that needs no key, and has the longest answer.
    Query,
    /// Another one, whose answer has a proof.
    Session,
    /// The longest request, with a seal that does not match.
    Forged,
    /// Bytes without an end.
    Noise,
}

/// The world of a node.
struct World<'m, M> {
    meter: &'m mut M,
    figures: &'m mut Figures,
    /// \[instruction\]
    now: u64,
    next: u64,
    begun: u64,
    turns: u32,
    /// The message that is sent again and again.
    message: Message,
    between_bytes: u64,
    taken: u64,
    forged: Bytes,
    frames: usize,
}

impl<M: Meter> World<'_, M> {
    /// Lets the time pass that has been worked.
    fn pass(&mut self) {
        self.now += u64::from(self.meter.stop());
        self.meter.start();
    }

    fn waiting(&mut self) -> u64 {
        let waiting =
            self.now.checked_div(self.between_bytes).unwrap_or(0).saturating_sub(self.taken);
        self.taken += waiting.saturating_sub(QUEUE);
        waiting.min(QUEUE)
    }

    fn next_byte(&mut self) -> Option<u8> {
        if self.waiting() == 0 {
            return None;
        }
        let place = self.taken.checked_rem(self.message.len() as u64)?;
        let byte = self.message.get(place as usize).copied();
        self.taken += 1;
        byte
    }
}

/// One end of a node's board.
struct End<'w, 'm, M>(&'w RefCell<World<'m, M>>);

impl<'m, M: Meter> End<'_, 'm, M> {
    /// Nothing else uses the world meanwhile.
    fn with<R>(&self, act: impl FnOnce(&mut World<'m, M>) -> R) -> Option<R> {
        self.0.try_borrow_mut().ok().map(|mut world| act(&mut world))
    }
}

impl<M: Meter> Sensor for End<'_, '_, M> {
    type Error = SensorErrorKind;

    fn outputs(&self) -> usize {
        1
    }

    fn read(&mut self, measurement: &mut [f32]) -> Result<(), SensorErrorKind> {
        measurement.iter_mut().for_each(|place| *place = 0.25);
        Ok(())
    }
}

impl<M: Meter> Link for End<'_, '_, M> {
    type Error = LinkErrorKind;

    fn send(&mut self, _: &[u8]) -> Result<(), LinkErrorKind> {
        Ok(())
    }

    fn poll<'b>(&mut self, buffer: &'b mut [u8]) -> Result<Option<&'b [u8]>, LinkErrorKind> {
        let length = self.with(|world| {
            world.frames = world.frames.checked_sub(1)?;
            let place = buffer.get_mut(..world.forged.len())?;
            place.iter_mut().zip(&world.forged).for_each(|(place, byte)| *place = *byte);
            Some(place.len())
        });
        Ok(length.flatten().and_then(|length| buffer.get(..length)))
    }
}

impl<M: Meter> Clock for End<'_, '_, M> {
    fn start(&mut self, _: f32) {}

    fn elapsed(&mut self) -> u32 {
        let periods = self.with(|world| {
            world.pass();
            let Some(late) = world.now.checked_sub(world.next) else { return 0 };
            let periods = 1 + late / u64::from(PERIOD);
            world.begun = world.next + (periods - 1) * u64::from(PERIOD);
            world.next = world.begun + u64::from(PERIOD);
            world.frames = 4 * NEIGHBOURS;
            periods as u32
        });
        periods.unwrap_or(0)
    }

    fn rest(&mut self) {
        self.with(|world| {
            let byte = (world.taken + 1) * world.between_bytes;
            world.now = world.now.max(world.next.min(byte));
        });
    }

    fn done(&mut self) {
        self.with(|world| {
            world.pass();
            world.turns += 1;
            world.figures.add(Figure::Flood, (world.now - world.begun) as u32);
        });
    }
}

impl<M> ErrorType for End<'_, '_, M> {
    type Error = Infallible;
}

impl<M: Meter> ReadReady for End<'_, '_, M> {
    fn read_ready(&mut self) -> Result<bool, Infallible> {
        Ok(self.with(|world| world.waiting() > 0).unwrap_or(false))
    }
}

impl<M: Meter> Read for End<'_, '_, M> {
    fn read(&mut self, buffer: &mut [u8]) -> Result<usize, Infallible> {
        let byte = self.with(World::next_byte).flatten();
        Ok(buffer.iter_mut().zip(byte).map(|(place, byte)| *place = byte).count())
    }
}

impl<M: Meter> Write for End<'_, '_, M> {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, Infallible> {
        Ok(bytes.len())
    }

    fn flush(&mut self) -> Result<(), Infallible> {
        Ok(())
    }
}

/// Floods a node in every way; returns [`Figure::Flood`].
///
/// # Errors
/// The node cannot be set up.
pub fn flood(meter: &mut impl Meter) -> Result<Figures, Unusable> {
    let mut figures = Figures::NONE;
    for traffic in [Traffic::Query, Traffic::Session, Traffic::Forged, Traffic::Noise] {
        for between_bytes in BYTES {
            run(meter, &mut figures, &message(traffic), between_bytes)?;
        }
    }
    Ok(figures)
}

/// The bytes of one message on the line.
fn message(traffic: Traffic) -> Message {
    /// Index, the largest counter, and a salt; then as many bytes as the longest request and a tag.
    const FORGED: [u8; 170] = {
        let mut bytes = [0x5a; 170];
        (bytes[0], bytes[5]) = (17, 0x0f);
        (bytes[1], bytes[2], bytes[3], bytes[4]) = (0xff, 0xff, 0xff, 0xff);
        bytes
    };
    let request: &[u8] = match traffic {
        Traffic::Query => &[0],
        Traffic::Session => &[16],
        Traffic::Forged => &FORGED,
        Traffic::Noise => return [0x5a; 250].into_iter().collect(),
    };
    let mut line = Message::new();
    let mut encoder = Encoder::new(|bytes: &[u8]| {
        // The longest is shorter than the room.
        let _ = line.extend_from_slice(bytes);
    });
    encoder.extend(request);
    encoder.finish();
    line
}

#[inline(never)]
fn run(
    meter: &mut impl Meter,
    figures: &mut Figures,
    message: &Message,
    between_bytes: u64,
) -> Result<(), Unusable> {
    let stranger = NetworkKey::new(1, Secret::new([0xee; 16]));
    let stamp = Stamp { epoch: u32::MAX, sequence: 1 };
    let header = Header { sender: 2, stamp, tick: 9, kind: Kind::Estimate };
    let forged = authentic::seal(&header, &[1e3_f32.to_le_bytes(); N], &stranger);
    let settings = Settings {
        layout: LAYOUT,
        public_key: None,
        step_range: agent_core::package::StepRange::ANY,
        health: HealthSettings::RECOMMENDED,
        update_limit: agent_core::store::RateLimit::NONE,
        trial: firmware_template::RECOMMENDED_TRIAL,
        sample_stride: NonZeroU32::MIN,
        subscription: Subscription { state_every: Some(NonZeroU32::MIN), outer_weights: false },
        fallback: None,
        stack_unused: None,
        start: Start { epochs: Epochs { next: 0, end: EPOCHS_END }, ..Start::default() },
        keep_epochs: None,
        factory_reset: false,
        version: [0; 3],
    };
    let mut memory = Memory::<N, FEATURES, NEIGHBOURS, SAMPLES>::new();
    let node = Node::<_, N, FEATURES, NEIGHBOURS, SAMPLES>::new(
        ReadOnly::WITH_KEYS,
        settings,
        &mut memory,
    );
    let mut node = node.map_err(|_| Unusable { what: "the node's flash has another layout" })?;
    let world = RefCell::new(World {
        meter,
        figures,
        now: 0,
        next: u64::from(PERIOD),
        begun: 0,
        turns: 0,
        message: message.clone(),
        between_bytes,
        taken: 0,
        forged,
        frames: 0,
    });
    let mut board = Hardware::new(End(&world), End(&world), End(&world), End(&world));
    End(&world).with(|world| world.meter.start());
    while End(&world).with(|world| world.turns) < Some(TURNS) {
        if node.poll(&mut board) == firmware_template::Progress::Idle {
            firmware_template::Board::rest(&mut board);
        }
    }
    // Otherwise nothing would be decrypted.
    let has_keys = node.session().is_some_and(|session| session.epoch.is_some());
    if has_keys { Ok(()) } else { Err(Unusable { what: "the flooded node has no keys" }) }
}
