//! Disturbs frames on their way to a node, and adds frames that no agent has sent.

use agent_core::StateVector;
use agent_core::wire::frame::Frame;
use rand::seq::IndexedRandom;
use rand::{Rng, RngExt};

use super::rates;
use super::report::Tally;

/// Longest delay of a frame. \[steps\]
const DELAY_MAX: u64 = 30;
/// Number of frames stored for replay.
const KEPT: usize = 64;

/// The links to one node.
#[derive(Clone, Debug)]
pub(super) struct Links {
    /// The receiving node; agents are numbered from 1.
    agent: u32,
    neighbours: Vec<u32>,
    /// Arrival steps and bytes of frames in transit.
    under_way: Vec<(u64, Vec<u8>)>,
    old: Vec<Vec<u8>>,
}

impl Links {
    pub(super) fn new(agent: u32, neighbours: Vec<u32>) -> Self {
        Self { agent, neighbours, under_way: Vec::new(), old: Vec::new() }
    }

    /// Sends a neighbour's broadcast, due at `step`.
    pub(super) fn send(
        &mut self,
        frame: &[u8],
        step: u64,
        rates: &rates::Frame,
        rng: &mut impl Rng,
        tally: &mut Tally,
    ) {
        let mut frame = frame.to_vec();
        if self.old.len() < KEPT {
            self.old.push(frame.clone());
        } else if rng.random_bool(0.01) {
            let place = rng.random_range(0..KEPT);
            self.old[place].clone_from(&frame);
        }
        if rng.random_bool(rates.lost) {
            tally.fault("frame lost");
            return;
        }
        if rng.random_bool(rates.repeated) {
            tally.fault("frame repeated");
            self.under_way.push((step + rng.random_range(0..3), frame.clone()));
        }
        if rng.random_bool(rates.flipped) {
            tally.fault("frame with a flipped bit");
            let place = rng.random_range(0..frame.len());
            frame[place] ^= 1 << rng.random_range(0..8);
        }
        if rng.random_bool(rates.cut) {
            tally.fault("frame cut");
            frame.truncate(rng.random_range(0..frame.len()));
        }
        let delay = if rng.random_bool(rates.delayed) {
            tally.fault("frame delayed");
            rng.random_range(1..=DELAY_MAX)
        } else {
            0
        };
        self.under_way.push((step + delay, frame));
    }

    /// Returns the frames that arrive before the step.
    pub(super) fn arrivals(
        &mut self,
        step: u64,
        rates: &rates::Frame,
        rng: &mut impl Rng,
        tally: &mut Tally,
    ) -> Vec<Vec<u8>> {
        let (mut arrived, under_way): (Vec<_>, Vec<_>) =
            self.under_way.drain(..).partition(|(due, _)| *due <= step);
        self.under_way = under_way;
        let mut foreign = |name, frame: Vec<u8>| {
            tally.fault(name);
            arrived.push((step, frame));
        };
        if rng.random_bool(rates.stranger) {
            let any = u32::from(rng.random::<u16>());
            let stranger = if self.neighbours.contains(&any) { self.agent } else { any };
            let sender = *[self.agent, stranger].choose(rng).unwrap_or(&stranger);
            foreign("frame of a stranger", self.forged(sender, [1.0, 2.0, 3.0], rng));
        }
        let neighbour = *self.neighbours.choose(rng).unwrap_or(&0);
        if rng.random_bool(rates.not_finite) {
            let numbers = [f32::NAN, f32::INFINITY, f32::NEG_INFINITY];
            let mut estimate = [0.0; 3];
            estimate[rng.random_range(0..3)] = *numbers.choose(rng).unwrap_or(&f32::NAN);
            foreign("frame that is not finite", self.forged(neighbour, estimate, rng));
        }
        if rng.random_bool(rates.implausible) {
            let mut estimate = [0.0; 3];
            // Far above trained boxes with their margins.
            estimate[rng.random_range(0..3)] = huge(rng, 6.0);
            foreign("frame that is not plausible", self.forged(neighbour, estimate, rng));
        }
        if rng.random_bool(rates.noise) {
            let length = rng.random_range(0..=120);
            foreign("noise for a frame", (0..length).map(|_| rng.random()).collect());
        }
        if rng.random_bool(rates.old)
            && let Some(frame) = self.old.choose(rng)
        {
            foreign("old frame repeated", frame.clone());
        }
        if rng.random_bool(rates.farewell) {
            tally.fault("farewell that no agent has said");
            let farewell = Frame::<3>::farewell(neighbour, rng.random(), rng.random());
            arrived.push((step, farewell.encode().to_vec()));
        }
        arrived.into_iter().map(|(_, frame)| frame).collect()
    }

    /// Returns a frame with random sequence and tick.
    fn forged(&self, sender: u32, estimate: [f32; 3], rng: &mut impl Rng) -> Vec<u8> {
        let estimate = StateVector::from(estimate);
        let frame = Frame::new(sender, rng.random(), rng.random(), estimate);
        frame.encode().to_vec()
    }
}

/// Returns a number of either sign with a magnitude between `10^least` and 1e38.
pub(super) fn huge(rng: &mut impl Rng, least: f32) -> f32 {
    let size = 10f32.powf(rng.random_range(least..38.0));
    if rng.random() { size } else { -size }
}
