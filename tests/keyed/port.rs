//! What a node with a port key does for whom.

use agent_core::service::seal::PortKey;
use agent_core::service::{Problem, Provision, Request, Subscription};
use agent_core::store::StoreError;
use agent_core::wire::authentic;
use host_sim::service::Message;
use host_sim::signing::OperatorKey;

use super::test_node::{
    Off, TestNode, done, encoded, network_key, package, port_secret, salted, seal,
};

/// Every request that changes something or costs much.
fn changing() -> Vec<Request<'static>> {
    vec![
        Request::Begin { length: 400 },
        Request::Chunk { offset: 0, bytes: &[1, 2, 3] },
        Request::Stage,
        Request::Activate,
        Request::Confirm,
        Request::Revert,
        Request::Reset,
        Request::Subscribe(Subscription::default()),
        Request::Samples { from: 0, most: 1 },
        Request::StartAt { estimate: [0.0, 0.0].into_iter().collect() },
        Request::ForgetUnreadable,
        Request::Provision { bytes: &[0; Provision::LENGTH] },
        Request::NetworkKeys { bytes: &[7; 17] },
        Request::FactoryReset,
        Request::OperatorKeys { bytes: &[1; 33] },
    ]
}

#[test]
fn a_blank_node_does_what_it_is_asked() {
    let mut node = TestNode::blank();
    assert_eq!(node.ask(&Request::Session), Message::Session(None));
    for request in changing() {
        let answer = node.ask(&request);
        assert_ne!(answer, Message::Refused(Problem::NotSealed), "{request:?}");
        if matches!(request, Request::NetworkKeys { .. } | Request::FactoryReset) {
            panic!("a blank node was provisioned by {answer:?}");
        }
        if matches!(request, Request::Provision { .. }) {
            assert_eq!(answer, Message::Done);
            break;
        }
    }
    let mut node = TestNode::blank();
    for request in [Request::NetworkKeys { bytes: &[7; 17] }, Request::FactoryReset] {
        assert_eq!(node.ask(&request), Message::Refused(Problem::NotProvisioned));
    }
    let bytes = seal(&PortKey::new(port_secret(1)), 0, 1, &Request::Reset);
    assert_eq!(node.send(&bytes), Message::Refused(Problem::NotProvisioned));
}

#[test]
fn a_provisioned_node_takes_only_sealed_requests() {
    let mut node = TestNode::provisioned(1);
    let before = node.flash().to_vec();
    for request in changing() {
        assert_eq!(node.ask(&request), Message::Refused(Problem::NotSealed), "{request:?}");
    }
    assert!(node.flash() == before);
    for request in [Request::Query, Request::Report, Request::Session] {
        assert!(!matches!(node.ask(&request), Message::Refused(_)), "{request:?}");
    }
    assert_eq!(node.status().package.unwrap().version, 1);
    assert_eq!(node.push(&package(1, 2)), Ok(()));
    assert_eq!(node.status().package.unwrap().version, 2);
}

#[test]
fn a_sealed_request_is_carried_out_once() {
    let mut node = TestNode::provisioned(1);
    let refused = Message::Refused(Problem::Seal);
    let start = Request::StartAt { estimate: [0.5, 0.5].into_iter().collect() };
    let (first, second) = (node.sealed(&start), node.sealed(&start));
    // In another order, the earlier one comes too late.
    assert_eq!(node.send(&second), Message::Done);
    for bytes in [&first, &second] {
        assert_eq!(node.send(bytes), refused);
    }
    // Nor with another counter, any other bit, or the key of another node.
    let key = PortKey::new(port_secret(1));
    let session = node.session.unwrap();
    let counter = session.counter + 1;
    let epoch = session.epoch.unwrap();
    let mut renumbered = second.clone();
    renumbered.splice(
        ..encoded(&Request::Sealed(salted(counter - 1))).len(),
        encoded(&Request::Sealed(salted(counter))),
    );
    assert_eq!(node.send(&renumbered), refused);
    let sealed = seal(&key, epoch, counter, &start);
    let head = encoded(&Request::Sealed(salted(counter))).len();
    for bit in 8 * head..8 * sealed.len() {
        let mut changed = sealed.clone();
        changed[bit / 8] ^= 1 << (bit % 8);
        assert_eq!(node.send(&changed), refused);
    }
    for epoch in [0, epoch - 1, epoch + 1, u32::MAX] {
        assert_eq!(node.send(&seal(&key, epoch, counter, &start)), refused);
    }
    let other = PortKey::new(port_secret(2));
    assert_eq!(node.send(&seal(&other, epoch, counter, &start)), refused);
    assert_eq!(node.send(&sealed), Message::Done);
    // A request in a seal in a seal is not a request.
    let inner = seal(&key, epoch, counter + 2, &start);
    let mut body = inner.clone();
    let tag = key.seal(epoch, &salted(counter + 1), &mut body);
    let twice = [encoded(&Request::Sealed(salted(counter + 1))), body, tag.to_vec()].concat();
    assert_eq!(node.send(&twice), Message::Refused(Problem::Unknown));
}

#[test]
fn what_was_sealed_in_an_earlier_life_is_refused() {
    for off in [Off::Reset, Off::Power] {
        let mut node = TestNode::provisioned(1);
        let start = Request::StartAt { estimate: [0.5, 0.5].into_iter().collect() };
        let old = node.sealed(&start);
        let epoch = node.session.unwrap().epoch;
        node.restart(off);
        assert_eq!(node.send(&old), Message::Refused(Problem::Seal));
        assert!(node.open_session().epoch > epoch);
        assert_eq!(node.ask_sealed(&start), Message::Done);
    }
}

#[test]
fn first_keys_must_be_signed_if_packages_must() {
    let operator = OperatorKey::generate().unwrap();
    let stranger = OperatorKey::generate().unwrap();
    let mut node = TestNode::with_public_key(Some(*operator.public_key()));
    let provision = Provision { agent: 1, port_key: port_secret(1), epoch: 5 };
    let other = Provision { agent: 2, ..provision };
    for signature in [
        vec![],
        vec![0; 64],
        stranger.sign(&provision.signed_bytes()).to_vec(),
        operator.sign(&other.signed_bytes()).to_vec(),
        // What is signed has a label, so that a signature of anything else does not match.
        operator.sign(&provision.to_bytes()).to_vec(),
    ] {
        assert_eq!(node.provision(1, 5, &signature), Err(Problem::NotSigned));
        assert_eq!(node.ask(&Request::Session), Message::Session(None));
    }
    let signature = operator.sign(&provision.signed_bytes());
    assert_eq!(node.provision(1, 5, &signature), Ok(()));
    assert_eq!(node.open_session().agent, 1);
    // Later ones only need the seal.
    assert_eq!(node.provision(2, 5, &[]), Ok(()));
    assert_eq!(node.open_session().agent, 2);
}

#[test]
fn a_provisioned_node_refuses_the_packages_of_another_agent() {
    let mut node = TestNode::blank();
    assert_eq!(node.provision(2, 1_000, &[]), Ok(()));
    assert!(matches!(node.push(&package(1, 1)), Err(Problem::Package(_))));
    assert_eq!(node.push(&package(2, 1)), Ok(()));
    // Until the operator says so.
    assert_eq!(node.provision(1, 1_000, &[]), Ok(()));
    assert_eq!(node.push(&package(1, 2)), Ok(()));
    node.restart(Off::Power);
    assert_eq!(node.status().package.unwrap().agent, 1);
}

#[test]
fn epochs_rise_with_every_boot_and_survive_a_reset_to_blank() {
    let mut node = TestNode::provisioned(1);
    let mut last = node.open_session().epoch.unwrap();
    assert!(last >= 1_000);
    let mut erased_after = Vec::new();
    for boot in 0..200 {
        let before = node.flash().to_vec();
        node.restart(if boot % 7 == 0 { Off::Power } else { Off::Reset });
        if node.flash() != before {
            erased_after.push(boot);
        }
        let epoch = node.open_session().epoch.unwrap();
        assert!(epoch > last, "boot {boot}");
        last = epoch;
    }
    // The journal is written after a loss of power, and seldom after a reset.
    let after_resets = erased_after.iter().filter(|&boot| boot % 7 != 0).count();
    assert_eq!(after_resets, 0, "{erased_after:?}");
    assert_eq!(done(&node.ask_sealed(&Request::FactoryReset)), Ok(()));
    assert_eq!(node.ask(&Request::Session), Message::Session(None));
    assert_eq!(node.status().package, None);
    assert_eq!(node.provision(1, 0, &[]), Ok(()));
    assert!(node.open_session().epoch.unwrap() > last);
    // Nor does a package come back that has been replaced.
    let replayed = node.push(&package(1, 1));
    assert!(matches!(replayed, Err(Problem::Package(_))), "{replayed:?}");
    assert_eq!(node.push(&package(1, 2)), Ok(()));
}

#[test]
fn a_loop_of_resets_seldom_writes_the_journal() {
    let mut node = TestNode::provisioned(1);
    let mut writes = 0;
    for _ in 0..1_000 {
        let before = node.flash().to_vec();
        node.restart(Off::Reset);
        writes += u32::from(node.flash() != before);
    }
    // The count of boots every 16th time, and epochs.
    assert!(writes <= 1_000 / 16 + 1_000 * 5 / 64 + 2, "{writes}");
}

#[test]
fn the_button_makes_a_node_blank_whose_key_is_lost() {
    let mut node = TestNode::provisioned(1);
    let epoch = node.open_session().epoch.unwrap();
    node.reset_by_hand();
    assert_eq!(node.ask(&Request::Session), Message::Session(None));
    assert_eq!(node.status().package, None);
    assert_eq!(node.provision(2, 0, &[]), Ok(()));
    assert!(node.open_session().epoch.unwrap() > epoch);
}

#[test]
fn what_cannot_be_keys_is_refused_and_changes_nothing() {
    let mut node = TestNode::provisioned(1);
    let key = network_key(3).to_bytes();
    for bytes in [vec![], key[1..].to_vec(), [key, key].concat(), [key, key, key].concat()] {
        let answer = node.ask_sealed(&Request::NetworkKeys { bytes: &bytes });
        assert_eq!(answer, Message::Refused(Problem::Store(StoreError::Note)));
    }
    assert_eq!(node.open_session().network_keys, [Some(1), None]);
    assert_eq!(node.give_network_keys(&[1, 2]), Ok(()));
    assert_eq!(node.open_session().network_keys, [Some(1), Some(2)]);
    let answer = node.ask_sealed(&Request::Provision { bytes: &[0; Provision::LENGTH - 1] });
    assert_eq!(answer, Message::Refused(Problem::Unknown));
    node.restart(Off::Power);
    assert_eq!(node.open_session().network_keys, [Some(1), Some(2)]);
}

#[test]
fn an_epoch_near_the_end_is_refused_and_changes_nothing() {
    let mut node = TestNode::blank();
    let before = node.flash().to_vec();
    for epoch in [0xf000_0001, u32::MAX] {
        assert_eq!(node.provision(1, epoch, &[]), Err(Problem::Store(StoreError::Note)));
    }
    assert!(node.flash() == before);
    assert_eq!(node.provision(1, 0xf000_0000, &[]), Ok(()));
    assert_eq!(node.open_session().epoch, Some(0xf000_0000));
}

#[test]
fn a_higher_epoch_takes_effect_at_once() {
    let mut node = TestNode::provisioned(1);
    let request = Request::StartAt { estimate: [0.5, 0.5].into_iter().collect() };
    let old = node.sealed(&request);
    assert_eq!(node.provision(1, 50_000, &[]), Ok(()));
    assert!(node.open_session().epoch.unwrap() >= 50_000);
    assert_eq!(node.send(&old), Message::Refused(Problem::Seal));
    assert_eq!(node.ask_sealed(&request), Message::Done);
    let frames = node.step([]);
    assert!(!frames.is_empty());
    for bytes in frames {
        let (header, _) = authentic::open(&bytes, &[network_key(1)]).unwrap();
        assert!(header.stamp.epoch >= 50_000, "{header:?}");
    }
}
