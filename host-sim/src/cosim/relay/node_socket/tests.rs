//! Tests of sealed requests that pass through a relay.

use std::os::unix::net::UnixStream;
use std::sync::mpsc::Receiver;
use std::time::Duration;

use agent_core::service::Subscription;
use tempfile::TempDir;

use super::*;
use crate::cosim::BoardReport;
use crate::cosim::board::Board;
use crate::keys::KeyFolder;
use crate::service::client::fake_node::FakeNode;
use crate::service::provision::{self, NewKeys};
use crate::service::push::done;
use crate::service::{self, Address, Line, RetryPolicy, ServiceError};

const RETRY_POLICY: RetryPolicy = RetryPolicy { timeout: Duration::from_secs(2), tries: 3 };

const SUBSCRIBE: Request<'_> = Request::Subscribe(Subscription {
    state_every: Some(core::num::NonZeroU32::MIN),
    outer_weights: false,
});

/// A relay with a node and a key folder.
struct Served {
    folder: TempDir,
    socket: NodeSocket,
    node: LoopNode,
    /// What has reached the node.
    seen: Receiver<Vec<u8>>,
    keys: KeyFolder,
}

type NodeClient = service::Client;

impl Served {
    fn new() -> Self {
        let folder = TempDir::new().unwrap();
        let (keys, _) = KeyFolder::create(&folder.path().join("keys")).unwrap();
        let (node, seen) = FakeNode::new(None);
        let (here, there) = UnixStream::pair().unwrap();
        drop(node.serve(there));
        let line = Line::over_socket(here, &std::sync::Arc::default()).unwrap();
        let board = Board::new(line, "node", true);
        let node = LoopNode::new(board, Vec::new(), Vec::new(), BoardReport::new(1, "node"));
        let socket = NodeSocket::new(Socket::bind(folder.path().join("socket")).unwrap());
        Self { folder, socket, node, seen, keys }
    }

    /// Serves a client, with keys or without, until it is done.
    fn with<T: Send>(&mut self, keys: bool, act: impl FnOnce(&mut NodeClient) -> T + Send) -> T {
        let address = Address::Socket(self.folder.path().join("socket"));
        let mut client = NodeClient::new(address.connect(&std::sync::Arc::default()).unwrap());
        if keys {
            client.set_keys(self.keys.fleet().port_keys());
        }
        let (socket, node) = (&mut self.socket, &mut self.node);
        std::thread::scope(|scope| {
            let acting = scope.spawn(move || {
                let done = act(&mut client);
                (done, client)
            });
            while !acting.is_finished() {
                if node.has_ended() {
                    assert!(socket.restart_requested().is_none());
                } else {
                    socket.serve(0, node).unwrap();
                }
                std::thread::sleep(Duration::from_millis(1));
            }
            // The client stays connected until the relay has been asked about it.
            acting.join().unwrap().0
        })
    }

    fn provision(&mut self, agent: u32) {
        let folder = self.keys.path().to_owned();
        let keys = KeyFolder::read(&folder, &mut |_| unreachable!()).unwrap();
        let operator = keys.operator(&mut |_| unreachable!()).unwrap();
        self.with(true, |client| {
            provision::provision(
                client,
                &NewKeys { fleet: keys.fleet(), operator: Some(&operator), epoch: 7 },
                agent,
                RETRY_POLICY,
            )
            .unwrap();
        });
    }
}

fn ask(client: &mut NodeClient, request: &Request<'_>) -> Result<(), ServiceError> {
    client.request(request, RETRY_POLICY, &mut |_| {}, "a confirmation", done)
}

#[test]
fn sealed_requests_reach_the_node_but_subscriptions_stay_with_the_relay() {
    let mut served = Served::new();
    // Provisioned again: sealed, and the relay reads the new key in a copy.
    for agent in [2, 3] {
        served.provision(agent);
        assert!(served.node.board.seals().unwrap());
    }
    served.seen.try_iter().for_each(drop);
    served.with(true, |client| {
        ask(client, &SUBSCRIBE).unwrap();
        ask(client, &Request::Confirm).unwrap();
    });
    let subscriptions: Vec<_> =
        served.socket.clients.iter().filter_map(|client| client.subscription.state_every).collect();
    assert_eq!(subscriptions.len(), 1);
    let sealed = served.seen.try_iter().filter(|request| split_seal(request).0.is_some()).count();
    assert_eq!(sealed, 1, "only the confirmation reaches the node");
    // The co-simulation's own requests and those of the client take turns.
    for _ in 0..2 {
        let exchange = served.node.board.exchange(&Request::Stage).unwrap();
        assert_eq!(receive(exchange.answers.last().unwrap()), Some(Message::Done));
        served.with(true, |client| ask(client, &Request::Confirm).unwrap());
    }
}

#[test]
fn a_provisioned_node_refuses_clients_without_keys() {
    let mut served = Served::new();
    served.with(false, |client| ask(client, &SUBSCRIBE).unwrap());
    served.provision(2);
    for request in [SUBSCRIBE, Request::Confirm, Request::Reset] {
        let error = served.with(false, |client| ask(client, &request).unwrap_err());
        assert!(matches!(error, ServiceError::Refused(Problem::NotSealed)), "{error}");
    }
    assert_eq!(served.node.report.parted, None);
}

#[test]
fn a_sealed_reset_restarts_the_node() {
    let mut served = Served::new();
    served.provision(2);
    served.with(true, |client| ask(client, &Request::Reset).unwrap());
    assert!(served.node.report.parted.take().is_some_and(|reason| reason.contains("was reset")));
    served.with(true, |client| {
        ask(client, &Request::Confirm).unwrap();
        assert!(provision::factory_reset(client, RETRY_POLICY).unwrap());
        ask(client, &Request::Confirm).unwrap();
    });
    assert!(served.node.report.parted.take().is_some_and(|reason| reason.contains("factory")));
    assert!(!served.node.board.seals().unwrap());
}

#[test]
fn a_stopped_node_is_restarted_without_a_seal() {
    let mut served = Served::new();
    served.provision(2);
    served.node.end(0, &Fault::Closed);
    let session = served.with(true, |client| provision::session(client, RETRY_POLICY).unwrap());
    assert_eq!(session, None);
}
