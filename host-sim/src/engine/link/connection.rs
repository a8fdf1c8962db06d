//! Edges that are gone for some time, alone or because groups of agents are cut off from each other.

use super::layer::{Effect, Layer, Transmission};
use crate::scenario::EdgeSettings;

#[derive(Debug, Default)]
pub(super) struct Connection {
    lost: u64,
}

impl Layer for Connection {
    fn name(&self) -> &'static str {
        "connection"
    }

    fn effect(&self) -> Effect {
        Effect::Loses("over edges that were gone")
    }

    fn carry(
        &mut self,
        edge: &EdgeSettings,
        transmission: Transmission,
        next: &mut dyn FnMut(Transmission),
    ) {
        if edge.connected {
            next(transmission);
        } else {
            self.lost += 1;
        }
    }

    fn count(&self) -> u64 {
        self.lost
    }
}
