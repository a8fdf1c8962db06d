//! Sampled estimates: `x_tilde_i(t) = x_hat_i(t_k)` for `t` in `[t_k, t_(k+1))`
//! (equation `x_i_tilde`).
//!
//! An agent keeps one [`Hold`] for itself and one for each neighbour that it has heard. Both
//! ends of an edge see the same samples, so they agree on what is held. How a sample stands
//! in for the estimate until the next one is a matter of this module alone: today it is kept
//! as it is (zero order).
//!
//! Memory: `4 N + 16` bytes. Cost: none.

use crate::{StateVector, Tick};

/// One agent's last broadcast sample.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hold<const N: usize> {
    sample: StateVector<N>,
    tick: Tick,
    sequence: u32,
}

impl<const N: usize> Hold<N> {
    /// The sample that was taken at `tick` and broadcast under the number `sequence`.
    #[must_use]
    pub fn new(sample: StateVector<N>, tick: Tick, sequence: u32) -> Self {
        Self { sample, tick, sequence }
    }

    /// `x_tilde`, what stands in for the estimate since the sample was taken.
    #[inline]
    #[must_use]
    pub fn estimate(&self) -> &StateVector<N> {
        &self.sample
    }

    /// When the sample was taken.
    #[must_use]
    pub fn tick(&self) -> Tick {
        self.tick
    }

    /// Number of the broadcast, rising by one from 0 for each agent.
    #[must_use]
    pub fn sequence(&self) -> u32 {
        self.sequence
    }

    /// Steps since the sample was taken; 0 for a sample from the future.
    #[must_use]
    pub fn age(&self, now: Tick) -> Tick {
        now.saturating_sub(self.tick)
    }
}
