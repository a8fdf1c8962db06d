//! Messages on a line: requests, their answers, and what comes unasked.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use agent_core::service::{PROTOCOL_VERSION, Problem, Request, receive, send};
use agent_core::wire::cobs::{Decoder, SerialError};

use super::hint::{of_garbage, of_refusal};
use super::{Line, LineError, Message};

/// Longest message of a node: a state with the outer weights of the widest network, and room.
const MESSAGE_MAX: usize = 4096;

/// Messages to and from one node.
#[derive(Debug)]
pub struct Client {
    line: Line,
    decoder: Box<Decoder<MESSAGE_MAX>>,
    /// What has been received and not been asked for: messages, or damage.
    heard: VecDeque<Result<Vec<u8>, SerialError>>,
    unsent: Vec<u8>,
    /// Bytes that have been received in all.
    bytes: u64,
    /// Messages that arrived as they were sent.
    whole: u64,
    /// Messages that arrived damaged.
    damaged: u64,
    /// How often two neighbouring bits in a received byte differ, in all.
    changes: u64,
    /// Requests that were not answered in time: their answers may still come.
    overdue: u32,
}

/// How long an answer is waited for, and how often it is asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RetryPolicy {
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
    #[error("{0}{hint}", hint = line_hint(.0))]
    Line(#[from] LineError),
    /// Bytes flow that are not messages.
    #[error(
        "no answer that can be read: {bytes} bytes have arrived, with {damaged} damaged messages and \
         {whole} whole ones; {hint}"
    )]
    Garbage {
        /// Bytes that have been received.
        bytes: u64,
        /// Damaged messages in them.
        damaged: u64,
        /// Whole messages in them.
        whole: u64,
        /// What to do about it.
        hint: String,
    },
    /// The node speaks another version of the protocol.
    #[error(
        "the node's firmware speaks version {found} of the protocol, this program version \
         {PROTOCOL_VERSION}; build both from the same source"
    )]
    Protocol {
        /// Its version.
        found: u8,
    },
    /// The node does not do it.
    #[error("the node refuses: {0}; {hint}", hint = of_refusal(*.0))]
    Refused(Problem),
    /// A message that is not known.
    #[error(
        "the node sends an unknown message: {0}; build firmware and host-sim from the same source"
    )]
    Nonsense(String),
    /// A message that does not belong here.
    #[error(
        "the node sends {found}, where {expected} is expected; make sure that no other program talks to it, and try again"
    )]
    Unexpected {
        /// What came.
        found: String,
        /// What should have.
        expected: &'static str,
    },
}

fn line_hint(error: &LineError) -> &'static str {
    match error {
        LineError::Interrupted => "",
        LineError::Silent => {
            "; check that the board is on and that no other program talks to it, and try again"
        }
        LineError::Closed => {
            "; check that the board is on, or that its co-simulation still runs: if that has reported \
             the end of the node, `host-sim node ENDPOINT reset` starts it again"
        }
        LineError::System(_) => "; connect the board again, and try again",
    }
}

impl Client {
    /// A client at the beginning.
    #[must_use]
    pub fn new(line: Line) -> Self {
        Self {
            line,
            decoder: Box::new(Decoder::new()),
            heard: VecDeque::new(),
            unsent: Vec::new(),
            bytes: 0,
            whole: 0,
            damaged: 0,
            changes: 0,
            overdue: 0,
        }
    }

    /// Bytes that have been received, and messages among them that were damaged.
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

    /// Prepares a request; [`Self::flush`] sends it.
    pub fn prepare(&mut self, request: &Request<'_>) {
        send(request, |bytes| self.unsent.extend_from_slice(bytes));
    }

    /// Ends whatever the receiver may hold of an earlier message.
    pub fn prepare_delimiter(&mut self) {
        self.unsent.push(agent_core::wire::cobs::DELIMITER);
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
            // A node that sends without end does not keep us from ending.
            self.line.check_interruption()?;
            if let Some(message) = self.heard.pop_front() {
                return Ok(message);
            }
            let received = self.line.receive(deadline.saturating_duration_since(Instant::now()))?;
            self.bytes += received.len() as u64;
            for byte in received {
                self.changes += u64::from(((byte ^ (byte >> 1)) & 0x7f).count_ones());
                if let Some(message) = self.decoder.push(byte) {
                    let count = if message.is_ok() { &mut self.whole } else { &mut self.damaged };
                    *count += 1;
                    self.heard.push_back(message.map(<[u8]>::to_vec));
                }
            }
            if self.heard.is_empty() && Instant::now() >= deadline {
                return Err(LineError::Silent);
            }
        }
    }

    /// What a silence means: that nothing comes, or nothing that can be read.
    fn silence(&self, error: ServiceError) -> ServiceError {
        let unread = self.damaged > 0 || self.whole == 0 && self.bytes > 0;
        match error {
            ServiceError::Line(LineError::Silent) if unread => ServiceError::Garbage {
                bytes: self.bytes,
                damaged: self.damaged,
                whole: self.whole,
                hint: of_garbage(self.line.baud(), self.changes as f64 / self.bytes.max(1) as f64),
            },
            other => other,
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
            // Whatever comes, the time for an answer ends.
            let next = if left.is_zero() { Err(LineError::Silent) } else { self.next(left) };
            let next = next.inspect_err(|error| {
                let silent = matches!(error, LineError::Silent);
                self.overdue = self.overdue.saturating_add(u32::from(silent));
            });
            let Ok(bytes) = next? else { continue };
            let message = match understood(&bytes) {
                // A newer node may tell more without being asked.
                Err(ServiceError::Nonsense(_)) if !may_be_answer(&bytes) => continue,
                message => message?,
            };
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
    pub fn request<T>(
        &mut self,
        request: &Request<'_>,
        retry_policy: RetryPolicy,
        unasked: &mut dyn FnMut(&Message<'_>),
        expected: &'static str,
        answer: impl Fn(&Message<'_>) -> Option<T>,
    ) -> Result<T, ServiceError> {
        let mut tries_left = retry_policy.tries;
        loop {
            tries_left = tries_left.saturating_sub(1);
            match self.ask(request, retry_policy.timeout, unasked, expected, &answer) {
                Err(ServiceError::Line(LineError::Silent)) if tries_left > 0 => {
                    self.prepare_delimiter();
                }
                done => return done.map_err(|error| self.silence(error)),
            }
        }
    }
}

/// The message in these bytes.
///
/// # Errors
/// [`ServiceError::Protocol`] if it is the status of a node that speaks another version, otherwise
/// [`ServiceError::Nonsense`].
pub fn understood(bytes: &[u8]) -> Result<Message<'_>, ServiceError> {
    // In every version a status and a greeting begin with their kind and the version.
    if let &[0 | 1, found, ..] = bytes
        && found != PROTOCOL_VERSION
    {
        return Err(ServiceError::Protocol { found });
    }
    receive(bytes).ok_or_else(|| {
        let shown = bytes.len().min(16);
        let more = if bytes.len() > shown { ".." } else { "" };
        let bytes_shown: Vec<_> = bytes[..shown].iter().map(|b| format!("{b:02x}")).collect();
        ServiceError::Nonsense(format!("{} bytes, {}{more}", bytes.len(), bytes_shown.join(" ")))
    })
}

/// Whether a message that is not understood may answer a request, by its kind: those of
/// [`Message::is_answer`], which stay.
fn may_be_answer(bytes: &[u8]) -> bool {
    matches!(bytes, [] | [0 | 2..=8, ..])
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
        Message::BoardErrors { .. } => "what its sensor and link have reported".to_owned(),
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

    /// What asking for the status ends with at a peer that sends `bytes` again and again.
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
    fn a_node_of_another_protocol_version_is_told_apart() {
        // A status with fields that this version does not know, and one that seems to fit.
        for message in [&[0, 2][..], &[0, 2, 1, 2, 3, 4, 5, 6, 7], &[1, 9]] {
            let error = status_of(framed(message));
            let found = message[1];
            assert!(matches!(error, ServiceError::Protocol { found: f } if f == found), "{error}");
            assert!(error.to_string().contains("build both from the same source"), "{error}");
        }
    }

    #[test]
    fn garbage_without_end_is_told_as_such_when_the_time_is_over() {
        let mut seed = 1u32;
        let garbage = (0..4000).map(|_| {
            seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (seed >> 24) as u8
        });
        let error = status_of(garbage.collect());
        let ServiceError::Garbage { bytes, damaged, whole, .. } = error else { panic!("{error}") };
        assert!(bytes > 4000 && damaged > 0 && whole == 0, "{error}");
        assert!(error.to_string().contains("baud rate"), "{error}");
        // Without a delimiter in it there is not even a damaged message.
        let error = status_of(vec![0x55; 4000]);
        assert!(matches!(error, ServiceError::Garbage { damaged: 0, .. }), "{error}");
    }

    #[test]
    fn what_a_newer_node_tells_without_being_asked_is_skipped() {
        // A kind of message and an event that this version does not know.
        for message in [&[100, 1, 2][..], &[11, 100, 1]] {
            assert!(matches!(understood(message), Err(ServiceError::Nonsense(_))));
            let error = status_of(framed(message));
            assert!(matches!(error, ServiceError::Line(LineError::Silent)), "{error}");
        }
        // What is no answer where one may be is not skipped: an upload without its length.
        let error = status_of(framed(&[2]));
        assert!(matches!(error, ServiceError::Nonsense(_)), "{error}");
        // Every kind of message that this version knows is told apart in the same way.
        for (message, is_answer) in [(&[5][..], true), (&[8, 0], true), (&[11, 1, 0], false)] {
            assert!(understood(message).is_ok_and(|known| known.is_answer() == is_answer));
            assert_eq!(may_be_answer(message), is_answer);
        }
    }

    #[test]
    fn whole_messages_without_end_do_not_hold_up_a_request() {
        // Unsolicited: postcard's `Health` with 15 counters.
        let mut health = vec![10, 0];
        health.extend([0; 15]);
        assert!(understood(&health).is_ok_and(|message| !message.is_answer()));
        let error = status_of(framed(&health));
        assert!(matches!(error, ServiceError::Line(LineError::Silent)), "{error}");
    }
}
