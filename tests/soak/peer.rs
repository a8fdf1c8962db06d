//! A node with a line and a power supply: the firmware in an emulator, or its twin, the same code
//! compiled for this machine, in a thread.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use agent_core::service::receive;
use agent_core::wire::cobs::Decoder;
use host_sim::packages::PackageBytes;
use host_sim::service::{Line, Message};

use super::emulator::Emulator;
use super::twin::Twin;

/// Time limit for an answer.
pub(super) const DEADLINE: Duration = Duration::from_secs(20);

/// Length of a node's longest message.
const MESSAGE_MAX: usize = 4096;

/// The last message to wait for.
#[derive(Clone, Copy, Debug)]
pub(super) enum End {
    /// The answer to the fence with this number.
    Fence(u64),
    /// The acknowledgement of a reset.
    Done,
    /// Its greeting.
    Hello,
}

impl End {
    fn is(self, message: &[u8]) -> bool {
        match (self, receive::<Message<'_>>(message)) {
            (Self::Fence(number), Some(Message::SamplesEnd { next })) => next == number,
            (Self::Done, Some(Message::Done)) | (Self::Hello, Some(Message::Hello(_))) => true,
            _ => false,
        }
    }
}

/// The output of a node: the bytes, and the messages in them.
#[derive(Clone, Debug, Default)]
pub(super) struct Said {
    pub(super) bytes: Vec<u8>,
    pub(super) messages: Vec<Vec<u8>>,
}

enum Body {
    Emulator(Emulator),
    Twin(Twin),
}

/// A node and the line to it.
pub(super) struct Peer {
    body: Body,
    line: Line,
    decoder: Box<Decoder<MESSAGE_MAX>>,
    unread: VecDeque<u8>,
}

impl Peer {
    /// Starts the node's code in a thread.
    pub(super) fn twin(package: &PackageBytes) -> Self {
        let (twin, line) = Twin::start(package);
        Self::new(Body::Twin(twin), line)
    }

    /// Starts the firmware in an emulator.
    pub(super) fn emulated(
        firmware: &std::path::Path,
        package: &PackageBytes,
    ) -> Result<Self, String> {
        let (emulator, line) = Emulator::start(firmware, package)?;
        Ok(Self::new(Body::Emulator(emulator), line))
    }

    fn new(body: Body, line: Line) -> Self {
        Self { body, line, decoder: Box::new(Decoder::new()), unread: VecDeque::new() }
    }

    pub(super) fn send(&mut self, bytes: &[u8]) -> Result<(), String> {
        self.line.send(bytes, DEADLINE).map_err(|error| error.to_string())
    }

    /// Returns the output up to `end`.
    pub(super) fn hear(&mut self, end: End) -> Result<Said, String> {
        let deadline = Instant::now() + DEADLINE;
        let mut said = Said::default();
        loop {
            while let Some(byte) = self.unread.pop_front() {
                said.bytes.push(byte);
                if let Some(message) = self.decoder.push(byte) {
                    let message = message.map_err(|error| error.to_string())?.to_vec();
                    let last = end.is(&message);
                    said.messages.push(message);
                    if last {
                        return Ok(said);
                    }
                }
            }
            let left = deadline.saturating_duration_since(Instant::now());
            let received = self.line.receive(left).map_err(|error| {
                format!(
                    "{error} while waiting for {end:?}, after {:?}",
                    super::judge::names(&said.messages)
                )
            })?;
            self.unread.extend(received);
        }
    }

    /// Prepares for a reset that the node has acknowledged; its pipes close for a moment.
    pub(super) fn expect_reset(&mut self) {
        self.line.expect_reset();
    }

    /// Cuts the power and restores it.
    pub(super) fn cycle_power(&mut self) -> Result<(), String> {
        if !self.unread.is_empty() {
            return Err(format!("{} unsolicited bytes", self.unread.len()));
        }
        self.line = match &mut self.body {
            Body::Emulator(emulator) => emulator.cycle_power()?,
            Body::Twin(twin) => twin.cycle_power()?,
        };
        *self.decoder = Decoder::new();
        Ok(())
    }

    /// Returns the flash contents at the last power failure.
    pub(super) fn flash(&self) -> &[u8] {
        match &self.body {
            Body::Emulator(emulator) => emulator.flash(),
            Body::Twin(twin) => twin.flash(),
        }
    }
}
