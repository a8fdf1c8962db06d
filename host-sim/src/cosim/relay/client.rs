//! A client of a relay, with its queued requests and unsent output.
//!
//! Memory: at most 1 KiB of requests and 64 KiB of output.

use std::collections::VecDeque;
use std::io::{ErrorKind, Read, Write};
use std::os::unix::net::UnixStream;
use std::time::{Duration, Instant};

use agent_core::agent::capture::is_due;
use agent_core::service::{REQUEST_LENGTH_MAX, Response, State, Subscription, send, send_numbered};
use agent_core::wire::cobs::{Decoder, Encoder};
use serde::Serialize;

use crate::service::client::Raw;

/// Limit of a client's unsent output; beyond it, new messages are dropped, as on a slow line.
/// \[byte\]
const UNSENT_MAX: usize = 1 << 16;

/// How long messages may be dropped before a client that does not read is disconnected.
const UNREAD_MAX: Duration = Duration::from_secs(5);

type RequestDecoder = Decoder<{ REQUEST_LENGTH_MAX + agent_core::wire::crc::CHECKSUM_LENGTH }>;

/// A message from the relay itself.
pub(super) type Reply<'a> = Response<'a, Vec<f32>>;

/// A client connected to a socket.
pub(super) struct Client {
    socket: UnixStream,
    decoder: RequestDecoder,
    /// Received requests that are not yet handled.
    requests: VecDeque<Vec<u8>>,
    unsent: Vec<u8>,
    /// Since when messages are dropped because the client does not read.
    dropping_since: Option<Instant>,
    pub(super) subscription: Subscription,
    pub(super) gone: bool,
}

impl Client {
    /// Creates a client on this nonblocking socket.
    pub(super) fn new(socket: UnixStream) -> Self {
        Self {
            socket,
            decoder: RequestDecoder::new(),
            requests: VecDeque::new(),
            unsent: Vec::new(),
            dropping_since: None,
            subscription: Subscription::default(),
            gone: false,
        }
    }

    /// Returns the next request. Damaged ones are ignored, as on a node. Reads only when no request
    /// is queued, so that a client which sends too fast is slowed down.
    pub(super) fn request(&mut self) -> Option<Vec<u8>> {
        if self.requests.is_empty() {
            let mut buffer = [0; 1024];
            match self.socket.read(&mut buffer) {
                Ok(0) => self.gone = true,
                Ok(length) => {
                    for &byte in &buffer[..length] {
                        if let Some(Ok(request)) = self.decoder.push(byte) {
                            self.requests.push_back(request.to_vec());
                        }
                    }
                }
                Err(error) if error.kind() == ErrorKind::WouldBlock => {}
                Err(_) => self.gone = true,
            }
        }
        self.requests.pop_front()
    }

    /// Sends a message of the relay.
    pub(super) fn send(&mut self, message: &impl Serialize) {
        let mut framed = Vec::new();
        send(message, |bytes| framed.extend_from_slice(bytes));
        self.queue(&framed);
    }

    /// Answers a request with this number.
    pub(super) fn answer(&mut self, number: Option<u16>, message: &impl Serialize) {
        let mut framed = Vec::new();
        send_numbered(number, message, |bytes| framed.extend_from_slice(bytes));
        self.queue(&framed);
    }

    /// Forwards a node's answer to a request with this number.
    pub(super) fn forward_answer(&mut self, number: Option<u16>, answer: &[u8]) {
        self.answer(number, &Raw(answer));
    }

    /// Forwards a node's message.
    pub(super) fn forward(&mut self, message: &[u8]) {
        let mut framed = Vec::new();
        let mut encoder = Encoder::new(|bytes: &[u8]| framed.extend_from_slice(bytes));
        encoder.extend(message);
        encoder.finish();
        self.queue(&framed);
    }

    /// Sends a state, according to the client's subscription.
    pub(super) fn send_state(&mut self, state: &State<Vec<f32>>) {
        let every = self.subscription.state_every;
        if every.is_some_and(|every| is_due(state.tick, every)) {
            let mut state = state.clone();
            if !self.subscription.outer_weights {
                state.outer_weights.clear();
            }
            self.send(&Reply::State(state));
        }
    }

    fn queue(&mut self, framed: &[u8]) {
        if self.unsent.len() + framed.len() <= UNSENT_MAX {
            self.unsent.extend_from_slice(framed);
        } else {
            let since = *self.dropping_since.get_or_insert_with(Instant::now);
            self.gone |= since.elapsed() > UNREAD_MAX;
        }
    }

    /// Writes as much unsent output as the socket accepts.
    pub(super) fn write_out(&mut self) {
        if self.unsent.is_empty() {
            return;
        }
        match self.socket.write(&self.unsent) {
            Ok(length) => {
                self.unsent.drain(..length);
                self.dropping_since = None;
            }
            Err(error) if error.kind() == ErrorKind::WouldBlock => {}
            Err(_) => self.gone = true,
        }
    }
}

#[cfg(test)]
mod tests {
    use agent_core::service::{Request, receive};

    use super::*;

    #[test]
    fn a_client_that_does_not_read_is_bounded_and_disconnected() {
        let (here, there) = UnixStream::pair().unwrap();
        here.set_nonblocking(true).unwrap();
        let mut client = Client::new(here);
        for _ in 0..100_000 {
            client.forward(&[1; 100]);
            client.write_out();
        }
        assert!(client.unsent.len() <= UNSENT_MAX && !client.gone);
        // Messages have been dropped for too long.
        client.dropping_since = Instant::now().checked_sub(2 * UNREAD_MAX);
        client.forward(&[1; 100]);
        assert!(client.gone);
        drop(there);
    }

    #[test]
    fn a_client_that_sends_too_many_requests_is_slowed_down() {
        let (here, mut there) = UnixStream::pair().unwrap();
        here.set_nonblocking(true).unwrap();
        let mut requests = Vec::new();
        for _ in 0..2000 {
            send(&Request::Query, |bytes| requests.extend_from_slice(bytes));
        }
        there.write_all(&requests).unwrap();
        let mut client = Client::new(here);
        let mut count = 0;
        while let Some(request) = client.request() {
            assert!(matches!(receive(&request), Some(Request::Query)));
            // One read is 1 KiB, and a message has 7 bytes.
            assert!(client.requests.len() < 150, "{}", client.requests.len());
            count += 1;
        }
        assert_eq!(count, 2000);
    }
}
