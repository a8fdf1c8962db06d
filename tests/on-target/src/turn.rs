//! A complete node of the firmware template with its inputs and outputs: one turn after another,
//! until a reset is requested.

use core::num::NonZeroU32;

use agent_core::health::HealthSettings;
use agent_core::service::{Request, Subscription, send};
use agent_core::store::{Layout, MappedFlash};
use agent_core::wire::cobs::SerialError;
use agent_core::wire::frame::{FRAME_LENGTH_MAX, Frame, FrameBytes};
use embedded_storage::nor_flash::{ErrorType, NorFlash, NorFlashErrorKind, ReadNorFlash};
use firmware_template::board::{
    Board, LinkErrorKind, RequestBuffer, RequestDecoder, SensorErrorKind,
};
use firmware_template::{Memory, Node, Settings};

use crate::Unusable;
use crate::digest::Digest;
use crate::draw::{scaled, triangle};
use crate::meter::{Figure, Figures, Meter};
use crate::node::N;
use crate::package;

/// Number of turns.
const TURNS: u32 = 400;
/// Capacities of the node.
pub(crate) const FEATURES: usize = 8;
pub(crate) const NEIGHBOURS: usize = 2;
pub(crate) const SAMPLES: usize = 8;

/// Largest output of a node in a turn, including its greeting. \[byte\]
const SAID: usize = 1024;
/// Length of a slot, of the journal's halves, and of an erase unit. \[byte\]
const UNIT: usize = 4096;
pub(crate) const LAYOUT: Layout = Layout {
    slots: [0, UNIT as u32],
    slot_length: UNIT as u32,
    commit: 2 * UNIT as u32,
    commit_length: 2 * UNIT as u32,
};

/// Flash as programmed at the factory: a package in slot A, without a record of it, and a journal.
#[repr(C, align(4))]
struct Rom([u8; 4 * UNIT]);

const fn programmed(journal: &[u8]) -> Rom {
    let mut rom = Rom([0xff; 4 * UNIT]);
    let mut place = 0;
    while place < package::LENGTH {
        rom.0[place] = package::FIXTURE.0[place];
        place += 1;
    }
    let mut place = 0;
    while place < journal.len() {
        rom.0[2 * UNIT + place] = journal[place];
        place += 1;
    }
    rom
}

static ROM: Rom = programmed(&[]);
static ROM_WITH_KEYS: Rom = programmed(&crate::flood::JOURNAL);

/// A driver that refuses writes.
pub(crate) struct ReadOnly(&'static Rom);

impl ReadOnly {
    const BLANK: Self = Self(&ROM);
    /// With the keys of [`crate::flood`].
    pub(crate) const WITH_KEYS: Self = Self(&ROM_WITH_KEYS);
}

impl ErrorType for ReadOnly {
    type Error = NorFlashErrorKind;
}

impl ReadNorFlash for ReadOnly {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), NorFlashErrorKind> {
        let place = self.0.0.get(offset as usize..).and_then(|rest| rest.get(..bytes.len()));
        let place = place.ok_or(NorFlashErrorKind::OutOfBounds)?;
        bytes.iter_mut().zip(place).for_each(|(byte, stored)| *byte = *stored);
        Ok(())
    }

    fn capacity(&self) -> usize {
        self.0.0.len()
    }
}

impl NorFlash for ReadOnly {
    const WRITE_SIZE: usize = 4;
    const ERASE_SIZE: usize = UNIT;

    fn erase(&mut self, _: u32, _: u32) -> Result<(), NorFlashErrorKind> {
        Err(NorFlashErrorKind::Other)
    }

    fn write(&mut self, _: u32, _: &[u8]) -> Result<(), NorFlashErrorKind> {
        Err(NorFlashErrorKind::Other)
    }
}

impl MappedFlash for ReadOnly {
    fn mapped(&self) -> &[u8] {
        &self.0.0
    }
}

/// Counts from the start of a period until all reports have been sent.
struct Bench<'b, M> {
    meter: &'b mut M,
    figures: &'b mut Figures,
    figure: Figure,
    digest: Digest,
    turn: u32,
    /// The neighbours' frames for this turn, encoded before counting starts.
    frames: [FrameBytes; NEIGHBOURS],
    received: usize,
    broadcast: bool,
    /// The node's output, hashed after counting has stopped.
    said: [u8; SAID],
    length: usize,
    is_counted: bool,
}

impl<M> Bench<'_, M> {
    /// Buffers bytes, as a link or a port does.
    #[inline]
    fn hear(&mut self, bytes: &[u8]) {
        let room = self.said.get_mut(self.length..).unwrap_or_default();
        if let Some(place) = room.get_mut(..bytes.len()) {
            place.iter_mut().zip(bytes).for_each(|(place, byte)| *place = *byte);
            self.length += bytes.len();
        }
    }

    fn hash_what_was_said(&mut self) {
        self.digest.bytes(self.said.get(..self.length).unwrap_or_default());
        self.length = 0;
    }
}

impl<M: Meter> Board for Bench<'_, M> {
    fn start(&mut self, period: f32) {
        self.digest.number(period.to_bits());
    }

    fn elapsed(&mut self) -> u32 {
        if self.turn == TURNS {
            return 0;
        }
        self.hash_what_was_said();
        self.frames = [frame(2, self.turn), frame(3, self.turn)];
        (self.received, self.broadcast) = (0, false);
        self.is_counted = true;
        self.meter.start();
        1
    }

    fn rest(&mut self) {}

    fn measure(&mut self, measurement: &mut [f32]) -> Result<usize, SensorErrorKind> {
        let place = measurement.first_mut().ok_or(SensorErrorKind::Other)?;
        *place = scaled(triangle(self.turn, 300), 8);
        Ok(1)
    }

    fn broadcast(&mut self, frame: &[u8]) -> Result<(), LinkErrorKind> {
        self.hear(frame);
        self.broadcast = true;
        Ok(())
    }

    fn frame<'buffer>(
        &mut self,
        buffer: &'buffer mut [u8],
    ) -> Option<Result<&'buffer [u8], LinkErrorKind>> {
        let bytes = self.frames.get(self.received)?;
        self.received += 1;
        let place = buffer.get_mut(..bytes.len())?;
        place.iter_mut().zip(bytes).for_each(|(place, byte)| *place = *byte);
        Some(Ok(place))
    }

    fn request<'buffer>(
        &mut self,
        buffer: &'buffer mut RequestBuffer,
    ) -> Option<Result<&'buffer mut [u8], SerialError>> {
        if self.turn < TURNS {
            return None;
        }
        let mut decoder = RequestDecoder::new();
        let mut length = 0;
        send(&Request::Reset, |block| {
            for &byte in block {
                if let Some(Ok(message)) = decoder.push(byte) {
                    length = message.len();
                    buffer.iter_mut().zip(message).for_each(|(place, byte)| *place = *byte);
                }
            }
        });
        buffer.get_mut(..length).map(Ok)
    }

    fn respond(&mut self, bytes: &[u8]) {
        self.hear(bytes);
    }

    fn flush(&mut self) {
        if !self.is_counted {
            return;
        }
        let instructions = self.meter.stop();
        if self.received == NEIGHBOURS && self.broadcast {
            self.figures.add(self.figure, instructions);
        }
        self.turn += 1;
        self.is_counted = false;
    }
}

/// Returns the frame of neighbour `id` before a turn.
fn frame(id: u32, turn: u32) -> FrameBytes {
    let phase = turn + 100 * id;
    let estimate = [
        scaled(triangle(phase, 300), 8),
        scaled(triangle(phase + 75, 300), 8),
        scaled(triangle(phase + 150, 300), 8),
    ];
    Frame::new(id, turn, turn.into(), estimate.into()).encode()
}

const _: () = assert!(FRAME_LENGTH_MAX < UNIT);

#[inline(never)]
pub(crate) fn digest(meter: &mut impl Meter, figures: &mut Figures) -> Result<u64, Unusable> {
    let digest = run(meter, figures, Figure::Turn, false, Digest::NEW)?;
    run(meter, figures, Figure::WholeTurn, true, digest).map(Digest::finish)
}

/// Takes all turns, with or without the outer weights in the node's reports.
fn run(
    meter: &mut impl Meter,
    figures: &mut Figures,
    figure: Figure,
    outer_weights: bool,
    digest: Digest,
) -> Result<Digest, Unusable> {
    let settings = Settings {
        layout: LAYOUT,
        public_key: None,
        step_range: agent_core::package::StepRange::ANY,
        health: HealthSettings::RECOMMENDED,
        update_limit: agent_core::store::RateLimit::NONE,
        trial: firmware_template::RECOMMENDED_TRIAL,
        sample_stride: NonZeroU32::MIN,
        subscription: Subscription { state_every: Some(NonZeroU32::MIN), outer_weights },
        fallback: None,
        stack_unused: None,
        start: firmware_template::Start::default(),
        keep_epochs: None,
        factory_reset: false,
        version: [0; 3],
    };
    let mut memory = Memory::<N, FEATURES, NEIGHBOURS, SAMPLES>::new();
    let node =
        Node::<_, N, FEATURES, NEIGHBOURS, SAMPLES>::new(ReadOnly::BLANK, settings, &mut memory);
    let mut node = node.map_err(|_| Unusable { what: "the node's flash has another layout" })?;
    let mut bench = Bench {
        meter,
        figures,
        figure,
        digest,
        turn: 0,
        frames: [FrameBytes::new(), FrameBytes::new()],
        received: 0,
        broadcast: false,
        said: [0; SAID],
        length: 0,
        is_counted: false,
    };
    node.run(&mut bench);
    bench.hash_what_was_said();
    Ok(bench.digest)
}
