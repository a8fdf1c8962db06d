//! Delay: constant, with a jitter that is uniform around it. A copy is overtaken if
//! its delay exceeds that of the next one by more than the interval between them.

use super::layer::{Effect, Layer, Transmission};
use crate::random::{Purpose, Random};
use crate::scenario::EdgeSettings;

#[derive(Debug)]
pub(super) struct Delay {
    random: Random,
    delayed: u64,
}

impl Delay {
    pub(super) fn new(seed: u64) -> Self {
        Self { random: Random::new(seed, Purpose::Delay), delayed: 0 }
    }
}

impl Layer for Delay {
    fn name(&self) -> &'static str {
        "delay"
    }

    fn effect(&self) -> Effect {
        Effect::Alters("delayed")
    }

    fn carry(
        &mut self,
        edge: &EdgeSettings,
        mut transmission: Transmission,
        next: &mut dyn FnMut(Transmission),
    ) {
        let mut delay = edge.delay;
        if edge.jitter > 0.0 {
            delay += edge.jitter * (2.0 * self.random.uniform(transmission.at()) - 1.0);
        }
        self.delayed += u64::from(delay > 0.0);
        transmission.arrival += delay;
        next(transmission);
    }

    fn count(&self) -> u64 {
        self.delayed
    }
}
