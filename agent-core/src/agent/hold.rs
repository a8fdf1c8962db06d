//! Sampled estimates: `x_tilde_i(t) = x_hat_i(t_k)` for `t` in `[t_k, t_(k+1))`
//! (equation `x_i_tilde`).
//!
//! An agent keeps one [`Hold`] for itself and one for each neighbour that it has heard. Both
//! ends of an edge see the same samples, so they agree on what is held. How a sample stands
//! in for the estimate until the next one is a matter of this module alone: today it is kept
//! as it is (zero order).
//!
//! # Which of two samples is the newer one
//! Sequence and tick of an agent's samples both rise. A sample takes the place of the one that
//! is held if it comes later by either of them: then it is no copy, and no frame that was
//! overtaken on its way. An agent that began anew counts both from 0 and would be taken for its
//! own past. No clock is shared, so it cannot be told apart by its numbers; but an overtaken frame
//! arrives within the link's longest delay, and a neighbour that began anew goes on
//! broadcasting. So any sample is taken once the held one has been the newest for longer than
//! [`RESTART_SILENCE`] of the *receiver's* steps (or what
//! [`with_restart_silence`](crate::agent::AgentParams::with_restart_silence) sets). The same
//! rule ends the reign of a frame whose sequence was far ahead by mistake. It is no protection
//! against somebody who records frames and repeats them on purpose.
//!
//! Memory: `4 N + 20` bytes. Cost: a few comparisons for each sample that arrives.

use crate::wire::sequence::is_newer;
use crate::{StateVector, Tick};

/// One agent's last broadcast sample.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hold<const N: usize> {
    sample: StateVector<N>,
    tick: Tick,
    sequence: u32,
    /// On the clock of the agent that holds it.
    taken_over: Tick,
}

/// One slot for each neighbour's sample, in the order of the agent's parameters; `None` where
/// nothing has been heard. An array or a `heapless::Vec` on a node, a `Vec` on the host.
pub trait HoldSlots<const N: usize>: AsRef<[Option<Hold<N>>]> + AsMut<[Option<Hold<N>>]> {}

impl<const N: usize, S: AsRef<[Option<Hold<N>>]> + AsMut<[Option<Hold<N>>]>> HoldSlots<N> for S {}

/// For how many steps a held sample stays the newest until one that looks older is taken for
/// that of a neighbour that began anew: a second at a step of 1 ms, far above the delay at which
/// a sample is still worth something to an observer with gains of some 100 / s.
pub const RESTART_SILENCE: Tick = 1_000;

impl<const N: usize> Hold<N> {
    /// The sample that was taken at `tick` and broadcast under the number `sequence`.
    #[must_use]
    pub const fn new(sample: StateVector<N>, tick: Tick, sequence: u32) -> Self {
        Self { sample, tick, sequence, taken_over: tick }
    }

    /// The same sample, taken over by another agent in that agent's step `now`.
    pub(crate) fn taken_over(self, now: Tick) -> Self {
        Self { taken_over: now, ..self }
    }

    /// Whether the agent took this sample after `other`, also across the wrap of the sequence
    /// from `u32::MAX` to 0.
    #[inline]
    pub(crate) fn is_newer_than(&self, other: &Self) -> bool {
        is_newer(self.sequence, other.sequence) || self.tick > other.tick
    }

    /// Whether this sample takes the place of `held` in the receiver's step `now`: see the
    /// module's description.
    #[inline]
    pub(crate) fn replaces(&self, held: &Self, now: Tick, silence: Tick) -> bool {
        self.is_newer_than(held) || now.saturating_sub(held.taken_over) > silence
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

#[cfg(test)]
mod tests {
    use super::*;

    fn hold(tick: Tick, sequence: u32) -> Hold<1> {
        Hold::new([0.0].into(), tick, sequence)
    }

    #[test]
    fn sequence_or_tick_makes_a_sample_newer() {
        let held = hold(100, 7);
        for (tick, sequence, newer) in [
            (100, 7, false),
            (90, 6, false),
            (110, 8, true),
            // Began anew with a clock that goes on, and long ago with one that does not.
            (110, 0, true),
            (20, 8, true),
            // Half the numbers are ahead, half behind.
            (90, 7 + (1 << 31) - 1, true),
            (90, 7 + (1 << 31), false),
        ] {
            assert_eq!(hold(tick, sequence).is_newer_than(&held), newer, "{tick}, {sequence}");
        }
        assert!(hold(5, 0).is_newer_than(&hold(5, u32::MAX)));
        assert!(!hold(5, u32::MAX).is_newer_than(&hold(5, 0)));
    }

    #[test]
    fn what_looks_older_has_to_wait_for_the_silence_on_the_receivers_clock() {
        // The sender's clock is far ahead of the receiver's.
        let held = hold(1_000_000, 500).taken_over(40);
        let anew = hold(0, 0);
        assert!(!anew.replaces(&held, 50, 10));
        assert!(anew.replaces(&held, 51, 10));
        assert!(!anew.replaces(&held, 39, 10));
    }
}
