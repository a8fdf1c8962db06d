//! Duplication: some copies arrive twice, as when an acknowledgement is lost.

use super::layer::{Effect, Layer, Transmission};
use crate::random::{Purpose, Random};
use crate::scenario::EdgeSettings;

#[derive(Debug)]
pub(super) struct Duplicate {
    random: Random,
    duplicated: u64,
}

impl Duplicate {
    pub(super) fn new(seed: u64) -> Self {
        Self { random: Random::new(seed, Purpose::Duplicate), duplicated: 0 }
    }
}

impl Layer for Duplicate {
    fn name(&self) -> &'static str {
        "duplicate"
    }

    fn effect(&self) -> Effect {
        Effect::Alters("delivered twice")
    }

    fn carry(
        &mut self,
        edge: &EdgeSettings,
        transmission: Transmission,
        next: &mut dyn FnMut(Transmission),
    ) {
        if self.random.happens(edge.duplicate, transmission.at()) {
            self.duplicated += 1;
            next(Transmission { twin: 1, ..transmission.clone() });
        }
        next(transmission);
    }

    fn count(&self) -> u64 {
        self.duplicated
    }
}
