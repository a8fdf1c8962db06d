//! Client of the service protocol: requests, answers and unsolicited messages.
//!
//! | module | purpose |
//! | --- | --- |
//! | `session` | asks a provisioned node for its session |
//! | `sealing` | seals requests for that session |
//! | `error` | why a request failed |

mod error;
mod sealing;
mod session;

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use agent_core::service::{
    PROTOCOL_VERSION, Problem, Request, receive, send_numbered, split_number,
};
use agent_core::wire::cobs::{Decoder, SerialError};
use serde::ser::SerializeTuple as _;
use serde::{Serialize, Serializer};

pub use error::ServiceError;
use sealing::Sealing;

use super::hint::of_garbage;
use super::{Line, LineError, Message};

/// Maximum length of a message: more than a state with the outer weights of the widest network.
/// \[byte\]
const MESSAGE_MAX: usize = 4096;

/// A client of one node.
#[derive(Debug)]
pub struct Client {
    line: Line,
    decoder: Box<Decoder<MESSAGE_MAX>>,
    /// Received messages, or framing errors, that have not been read.
    pending: VecDeque<Result<Vec<u8>, SerialError>>,
    unsent: Vec<u8>,
    /// Total number of received bytes.
    bytes: u64,
    /// Number of intact messages.
    intact: u64,
    /// Number of damaged messages.
    damaged: u64,
    /// Total number of differing adjacent bits within received bytes.
    changes: u64,
    /// Number of requests that timed out, whose answers may still arrive.
    overdue: u32,
    numbering: Numbering,
    /// Number of the last request.
    number: u16,
    /// Seals requests, with the operator's keys.
    sealing: Option<Sealing>,
}

/// A message that is already encoded.
pub(crate) struct Raw<'a>(pub(crate) &'a [u8]);

impl Serialize for Raw<'_> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut tuple = serializer.serialize_tuple(self.0.len())?;
        self.0.iter().try_for_each(|byte| tuple.serialize_element(byte))?;
        tuple.end()
    }
}

/// Whether the node understands numbered requests.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Numbering {
    Untried,
    Understood,
    /// Firmware from before they existed.
    Unknown,
}

/// Timeout and number of tries of a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RetryPolicy {
    /// Timeout of one try.
    pub timeout: Duration,
    /// Number of tries, at least 1.
    pub tries: u32,
}

impl Client {
    /// Creates a client on this line.
    #[must_use]
    pub fn new(line: Line) -> Self {
        Self {
            line,
            decoder: Box::new(Decoder::new()),
            pending: VecDeque::new(),
            unsent: Vec::new(),
            bytes: 0,
            intact: 0,
            damaged: 0,
            changes: 0,
            overdue: 0,
            numbering: Numbering::Untried,
            number: 0,
            sealing: None,
        }
    }

    /// Returns the number of received bytes and of damaged messages.
    #[must_use]
    pub fn received(&self) -> (u64, u64) {
        (self.bytes, self.damaged)
    }

    /// See [`Line::set_grace`].
    pub fn set_grace(&mut self, grace: Duration) {
        self.line.set_grace(grace);
    }

    /// See [`Line::expect_reset`].
    pub fn expect_reset(&mut self) {
        self.line.expect_reset();
        self.forget_session();
    }

    /// Queues a request as it is, not sealed; [`Self::flush`] sends it.
    pub fn prepare(&mut self, request: &Request<'_>) {
        self.queue(None, request);
    }

    /// Queues a request, sealed if there are keys and the node is provisioned; [`Self::flush`] sends
    /// it. Waits only for the node's session, if that is not known. Messages that arrive in the
    /// meantime are kept.
    ///
    /// # Errors
    /// See [`ServiceError`].
    pub fn prepare_sealed(
        &mut self,
        request: &Request<'_>,
        timeout: Duration,
    ) -> Result<(), ServiceError> {
        self.find_session(request, timeout)?;
        self.queue_sealed(None, request)
    }

    /// Queues a request that another client has encoded, without its number.
    pub fn prepare_encoded(&mut self, request: &[u8]) {
        self.queue(None, &Raw(request));
    }

    fn queue(&mut self, number: Option<u16>, request: &impl Serialize) {
        send_numbered(number, request, |bytes| self.unsent.extend_from_slice(bytes));
    }

    /// Queues a request, sealed with the next counter if the node's session is known.
    fn queue_sealed(
        &mut self,
        number: Option<u16>,
        request: &Request<'_>,
    ) -> Result<(), ServiceError> {
        let sealing = self.sealing.as_mut().filter(|_| Sealing::applies_to(request));
        match sealing.map(|sealing| sealing.seal(request)).transpose()?.flatten() {
            Some(sealed) => self.queue(number, &Raw(&sealed)),
            None => self.queue(number, request),
        }
        Ok(())
    }

    /// Returns the number of the next request; `None` if the node does not know numbers.
    fn next_number(&mut self) -> Option<u16> {
        (self.numbering != Numbering::Unknown).then(|| {
            self.number = self.number.wrapping_add(1);
            self.number
        })
    }

    /// Like [`Self::next`], but the deadline holds even if messages keep arriving, and a timeout is
    /// counted.
    fn next_until(&mut self, deadline: Instant) -> Result<Result<Vec<u8>, SerialError>, LineError> {
        let left = deadline.saturating_duration_since(Instant::now());
        let next = if left.is_zero() { Err(LineError::Silent) } else { self.next(left) };
        next.inspect_err(|error| {
            let silent = matches!(error, LineError::Silent);
            self.overdue = self.overdue.saturating_add(u32::from(silent));
        })
    }

    /// Queues a delimiter, which ends any partial message at the receiver.
    pub fn prepare_delimiter(&mut self) {
        self.unsent.push(agent_core::wire::cobs::DELIMITER);
    }

    /// Sends everything queued.
    ///
    /// # Errors
    /// See [`LineError`].
    pub fn flush(&mut self, timeout: Duration) -> Result<(), LineError> {
        let sent = self.line.send(&self.unsent, timeout);
        self.unsent.clear();
        sent
    }

    /// Returns the next message, or its framing error.
    ///
    /// # Errors
    /// [`LineError::Silent`] if no message is complete in time; see [`LineError`].
    pub fn next(&mut self, timeout: Duration) -> Result<Result<Vec<u8>, SerialError>, LineError> {
        let deadline = Instant::now() + timeout;
        loop {
            // Check even if the node sends continuously.
            self.line.check_interruption()?;
            if let Some(message) = self.pending.pop_front() {
                return Ok(message);
            }
            let received = self.line.receive(deadline.saturating_duration_since(Instant::now()))?;
            self.bytes += received.len() as u64;
            for byte in received {
                self.changes += u64::from(((byte ^ (byte >> 1)) & 0x7f).count_ones());
                if let Some(message) = self.decoder.push(byte) {
                    let message = message.map(<[u8]>::to_vec);
                    let count = if message.is_ok() { &mut self.intact } else { &mut self.damaged };
                    *count += 1;
                    if let Ok(message) = &message {
                        self.notice(message);
                    }
                    self.pending.push_back(message);
                }
            }
            if self.pending.is_empty() && Instant::now() >= deadline {
                return Err(LineError::Silent);
            }
        }
    }

    /// Converts a timeout to [`ServiceError::Garbage`] if unreadable bytes were received.
    fn explain_silence(&self, error: ServiceError) -> ServiceError {
        let unread = self.damaged > 0 || self.intact == 0 && self.bytes > 0;
        match error {
            ServiceError::Line(LineError::Silent) if unread => ServiceError::Garbage {
                bytes: self.bytes,
                damaged: self.damaged,
                intact: self.intact,
                hint: of_garbage(self.line.baud(), self.changes as f64 / self.bytes.max(1) as f64),
            },
            other => other,
        }
    }

    /// Sends a request and waits for the answer. Other messages are passed to `unsolicited`;
    /// damaged ones are ignored.
    ///
    /// Requests are numbered, and an answer with another number, to a request that has been repeated
    /// or to another program, is skipped. A node that does not know numbers is asked without.
    ///
    /// With keys, requests to a provisioned node are sealed. If the node refuses the seal, it is asked
    /// for its session and then once more for an answer.
    ///
    /// # Errors
    /// See [`ServiceError`]. `answer` returns `None` for a message that is not the answer.
    pub fn ask<T>(
        &mut self,
        request: &Request<'_>,
        timeout: Duration,
        unsolicited: &mut dyn FnMut(&Message<'_>),
        expected: &'static str,
        answer: impl Fn(&Message<'_>) -> Option<T>,
    ) -> Result<T, ServiceError> {
        let sealable = self.sealing.is_some() && Sealing::applies_to(request);
        match self.ask_once(request, timeout, unsolicited, expected, &answer) {
            Err(ServiceError::Refused(Problem::Seal | Problem::NotSealed)) if sealable => {
                self.forget_session();
                self.ask_once(request, timeout, unsolicited, expected, &answer)
            }
            done => done,
        }
    }

    fn ask_once<T>(
        &mut self,
        request: &Request<'_>,
        timeout: Duration,
        unsolicited: &mut dyn FnMut(&Message<'_>),
        expected: &'static str,
        answer: &impl Fn(&Message<'_>) -> Option<T>,
    ) -> Result<T, ServiceError> {
        self.find_session(request, timeout)?;
        let mut number = self.next_number();
        self.queue_sealed(number, request)?;
        self.flush(timeout)?;
        let deadline = Instant::now() + timeout;
        loop {
            let Ok(bytes) = self.next_until(deadline)? else { continue };
            let (found, bytes) = split_number(&bytes);
            if found.is_some() {
                if found != number {
                    continue;
                }
                self.numbering = Numbering::Understood;
            }
            let message = match decode(bytes) {
                // A newer node may send other unsolicited messages.
                Err(ServiceError::Unrecognised(_)) if !may_be_answer(bytes) => continue,
                message => message?,
            };
            if number.is_some() && found.is_none() && message.is_answer() {
                // To a plain request of another program, or from a node that does not support numbers.
                let unknown = matches!(message, Message::Refused(Problem::Unknown));
                if unknown && self.numbering == Numbering::Untried {
                    (self.numbering, number) = (Numbering::Unknown, None);
                    self.queue_sealed(None, request)?;
                    self.flush(timeout)?;
                }
                continue;
            }
            if let Some(answer) = answer(&message) {
                return Ok(answer);
            }
            match message {
                Message::Refused(problem) => return Err(ServiceError::Refused(problem)),
                // A late answer to a request that has been repeated.
                message if message.is_answer() && self.overdue > 0 => self.overdue -= 1,
                message if message.is_answer() => {
                    return Err(ServiceError::Unexpected { found: name(&message), expected });
                }
                message => unsolicited(&message),
            }
        }
    }

    /// Like [`Self::ask`], but repeats the request up to `tries` times. The request must be
    /// idempotent.
    ///
    /// # Errors
    /// See [`ServiceError`].
    pub fn request<T>(
        &mut self,
        request: &Request<'_>,
        retry_policy: RetryPolicy,
        unsolicited: &mut dyn FnMut(&Message<'_>),
        expected: &'static str,
        answer: impl Fn(&Message<'_>) -> Option<T>,
    ) -> Result<T, ServiceError> {
        let mut tries_left = retry_policy.tries;
        loop {
            tries_left = tries_left.saturating_sub(1);
            match self.ask(request, retry_policy.timeout, unsolicited, expected, &answer) {
                Err(ServiceError::Line(LineError::Silent)) if tries_left > 0 => {
                    self.prepare_delimiter();
                }
                done => return done.map_err(|error| self.explain_silence(error)),
            }
        }
    }
}

/// Decodes a message.
///
/// # Errors
/// [`ServiceError::Protocol`] if it is the status of a node with another protocol version,
/// otherwise [`ServiceError::Unrecognised`].
pub fn decode(bytes: &[u8]) -> Result<Message<'_>, ServiceError> {
    // In every version, a status and a greeting start with their kind and the version.
    if let &[0 | 1, found, ..] = bytes
        && found != PROTOCOL_VERSION
    {
        return Err(ServiceError::Protocol { found });
    }
    receive(bytes).ok_or_else(|| {
        let shown = bytes.len().min(16);
        let more = if bytes.len() > shown { ".." } else { "" };
        let bytes_shown: Vec<_> = bytes[..shown].iter().map(|b| format!("{b:02x}")).collect();
        ServiceError::Unrecognised(format!(
            "{} bytes, {}{more}",
            bytes.len(),
            bytes_shown.join(" ")
        ))
    })
}

/// Returns whether a message that cannot be decoded may be an answer, judging by its kind: the
/// kinds of [`Message::is_answer`] are fixed.
fn may_be_answer(bytes: &[u8]) -> bool {
    matches!(bytes, [] | [0 | 2..=8 | 14 | 16, ..])
}

/// What kind of message it is, for people.
#[must_use]
pub fn name(message: &Message<'_>) -> String {
    match message {
        Message::Status(_) => "a status".to_owned(),
        Message::Hello(_) => "a greeting after a reset".to_owned(),
        Message::Upload(upload) => format!("an upload progress of {} bytes", upload.received),
        Message::Staged { version } => format!("the verification of version {version}"),
        Message::InUse { version: Some(version) } => {
            format!("a report that version {version} is in use")
        }
        Message::InUse { version: None } => "a report that no package is in use".to_owned(),
        Message::Done => "a confirmation".to_owned(),
        Message::Refused(problem) => format!("a refusal ({problem})"),
        Message::Sample { tick, .. } => format!("a sample of tick {tick}"),
        Message::SamplesEnd { .. } => "the end of samples".to_owned(),
        Message::State(state) => format!("the state of tick {}", state.tick),
        Message::Health { .. } => "health counters".to_owned(),
        Message::Event(_) => "an event".to_owned(),
        Message::Broadcast { .. } => "a frame".to_owned(),
        Message::BoardErrors { .. } => "sensor and link errors".to_owned(),
        Message::Report(_) => "a report".to_owned(),
        Message::Session(_) => "a session".to_owned(),
        Message::Answer { number } => format!("an empty answer to request {number}"),
    }
}

#[cfg(test)]
mod tests;

#[cfg(test)]
mod sealing_tests;

#[cfg(test)]
pub(crate) mod fake_node;
