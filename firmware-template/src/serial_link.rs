//! A link over a shared serial line: RS-485, a UART between two nodes, or a transparent radio
//! module.
//!
//! Frames are encoded like messages ([`agent_core::wire::cobs`]), so a node that joins late
//! synchronises at the next one. Access to the line is not arbitrated; colliding frames fail their
//! checksum and are lost, which the observer tolerates.
//!
//! Memory: the port and 90 bytes.

use agent_core::wire::cobs::{Decoder, Encoder, SerialError};
use agent_core::wire::crc::CHECKSUM_LENGTH;
use agent_core::wire::frame::FRAME_LENGTH_MAX;
use embedded_io::{Read, ReadReady, Write};

use crate::board::{copied, write_whole};
use crate::{Link, Lost};

/// A link over the port `P`.
#[derive(Debug)]
pub struct SerialLink<P> {
    port: P,
    decoder: Decoder<{ FRAME_LENGTH_MAX + CHECKSUM_LENGTH }>,
}

impl<P> SerialLink<P> {
    /// Creates a link over `port`.
    pub const fn new(port: P) -> Self {
        Self { port, decoder: Decoder::new() }
    }
}

impl<P: Read + ReadReady + Write> Link for SerialLink<P> {
    type Error = Lost;

    fn send(&mut self, frame: &[u8]) -> Result<(), Lost> {
        let mut outcome = Ok(());
        let port = &mut self.port;
        let mut encoder = Encoder::new(|block: &[u8]| {
            if outcome.is_ok() {
                outcome = write_whole(port, block);
            }
        });
        encoder.extend(frame);
        encoder.finish();
        outcome
    }

    fn poll<'buffer>(&mut self, buffer: &'buffer mut [u8]) -> Result<Option<&'buffer [u8]>, Lost> {
        while self.port.read_ready().map_err(|_| Lost)? {
            let mut byte = [0];
            if self.port.read(&mut byte).map_err(|_| Lost)? == 0 {
                break;
            }
            let [byte] = byte;
            if let Some(message) = self.decoder.push(byte) {
                let frame: Result<_, SerialError> =
                    message.and_then(|message| copied(message, buffer));
                return frame.map(Some).map_err(|_| Lost);
            }
        }
        Ok(None)
    }
}
