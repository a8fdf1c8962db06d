//! Scripted peers at the other end of a socket.

use std::io::{Read as _, Write as _};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::Path;
use std::time::Duration;

use agent_core::health::HealthCounters;
use agent_core::service::{
    Firmware, Outcome, PROTOCOL_VERSION, PackageStatus, Problem, Request, Response, State, Status,
    receive, send, split_number,
};
use agent_core::store::Slot;
use agent_core::wire::cobs::{Decoder, Encoder};

/// A response with its numbers in vectors.
pub(crate) type Message = Response<'static, Vec<f32>>;

/// The node's end of a connection.
pub(crate) struct Peer {
    socket: UnixStream,
    decoder: Decoder<256>,
    received: Vec<u8>,
}

impl Peer {
    /// Sends a message; returns whether the other end still listens.
    pub(crate) fn say(&mut self, message: &Message) -> bool {
        let mut bytes = Vec::new();
        send(message, |piece| bytes.extend_from_slice(piece));
        self.write(&bytes)
    }

    /// Sends bytes; returns whether the other end still listens.
    pub(crate) fn write(&mut self, bytes: &[u8]) -> bool {
        self.socket.write_all(bytes).is_ok()
    }

    /// Sends a message of these bytes, of whatever kind; returns whether the other end still listens.
    pub(crate) fn frame(&mut self, message: &[u8]) -> bool {
        let mut bytes = Vec::new();
        let mut encoder = Encoder::new(|piece: &[u8]| bytes.extend_from_slice(piece));
        encoder.extend(message);
        encoder.finish();
        self.write(&bytes)
    }

    /// Waits for the next request; `None` at the end. Like firmware from before they existed, it does
    /// not know numbered requests, reports and sessions.
    pub(crate) fn request(&mut self) -> Option<Vec<u8>> {
        loop {
            let request = self.any_request()?;
            if split_number(&request).0.is_none()
                && !matches!(receive(&request), Some(Request::Report | Request::Session))
            {
                return Some(request);
            }
            self.say(&Response::Refused(Problem::Unknown));
        }
    }

    /// Waits for the next request of any kind; `None` at the end.
    fn any_request(&mut self) -> Option<Vec<u8>> {
        loop {
            for (index, &byte) in self.received.iter().enumerate() {
                if let Some(Ok(request)) = self.decoder.push(byte) {
                    let request = request.to_vec();
                    self.received.drain(..=index);
                    return Some(request);
                }
            }
            self.received.clear();
            let mut buffer = [0; 1024];
            let length = self.socket.read(&mut buffer).ok().filter(|&length| length > 0)?;
            self.received.extend_from_slice(&buffer[..length]);
        }
    }
}

/// Calls `behave` for every connection to this socket.
pub(crate) fn listen(path: &Path, behave: impl Fn(&mut Peer) + Clone + Send + 'static) {
    let listener = UnixListener::bind(path).unwrap();
    std::thread::spawn(move || {
        while let Ok((socket, _)) = listener.accept() {
            let behave = behave.clone();
            std::thread::spawn(move || {
                behave(&mut Peer { socket, decoder: Decoder::new(), received: Vec::new() });
            });
        }
    });
}

/// Returns a status that claims to be agent 1 of the paper's scenario.
pub(crate) fn status() -> Status {
    Status {
        protocol: PROTOCOL_VERSION,
        firmware: Firmware {
            version: [0, 1, 0],
            dimension: 3,
            features: 8,
            neighbours: 2,
            signed_only: false,
            sample_stride: 20,
        },
        tick: 0,
        package: Some(PackageStatus {
            agent: 1,
            version: 3,
            checksum: 0x1234,
            step_size: 1e-3,
            slot: Slot::A,
            trial: None,
            network_in_use: true,
        }),
        staged: false,
        upload: None,
        refused_at_start: [None; 2],
        stack_unused: None,
        samples: 0,
        messages_damaged: 0,
        measurements_missing: 0,
        broadcasts_lost: 0,
        health: HealthCounters::default(),
    }
}

/// Returns a node's report of a step.
pub(crate) fn state(tick: u64) -> Message {
    let number = tick as f32;
    Response::State(State {
        tick,
        outcome: Outcome::Stepped,
        estimate: vec![number, 0.5, -number],
        derivative: vec![1.0, number, 2.0],
        outer_weights: vec![0.25; 15],
    })
}

/// Answers requests as a node with this status until a subscription, then sends `count` states with
/// `pause` in between, and disconnects.
pub(crate) fn tell_states(peer: &mut Peer, status: Status, count: u64, pause: Duration) {
    while let Some(request) = peer.request() {
        match receive::<Request<'_>>(&request) {
            Some(Request::Query) => assert!(peer.say(&Response::Status(status))),
            Some(Request::Subscribe(_)) => {
                peer.say(&Response::Done);
                for tick in 0..count {
                    if !peer.say(&state(tick)) {
                        return;
                    }
                    std::thread::sleep(pause);
                }
                return;
            }
            _ => {}
        }
    }
}
