//! Whom nodes with network keys believe.

use agent_core::wire::authentic::{self, Kind};

use super::test_node::{Off, TestNode, network_key, package, quiet_package};

/// Steps of 2 s, the time within which a true neighbour is believed again.
const TWO_SECONDS: u32 = 2_000;

/// Two nodes and what they have heard.
struct Pair {
    nodes: [TestNode; 2],
    sent: [Vec<Vec<u8>>; 2],
}

impl Pair {
    fn new() -> Self {
        Self {
            nodes: [TestNode::provisioned(1), TestNode::provisioned(2)],
            sent: Default::default(),
        }
    }

    /// A step of both; each hears what the other has sent in the step before.
    fn step(&mut self) {
        let [one, two] = std::mem::take(&mut self.sent);
        let [first, second] = &mut self.nodes;
        self.sent = [first.step(two), second.step(one)];
    }

    /// Frames refused by each so far.
    fn refused(&mut self) -> [u32; 2] {
        self.nodes.each_mut().map(|node| node.status().health.frames_refused)
    }
}

#[test]
fn a_blank_node_speaks_version_1_and_never_again_once_it_has_a_key() {
    let mut node = TestNode::blank();
    let versions = |frames: Vec<Vec<u8>>| frames.iter().map(|frame| frame[0]).collect::<Vec<_>>();
    assert_eq!(node.provision(1, 1_000, &[]), Ok(()));
    assert_eq!(node.push(&package(1, 1)), Ok(()));
    let first = versions(node.step([]));
    assert!(!first.is_empty() && first.iter().all(|&version| version == 1), "{first:?}");
    assert_eq!(node.give_network_keys(&[1]), Ok(()));
    let mut sent = Vec::new();
    (0..3_000).for_each(|_| sent.extend(versions(node.step([]))));
    for off in [Off::Reset, Off::Power] {
        node.restart(off);
        (0..10).for_each(|_| sent.extend(versions(node.step([]))));
    }
    assert!(sent.len() > 3 && sent.iter().all(|&version| version == 2), "{sent:?}");
    // It does not take any either.
    let before = node.status().health.frames_refused;
    node.step([vec![1; 20], TestNode::blank().step([]).concat()]);
    assert_eq!(node.status().health.frames_refused, before + 2);
}

#[test]
fn true_neighbours_are_believed_again_after_a_reboot_of_either() {
    let mut pair = Pair::new();
    for (rebooted, off) in [(0, Off::Reset), (1, Off::Power), (0, Off::Power), (1, Off::Reset)]
        .into_iter()
        .cycle()
        .take(12)
    {
        pair.nodes[rebooted].restart(off);
        // Whatever it said is lost.
        pair.sent[rebooted].clear();
        (0..TWO_SECONDS).for_each(|_| pair.step());
        let before = pair.refused();
        let mut heard = 0;
        for _ in 0..2 * TWO_SECONDS {
            heard += pair.sent.iter().map(Vec::len).sum::<usize>();
            pair.step();
        }
        assert!(heard > 0, "nothing was broadcast");
        assert_eq!(pair.refused(), before, "a true frame was refused");
    }
}

/// An event trigger is not bounded in time, so a node that has just got its first network key may have
/// nothing to broadcast for long. It must answer hellos all the same.
#[test]
fn nodes_that_get_their_first_key_while_they_run_believe_each_other() {
    let mut pair = Pair {
        nodes: [1, 2].map(|agent| {
            let mut node = TestNode::blank();
            assert_eq!(node.provision(agent, 1_000, &[]), Ok(()));
            assert_eq!(node.push(&quiet_package(agent)), Ok(()));
            node
        }),
        sent: Default::default(),
    };
    (0..10).for_each(|_| pair.step());
    assert!(pair.sent.iter().all(Vec::is_empty), "they are not quiet");
    pair.nodes.iter_mut().for_each(|node| assert_eq!(node.give_network_keys(&[1]), Ok(())));
    pair.sent = Default::default();
    let (mut hellos, mut syncs) = (0, 0);
    let keys = [network_key(1)];
    for _ in 0..TWO_SECONDS {
        pair.step();
        for bytes in pair.sent.iter().flatten() {
            let (header, _) = authentic::open(bytes, &keys).unwrap();
            hellos += u32::from(header.kind == Kind::Hello);
            syncs += u32::from(matches!(header.kind, Kind::Sync { .. }));
        }
    }
    // One of each: the first hello is answered at once.
    assert!(syncs >= 2 && hellos <= 4, "{hellos} hellos, {syncs} answers");
}
