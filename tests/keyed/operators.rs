//! The operator's keys: which ones a node accepts, and their rotation.

use agent_core::service::{Problem, Provision, Request};
use agent_core::store::StoreError;
use host_sim::packages::PackageBytes;
use host_sim::service::Message;
use host_sim::signing::OperatorKey;

use super::test_node::{Off, TestNode, done, package, port_secret};

/// A node with the public key of `operator`, provisioned as agent 1, and using version 1.
fn signed_only(operator: &OperatorKey) -> TestNode {
    let mut node = TestNode::with_public_key(Some(*operator.public_key()));
    assert_eq!(node.provision(1, 0, &first_keys(operator)), Ok(()));
    assert_eq!(node.push(&signed(1, operator)), Ok(()));
    node
}

/// The operator's signature of the first keys of agent 1.
fn first_keys(operator: &OperatorKey) -> [u8; 64] {
    operator.sign(&Provision { agent: 1, port_key: port_secret(1), epoch: 0 }.signed_bytes())
}

fn signed(version: u32, operator: &OperatorKey) -> PackageBytes {
    package(1, version).signed(operator)
}

fn operators(flag: u8, operator: &OperatorKey) -> Vec<u8> {
    [&[flag][..], operator.public_key().as_bytes()].concat()
}

fn give(node: &mut TestNode, bytes: &[u8]) -> Result<(), Problem> {
    done(&node.ask_sealed(&Request::OperatorKeys { bytes }))
}

fn version(node: &mut TestNode) -> u32 {
    node.status().package.unwrap().version
}

#[test]
fn keys_overlap_until_only_the_new_one_is_left() {
    let [old, new] = [(); 2].map(|()| OperatorKey::generate().unwrap());
    let mut node = signed_only(&old);
    let is_refused =
        |outcome: Result<(), Problem>| assert!(matches!(outcome, Err(Problem::Package(_))));
    is_refused(node.push(&signed(2, &new)));

    assert_eq!(give(&mut node, &operators(1, &new)), Ok(()));
    for off in [Off::Reset, Off::Power] {
        node.restart(off);
    }
    assert_eq!(node.push(&signed(2, &new)), Ok(()));
    assert_eq!(node.push(&signed(3, &old)), Ok(()));

    // The next boot would refuse the package in use.
    is_refused(give(&mut node, &operators(0, &new)));
    node.restart(Off::Power);
    assert_eq!(version(&mut node), 3);
    assert_eq!(node.push(&signed(4, &new)), Ok(()));
    assert_eq!(give(&mut node, &operators(0, &new)), Ok(()));
    is_refused(node.push(&signed(5, &old)));
    node.restart(Off::Power);
    assert_eq!(version(&mut node), 4);
    is_refused(node.push(&signed(5, &old)));
    assert_eq!(node.push(&signed(5, &new)), Ok(()));
    // Nor does the old key come back before a package that it signs.
    is_refused(give(&mut node, &[]));
    assert_eq!(give(&mut node, &operators(1, &new)), Ok(()));
    assert_eq!(node.push(&signed(6, &old)), Ok(()));
    assert_eq!(give(&mut node, &[]), Ok(()));
    is_refused(node.push(&signed(7, &new)));
    node.restart(Off::Power);
    is_refused(node.push(&signed(7, &new)));
}

#[test]
fn a_factory_reset_leaves_the_key_of_the_firmware() {
    let [old, new] = [(); 2].map(|()| OperatorKey::generate().unwrap());
    for by_hand in [false, true] {
        let mut node = signed_only(&old);
        assert_eq!(give(&mut node, &operators(1, &new)), Ok(()));
        assert_eq!(node.push(&signed(2, &new)), Ok(()));
        assert_eq!(give(&mut node, &operators(0, &new)), Ok(()));
        if by_hand {
            node.reset_by_hand();
        } else {
            assert_eq!(done(&node.ask_sealed(&Request::FactoryReset)), Ok(()));
        }
        assert_eq!(node.provision(1, 0, &first_keys(&new)), Err(Problem::NotSigned));
        assert_eq!(node.provision(1, 0, &first_keys(&old)), Ok(()));
        assert_eq!(node.push(&signed(3, &old)), Ok(()));
    }
}

#[test]
fn what_is_not_an_operator_key_is_refused_and_changes_nothing() {
    let [old, new] = [(); 2].map(|()| OperatorKey::generate().unwrap());
    let mut node = signed_only(&old);
    let before = node.flash().to_vec();
    let key = operators(1, &new);
    // A point of small order: anyone could forge signatures for it.
    let weak = [&[1, 1][..], &[0; 31]].concat();
    let not_a_point = [&[1, 2][..], &[0; 31]].concat();
    for bytes in [
        &key[..1],
        &key[..32],
        &[&key[..], &[0]].concat(),
        &operators(2, &new),
        &weak,
        &not_a_point,
    ] {
        assert_eq!(give(&mut node, bytes), Err(Problem::Store(StoreError::Note)), "{bytes:?}");
    }
    let unsealed = node.ask(&Request::OperatorKeys { bytes: &key });
    assert_eq!(unsealed, Message::Refused(Problem::NotSealed));
    assert!(node.flash() == before);

    let mut blank = TestNode::with_public_key(Some(*old.public_key()));
    let answer = blank.ask(&Request::OperatorKeys { bytes: &key });
    assert_eq!(answer, Message::Refused(Problem::NotProvisioned));
    // Firmware that takes unsigned packages has no use for keys.
    assert_eq!(give(&mut TestNode::provisioned(1), &key), Err(Problem::Unknown));
}
