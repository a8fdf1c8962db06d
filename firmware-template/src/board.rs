//! What a node needs from its board.
//!
//! | trait | purpose | implementation |
//! | --- | --- | --- |
//! | [`Sensor`] | reads the agent's own part of the output, `y_i` | [`crate::RegisterSensor`], or the board |
//! | [`Link`] | moves frames to and from the neighbours | [`crate::SerialLink`], or the board |
//! | [`Clock`] | paces the steps | the board |
//! | [`embedded_io`]'s `Read`, `ReadReady`, `Write` | the service port, to a laptop | the board's HAL |
//! | [`agent_core::store::MappedFlash`] | keeps weight packages | the board |
//!
//! [`Hardware`] joins the first four to a [`Board`], which is what [`crate::node::Node`] runs on.
//! None of this allocates, and only [`Clock::rest`] waits.
//!
//! What goes wrong with sensor and link has a kind ([`SensorErrorKind`], [`LinkErrorKind`]), as errors
//! of embedded-hal do. A node counts them by kind and reports the counts through its service port, as
//! [`agent_core::health::BoardErrors`].

use agent_core::service::REQUEST_LENGTH_MAX;
use agent_core::wire::cobs::{Decoder, SerialError};
use embedded_io::{Read, ReadReady, Write};

pub use crate::board_error::{LinkError, LinkErrorKind, SensorError, SensorErrorKind};

/// Reads the agent's own part of the output, `y_i`.
pub trait Sensor {
    /// What can go wrong on the way to the sensor; [`SensorErrorKind`] itself will do.
    type Error: SensorError;

    /// Returns the number of components of `y_i` that [`read`](Self::read) delivers.
    fn outputs(&self) -> usize;

    /// Takes one sample and writes it into `measurement`, in the units of the agent's model.
    ///
    /// # Errors
    /// The bus or the sensor failed, or `measurement` does not have
    /// [`outputs`](Self::outputs) elements. `measurement` is then unchanged, so that the
    /// observer never gets part of a sample.
    fn read(&mut self, measurement: &mut [f32]) -> Result<(), Self::Error>;
}

/// Moves frames to and from the neighbours without decoding them.
///
/// A link may lose, repeat and reorder whole frames. It never delivers a part of one.
pub trait Link {
    /// What can go wrong on the way to the neighbours; [`LinkErrorKind`] itself will do.
    type Error: LinkError;

    /// Passes a frame on for sending to all neighbours. Delivery is not guaranteed.
    ///
    /// # Errors
    /// The frame could not be passed on, and no part of it was sent.
    fn send(&mut self, frame: &[u8]) -> Result<(), Self::Error>;

    /// Takes the oldest received frame, if there is one: copies it to the start of `buffer`
    /// and returns that part of it. Never waits.
    ///
    /// # Errors
    /// The receiver failed, or the frame is longer than `buffer`. The frame is then lost, and
    /// the next call takes the next one.
    fn poll<'buffer>(
        &mut self,
        buffer: &'buffer mut [u8],
    ) -> Result<Option<&'buffer [u8]>, Self::Error>;
}

/// Paces the agent at the fixed sampling period of its observer.
pub trait Clock {
    /// Starts counting sampling periods of this length \[s\], which is the `dt` of the package in
    /// use. Called when the node starts and whenever a package has another period.
    fn start(&mut self, period: f32);

    /// Returns how many periods have begun since the last call: 1 if the agent keeps up, more if
    /// it is late, 0 if the next period has not begun. Never waits.
    fn elapsed(&mut self) -> u32;

    /// Waits until a period may have begun or a byte may have arrived at the service port. Spurious
    /// returns are allowed, as from an instruction that waits for an interrupt.
    fn rest(&mut self);

    /// Called when the work of a period has been done. A board feeds its watchdog here, and while
    /// nothing is due ([`Periods::nothing_is_due`](crate::Periods::nothing_is_due)), so that it bites
    /// when due work is not done, whatever else still runs.
    fn done(&mut self) {}
}

/// Everything around a node except its flash.
pub trait Board {
    /// See [`Clock::start`].
    fn start(&mut self, period: f32);

    /// See [`Clock::elapsed`].
    fn elapsed(&mut self) -> u32;

    /// See [`Clock::rest`].
    fn rest(&mut self);

    /// See [`Clock::done`].
    fn done(&mut self) {}

    /// Takes a sample into `measurement` and returns how many components it has. See [`Sensor::read`].
    ///
    /// # Errors
    /// The sensor failed, or has more components than there is room for.
    fn measure(&mut self, measurement: &mut [f32]) -> Result<usize, SensorErrorKind>;

    /// Hands a frame to the link. See [`Link::send`].
    ///
    /// # Errors
    /// The frame was not sent.
    fn broadcast(&mut self, frame: &[u8]) -> Result<(), LinkErrorKind>;

    /// The oldest received frame, or why it was lost. See [`Link::poll`].
    fn frame<'buffer>(
        &mut self,
        buffer: &'buffer mut [u8],
    ) -> Option<Result<&'buffer [u8], LinkErrorKind>>;

    /// The next request at the service port, or that it was damaged. Never waits. A sealed request is
    /// opened in place.
    fn request<'buffer>(
        &mut self,
        buffer: &'buffer mut RequestBuffer,
    ) -> Option<Result<&'buffer mut [u8], SerialError>>;

    /// Sends bytes through the service port. Bytes that cannot be sent are lost: telemetry must not
    /// hold up a step.
    fn respond(&mut self, bytes: &[u8]);

    /// Sends what [`respond`](Self::respond) may have buffered.
    fn flush(&mut self);
}

/// Room for one request.
pub type RequestBuffer = [u8; REQUEST_LENGTH_MAX];

/// Decodes the service port's requests.
pub type RequestDecoder = Decoder<{ REQUEST_LENGTH_MAX + agent_core::wire::crc::CHECKSUM_LENGTH }>;

/// A board made of a sensor, a link, a clock and a service port.
#[derive(Debug)]
pub struct Hardware<S, L, C, P> {
    sensor: S,
    link: L,
    clock: C,
    port: P,
    decoder: RequestDecoder,
}

impl<S: Sensor, L: Link, C: Clock, P: Read + ReadReady + Write> Hardware<S, L, C, P> {
    /// Creates a board from its parts.
    pub const fn new(sensor: S, link: L, clock: C, port: P) -> Self {
        Self { sensor, link, clock, port, decoder: RequestDecoder::new() }
    }

    /// Returns the clock: an asynchronous main loop asks it when the next period begins.
    pub const fn clock(&mut self) -> &mut C {
        &mut self.clock
    }
}

impl<S: Sensor, L: Link, C: Clock, P: Read + ReadReady + Write> Board for Hardware<S, L, C, P> {
    fn start(&mut self, period: f32) {
        self.clock.start(period);
    }

    fn elapsed(&mut self) -> u32 {
        self.clock.elapsed()
    }

    fn rest(&mut self) {
        self.clock.rest();
    }

    fn done(&mut self) {
        self.clock.done();
    }

    fn measure(&mut self, measurement: &mut [f32]) -> Result<usize, SensorErrorKind> {
        let outputs = self.sensor.outputs();
        let measurement = measurement.get_mut(..outputs).ok_or(SensorErrorKind::Other)?;
        self.sensor.read(measurement).map_err(|error| error.kind())?;
        Ok(outputs)
    }

    fn broadcast(&mut self, frame: &[u8]) -> Result<(), LinkErrorKind> {
        self.link.send(frame).map_err(|error| error.kind())
    }

    fn frame<'buffer>(
        &mut self,
        buffer: &'buffer mut [u8],
    ) -> Option<Result<&'buffer [u8], LinkErrorKind>> {
        self.link.poll(buffer).map_err(|error| error.kind()).transpose()
    }

    #[inline(never)] // Frees its stack before the request is carried out.
    fn request<'buffer>(
        &mut self,
        buffer: &'buffer mut RequestBuffer,
    ) -> Option<Result<&'buffer mut [u8], SerialError>> {
        // When flooded, the node returns to its steps after the longest request.
        for _ in 0..2 * REQUEST_LENGTH_MAX {
            if !self.port.read_ready().unwrap_or(false) {
                return None;
            }
            let mut byte = [0];
            if !matches!(self.port.read(&mut byte), Ok(1)) {
                return None;
            }
            let [byte] = byte;
            if let Some(message) = self.decoder.push(byte) {
                return Some(message.and_then(|message| copied(message, buffer)));
            }
        }
        None
    }

    fn respond(&mut self, bytes: &[u8]) {
        let _ = write_whole(&mut self.port, bytes);
    }

    fn flush(&mut self) {
        let _ = self.port.flush();
    }
}

/// Writes all of `bytes`, or returns that it could not: `write_all` panics where a port writes nothing.
pub(crate) fn write_whole<P: Write>(port: &mut P, mut bytes: &[u8]) -> Result<(), LinkErrorKind> {
    while !bytes.is_empty() {
        match port.write(bytes) {
            Ok(length) if length > 0 => bytes = bytes.get(length..).unwrap_or_default(),
            _ => return Err(LinkErrorKind::NotSent),
        }
    }
    Ok(())
}

/// Copies `message` to the start of `buffer`.
pub(crate) fn copied<'buffer>(
    message: &[u8],
    buffer: &'buffer mut [u8],
) -> Result<&'buffer mut [u8], SerialError> {
    let place = buffer.get_mut(..message.len()).ok_or(SerialError::TooLong)?;
    // `copy_from_slice` would keep a panicking path when the compiler optimises for size.
    place.iter_mut().zip(message).for_each(|(place, byte)| *place = *byte);
    Ok(place)
}
