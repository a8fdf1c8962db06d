//! A stranger with a radio beside three nodes with authentic frames.

use std::collections::BTreeSet;

use agent_core::agent::trust::{Trust, TrustParams};
use agent_core::wire::authentic::{self, Bytes, Header, Kind, NetworkKey, Stamp, TAG_LENGTH};
use agent_core::wire::secret::Secret;
use agent_core::{AgentId, Frame, Neighbour, Tick};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{Outcome, alter};

const PARAMS: TrustParams = TrustParams { hello_interval: 250, answer_gap: 100 };

/// Longest time after a reboot until every true neighbour is believed again, at steps of 1 ms.
const BELIEVED_AGAIN: Tick = 2_000;

/// Frames of the stranger per tick.
const FRAMES_PER_TICK: usize = 4;

/// A node, with what survives a reboot.
struct Node {
    own: AgentId,
    trust: Trust<2>,
    neighbours: [Neighbour; 2],
    keys: Vec<NetworkKey>,
    sequence: u32,
    last: Option<Frame<1>>,
    /// The first epoch that has never been reserved, in flash.
    unreserved: u32,
    booted: Tick,
    /// Stamps accepted of each neighbour since the first boot.
    accepted: [BTreeSet<Stamp>; 2],
}

impl Node {
    fn new(own: AgentId, unreserved: u32, keys: Vec<NetworkKey>, now: Tick) -> Self {
        let neighbour = |id| Neighbour { id, weight: 1.0 };
        let [first, second] = match own {
            1 => [2, 3],
            2 => [1, 3],
            _ => [1, 2],
        };
        let end = unreserved + 4;
        let neighbours = [neighbour(first), neighbour(second)];
        let mut trust = Trust::new(own, (unreserved, end), PARAMS);
        assert!(trust.set_neighbours(&neighbours, PARAMS));
        Self {
            own,
            trust,
            neighbours,
            keys,
            sequence: 0,
            last: None,
            unreserved: end,
            booted: now,
            accepted: Default::default(),
        }
    }

    /// Starts again, with a new epoch and what is in flash.
    fn reboot(&mut self, now: Tick) {
        let accepted = std::mem::take(&mut self.accepted);
        let fresh = Self::new(self.own, self.unreserved, std::mem::take(&mut self.keys), now);
        *self = Self { accepted, ..fresh };
    }

    /// The frames that the node sends at `now`; it samples if `samples`.
    fn speak(&mut self, now: Tick, samples: bool) -> Vec<Bytes> {
        let key = *self.keys.last().unwrap();
        let mut sent = Vec::new();
        if samples || self.last.is_none() {
            let estimate = [f32::from(self.sequence as u16)].into();
            let frame = Frame::new(self.own, self.sequence, now, estimate);
            if let Some(bytes) = self.trust.seal(&frame, &key) {
                self.sequence += 1;
                self.last = Some(frame);
                sent.push(bytes);
            }
        }
        sent.extend(self.trust.hello(now, &key));
        if self.trust.must_speak() {
            sent.extend(self.last.as_ref().and_then(|last| self.trust.seal(last, &key)));
        }
        if let Some(last) = &self.last {
            sent.extend(self.trust.answer(last, now, &key));
        }
        sent
    }

    fn hear(
        &mut self,
        bytes: &[u8],
    ) -> Result<Option<Frame<1>>, agent_core::wire::frame::FrameError> {
        self.trust.open(&self.keys, bytes)
    }
}

/// The stranger hears everything and sends recorded, changed, cut, reflected, foreign and invented
/// frames, while nodes reboot, are replaced and change their network key, and agents restart.
///
/// A frame of the stranger counts as accepted if the observer would take its sample. Harm is a true
/// frame that a node believes twice, a sample that a node believes although its sender has already
/// sent a later one that was believed, and a true neighbour that is not believed again in time.
pub(super) fn stranger(tries: u64, seed: u64) -> Outcome {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut key_number = 1;
    let key = |number: u8| NetworkKey::new(number, Secret::new([number; 16]));
    let mut nodes = [1, 2, 3].map(|own| Node::new(own, 10, vec![key(1)], 0));
    let mut recorded = Vec::<Bytes>::new();
    let mut outcome = Outcome { name: "radio-frames", tries: 0, accepted: 0, harm: 0 };
    let mut now = 0;
    while outcome.tries < tries {
        now += 1;
        for node in &mut nodes {
            match random.random_range(0..4_000) {
                0 | 1 => node.reboot(now),
                // A spare node with the same number: provisioning gives it a higher epoch.
                2 => node.unreserved += 1_000,
                // The agent restarts, and with it the sequence, if an epoch is left.
                3 if node.trust.epochs_left() > 1 => node.sequence = 0,
                // A package leaves out a neighbour, and the next one takes it back.
                4 if node.trust.epochs_left() > 2 => {
                    let [first, second] = node.neighbours;
                    for neighbours in [&[second][..], &[first, second]] {
                        assert!(node.trust.set_neighbours(neighbours, PARAMS));
                    }
                    node.booted = now;
                }
                _ => {}
            }
        }
        // Rotation with an overlap: the new key is known, then used, then the old one is removed.
        for node in &mut nodes {
            match now % 7_000 {
                0 => node.keys.insert(0, key(key_number + 1)),
                500 if node.keys.len() > 1 => node.keys.reverse(),
                1_500 if node.keys.len() > 1 => drop(node.keys.drain(..1)),
                _ => {}
            }
        }
        if now % 7_000 == 0 {
            key_number = key_number.wrapping_add(1).max(1);
        }

        let mut sent = Vec::new();
        for node in &mut nodes {
            let samples = random.random_range(0..20) == 0;
            sent.extend(node.speak(now, samples).into_iter().map(|bytes| (node.own, bytes)));
        }
        for (from, bytes) in sent {
            for node in nodes.iter_mut().filter(|node| node.own != from) {
                if let Ok(Some(_)) = node.hear(&bytes) {
                    let (frame, _) = authentic::open(&bytes, &node.keys).unwrap();
                    let place = node.neighbours.iter().position(|n| n.id == from).unwrap();
                    let is_answer = matches!(frame.kind, Kind::Sync { .. });
                    let before = node.accepted[place].last().copied();
                    let is_new = node.accepted[place].insert(frame.stamp);
                    // The answer to a rebooted node repeats what it may have believed before.
                    outcome.harm += u64::from(!is_new && !is_answer);
                    outcome.harm += u64::from(before.is_some_and(|before| frame.stamp < before));
                }
            }
            recorded.push(bytes);
        }
        for node in &nodes {
            let all = (0..2).all(|place| node.trust.is_believed(place));
            outcome.harm += u64::from(!all && now - node.booted > BELIEVED_AGAIN);
        }

        for _ in 0..FRAMES_PER_TICK {
            let bytes = forged(&recorded, &mut random, now);
            let node = &mut nodes[random.random_range(0..3)];
            outcome.tries += 1;
            outcome.accepted += u64::from(matches!(node.hear(&bytes), Ok(Some(_))));
        }
    }
    outcome
}

/// A frame of the stranger.
fn forged(recorded: &[Bytes], random: &mut ChaCha8Rng, now: Tick) -> Vec<u8> {
    let mut bytes = recorded[random.random_range(0..recorded.len())].to_vec();
    let sender = random.random_range(0..5);
    let latest = Stamp { epoch: u32::MAX, sequence: u32::MAX };
    match random.random_range(0..7) {
        // As recorded, at any time, to anyone, its own sender included.
        0 | 1 => {}
        2..5 => {
            let other = &recorded[random.random_range(0..recorded.len())];
            alter(&mut bytes, other, TAG_LENGTH, random);
        }
        // From another network that uses the same number for its key.
        5 => {
            let foreign = NetworkKey::new(random.random_range(0..4), Secret::new([99; 16]));
            let header = Header { sender, stamp: latest, tick: now, kind: Kind::Estimate };
            bytes = authentic::seal(&header, &[1e3_f32.to_le_bytes()], &foreign).to_vec();
        }
        _ => bytes.iter_mut().skip(1).for_each(|byte| *byte = random.random()),
    }
    bytes
}
