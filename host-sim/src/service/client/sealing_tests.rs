//! Tests of sealed requests, against a node that follows the rules.

use std::io::{Read as _, Write as _};
use std::os::unix::net::UnixStream;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::thread::JoinHandle;

use agent_core::AgentId;
use agent_core::service::seal::PortKey;
use agent_core::service::{
    Provision, REQUEST_LENGTH_MAX, Response, Session, send_numbered, split_seal,
};

use super::*;
use crate::keys::{FleetSecret, KeyFolder, PortKeys};
use crate::service::provision;
use crate::service::push::done;

const RETRY_POLICY: RetryPolicy = RetryPolicy { timeout: Duration::from_millis(300), tries: 3 };

/// A node with keys, or without.
struct FakeNode {
    keys: Option<(AgentId, PortKey)>,
    epoch: Option<u32>,
    counter: u32,
    /// Number and key of each.
    network_keys: Vec<u8>,
    /// Firmware from before sessions.
    knows_sessions: bool,
    /// Firmware from before numbers.
    knows_numbers: bool,
    /// Number of requests to ignore, as if lost on the way.
    deaf: u32,
    /// What has arrived, sealed or not, without number.
    seen: Sender<Vec<u8>>,
}

type Reply<'a> = Response<'a, &'a [f32]>;

impl FakeNode {
    fn new(keys: Option<(AgentId, PortKey)>) -> (Self, Receiver<Vec<u8>>) {
        let (seen, received) = channel();
        let node = Self {
            keys,
            epoch: Some(9),
            counter: 0,
            network_keys: Vec::new(),
            knows_sessions: true,
            knows_numbers: true,
            deaf: 0,
            seen,
        };
        (node, received)
    }

    /// Serves a client until it disconnects, and returns the node's keys and counter.
    fn serve(mut self, mut line: UnixStream) -> JoinHandle<Self> {
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
                Some(Request::NetworkKeys { .. } | Request::FactoryReset) => {
                    Reply::Refused(Problem::NotProvisioned)
                }
                Some(request) => self.carry_out(&request),
                None => Reply::Refused(Problem::Unknown),
            },
            ((Some(_), _), None) => Reply::Refused(Problem::NotProvisioned),
            ((Some(counter), sealed), Some((_, key))) => {
                opened.truncate(0);
                opened.extend_from_slice(sealed);
                match key.open(self.epoch.unwrap(), counter, &mut opened) {
                    Some(request) if counter > self.counter => {
                        self.counter = counter;
                        let request = receive(request).unwrap();
                        self.carry_out(&request)
                    }
                    _ => Reply::Refused(Problem::Seal),
                }
            }
        };
        send_numbered(number, &reply, sink);
        if matches!(reply, Reply::InUse { .. }) {
            // Also restarts: a new epoch.
            self.epoch = self.epoch.map(|epoch| epoch + 1);
            self.counter = 0;
        }
    }

    fn carry_out(&mut self, request: &Request<'_>) -> Reply<'static> {
        match request {
            Request::Session if !self.knows_sessions => Reply::Refused(Problem::Unknown),
            Request::Session => Reply::Session(self.keys.map(|(agent, key)| Session {
                agent,
                epoch: self.epoch,
                counter: self.counter,
                proof: key.proof(agent, self.epoch.unwrap_or(0)),
                network_keys: [0, 17].map(|i| self.network_keys.get(i).copied()),
            })),
            Request::Provision { bytes } => {
                let (new, _) = Provision::split(bytes).unwrap();
                self.keys = Some((new.agent, PortKey::new(new.port_key)));
                Reply::Done
            }
            Request::NetworkKeys { bytes } => {
                self.network_keys = bytes.to_vec();
                Reply::Done
            }
            Request::FactoryReset => {
                self.keys = None;
                Reply::Done
            }
            Request::Revert => Reply::InUse { version: Some(1) },
            _ => Reply::Done,
        }
    }
}

fn secret() -> FleetSecret {
    FleetSecret::new([3; 32])
}

/// A provisioned node of agent 5.
fn provisioned() -> (FakeNode, Receiver<Vec<u8>>) {
    FakeNode::new(Some((5, secret().port_key(5))))
}

fn client(node: FakeNode, keys: Option<PortKeys>) -> (Client, JoinHandle<FakeNode>) {
    let (here, there) = UnixStream::pair().unwrap();
    let node = node.serve(there);
    let mut client = Client::new(Line::over_socket(here, &std::sync::Arc::default()).unwrap());
    if let Some(keys) = keys {
        client.set_keys(keys);
    }
    (client, node)
}

fn fleet() -> Option<PortKeys> {
    Some(PortKeys::Fleet(secret()))
}

fn ask(client: &mut Client, request: &Request<'_>) -> Result<(), ServiceError> {
    client.request(request, RETRY_POLICY, &mut |_| {}, "a confirmation", done)
}

/// Counters of the sealed requests among the messages, and the number of those not sealed.
fn counted(seen: &Receiver<Vec<u8>>) -> (Vec<u32>, usize) {
    let all: Vec<_> = seen.try_iter().map(|message| split_seal(&message).0).collect();
    (all.iter().copied().flatten().collect(), all.iter().filter(|found| found.is_none()).count())
}

#[test]
fn requests_are_sealed_with_rising_counters() {
    let (node, seen) = provisioned();
    let (mut client, node) = client(node, fleet());
    let chunk = Request::Chunk { offset: u32::MAX, bytes: &[1; 128] };
    for request in [&Request::Confirm, &Request::Stage, &chunk] {
        ask(&mut client, request).unwrap();
    }
    // The first one was preceded by a request for the session.
    let (counters, plain) = counted(&seen);
    assert_eq!((counters.len(), plain), (3, 1));
    assert!(counters.is_sorted_by(|a, b| b - a == 1), "{counters:?}");
    ask(&mut client, &Request::Query).unwrap();
    assert_eq!(counted(&seen), (vec![], 1));
    drop(client);
    node.join().unwrap();
}

#[test]
fn without_keys_nothing_is_sealed_and_the_refusal_says_what_to_do() {
    let (node, seen) = provisioned();
    let (mut client, _) = client(node, None);
    let error = ask(&mut client, &Request::Confirm).unwrap_err();
    assert!(matches!(error, ServiceError::Refused(Problem::NotSealed)), "{error}");
    assert!(error.to_string().contains("--keys FOLDER"), "{error}");
    assert_eq!(counted(&seen), (vec![], 1));
}

#[test]
fn a_node_without_keys_gets_plain_requests_but_no_secrets() {
    for (knows_sessions, knows_numbers) in [(true, true), (false, true), (false, false)] {
        let (mut node, seen) = FakeNode::new(None);
        (node.knows_sessions, node.knows_numbers) = (knows_sessions, knows_numbers);
        let (mut client, _) = client(node, fleet());
        ask(&mut client, &Request::Confirm).unwrap();
        ask(&mut client, &Request::Stage).unwrap();
        assert_eq!(counted(&seen), (vec![], 3));
        assert_eq!(provision::session(&mut client, RETRY_POLICY).unwrap(), None);
        let error = ask(&mut client, &Request::NetworkKeys { bytes: &[] }).unwrap_err();
        assert!(matches!(error, ServiceError::NotProvisioned), "{error}");
        let error = ask(&mut client, &Request::FactoryReset).unwrap_err();
        assert!(error.to_string().contains("provision --keys FOLDER"), "{error}");
        let secrets = |message: &Vec<u8>| matches!(message[0], 18..);
        assert!(!seen.try_iter().any(|message| secrets(&message)));
    }
}

#[test]
fn a_restart_of_the_node_is_noticed() {
    let (node, seen) = provisioned();
    let (mut client, node) = client(node, fleet());
    ask(&mut client, &Request::Confirm).unwrap();
    let in_use = |m: &Message<'_>| matches!(m, Message::InUse { .. }).then_some(());
    // Restarts without a greeting.
    client.request(&Request::Revert, RETRY_POLICY, &mut |_| {}, "", in_use).unwrap();
    ask(&mut client, &Request::Confirm).unwrap();
    // Two sessions; the third request was refused once.
    let (counters, plain) = counted(&seen);
    assert_eq!((counters.len(), plain), (4, 2));
    drop(client);
    assert_eq!(node.join().unwrap().epoch, Some(10));
}

#[test]
fn a_repeated_request_has_a_counter_of_its_own() {
    let (mut node, seen) = provisioned();
    // The request for the session is lost, and then nothing.
    node.deaf = 1;
    let (mut first, _) = client(node, fleet());
    ask(&mut first, &Request::Confirm).unwrap();
    let (counters, plain) = counted(&seen);
    assert_eq!((counters.len(), plain), (1, 2));
    // The session is known, and the requests are lost.
    let (mut node, seen) = provisioned();
    node.deaf = 2;
    let (mut client, _) = client(node, fleet());
    let session = Session {
        agent: 5,
        epoch: Some(9),
        counter: 0,
        proof: secret().port_key(5).proof(5, 9),
        network_keys: [None; 2],
    };
    client.sealing.as_mut().unwrap().begin(Some(&session)).unwrap();
    ask(&mut client, &Request::Confirm).unwrap();
    let (counters, plain) = counted(&seen);
    assert_eq!((counters.len(), plain), (3, 0));
    assert!(counters.is_sorted_by(|a, b| a < b), "{counters:?}");
}

#[test]
fn a_counter_is_never_used_twice_whatever_the_node_says() {
    let mut sealing = Sealing::new(PortKeys::Fleet(secret()));
    let session = |counter| Session {
        agent: 5,
        epoch: Some(9),
        counter,
        proof: secret().port_key(5).proof(5, 9),
        network_keys: [None; 2],
    };
    let mut last = 0;
    for told in [0, 100_000, 3, 0] {
        sealing.begin(Some(&session(told))).unwrap();
        for _ in 0..3 {
            let sealed = sealing.seal(&Request::Confirm).unwrap().unwrap();
            let counter = split_seal(&sealed).0.unwrap();
            assert!(counter > last.max(told), "{counter} after {last}");
            last = counter;
        }
    }
    sealing.begin(Some(&session(u32::MAX))).unwrap();
    let error = sealing.seal(&Request::Confirm).unwrap_err();
    assert!(matches!(error, ServiceError::CounterUsedUp), "{error}");
}

#[test]
fn a_node_that_cannot_prove_its_key_gets_no_request() {
    let (node, seen) = FakeNode::new(Some((5, secret().port_key(6))));
    let (mut first, _) = client(node, fleet());
    let error = ask(&mut first, &Request::Confirm).unwrap_err();
    assert!(matches!(error, ServiceError::Proof { agent: 5 }), "{error}");
    assert_eq!(counted(&seen), (vec![], 1));
    let (mut node, _seen) = provisioned();
    node.epoch = None;
    let (mut client, _) = client(node, fleet());
    let error = ask(&mut client, &Request::Confirm).unwrap_err();
    assert!(matches!(error, ServiceError::NoEpoch), "{error}");
}

#[test]
fn a_prepared_request_is_sealed_and_keeps_what_arrives_meanwhile() {
    let (node, seen) = provisioned();
    let (here, mut there) = UnixStream::pair().unwrap();
    let mut health = vec![10, 0];
    health.extend([0; 15]);
    let mut early = Vec::new();
    send_numbered(None, &Raw(&health), |bytes| early.extend_from_slice(bytes));
    there.write_all(&early).unwrap();
    let _node = node.serve(there);
    let mut client = Client::new(Line::over_socket(here, &std::sync::Arc::default()).unwrap());
    client.set_keys(PortKeys::Fleet(secret()));
    client.prepare_sealed(&Request::Confirm, RETRY_POLICY.timeout).unwrap();
    client.flush(RETRY_POLICY.timeout).unwrap();
    assert_eq!(client.next(RETRY_POLICY.timeout).unwrap().unwrap(), health);
    let answer = client.next(RETRY_POLICY.timeout).unwrap().unwrap();
    assert_eq!(decode(&answer).unwrap(), Message::Done);
    // Stimuli are not sealed.
    client.prepare_sealed(&Request::Frame { bytes: &[1] }, RETRY_POLICY.timeout).unwrap();
    client.flush(RETRY_POLICY.timeout).unwrap();
    client.next(RETRY_POLICY.timeout).unwrap().unwrap();
    let (counters, plain) = counted(&seen);
    assert_eq!((counters.len(), plain), (1, 2));
}

#[test]
fn a_node_is_provisioned_given_other_keys_and_reset() {
    let folder = tempfile::TempDir::new().unwrap();
    let (keys, operator) = KeyFolder::create(&folder.path().join("keys")).unwrap();
    let (node, _seen) = FakeNode::new(None);
    let (mut client, node) = client(node, Some(keys.port_keys()));
    let found = |client: &mut Client| provision::session(client, RETRY_POLICY).unwrap();
    for agent in [2, 3] {
        provision::provision(&mut client, &keys, &operator, agent, 77, RETRY_POLICY).unwrap();
        let session = found(&mut client).unwrap();
        assert_eq!((session.agent, session.network_keys), (agent, [Some(1), None]));
    }
    KeyFolder::advance_rotation(keys.path()).unwrap();
    let keys =
        KeyFolder::read(keys.path(), &mut |_| unreachable!("there is no passphrase")).unwrap();
    provision::network_keys(&mut client, &keys.network_keys(), RETRY_POLICY).unwrap();
    assert_eq!(found(&mut client).unwrap().network_keys, [Some(1), Some(2)]);
    assert!(provision::factory_reset(&mut client, RETRY_POLICY).unwrap());
    assert_eq!(found(&mut client), None);
    drop(client);
    assert!(node.join().unwrap().keys.is_none());
}
