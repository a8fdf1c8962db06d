extern crate std;

use std::collections::BTreeSet;
use std::vec::Vec;

use super::*;
use crate::wire::authentic::KEY_LENGTH;

const KEY: NetworkKey = NetworkKey::new(1, [9; KEY_LENGTH]);
const PARAMS: TrustParams = TrustParams { hello_interval: 250, answer_gap: 100 };

fn neighbour(id: AgentId) -> Neighbour {
    Neighbour { id, weight: 1.0 }
}

fn sampled(sender: AgentId, sequence: u32) -> Frame<1> {
    let estimate = [f32::from(sequence as u16)].into();
    Frame { sender, sequence, tick: 10 * Tick::from(sequence), estimate }
}

/// Agent 1 and agent 2 after a boot with the given epochs.
fn pair(first: u32, second: u32) -> [Trust<1>; 2] {
    [(1, first), (2, second)]
        .map(|(own, epoch)| Trust::new(own, 1, (epoch, epoch + 10), PARAMS).unwrap())
}

#[test]
fn a_neighbour_is_believed_after_its_answer() {
    let [mut one, mut two] = pair(5, 8);
    let (of_one, of_two) = ([neighbour(2)], [neighbour(1)]);
    let first = two.seal(&sampled(2, 0), &KEY).unwrap();
    let refused = FrameError::NotBelieved { sender: 2 };
    assert_eq!(one.open::<1>(&of_one, &[KEY], &first), Err(refused));

    let hello = one.hello(0, &KEY).unwrap();
    assert_eq!(one.hello(249, &KEY), None);
    assert_eq!(two.open::<1>(&of_two, &[KEY], &hello), Ok(Believed::Nothing));
    let sync = two.answer(&of_two, &sampled(2, 0), 3, &KEY).unwrap();
    assert_eq!(two.answer(&of_two, &sampled(2, 0), 4, &KEY), None);
    // The hello does not make agent 1 believed.
    assert!(!two.is_believed(0));

    assert_eq!(one.open(&of_one, &[KEY], &sync), Ok(Believed::Sample(sampled(2, 0))));
    assert!(one.is_believed(0));
    assert_eq!(one.open::<1>(&of_one, &[KEY], &sync), Ok(Believed::Nothing));
    assert_eq!(one.hello(1_000, &KEY), None);
    let replayed = FrameError::Replayed { sender: 2 };
    assert_eq!(one.open::<1>(&of_one, &[KEY], &first), Err(replayed));
    let next = two.seal(&sampled(2, 1), &KEY).unwrap();
    assert_eq!(one.open(&of_one, &[KEY], &next), Ok(Believed::Sample(sampled(2, 1))));
    assert_eq!(one.open::<1>(&of_one, &[KEY], &next), Err(replayed));
}

#[test]
fn an_answer_from_an_earlier_life_is_refused() {
    let [mut one, mut two] = pair(5, 8);
    let (of_one, of_two) = ([neighbour(2)], [neighbour(1)]);
    let _ = two.seal(&sampled(2, 0), &KEY);
    let hello = one.hello(0, &KEY).unwrap();
    let _ = two.open::<1>(&of_two, &[KEY], &hello);
    let sync = two.answer(&of_two, &sampled(2, 0), 3, &KEY).unwrap();
    let mut rebooted = Trust::<1>::new(1, 1, (15, 25), PARAMS).unwrap();
    let replayed = Err(FrameError::Replayed { sender: 2 });
    assert_eq!(rebooted.open::<1>(&of_one, &[KEY], &sync), replayed);
    // Nor by a node that has no epoch of its own, even if the numbers match.
    let mut listening = Trust::<1>::new(1, 1, (5, 5), PARAMS).unwrap();
    assert_eq!(listening.open::<1>(&of_one, &[KEY], &sync), replayed);
    assert_eq!(listening.hello(0, &KEY), None);
    assert_eq!(listening.seal(&sampled(1, 0), &KEY), None);
}

#[test]
fn a_rebooted_sender_is_believed_at_once() {
    let [mut one, mut two] = pair(5, 8);
    let (of_one, of_two) = ([neighbour(2)], [neighbour(1)]);
    let _ = two.seal(&sampled(2, 7), &KEY);
    let _ = two.open::<1>(&of_two, &[KEY], &one.hello(0, &KEY).unwrap());
    let sync = two.answer(&of_two, &sampled(2, 7), 3, &KEY).unwrap();
    assert!(one.open::<1>(&of_one, &[KEY], &sync).is_ok());
    let mut rebooted = Trust::<1>::new(2, 1, (18, 28), PARAMS).unwrap();
    let frame = rebooted.seal(&sampled(2, 0), &KEY).unwrap();
    assert_eq!(one.open(&of_one, &[KEY], &frame), Ok(Believed::Sample(sampled(2, 0))));
    // Its hello of the life before is not answered any more.
    let old = two.hello(10, &KEY).unwrap();
    let replayed = Err(FrameError::Replayed { sender: 2 });
    assert_eq!(one.open::<1>(&of_one, &[KEY], &old), replayed);
}

#[test]
fn the_epoch_rises_when_the_sequence_starts_again() {
    let mut one = Trust::<1>::new(1, 1, (5, 7), PARAMS).unwrap();
    assert!(one.seal(&sampled(1, 0), &KEY).is_some());
    assert!(one.seal(&sampled(1, u32::MAX), &KEY).is_some());
    assert_eq!(one.epochs_left(), 2);
    assert!(one.seal(&sampled(1, 0), &KEY).is_some());
    assert_eq!(one.epochs_left(), 1);
    // The next epoch has not been reserved.
    assert_eq!(one.seal(&sampled(1, 0), &KEY), None);
    one.extend(9);
    assert!(one.seal(&sampled(1, 0), &KEY).is_some());
}

#[test]
fn a_repeated_hello_is_answered_at_most_once_in_the_gap() {
    let [mut one, mut two] = pair(5, 8);
    let of_two = [neighbour(1)];
    let _ = two.seal(&sampled(2, 0), &KEY);
    let hello = one.hello(0, &KEY).unwrap();
    let mut answers = 0;
    for now in 0..1_000 {
        assert_eq!(two.open::<1>(&of_two, &[KEY], &hello), Ok(Believed::Nothing));
        answers += u32::from(two.answer(&of_two, &sampled(2, 0), now, &KEY).is_some());
    }
    assert_eq!(answers, 10);
}

/// SplitMix64.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn below(&mut self, bound: usize) -> usize {
        (self.next() % bound as u64) as usize
    }
}

/// A node of the simulated network, with what survives a reboot.
struct Node {
    trust: Trust<2>,
    neighbours: [Neighbour; 2],
    sequence: u32,
    last: Option<Frame<1>>,
    /// Stored: the first epoch never reserved.
    reserved: u32,
    /// When each neighbour was last seen to reboot, or this node did.
    disturbed: [Tick; 2],
    /// (epoch, sequence) pairs accepted of each neighbour.
    accepted: [BTreeSet<(u32, u32)>; 2],
}

impl Node {
    fn new(own: AgentId, reserved: u32) -> Self {
        let ids = [1, 2, 3].into_iter().filter(|&id| id != own).collect::<Vec<_>>();
        let end = reserved + 4;
        Self {
            trust: Trust::new(own, 2, (reserved, end), PARAMS).unwrap(),
            neighbours: [neighbour(ids[0]), neighbour(ids[1])],
            sequence: 0,
            last: None,
            reserved: end,
            disturbed: [0; 2],
            accepted: Default::default(),
        }
    }
}

/// Three nodes on a perfect radio beside a stranger, who hears everything and sends recorded,
/// changed, cut, foreign and invented frames. Nodes reboot and change their network key.
#[test]
fn a_stranger_is_never_believed_and_true_neighbours_soon_are() {
    let seed = 1;
    let mut random = Random(seed);
    let mut nodes = [1, 2, 3].map(|id| Node::new(id, 10));
    let mut keys: [Vec<NetworkKey>; 3] = core::array::from_fn(|_| std::vec![KEY]);
    let foreign = NetworkKey::new(1, [77; KEY_LENGTH]);
    let mut recorded: Vec<Bytes> = Vec::new();
    let mut genuine: BTreeSet<Vec<u8>> = BTreeSet::new();
    let (mut tries, mut forged, mut twice, mut reboots, mut longest_wait) = (0, 0, 0, 0, 0);
    let mut key_number = 1;
    for now in 0..60_000 {
        let mut sent: Vec<(usize, Bytes)> = Vec::new();
        for (place, node) in nodes.iter_mut().enumerate() {
            let newest = *keys[place].last().unwrap();
            if random.below(2_000) == 0 {
                let own = place as AgentId + 1;
                let accepted = core::mem::take(&mut node.accepted);
                *node = Node { accepted, disturbed: [now; 2], ..Node::new(own, node.reserved) };
                reboots += 1;
            }
            if random.below(20) == 0 || node.last.is_none() {
                // Now and then the agent restarts, and with it the sequence.
                if random.below(500) == 0 && node.trust.epochs_left() > 1 {
                    node.sequence = 0;
                }
                let frame = sampled(place as AgentId + 1, node.sequence);
                if let Some(bytes) = node.trust.seal(&frame, &newest) {
                    node.sequence += 1;
                    node.last = Some(frame);
                    sent.push((place, bytes));
                }
            }
            sent.extend(node.trust.hello(now, &newest).map(|bytes| (place, bytes)));
            if let Some(last) = node.last {
                let neighbours = node.neighbours;
                let answer = node.trust.answer(&neighbours, &last, now, &newest);
                sent.extend(answer.map(|bytes| (place, bytes)));
            }
        }
        // Rotation: all accept the new key first, then it is the newest of all, then the old one
        // goes.
        if now % 7_000 == 6_999 {
            key_number += 1;
            let key = NetworkKey::new(key_number, [key_number; KEY_LENGTH]);
            keys.iter_mut().for_each(|keys| keys.insert(0, key));
        } else if now % 7_000 == 500 && now > 7_000 {
            keys.iter_mut().for_each(|keys| keys.reverse());
        } else if now % 7_000 == 1_500 && now > 7_000 {
            for keys in &mut keys {
                keys.remove(0);
            }
        }
        for (from, bytes) in &sent {
            genuine.insert(bytes.to_vec());
            recorded.push(bytes.clone());
            for (to, node) in nodes.iter_mut().enumerate().filter(|(to, _)| to != from) {
                let neighbours = node.neighbours;
                let opened = node.trust.open::<1>(&neighbours, &keys[to], bytes);
                if let Ok(Believed::Sample(frame)) = opened {
                    let place = neighbours.iter().position(|n| n.id == frame.sender).unwrap();
                    let epoch = nodes_epoch(bytes, &keys[to]);
                    // Each once, in spite of reboots of the receiver.
                    let is_new = node.accepted[place].insert((epoch, frame.sequence));
                    let is_answer = matches!(
                        AuthenticFrame::<StateVector<1>>::open(bytes, &keys[to]).unwrap().payload,
                        Payload::Sync { .. }
                    );
                    twice += u32::from(!is_new && !is_answer);
                }
            }
        }
        for (place, node) in nodes.iter().enumerate() {
            for (of, neighbour) in node.neighbours.iter().enumerate() {
                let _ = (place, neighbour);
                if !node.trust.is_believed(of) {
                    longest_wait = longest_wait.max(now - node.disturbed[of]);
                }
            }
        }
        // The stranger.
        for _ in 0..3 {
            let Some(template) = recorded.get(random.below(recorded.len().max(1))) else { break };
            let mut bytes = template.clone();
            match random.below(5) {
                // As recorded, to anyone, its own sender included.
                0 | 1 => {}
                2 => {
                    let bit = random.below(8 * bytes.len());
                    bytes[bit / 8] ^= 1 << (bit % 8);
                }
                3 => bytes.truncate(random.below(bytes.len())),
                _ => {
                    let payload = Payload::Estimate(&[1e3][..]);
                    let sender = random.below(4) as AgentId;
                    let stamp = Stamp { epoch: u32::MAX, sequence: u32::MAX };
                    bytes = AuthenticFrame { sender, stamp, tick: now, payload }.seal(&foreign);
                }
            }
            let to = random.below(3);
            let is_known = genuine.contains(&bytes[..]);
            let node = &mut nodes[to];
            let neighbours = node.neighbours;
            let opened = node.trust.open::<1>(&neighbours, &keys[to], &bytes);
            tries += 1;
            forged += u32::from(matches!(opened, Ok(Believed::Sample(_))));
            // Recorded hellos and syncs can pass as authentic, but carry nothing to the observer.
            assert!(is_known || opened.is_err(), "a frame that no node sent was opened");
        }
    }
    std::println!(
        "{tries} frames of a stranger: {forged} believed; {twice} true frames believed twice; \
         {reboots} reboots, a neighbour was believed again after at most {longest_wait} ticks"
    );
    assert_eq!((forged, twice), (0, 0));
    assert!(reboots > 50, "{reboots} reboots");
    assert!(longest_wait <= 2_000, "{longest_wait} ticks of 1 ms");
}

fn nodes_epoch(bytes: &[u8], keys: &[NetworkKey]) -> u32 {
    AuthenticFrame::<StateVector<1>>::open(bytes, keys).unwrap().stamp.epoch
}
