//! A link over a shared serial line: RS-485, a UART between two nodes, or a transparent radio
//! module.
//!
//! Frames travel as [`agent_core::wire::cobs`] encodes messages, so that a receiver that joins late finds
//! the next one. Nothing here decides who may talk when; frames that collide fail their checksum
//! and are lost, as the observer expects of a link.
//!
//! Memory: the port and 90 bytes.

use agent_core::wire::LENGTH_MAX;
use agent_core::wire::cobs::{Decoder, Encoder};
use agent_core::wire::crc::CHECKSUM_LENGTH;
use embedded_io::{Read, ReadReady, Write};

use crate::board::{copied, write_whole};
use crate::{Link, LinkErrorKind};

/// A link over the port `P`.
#[derive(Debug)]
pub struct SerialLink<P> {
    port: P,
    decoder: Decoder<{ LENGTH_MAX + CHECKSUM_LENGTH }>,
}

impl<P> SerialLink<P> {
    /// Creates a link over this port.
    pub const fn new(port: P) -> Self {
        Self { port, decoder: Decoder::new() }
    }
}

impl<P: Read + ReadReady + Write> Link for SerialLink<P> {
    type Error = LinkErrorKind;

    fn send(&mut self, frame: &[u8]) -> Result<(), LinkErrorKind> {
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

    fn poll<'buffer>(
        &mut self,
        buffer: &'buffer mut [u8],
    ) -> Result<Option<&'buffer [u8]>, LinkErrorKind> {
        while self.port.read_ready().map_err(|_| LinkErrorKind::Receiver)? {
            let mut byte = [0];
            if self.port.read(&mut byte).map_err(|_| LinkErrorKind::Receiver)? == 0 {
                break;
            }
            let [byte] = byte;
            if let Some(message) = self.decoder.push(byte) {
                let frame = message.and_then(|message| copied(message, buffer));
                return frame.map(|frame| Some(&*frame)).map_err(LinkErrorKind::from);
            }
        }
        Ok(None)
    }
}
