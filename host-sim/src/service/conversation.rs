//! Messages on a line: requests, their answers, and what comes unasked.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use agent_core::serial::{Decoder, SerialError};
use agent_core::service::{Problem, Request, receive, send};

use super::{Line, LineError, Message};

/// Longest message of a node: a state with the outer weights of the widest network, and room.
const MESSAGE_MAX: usize = 4096;

/// Messages to and from one node.
#[derive(Debug)]
pub struct Conversation {
    line: Line,
    decoder: Box<Decoder<MESSAGE_MAX>>,
    /// What has been received and not been asked for: messages, or damage.
    heard: VecDeque<Result<Vec<u8>, SerialError>>,
    unsent: Vec<u8>,
    /// Bytes that have been received in all.
    bytes: u64,
    /// Messages that arrived damaged.
    damaged: u32,
    /// Requests that nobody answered in time: their answers may still come.
    overdue: u32,
}

/// How long an answer is waited for, and how often it is asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Patience {
    /// The time for one answer.
    pub timeout: Duration,
    /// How often the request is sent, at least once.
    pub tries: u32,
}

/// Why a request has no answer.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ServiceError {
    /// Bytes do not flow.
    #[error(transparent)]
    Line(#[from] LineError),
    /// The node does not do it.
    #[error("the node refuses: {0}")]
    Refused(Problem),
    /// A message that is none.
    #[error("the node sends what is no message: {0}")]
    Nonsense(String),
    /// A message that does not belong here.
    #[error("the node sends {found}, where {expected} is expected")]
    Unexpected {
        /// What came.
        found: String,
        /// What should have.
        expected: &'static str,
    },
}

impl Conversation {
    /// A conversation at the beginning.
    #[must_use]
    pub fn new(line: Line) -> Self {
        Self {
            line,
            decoder: Box::new(Decoder::new()),
            heard: VecDeque::new(),
            unsent: Vec::new(),
            bytes: 0,
            damaged: 0,
            overdue: 0,
        }
    }

    /// Bytes that have been received, and messages among them that were damaged.
    #[must_use]
    pub fn received(&self) -> (u64, u32) {
        (self.bytes, self.damaged)
    }

    /// See [`Line::expect_reset`].
    pub fn expect_reset(&mut self) {
        self.line.expect_reset();
    }

    /// Prepares a request; [`Self::flush`] sends it.
    pub fn prepare(&mut self, request: &Request<'_>) {
        send(request, |bytes| self.unsent.extend_from_slice(bytes));
    }

    /// Ends whatever the receiver may hold of an earlier message.
    pub fn prepare_delimiter(&mut self) {
        self.unsent.push(agent_core::serial::DELIMITER);
    }

    /// Sends what has been prepared.
    ///
    /// # Errors
    /// See [`LineError`].
    pub fn flush(&mut self, timeout: Duration) -> Result<(), LineError> {
        let sent = self.line.send(&self.unsent, timeout);
        self.unsent.clear();
        sent
    }

    /// The next message as it was framed, or what is wrong with it.
    ///
    /// # Errors
    /// [`LineError::Silent`] if none is complete in time, and the others.
    pub fn next(&mut self, timeout: Duration) -> Result<Result<Vec<u8>, SerialError>, LineError> {
        let deadline = Instant::now() + timeout;
        loop {
            if let Some(message) = self.heard.pop_front() {
                return Ok(message);
            }
            let received = self.line.receive(deadline.saturating_duration_since(Instant::now()))?;
            self.bytes += received.len() as u64;
            for byte in received {
                if let Some(message) = self.decoder.push(byte) {
                    self.damaged += u32::from(message.is_err());
                    self.heard.push_back(message.map(<[u8]>::to_vec));
                }
            }
        }
    }

    /// Asks, and waits for the answer; hands what comes in between to `unasked`. Damaged messages
    /// are left out: what they were has to be asked for again.
    ///
    /// # Errors
    /// See [`ServiceError`]; `answer` returns nothing for a message that is not the answer.
    pub fn ask<T>(
        &mut self,
        request: &Request<'_>,
        timeout: Duration,
        unasked: &mut dyn FnMut(&Message<'_>),
        expected: &'static str,
        answer: impl Fn(&Message<'_>) -> Option<T>,
    ) -> Result<T, ServiceError> {
        self.prepare(request);
        self.flush(timeout)?;
        let deadline = Instant::now() + timeout;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            let next = self.next(left).inspect_err(|error| {
                self.overdue += u32::from(matches!(error, LineError::Silent));
            });
            let Ok(bytes) = next? else { continue };
            let message = understood(&bytes)?;
            if let Some(answer) = answer(&message) {
                return Ok(answer);
            }
            match message {
                Message::Refused(problem) => return Err(ServiceError::Refused(problem)),
                // The answer to a request that has been repeated since.
                message if message.is_answer() && self.overdue > 0 => self.overdue -= 1,
                message if message.is_answer() => {
                    return Err(ServiceError::Unexpected { found: name(&message), expected });
                }
                message => unasked(&message),
            }
        }
    }

    /// Asks up to `tries` times, for requests that may be lost and do no harm if they are carried out
    /// twice; otherwise as [`Self::ask`].
    ///
    /// # Errors
    /// See [`ServiceError`].
    pub fn insist<T>(
        &mut self,
        request: &Request<'_>,
        patience: Patience,
        unasked: &mut dyn FnMut(&Message<'_>),
        expected: &'static str,
        answer: impl Fn(&Message<'_>) -> Option<T>,
    ) -> Result<T, ServiceError> {
        let mut tries_left = patience.tries;
        loop {
            tries_left = tries_left.saturating_sub(1);
            match self.ask(request, patience.timeout, unasked, expected, &answer) {
                Err(ServiceError::Line(LineError::Silent)) if tries_left > 0 => {
                    self.prepare_delimiter();
                }
                done => return done,
            }
        }
    }
}

/// The message in these bytes.
///
/// # Errors
/// [`ServiceError::Nonsense`].
pub fn understood(bytes: &[u8]) -> Result<Message<'_>, ServiceError> {
    receive(bytes).ok_or_else(|| {
        let shown = bytes.len().min(16);
        let more = if bytes.len() > shown { ".." } else { "" };
        let bytes_shown: Vec<_> = bytes[..shown].iter().map(|b| format!("{b:02x}")).collect();
        ServiceError::Nonsense(format!("{} bytes, {}{more}", bytes.len(), bytes_shown.join(" ")))
    })
}

/// What kind of message it is, for people.
#[must_use]
pub fn name(message: &Message<'_>) -> String {
    match message {
        Message::Status(_) => "its status".to_owned(),
        Message::Hello(_) => "its greeting after a reset".to_owned(),
        Message::Upload(upload) => format!("that it has received {} bytes", upload.received),
        Message::Staged { version } => format!("that it has verified version {version}"),
        Message::InUse { version: Some(version) } => format!("that version {version} is in use"),
        Message::InUse { version: None } => "that no package is in use".to_owned(),
        Message::Done => "that something is done".to_owned(),
        Message::Refused(problem) => format!("a refusal ({problem})"),
        Message::Sample { tick, .. } => format!("a sample of tick {tick}"),
        Message::SamplesEnd { .. } => "the end of samples".to_owned(),
        Message::State(state) => format!("the state of tick {}", state.tick),
        Message::Health { .. } => "its health".to_owned(),
        Message::Event(_) => "an event".to_owned(),
        Message::Broadcast { .. } => "a frame".to_owned(),
    }
}
