//! A node that follows the rules for sealed requests, for tests.

use std::io::{Read as _, Write as _};
use std::os::unix::net::UnixStream;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread::JoinHandle;

use agent_core::AgentId;
use agent_core::health::HealthCounters;
use agent_core::service::seal::PortKey;
use agent_core::service::{
    Firmware, PROTOCOL_VERSION, Problem, Provision, REQUEST_LENGTH_MAX, Request, Response, Session,
    Status, receive, send_numbered, split_number, split_seal,
};
use agent_core::wire::cobs::Decoder;

/// A node with keys, or without.
pub(crate) struct FakeNode {
    pub(crate) keys: Option<(AgentId, PortKey)>,
    pub(crate) epoch: Option<u32>,
    pub(crate) counter: u32,
    /// Number and key of each.
    pub(crate) network_keys: Vec<u8>,
    /// Firmware from before sessions.
    pub(crate) knows_sessions: bool,
    /// Firmware from before numbers.
    pub(crate) knows_numbers: bool,
    /// Number of requests to ignore, as if lost on the way.
    pub(crate) deaf: u32,
    /// Whether the node restarts after its answer.
    restarts: bool,
    /// What has arrived, sealed or not, without number.
    seen: Sender<Vec<u8>>,
}

type Reply<'a> = Response<'a, &'a [f32]>;

impl FakeNode {
    pub(crate) fn new(keys: Option<(AgentId, PortKey)>) -> (Self, Receiver<Vec<u8>>) {
        let (seen, received) = channel();
        let node = Self {
            keys,
            epoch: Some(9),
            counter: 0,
            network_keys: Vec::new(),
            knows_sessions: true,
            knows_numbers: true,
            deaf: 0,
            restarts: false,
            seen,
        };
        (node, received)
    }

    /// Serves a client until it disconnects, and returns the node's keys and counter.
    pub(crate) fn serve(mut self, mut line: UnixStream) -> JoinHandle<Self> {
        std::thread::spawn(move || {
            let mut decoder = Decoder::<{ REQUEST_LENGTH_MAX + 4 }>::new();
            let mut bytes = [0; 256];
            loop {
                let Ok(length @ 1..) = line.read(&mut bytes) else { return self };
                let mut replies = Vec::new();
                for &byte in &bytes[..length] {
                    if let Some(Ok(message)) = decoder.push(byte) {
                        self.reply(message, &mut |bytes| replies.extend_from_slice(bytes));
                    }
                }
                if line.write_all(&replies).is_err() {
                    return self;
                }
            }
        })
    }

    fn reply(&mut self, message: &[u8], sink: &mut dyn FnMut(&[u8])) {
        let (number, rest) = split_number(message);
        self.seen.send(rest.to_vec()).unwrap();
        if self.deaf > 0 {
            self.deaf -= 1;
            return;
        }
        if number.is_some() && !self.knows_numbers {
            return send_numbered(None, &Reply::Refused(Problem::Unknown), sink);
        }
        let mut opened = rest.to_vec();
        let reply = match (split_seal(rest), &self.keys) {
            ((None, _), Some(_)) => match receive(rest) {
                Some(request @ Request::Session) => self.carry_out(&request),
                Some(request) if request.is_free() => Reply::Done,
                _ => Reply::Refused(Problem::NotSealed),
            },
            ((None, _), None) => match receive(rest) {
                Some(
                    Request::NetworkKeys { .. }
                    | Request::OperatorKeys { .. }
                    | Request::FactoryReset,
                ) => Reply::Refused(Problem::NotProvisioned),
                Some(request) => self.carry_out(&request),
                None => Reply::Refused(Problem::Unknown),
            },
            ((Some(_), _), None) => Reply::Refused(Problem::NotProvisioned),
            ((Some(seal), sealed), Some((_, key))) => {
                opened.truncate(0);
                opened.extend_from_slice(sealed);
                match key.open(self.epoch.unwrap(), &seal, &mut opened) {
                    Some(request) if seal.counter > self.counter => {
                        self.counter = seal.counter;
                        let request = receive(request).unwrap();
                        self.carry_out(&request)
                    }
                    _ => Reply::Refused(Problem::Seal),
                }
            }
        };
        send_numbered(number, &reply, &mut *sink);
        if std::mem::take(&mut self.restarts) {
            self.epoch = self.epoch.map(|epoch| epoch + 1);
            self.counter = 0;
            if !matches!(reply, Reply::InUse { .. }) {
                send_numbered(None, &Reply::Hello(status()), sink);
            }
        }
    }

    fn carry_out(&mut self, request: &Request<'_>) -> Reply<'static> {
        match request {
            Request::Session if !self.knows_sessions => Reply::Refused(Problem::Unknown),
            Request::Session => Reply::Session(self.keys.map(|(agent, key)| {
                let session = Session {
                    agent,
                    epoch: self.epoch,
                    counter: self.counter,
                    proof: 0,
                    network_keys: [0, 17].map(|i| self.network_keys.get(i).copied()),
                };
                Session { proof: key.proof(&session), ..session }
            })),
            Request::Provision { bytes } => {
                let (new, _) = Provision::split(bytes).unwrap();
                self.keys = Some((new.agent, PortKey::new(new.port_key)));
                self.epoch = self.epoch.max(Some(new.epoch));
                Reply::Done
            }
            Request::NetworkKeys { bytes } => {
                self.network_keys = bytes.to_vec();
                Reply::Done
            }
            Request::FactoryReset => {
                (self.keys, self.restarts) = (None, true);
                Reply::Done
            }
            Request::Reset => {
                self.restarts = true;
                Reply::Done
            }
            // Restarts here without a greeting.
            Request::Revert => {
                self.restarts = true;
                Reply::InUse { version: Some(1) }
            }
            _ => Reply::Done,
        }
    }
}

/// A status of a node without a package.
fn status() -> Status {
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
        package: None,
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
