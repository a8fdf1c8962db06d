//! What layers do to frames, seen from outside: frames in, frames out.

use agent_core::Tick;

use super::*;
use crate::scenario::{PAPER, Scenario};

const STEPS: Tick = 20_000;

/// The paper's star with these keys in `[link]`.
fn scenario(link: &str) -> Scenario {
    let text = PAPER.replace("kind = \"lossless\"\n", &format!("{link}\n"));
    Scenario::parse("mine.toml", &text).unwrap()
}

/// A frame that arrived.
#[derive(Clone, Debug, PartialEq)]
struct Arrival {
    receiver: usize,
    sender: usize,
    sent: Tick,
    tick: Tick,
    is_intact: bool,
}

/// Sends a frame of each agent in `senders` at every tick for which `sends`, and returns what arrives.
fn carried(
    link: &mut Layered,
    senders: &[usize],
    steps: Tick,
    sends: impl Fn(Tick) -> bool,
) -> Vec<Arrival> {
    let mut arrivals = Vec::new();
    for tick in 0..steps {
        for &sender in senders.iter().filter(|_| sends(tick)) {
            link.send(sender, tick, &frame(sender, tick));
        }
        link.advance(tick);
        for receiver in 0..3 {
            link.deliver(receiver, tick, &mut |bytes| {
                let sent = Tick::from_le_bytes(bytes[1..9].try_into().unwrap());
                let sender = usize::from(bytes[0]).min(2);
                let is_intact = bytes == frame(sender, sent);
                arrivals.push(Arrival { receiver, sender, sent, tick, is_intact });
            });
        }
    }
    arrivals
}

fn received(link: &dyn Link, receiver: usize, tick: Tick) -> Vec<Vec<u8>> {
    let mut frames = Vec::new();
    link.deliver(receiver, tick, &mut |bytes| frames.push(bytes.to_vec()));
    frames
}

/// 25 bytes, as long as the paper's.
fn frame(sender: usize, tick: Tick) -> Vec<u8> {
    let mut bytes = vec![0x5a; 25];
    bytes[0] = sender as u8;
    bytes[1..9].copy_from_slice(&tick.to_le_bytes());
    bytes
}

fn always(_: Tick) -> bool {
    true
}

fn count(link: &Layered, layer: &str) -> u64 {
    link.layer_counts().iter().find(|count| count.layer == layer).unwrap().count
}

#[test]
fn neutral_layers_deliver_what_the_papers_link_does() {
    let scenario = scenario("");
    let (mut layered, mut lossless) = (Layered::new(&scenario, 0), Lossless::new(&scenario.graph));
    for tick in 0..1_000 {
        for sender in (0..3).filter(|sender| tick % (3 + sender) == 0) {
            let bytes = frame(sender as usize, tick);
            layered.send(sender as usize, tick, &bytes);
            lossless.send(sender as usize, tick, &bytes);
        }
        layered.advance(tick);
        for receiver in 0..3 {
            assert_eq!(received(&layered, receiver, tick), received(&lossless, receiver, tick));
        }
    }
    for agent in 0..3 {
        let (layered, lossless) =
            (layered.traffic(agent).unwrap(), lossless.traffic(agent).unwrap());
        assert_eq!(layered.delivered, lossless.delivered);
        assert!((layered.airtime - lossless.airtime).abs() < 1e-9);
    }
    assert!(layered.layer_counts().iter().all(|layer| layer.count == 0));
}

#[test]
fn loss_has_its_probability_on_every_edge() {
    let mut link = Layered::new(&scenario("loss = 0.2"), 5);
    let arrivals = carried(&mut link, &[0, 1, 2], STEPS, always);
    for (sender, receiver) in [(0, 1), (0, 2), (1, 0), (2, 0)] {
        let arrived =
            arrivals.iter().filter(|a| (a.sender, a.receiver) == (sender, receiver)).count();
        let share = arrived as f64 / STEPS as f64;
        assert!((share - 0.8).abs() < 0.01, "{sender} to {receiver}: {share}");
    }
    let traffic = link.traffic(0).unwrap();
    assert_eq!(traffic.delivered + traffic.lost, 2 * STEPS);
    assert_eq!(count(&link, "loss"), (0..3).map(|a| link.traffic(a).unwrap().lost).sum::<u64>());
    // The copies of one frame are lost independently.
    let both = arrivals
        .iter()
        .filter(|a| a.sender == 0 && a.receiver == 1)
        .filter(|first| arrivals.contains(&Arrival { receiver: 2, ..(*first).clone() }));
    let both = both.take(500).count();
    assert_eq!(both, 500);
}

#[test]
fn bursts_have_their_share_and_length() {
    let mut link = Layered::new(&scenario("burst = { to_bad = 0.02, to_good = 0.1 }"), 5);
    let arrivals = carried(&mut link, &[1], STEPS, always);
    let share = 1.0 - arrivals.len() as f64 / STEPS as f64;
    assert!((share - 0.02 / 0.12).abs() < 0.02, "{share}");
    // A burst begins where a frame is lost after one that arrived.
    let arrived: std::collections::BTreeSet<Tick> = arrivals.iter().map(|a| a.sent).collect();
    let lost = |tick: &Tick| !arrived.contains(tick);
    let bursts = (1..STEPS).filter(|tick| lost(tick) && !lost(&(tick - 1))).count();
    let length = (STEPS as f64 - arrivals.len() as f64) / bursts as f64;
    assert!((length - 10.0).abs() < 1.0, "{length}");
}

#[test]
fn a_delay_waits_for_the_next_step_and_jitter_changes_the_order() {
    for (delay, steps) in [("0.01", 10), ("0.0101", 11), ("0.0099", 10), ("0.0001", 1)] {
        let mut link = Layered::new(&scenario(&format!("delay = {delay}")), 0);
        let arrivals = carried(&mut link, &[1], 1_000, always);
        assert_eq!(arrivals.len() as Tick, 1_000 - steps);
        assert!(arrivals.iter().all(|a| a.tick == a.sent + steps), "{delay}");
    }
    let mut link = Layered::new(&scenario("delay = 0.01\njitter = 0.004"), 0);
    let arrivals = carried(&mut link, &[1], STEPS, always);
    let delays = arrivals.iter().map(|a| a.tick - a.sent);
    // Up to 14 ms, so in the 14th step after.
    assert_eq!((delays.clone().min(), delays.max()), (Some(7), Some(14)));
    let overtaken = arrivals.windows(2).filter(|pair| pair[1].sent < pair[0].sent).count();
    assert!(overtaken > 1_000, "{overtaken}");
}

#[test]
fn duplicates_arrive_twice_and_corrupt_frames_differ() {
    let mut link = Layered::new(&scenario("duplicate = 0.3\ncorrupt = 0.1"), 1);
    let arrivals = carried(&mut link, &[2], STEPS, always);
    let duplicates = arrivals.len() as u64 - STEPS;
    assert_eq!(duplicates, count(&link, "duplicate"));
    assert!((duplicates as f64 / STEPS as f64 - 0.3).abs() < 0.01);
    // A changed tick is another one than that of its arrival.
    let intact = |a: &&Arrival| a.is_intact && a.sent == a.tick;
    let corrupt = (arrivals.len() - arrivals.iter().filter(intact).count()) as u64;
    assert_eq!(corrupt, count(&link, "corrupt"));
    assert!((corrupt as f64 / arrivals.len() as f64 - 0.1).abs() < 0.01);
    let traffic = link.traffic(2).unwrap();
    assert_eq!((traffic.delivered, traffic.lost), (arrivals.len() as u64, 0));
}

#[test]
fn edges_and_partitions_come_and_go() {
    let rules = "[[link.edges]]\nagents = [2, 1]\nfrom = 1.0\nto = 2.0\nconnected = false\n\
                 [[link.edges]]\nagents = [1, 3]\nfrom = 3.0\ndelay = 0.003\n\
                 [[link.partitions]]\ngroups = [[1], [2, 3]]\nfrom = 4.0\nto = 5.0\n";
    let mut link = Layered::new(&scenario(rules), 0);
    let arrivals = carried(&mut link, &[0, 1, 2], 6_000, |tick| tick % 10 == 0);
    for tick in (0..6_000).step_by(10) {
        let of = |sender, receiver| {
            let of = |a: &&Arrival| (a.sender, a.receiver, a.sent) == (sender, receiver, tick);
            arrivals.iter().filter(of).map(|a| a.tick - a.sent).collect::<Vec<_>>()
        };
        let parted = (4_000..5_000).contains(&tick);
        let gone = (1_000..2_000).contains(&tick) || parted;
        let late = if tick >= 3_000 { 3 } else { 0 };
        let expected = |gone: bool, delay| if gone { Vec::new() } else { vec![delay] };
        for ends in [(0, 1), (1, 0)] {
            assert_eq!(of(ends.0, ends.1), expected(gone, 0), "{ends:?} at {tick}");
        }
        for ends in [(0, 2), (2, 0)] {
            assert_eq!(of(ends.0, ends.1), expected(parted, late), "{ends:?} at {tick}");
        }
    }
}

#[test]
fn a_node_that_is_down_receives_nothing() {
    let text = PAPER.to_owned() + "\n[[life]]\nagent = 1\nfrom = 0.5\nto = 0.7\n";
    let mut link = Layered::new(&Scenario::parse("mine.toml", &text).unwrap(), 0);
    let arrivals = carried(&mut link, &[1], 1_000, always);
    let missing: Vec<Tick> =
        (0..1_000).filter(|tick| !arrivals.iter().any(|a| a.sent == *tick)).collect();
    assert_eq!(missing, (500..700).collect::<Vec<_>>());
    assert_eq!((count(&link, "receiver-down"), link.traffic(1).unwrap().lost), (200, 200));
}

/// Time on air of a frame at 250 kbit/s. \[s\]
const AIRTIME: f64 = 8.0 * 31.0 / 250_000.0;

#[test]
fn a_shared_medium_carries_one_frame_at_a_time() {
    let mut link = Layered::new(&scenario("rate = 250000"), 0);
    // Three frames every 5 ms: 3 x (0.992 + 0.64) ms fit.
    let arrivals = carried(&mut link, &[0, 1, 2], STEPS, |tick| tick % 5 == 0);
    // All but the one on air at the end, from an outer agent to the centre.
    assert_eq!(arrivals.len() as Tick, 4 * STEPS / 5 - 1);
    let of = |sender| arrivals.iter().find(|a| a.sender == sender && a.sent == 0).unwrap().tick;
    // 0.992 ms, then 1.632 ms later, then once more, each in the next step.
    assert_eq!([of(0), of(1), of(2)], [1, 3, 5]);
    for agent in 0..3 {
        let airtime = link.traffic(agent).unwrap().airtime;
        assert!((airtime - AIRTIME * STEPS as f64 / 5.0).abs() < 1e-6, "{airtime}");
    }
}

#[test]
fn a_newer_frame_takes_the_place_of_one_that_waits() {
    let mut link = Layered::new(&scenario("rate = 20000"), 0);
    // 12.4 ms a frame and 8 ms of gap, but one every millisecond.
    let arrivals = carried(&mut link, &[0, 1, 2], STEPS, always);
    let slots = STEPS as f64 * 1e-3 / (12.4e-3 + 8e-3);
    let frames: f64 = (0..3).map(|agent| link.traffic(agent).unwrap().airtime / 12.4e-3).sum();
    assert!((frames - slots).abs() < 3.0, "{frames} of {slots}");
    // What arrives is as old as its transmission, whatever the queue.
    assert!(arrivals.iter().all(|a| a.tick - a.sent <= 14), "{arrivals:?}");
    // The longest waiting goes first, so all have the same share.
    let shares = [0, 1, 2].map(|agent| link.traffic(agent).unwrap().airtime / 12.4e-3 / frames);
    assert!(shares.iter().all(|share| (share - 1.0 / 3.0).abs() < 0.01), "{shares:?}");
    let traffic = link.traffic(1).unwrap();
    assert!(STEPS - traffic.delivered - traffic.lost <= 2, "{traffic:?}");
}

#[test]
fn slots_and_duty_cycles_are_kept() {
    let mut link = Layered::new(&scenario("rate = 250000\nslot = 0.002\nslots = 3"), 0);
    let arrivals = carried(&mut link, &[0, 1, 2], STEPS, always);
    for arrival in &arrivals {
        // A frame of 0.992 ms arrives in the first step after its slot has begun.
        let slot = (arrival.tick - 1) / 2;
        assert_eq!((arrival.tick % 2, slot as usize % 3), (1, arrival.sender), "{arrival:?}");
    }
    // A frame for each slot, two copies of the centre's.
    assert!(arrivals.len().abs_diff(4 * STEPS as usize / 6) <= 2, "{}", arrivals.len());
    let mut link = Layered::new(&scenario("rate = 250000\nduty_cycle = 0.01"), 0);
    carried(&mut link, &[1], STEPS, always);
    let share = link.traffic(1).unwrap().airtime / (STEPS as f64 * 1e-3);
    assert!((0.0095..0.0101).contains(&share), "{share}");
}

#[test]
fn a_frame_that_waits_meets_the_edge_as_it_is_when_it_starts() {
    // 12.4 ms on air and 8 ms of gap: of three frames at once, the others start at 20.4 and 40.8 ms.
    let rules =
        "rate = 20000\n[[link.partitions]]\ngroups = [[1], [2, 3]]\nfrom = 0.01\nto = 0.03\n";
    let mut link = Layered::new(&scenario(rules), 0);
    let arrivals = carried(&mut link, &[0, 1, 2], 100, |tick| tick == 0);
    let senders: Vec<_> = arrivals.iter().map(|a| a.sender).collect();
    assert_eq!(senders, [0, 0, 2]);
    // A node that loses its power does not send what waits.
    let text = PAPER.replace("kind = \"lossless\"\n", "rate = 20000\n")
        + "\n[[life]]\nagent = 3\nfrom = 0.01\nto = 0.2\n";
    let mut link = Layered::new(&Scenario::parse("mine.toml", &text).unwrap(), 0);
    let arrivals = carried(&mut link, &[0, 1, 2], 100, |tick| tick == 0);
    assert_eq!(
        arrivals.iter().map(|a| (a.sender, a.receiver)).collect::<Vec<_>>(),
        [(0, 1), (1, 0)]
    );
    assert_eq!(link.traffic(2).unwrap().lost, 1);
}

#[test]
fn fates_depend_on_the_seed_only() {
    let link = "loss = 0.2\nburst = { to_bad = 0.1, to_good = 0.5 }\ndelay = 0.01\njitter = 0.01\n\
                duplicate = 0.1\ncorrupt = 0.1";
    let scenario = scenario(link);
    let fates = |seed, senders: &[usize]| {
        carried(&mut Layered::new(&scenario, seed), senders, 2_000, always)
    };
    let all = fates(3, &[0, 1, 2]);
    assert_eq!(all, fates(3, &[0, 1, 2]));
    assert_ne!(all, fates(4, &[0, 1, 2]));
    // Those of one sender do not depend on what others send.
    let of_one: Vec<_> = all.into_iter().filter(|a| a.sender == 1 && a.is_intact).collect();
    let alone: Vec<_> = fates(3, &[1]).into_iter().filter(|a| a.is_intact).collect();
    assert_eq!(of_one, alone);
}
