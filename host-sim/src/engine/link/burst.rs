//! Loss in bursts: the channel of Gilbert (1960) and Elliott (1963).
//!
//! Each direction of an edge has a chain with two states, good at the start. For every copy it takes
//! a step, from good to bad with probability `to_bad` and back with `to_good`, and loses the copy if it
//! is then bad. So `to_bad / (to_bad + to_good)` of all copies are lost, in bursts of `1 / to_good` on
//! average.

use std::collections::BTreeSet;

use super::layer::{Effect, Layer, Transmission};
use crate::random::{Purpose, Random};
use crate::scenario::EdgeSettings;

#[derive(Debug)]
pub(super) struct BurstLoss {
    random: Random,
    /// Directed edges in the bad state, by sender and receiver.
    bad: BTreeSet<(usize, usize)>,
    lost: u64,
}

impl BurstLoss {
    pub(super) fn new(seed: u64) -> Self {
        Self { random: Random::new(seed, Purpose::Burst), bad: BTreeSet::new(), lost: 0 }
    }
}

impl Layer for BurstLoss {
    fn name(&self) -> &'static str {
        "burst"
    }

    fn effect(&self) -> Effect {
        Effect::Loses("in bursts")
    }

    fn carry(
        &mut self,
        edge: &EdgeSettings,
        transmission: Transmission,
        next: &mut dyn FnMut(Transmission),
    ) {
        let Some(burst) = edge.burst else { return next(transmission) };
        let direction = (transmission.sender, transmission.receiver);
        let was_bad = self.bad.contains(&direction);
        let leaves = if was_bad { burst.to_good } else { burst.to_bad };
        if self.random.happens(leaves, transmission.at()) {
            if was_bad {
                self.bad.remove(&direction);
            } else {
                self.bad.insert(direction);
            }
        }
        if self.bad.contains(&direction) {
            self.lost += 1;
        } else {
            next(transmission);
        }
    }

    fn count(&self) -> u64 {
        self.lost
    }
}
