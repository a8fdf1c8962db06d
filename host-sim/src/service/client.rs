//! Client of the service protocol: requests, answers and unsolicited messages.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use agent_core::service::{
    PROTOCOL_VERSION, Problem, Request, receive, send, send_numbered, split_number,
};
use agent_core::wire::cobs::{Decoder, SerialError};

use super::hint::{of_garbage, of_refusal};
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

/// Why a request failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ServiceError {
    /// The line failed.
    #[error("{0}{hint}", hint = line_hint(.0))]
    Line(#[from] LineError),
    /// The received bytes are not messages.
    #[error(
        "no readable answer: received {bytes} bytes with {damaged} damaged and {intact} intact \
         messages; {hint}"
    )]
    Garbage {
        /// Number of received bytes.
        bytes: u64,
        /// Number of damaged messages.
        damaged: u64,
        /// Number of intact messages.
        intact: u64,
        /// What to do.
        hint: String,
    },
    /// The node uses another version of the protocol.
    #[error(
        "the node's firmware uses protocol version {found}, but this program uses version \
         {PROTOCOL_VERSION}; build both from the same source"
    )]
    Protocol {
        /// Its version.
        found: u8,
    },
    /// The node refused the request.
    #[error("refused by the node: {0}; {hint}", hint = of_refusal(*.0))]
    Refused(Problem),
    /// An unknown message.
    #[error(
        "received an unrecognised message: {0}; build firmware and host-sim from the same source"
    )]
    Unrecognised(String),
    /// An unexpected message.
    #[error(
        "received {found} instead of {expected}; check that no other program is using the node, and try again"
    )]
    Unexpected {
        /// The message received.
        found: String,
        /// The message expected.
        expected: &'static str,
    },
}

fn line_hint(error: &LineError) -> &'static str {
    match error {
        LineError::Interrupted => "",
        LineError::Silent => {
            "; check that the board is running and that no other program is using it, and try again"
        }
        LineError::Closed => {
            "; check that the board or its co-simulation is still running; if the co-simulation has \
             reported that the node stopped, restart it with `host-sim node ENDPOINT reset`"
        }
        LineError::System(_) => "; reconnect the board, and try again",
    }
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
    }

    /// Queues a request; [`Self::flush`] sends it.
    pub fn prepare(&mut self, request: &Request<'_>) {
        send(request, |bytes| self.unsent.extend_from_slice(bytes));
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
                    let count = if message.is_ok() { &mut self.intact } else { &mut self.damaged };
                    *count += 1;
                    self.pending.push_back(message.map(<[u8]>::to_vec));
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
        let mut number = None;
        if self.numbering != Numbering::Unknown {
            self.number = self.number.wrapping_add(1);
            number = Some(self.number);
        }
        send_numbered(number, request, |bytes| self.unsent.extend_from_slice(bytes));
        self.flush(timeout)?;
        let deadline = Instant::now() + timeout;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            // The timeout holds even if other messages keep arriving.
            let next = if left.is_zero() { Err(LineError::Silent) } else { self.next(left) };
            let next = next.inspect_err(|error| {
                let silent = matches!(error, LineError::Silent);
                self.overdue = self.overdue.saturating_add(u32::from(silent));
            });
            let Ok(bytes) = next? else { continue };
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
                // To a plain request of another program, or from a node that knows no numbers.
                let unknown = matches!(message, Message::Refused(Problem::Unknown));
                if unknown && self.numbering == Numbering::Untried {
                    (self.numbering, number) = (Numbering::Unknown, None);
                    self.prepare(request);
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
    matches!(bytes, [] | [0 | 2..=8 | 14, ..])
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
        Message::Answer { number } => format!("an empty answer to request {number}"),
    }
}

#[cfg(test)]
mod tests {
    use std::io::{Read as _, Write as _};
    use std::os::unix::net::UnixStream;

    use agent_core::wire::cobs::Encoder;

    use super::*;
    use crate::service::push::status;

    const RETRY_POLICY: RetryPolicy = RetryPolicy { timeout: Duration::from_millis(100), tries: 2 };

    fn framed(message: &[u8]) -> Vec<u8> {
        let mut framed = Vec::new();
        let mut encoder = Encoder::new(|bytes: &[u8]| framed.extend_from_slice(bytes));
        encoder.extend(message);
        encoder.finish();
        framed
    }

    /// Returns the error of a status request to a peer that keeps sending `bytes`.
    fn status_of(bytes: Vec<u8>) -> ServiceError {
        let (here, mut there) = UnixStream::pair().unwrap();
        there.set_nonblocking(true).unwrap();
        let peer = std::thread::spawn(move || {
            let mut requests = [0; 1024];
            loop {
                if matches!(there.read(&mut requests), Ok(0)) {
                    return;
                }
                if there.write(&bytes).is_err_and(|e| e.kind() != std::io::ErrorKind::WouldBlock) {
                    return;
                }
            }
        });
        let mut client = Client::new(Line::over_socket(here, &std::sync::Arc::default()).unwrap());
        let error = status(&mut client, RETRY_POLICY).unwrap_err();
        drop(client);
        peer.join().unwrap();
        error
    }

    #[test]
    fn another_protocol_version_is_reported() {
        // A status with unknown fields, and one that happens to fit.
        for message in [&[0, 2][..], &[0, 2, 1, 2, 3, 4, 5, 6, 7], &[1, 9]] {
            let error = status_of(framed(message));
            let found = message[1];
            assert!(matches!(error, ServiceError::Protocol { found: f } if f == found), "{error}");
            assert!(error.to_string().contains("build both from the same source"), "{error}");
        }
    }

    #[test]
    fn endless_garbage_is_reported_after_the_timeout() {
        let mut seed = 1u32;
        let garbage = (0..4000).map(|_| {
            seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (seed >> 24) as u8
        });
        let error = status_of(garbage.collect());
        let ServiceError::Garbage { bytes, damaged, intact, .. } = error else { panic!("{error}") };
        assert!(bytes > 4000 && damaged > 0 && intact == 0, "{error}");
        assert!(error.to_string().contains("baud rate"), "{error}");
        // Without a delimiter, not even a damaged message is received.
        let error = status_of(vec![0x55; 4000]);
        assert!(matches!(error, ServiceError::Garbage { damaged: 0, .. }), "{error}");
    }

    #[test]
    fn unknown_unsolicited_messages_are_skipped() {
        // An unknown kind of message and an unknown event.
        for message in [&[100, 1, 2][..], &[11, 100, 1]] {
            assert!(matches!(decode(message), Err(ServiceError::Unrecognised(_))));
            let error = status_of(framed(message));
            assert!(matches!(error, ServiceError::Line(LineError::Silent)), "{error}");
        }
        // An invalid message of an answer's kind is not skipped: an upload without its length.
        let error = status_of(framed(&[2]));
        assert!(matches!(error, ServiceError::Unrecognised(_)), "{error}");
        // The kinds agree with `is_answer` for every known message.
        for (message, is_answer) in [(&[5][..], true), (&[8, 0], true), (&[11, 1, 0], false)] {
            assert!(decode(message).is_ok_and(|known| known.is_answer() == is_answer));
            assert_eq!(may_be_answer(message), is_answer);
        }
    }

    #[test]
    fn whole_messages_without_end_do_not_hold_up_a_request() {
        // Unsolicited: postcard's `Health` with 15 counters.
        let mut health = vec![10, 0];
        health.extend([0; 15]);
        assert!(decode(&health).is_ok_and(|message| !message.is_answer()));
        let error = status_of(framed(&health));
        assert!(matches!(error, ServiceError::Line(LineError::Silent)), "{error}");
    }
}
