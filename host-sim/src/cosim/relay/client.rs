//! A client of a relay: requests that wait for their turn, and what waits to be written.
//!
//! Cost: 1 KiB of requests and 64 KiB of what waits for it, at most.

use std::collections::VecDeque;
use std::io::{ErrorKind, Read, Write};
use std::os::unix::net::UnixStream;
use std::time::{Duration, Instant};

use agent_core::agent::capture::is_due;
use agent_core::service::{REQUEST_LENGTH_MAX, Response, State, Subscription, send};
use agent_core::wire::cobs::{Decoder, Encoder};
use serde::Serialize;

/// Bytes that wait for a client; of more, the newest messages are lost, as on a slow line.
const UNSENT_MAX: usize = 1 << 16;

/// How long a client may leave what waits for it unread while more is lost.
const UNREAD_MAX: Duration = Duration::from_secs(5);

type RequestDecoder = Decoder<{ REQUEST_LENGTH_MAX + agent_core::wire::crc::CHECKSUM_LENGTH }>;

/// What the relay itself says.
pub(super) type Reply<'a> = Response<'a, Vec<f32>>;

/// Somebody at a socket.
pub(super) struct Client {
    socket: UnixStream,
    decoder: RequestDecoder,
    /// Requests that have arrived and wait for their turn.
    requests: VecDeque<Vec<u8>>,
    unsent: Vec<u8>,
    /// Since when messages are lost because it does not read.
    losing_since: Option<Instant>,
    pub(super) subscription: Subscription,
    pub(super) gone: bool,
}

impl Client {
    /// Somebody at this socket, which does not block.
    pub(super) fn new(socket: UnixStream) -> Self {
        Self {
            socket,
            decoder: RequestDecoder::new(),
            requests: VecDeque::new(),
            unsent: Vec::new(),
            losing_since: None,
            subscription: Subscription::default(),
            gone: false,
        }
    }

    /// The next request. Damaged ones are left out, as they are on a node. More is read only when
    /// nothing waits, so that a client that asks faster than it is answered has to wait itself.
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

    /// Says something of our own.
    pub(super) fn say(&mut self, message: &impl Serialize) {
        let mut framed = Vec::new();
        send(message, |bytes| framed.extend_from_slice(bytes));
        self.queue(&framed);
    }

    /// Sends on what a node said.
    pub(super) fn forward(&mut self, message: &[u8]) {
        let mut framed = Vec::new();
        let mut encoder = Encoder::new(|bytes: &[u8]| framed.extend_from_slice(bytes));
        encoder.extend(message);
        encoder.finish();
        self.queue(&framed);
    }

    /// Tells a state as far as it has been subscribed to.
    pub(super) fn tell(&mut self, state: &State<Vec<f32>>) {
        let every = self.subscription.state_every;
        if every.is_some_and(|every| is_due(state.tick, every)) {
            let mut state = state.clone();
            if !self.subscription.outer_weights {
                state.outer_weights.clear();
            }
            self.say(&Reply::State(state));
        }
    }

    fn queue(&mut self, framed: &[u8]) {
        if self.unsent.len() + framed.len() <= UNSENT_MAX {
            self.unsent.extend_from_slice(framed);
        } else {
            let since = *self.losing_since.get_or_insert_with(Instant::now);
            self.gone |= since.elapsed() > UNREAD_MAX;
        }
    }

    /// Writes what the socket takes of what waits.
    pub(super) fn write_out(&mut self) {
        if self.unsent.is_empty() {
            return;
        }
        match self.socket.write(&self.unsent) {
            Ok(length) => {
                self.unsent.drain(..length);
                self.losing_since = None;
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
    fn a_client_that_does_not_read_costs_little_and_is_sent_away() {
        let (here, there) = UnixStream::pair().unwrap();
        here.set_nonblocking(true).unwrap();
        let mut client = Client::new(here);
        for _ in 0..100_000 {
            client.forward(&[1; 100]);
            client.write_out();
        }
        assert!(client.unsent.len() <= UNSENT_MAX && !client.gone);
        // It has lost messages for too long.
        client.losing_since = Instant::now().checked_sub(2 * UNREAD_MAX);
        client.forward(&[1; 100]);
        assert!(client.gone);
        drop(there);
    }

    #[test]
    fn requests_wait_with_the_client_that_sends_too_many() {
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
            // What is read at a time: 1 KiB of messages of 7 bytes.
            assert!(client.requests.len() < 150, "{}", client.requests.len());
            count += 1;
        }
        assert_eq!(count, 2000);
    }
}
