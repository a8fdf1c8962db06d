//! Tests of sealed requests, against a node that follows the rules.

use std::io::Write as _;
use std::os::unix::net::UnixStream;
use std::sync::mpsc::Receiver;
use std::thread::JoinHandle;

use agent_core::service::{Session, split_seal};

use super::fake_node::FakeNode;
use super::*;
use crate::keys::{FleetSecret, KeyFolder, PortKeys};
use crate::service::provision::{self, NewKeys};
use crate::service::push::done;

const RETRY_POLICY: RetryPolicy = RetryPolicy { timeout: Duration::from_millis(300), tries: 3 };

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

/// The session of agent 5 in epoch 9.
fn session(counter: u32) -> Session {
    let session = Session { agent: 5, epoch: Some(9), counter, proof: 0, network_keys: [None; 2] };
    Session { proof: secret().port_key(5).proof(&session), ..session }
}

fn ask(client: &mut Client, request: &Request<'_>) -> Result<(), ServiceError> {
    client.request(request, RETRY_POLICY, &mut |_| {}, "a confirmation", done)
}

/// Counters of the sealed requests among the messages, and the number of those not sealed.
fn counted(seen: &Receiver<Vec<u8>>) -> (Vec<u32>, usize) {
    let all: Vec<_> = seen.try_iter().map(|message| split_seal(&message).0).collect();
    (
        all.iter().flatten().map(|seal| seal.counter).collect(),
        all.iter().filter(|found| found.is_none()).count(),
    )
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
        let error = ask(&mut client, &Request::NetworkKeys { bytes: &[1; 17] }).unwrap_err();
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
    let session = session(0);
    client.sealing.as_mut().unwrap().begin(Some(&session)).unwrap();
    ask(&mut client, &Request::Confirm).unwrap();
    let (counters, plain) = counted(&seen);
    assert_eq!((counters.len(), plain), (3, 0));
    assert!(counters.is_sorted_by(|a, b| a < b), "{counters:?}");
}

#[test]
fn each_seal_has_a_salt_of_its_own_whatever_the_node_says() {
    let mut sealing = Sealing::new(PortKeys::Fleet(secret()));
    let mut salts = std::collections::BTreeSet::new();
    for told in [0, 100_000, 3, 0] {
        sealing.begin(Some(&session(told))).unwrap();
        for next in 1..4 {
            let sealed = sealing.seal(&Request::Confirm).unwrap().unwrap();
            let seal = split_seal(&sealed).0.unwrap();
            assert_eq!(seal.counter, told + next);
            assert!(salts.insert(seal.salt));
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
    let (mut client, node) = client(node, Some(keys.fleet().port_keys()));
    let found = |client: &mut Client| provision::session(client, RETRY_POLICY).unwrap();
    for agent in [2, 3] {
        provision::provision(
            &mut client,
            &NewKeys { fleet: keys.fleet(), operator: Some(&operator), epoch: 77 },
            agent,
            RETRY_POLICY,
        )
        .unwrap();
        let session = found(&mut client).unwrap();
        assert_eq!((session.agent, session.network_keys), (agent, [Some(1), None]));
    }
    KeyFolder::advance_rotation(keys.path()).unwrap();
    let keys =
        KeyFolder::read(keys.path(), &mut |_| unreachable!("there is no passphrase")).unwrap();
    provision::network_keys(&mut client, &keys.fleet().network_keys(), RETRY_POLICY).unwrap();
    assert_eq!(found(&mut client).unwrap().network_keys, [Some(1), Some(2)]);
    assert!(provision::factory_reset(&mut client, RETRY_POLICY).unwrap());
    assert_eq!(found(&mut client), None);
    drop(client);
    assert!(node.join().unwrap().keys.is_none());
}
