//! A board whose plant, clock and link are played at the other end of the service port: by the
//! simulator, for a co-simulation ("hardware in the loop").
//!
//! Requests to the node and stimuli ([`Request::Frame`], [`Request::Tick`]) arrive over one port
//! and take effect in order. The output of a turn is written at once.
//!
//! Memory: the port, one request, `FRAMES` frames, and 512 bytes of input and output.

use agent_core::service::{Numbers, Request, Response, receive, respond};
use agent_core::wire::LENGTH_MAX;
use agent_core::wire::cobs::SerialError;
use embedded_io::{Read, Write};

use crate::board::{
    Board, LinkErrorKind, RequestBuffer, RequestDecoder, SensorErrorKind, copied, write_whole,
};

/// Bytes read or written at a time.
const CHUNK: usize = 256;

/// A board in the loop, with capacity for `FRAMES` frames between two steps.
#[derive(Debug)]
pub struct InTheLoop<P, const FRAMES: usize> {
    port: P,
    decoder: RequestDecoder,
    input: [u8; CHUNK],
    /// The part of the input that has not been decoded.
    unread: core::ops::Range<usize>,
    output: heapless::Vec<u8, CHUNK>,
    frames: heapless::Deque<heapless::Vec<u8, LENGTH_MAX>, FRAMES>,
    periods: u32,
    measurement: Option<Numbers>,
}

impl<P: Read + Write, const FRAMES: usize> InTheLoop<P, FRAMES> {
    /// Creates the board at the end of this port.
    pub const fn new(port: P) -> Self {
        Self {
            port,
            decoder: RequestDecoder::new(),
            input: [0; CHUNK],
            unread: 0..0,
            output: heapless::Vec::new(),
            frames: heapless::Deque::new(),
            periods: 0,
            measurement: None,
        }
    }

    /// Returns the port, for what comes after the node's work.
    pub fn port(&mut self) -> &mut P {
        &mut self.port
    }

    /// Returns the next message, if it has arrived completely.
    fn message(&mut self) -> Option<Result<&[u8], SerialError>> {
        // The decoder's result borrows it, so the end of a message is located first.
        loop {
            let byte = *self.input.get(self.unread.next()?)?;
            if byte == agent_core::wire::cobs::DELIMITER {
                return self.decoder.push(byte);
            }
            let _ = self.decoder.push(byte);
        }
    }

    fn write_out(&mut self) {
        let _ = write_whole(&mut self.port, &self.output);
        self.output.clear();
    }
}

/// A message for the board; the node gets all others.
enum Stimulus {
    Frame(heapless::Vec<u8, LENGTH_MAX>),
    Tick(u32, Option<Numbers>),
}

fn stimulus(message: &[u8]) -> Option<Stimulus> {
    match receive::<Request<'_>>(message)? {
        // A longer one is not a frame; an empty one stands for it and is refused.
        Request::Frame { bytes } => {
            Some(Stimulus::Frame(heapless::Vec::from_slice(bytes).unwrap_or_default()))
        }
        Request::Tick { periods, measurement } => Some(Stimulus::Tick(periods, measurement)),
        _ => None,
    }
}

impl<P: Read + Write, const FRAMES: usize> Board for InTheLoop<P, FRAMES> {
    fn start(&mut self, _period: f32) {}

    fn elapsed(&mut self) -> u32 {
        core::mem::take(&mut self.periods)
    }

    fn rest(&mut self) {
        if self.unread.is_empty()
            && self.periods == 0
            && let Ok(length) = self.port.read(&mut self.input)
        {
            self.unread = 0..length;
        }
    }

    /// A tick without a measurement stands for a sensor that is not ready.
    fn measure(&mut self, measurement: &mut [f32]) -> Result<usize, SensorErrorKind> {
        let numbers = self.measurement.take().ok_or(SensorErrorKind::NotReady)?;
        let places = measurement.get_mut(..numbers.len()).ok_or(SensorErrorKind::Other)?;
        places.iter_mut().zip(&numbers).for_each(|(place, number)| *place = *number);
        Ok(numbers.len())
    }

    fn broadcast(&mut self, frame: &[u8]) -> Result<(), LinkErrorKind> {
        respond(None, &Response::Broadcast { bytes: frame }, &mut |bytes| self.respond(bytes));
        Ok(())
    }

    fn frame<'buffer>(
        &mut self,
        buffer: &'buffer mut [u8],
    ) -> Option<Result<&'buffer [u8], LinkErrorKind>> {
        let frame = self.frames.pop_front()?;
        Some(copied(&frame, buffer).map(|frame| &*frame).map_err(LinkErrorKind::from))
    }

    #[inline(never)] // Frees its stack before the request is carried out.
    fn request<'buffer>(
        &mut self,
        buffer: &'buffer mut RequestBuffer,
    ) -> Option<Result<&'buffer mut [u8], SerialError>> {
        while self.periods == 0 {
            let message = match self.message()? {
                Ok(message) => message,
                Err(error) => return Some(Err(error)),
            };
            match stimulus(message) {
                None => return Some(copied(message, buffer)),
                Some(Stimulus::Frame(frame)) => {
                    // Frames beyond the capacity are lost, as with a real receiver.
                    let _ = self.frames.push_back(frame);
                }
                Some(Stimulus::Tick(periods, measurement)) => {
                    (self.periods, self.measurement) = (periods, measurement);
                }
            }
        }
        None
    }

    fn respond(&mut self, bytes: &[u8]) {
        if self.output.capacity() - self.output.len() < bytes.len() {
            self.write_out();
        }
        if self.output.extend_from_slice(bytes).is_err() {
            let _ = write_whole(&mut self.port, bytes);
        }
    }

    fn flush(&mut self) {
        self.write_out();
        let _ = self.port.flush();
    }
}
