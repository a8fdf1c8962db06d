//! A stranger at the service port of a provisioned node.

use std::collections::BTreeSet;

use agent_core::service::seal::{PortKey, TAG_LENGTH};
use agent_core::service::{Problem, Provision, Request, Session, Subscription, split_number};
use agent_core::wire::secret::Secret;
use host_sim::service::Message;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{Outcome, alter};
use crate::keyed::test_node::{Off, TestNode, encoded, port_secret, salted, seal};

/// A provisioned node, and what its operator can do.
pub(super) trait Target {
    /// Sends a request as it comes out of its frame, and returns the answer.
    fn send(&mut self, request: &[u8]) -> Message<'static>;

    /// What the operator asks for, and the node's port key.
    fn session(&mut self) -> (Session, PortKey);

    /// Restarts the node in one of several ways.
    fn restart(&mut self, way: u32);

    /// What must not change but by sealed requests: the bytes in flash, if they can be seen.
    fn flash(&self) -> Option<&[u8]>;
}

impl Target for TestNode {
    fn send(&mut self, request: &[u8]) -> Message<'static> {
        Self::send(self, request)
    }

    fn session(&mut self) -> (Session, PortKey) {
        let session = self.open_session();
        (session, PortKey::new(port_secret(session.agent)))
    }

    fn restart(&mut self, way: u32) {
        Self::restart(self, if way.is_multiple_of(2) { Off::Reset } else { Off::Power });
    }

    fn flash(&self) -> Option<&[u8]> {
        Some(Self::flash(self))
    }
}

/// The stranger at a node in this process.
pub(super) fn stranger(tries: u64, seed: u64) -> Outcome {
    attack("port-requests", &mut TestNode::provisioned(1), 2, tries, seed)
}

/// The stranger hears what the operator sends, sealed, and sends it again, changed, cut, joined, in
/// another order and in another life of the node; what it has sealed with keys of its own; and
/// requests without a seal. The node restarts now and then.
///
/// Accepted are requests of the stranger that the node carries out. Harm is a sealed request of the
/// operator that it does not carry out, and a change of its flash by the stranger.
pub(super) fn attack(
    name: &'static str,
    node: &mut impl Target,
    dimension: usize,
    tries: u64,
    seed: u64,
) -> Outcome {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut outcome = Outcome { name, tries: 0, accepted: 0, harm: 0 };
    let mut heard: Vec<Vec<u8>> = Vec::new();
    let (mut session, mut key) = node.session();
    let mut epochs = BTreeSet::from([session.epoch]);
    let mut before = node.flash().map(<[u8]>::to_vec);
    while outcome.tries < tries {
        if heard.is_empty() || random.random_range(0..50) == 0 {
            // Another program of the operator may have skipped some numbers.
            session.counter += random.random_range(1..4);
            let request = ordered(random.random(), dimension);
            let sealed = seal(&key, session.epoch.unwrap(), session.counter, &request);
            outcome.harm += u64::from(matches!(node.send(&sealed), Message::Refused(_)));
            heard.push(sealed);
            if heard.len() > 10_000 {
                heard.swap_remove(random.random_range(0..5_000));
            }
        }
        if random.random_range(0..2_000) == 0 {
            let way = random.random_range(0..4);
            node.restart(way);
            (session, key) = node.session();
            outcome.harm += u64::from(!epochs.insert(session.epoch));
            before = node.flash().map(<[u8]>::to_vec);
        }
        let request = forged(&heard, &session, &mut random, dimension);
        outcome.tries += 1;
        let answer = node.send(&request);
        outcome.accepted += u64::from(is_carried_out(&answer));
        if outcome.tries.is_multiple_of(100)
            && let (Some(before), Some(now)) = (&before, node.flash())
        {
            outcome.harm += u64::from(before != now);
        }
    }
    outcome
}

/// Whether a request was more than free, and got past the seal.
fn is_carried_out(answer: &Message<'_>) -> bool {
    !matches!(
        answer,
        Message::Refused(
            Problem::NotSealed | Problem::Seal | Problem::NotProvisioned | Problem::Unknown
        ) | Message::Status(_)
            | Message::Report(_)
            | Message::Session(_)
    )
}

/// A request of the operator that can be carried out at any time and leaves flash as it is.
fn ordered(choice: u32, dimension: usize) -> Request<'static> {
    match choice % 3 {
        0 => Request::Subscribe(Subscription::default()),
        1 => Request::Samples { from: 0, most: 1 },
        _ => Request::StartAt { estimate: (0..dimension).map(|_| 0.125).collect() },
    }
}

/// What a stranger asks for.
fn wanted(choice: u32, dimension: usize) -> Request<'static> {
    match choice % 15 {
        0 => Request::Begin { length: 500 },
        1 => Request::Chunk { offset: 0, bytes: &[0x5a; 40] },
        2 => Request::Stage,
        3 => Request::Activate,
        4 => Request::Confirm,
        5 => Request::Revert,
        6 => Request::Reset,
        7 => Request::ForgetUnreadable,
        8 => Request::Provision { bytes: &[0x5a; Provision::LENGTH] },
        9 => Request::Provision { bytes: &[0x5a; Provision::LENGTH + 64] },
        10 => Request::NetworkKeys { bytes: &[0x5a; 17] },
        11 => Request::FactoryReset,
        12 => Request::OperatorKeys { bytes: &[0; 33] },
        other => ordered(other, dimension),
    }
}

fn forged(
    heard: &[Vec<u8>],
    session: &Session,
    random: &mut ChaCha8Rng,
    dimension: usize,
) -> Vec<u8> {
    let mut bytes = heard[random.random_range(0..heard.len())].clone();
    let epoch = session.epoch.unwrap();
    let counter = session.counter.wrapping_add(random.random_range(0..5));
    match random.random_range(0..9) {
        // As heard, at any time.
        0 | 1 => {}
        2..5 => {
            let other = &heard[random.random_range(0..heard.len())];
            alter(&mut bytes, other, TAG_LENGTH, random);
        }
        // What was heard, as a later request.
        5 => {
            let head = encoded(&Request::Sealed(salted(counter)));
            let length = bytes.iter().skip(1).position(|byte| byte & 0x80 == 0).unwrap() + 2;
            bytes.splice(..length.min(bytes.len()), head);
        }
        // With a key of its own, and the right epoch and counter.
        6 => {
            let own = PortKey::new(Secret::new(random.random()));
            bytes = seal(&own, epoch, counter, &wanted(random.random(), dimension));
        }
        7 => bytes = encoded(&wanted(random.random(), dimension)),
        _ => bytes.iter_mut().for_each(|byte| *byte = random.random()),
    }
    // A number would only come back with the answer.
    while let (Some(_), request) = split_number(&bytes) {
        bytes = request.to_vec();
    }
    bytes
}
