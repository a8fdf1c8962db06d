//! Independent loss: every copy is lost with the same probability.

use super::layer::{Effect, Layer, Transmission};
use crate::random::{Purpose, Random};
use crate::scenario::EdgeSettings;

#[derive(Debug)]
pub(super) struct Loss {
    random: Random,
    lost: u64,
}

impl Loss {
    pub(super) fn new(seed: u64) -> Self {
        Self { random: Random::new(seed, Purpose::Loss), lost: 0 }
    }
}

impl Layer for Loss {
    fn name(&self) -> &'static str {
        "loss"
    }

    fn effect(&self) -> Effect {
        Effect::Loses("by independent loss")
    }

    fn carry(
        &mut self,
        edge: &EdgeSettings,
        transmission: Transmission,
        next: &mut dyn FnMut(Transmission),
    ) {
        if self.random.happens(edge.loss, transmission.at()) {
            self.lost += 1;
        } else {
            next(transmission);
        }
    }

    fn count(&self) -> u64 {
        self.lost
    }
}
