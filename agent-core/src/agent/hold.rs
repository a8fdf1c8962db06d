//! Sampled estimates: `x_tilde_i(t) = x_hat_i(t_k)` for `t` in `[t_k, t_(k+1))`
//! (equation `x_i_tilde`).
//!
//! An agent keeps one [`Hold`] for itself and one for each neighbour it has heard. Both ends of an
//! edge see the same samples, so they agree on what is held. Only this module decides how a sample
//! replaces the estimate until the next one arrives: at present it is held constant (zero-order
//! hold).
//!
//! # Which of two samples is newer
//! The sequence and the tick of an agent's samples both increase. A sample replaces the held one if
//! either is later: it is then neither a duplicate nor a frame that was overtaken in transit. An
//! agent that restarts counts both from 0, so its frames look old. There is no shared clock, and
//! the numbers alone do not reveal a restart; but an overtaken frame arrives within the link's
//! longest delay, whereas a restarted neighbour keeps broadcasting. Any sample is therefore
//! accepted once the held one has been the newest for more than [`RESTART_SILENCE`] of the
//! *receiver's* steps (or the number set by
//! [`with_restart_silence`](crate::agent::AgentParams::with_restart_silence)). The same rule
//! recovers from a frame whose sequence was wrongly far ahead. It does not protect against replay
//! attacks.
//!
//! # Farewells
//! A neighbour that is about to stall says so. Its hold is then *absent*: every sum leaves it out, as
//! before its first sample, until a frame that is newer than the farewell.
//!
//! Memory: `4 N + 44` bytes, rounded up to a multiple of 8. Cost: a few comparisons per received sample.

use crate::math::numeric::{add_scaled, all_finite};
#[cfg(feature = "field")]
use crate::wire::announced::Announced;
use crate::wire::frame::Frame;
use crate::wire::sequence::is_newer;
use crate::{AgentId, StateVector, Tick};

/// The last sample that an agent broadcast.
///
/// ```
/// use agent_core::{Hold, StateVector};
///
/// let hold = Hold::new(StateVector::<2>::new(1.0, 2.0), 40, 7);
/// assert_eq!(hold.estimate()[1], 2.0);
/// assert_eq!(hold.age(45), 5);
/// assert_eq!(hold.age(39), 0); // from the future
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hold<const N: usize> {
    sample: StateVector<N>,
    tick: Tick,
    sequence: u32,
    /// In ticks of the agent that holds the sample.
    taken_over: Tick,
    /// Smallest difference so far between arrival and tick of the sender's samples, in parts of
    /// 1/[`LEAK`] of a step.
    offset: Option<i64>,
    /// Steps for which the sample was on its way.
    lag: u32,
    /// Whether it stands for a farewell, whose sender has no sample until its next frame.
    #[cfg(feature = "exchange")]
    is_absent: bool,
    /// Whether the sample evolves as announced; if not, as in the paper. An option would not be
    /// zero for nothing, and a static of an agent would have to be kept in flash.
    #[cfg(feature = "field")]
    goes_on: bool,
    #[cfg(feature = "field")]
    announced: Announced<N>,
    /// Steps for which it has evolved.
    #[cfg(feature = "field")]
    moved: u32,
}

/// One slot per neighbour, in the order of the agent's parameters; `None` until a sample arrives.
/// An array or a `heapless::Vec` on a node, a `Vec` on the host.
pub trait HoldSlots<const N: usize>: AsRef<[Option<Hold<N>>]> + AsMut<[Option<Hold<N>>]> {}

impl<const N: usize, S: AsRef<[Option<Hold<N>>]> + AsMut<[Option<Hold<N>>]>> HoldSlots<N> for S {}

/// Number of steps after which a sample that looks older is accepted as coming from a restarted
/// neighbour. At a step of 1 ms this is one second, far above the delay at which a sample is still
/// useful to an observer with gains of some 100 / s.
pub const RESTART_SILENCE: Tick = 1_000;

/// Steps after which the estimated difference of two clocks has risen by one step: 244 ppm.
pub const LEAK: i64 = 4_096;

/// Longest time in transit that is believed. \[step\]
pub const LAG_MAX: u32 = 1_000;

impl<const N: usize> Hold<N> {
    /// Creates a hold for the sample taken at `tick` and broadcast as number `sequence`.
    #[must_use]
    pub const fn new(sample: StateVector<N>, tick: Tick, sequence: u32) -> Self {
        Self {
            sample,
            tick,
            sequence,
            taken_over: tick,
            offset: None,
            lag: 0,
            #[cfg(feature = "exchange")]
            is_absent: false,
            #[cfg(feature = "field")]
            goes_on: false,
            #[cfg(feature = "field")]
            announced: Announced::NONE,
            #[cfg(feature = "field")]
            moved: 0,
        }
    }

    /// Returns the sample that a frame brings.
    pub(crate) fn of_frame(frame: &Frame<N>) -> Self {
        let hold = Self::new(frame.estimate, frame.tick, frame.sequence);
        #[cfg(feature = "exchange")]
        let hold = Self { is_absent: frame.is_farewell, ..hold };
        #[cfg(feature = "field")]
        let hold = Self {
            goes_on: frame.announced.is_some(),
            announced: frame.announced.unwrap_or(Announced::NONE),
            ..hold
        };
        hold
    }

    /// Returns the sample as a frame from `sender`: as it is now, if it evolves.
    pub(crate) fn frame_from(&self, sender: AgentId) -> Frame<N> {
        #[cfg(feature = "field")]
        let tick = self.tick.saturating_add(Tick::from(self.moved));
        #[cfg(not(feature = "field"))]
        let tick = self.tick;
        let frame = Frame::new(sender, self.sequence, tick, self.sample);
        #[cfg(feature = "field")]
        let frame = Frame {
            announced: self.announced().map(|announced| match self.moved {
                0 => *announced,
                // It was rounded when it was taken; a sample that has evolved is not.
                _ => announced.unrounded(),
            }),
            ..frame
        };
        frame
    }

    /// Returns whether the neighbour has said farewell and not been heard since. There is then no sample,
    /// as before the first one; sequence and tick are those of the farewell, so that older frames do not
    /// replace it.
    #[inline]
    #[must_use]
    pub const fn is_absent(&self) -> bool {
        #[cfg(feature = "exchange")]
        {
            self.is_absent
        }
        #[cfg(not(feature = "exchange"))]
        {
            false
        }
    }

    /// Returns the hold in a slot if it has a sample.
    #[inline]
    pub(crate) fn present(slot: &Option<Self>) -> Option<&Self> {
        slot.as_ref().filter(|hold| !hold.is_absent())
    }

    /// Takes the next number of the sequence, for a frame that has no sample; returns it.
    #[cfg(feature = "exchange")]
    pub(crate) fn take_number(&mut self) -> u32 {
        self.sequence = self.sequence.wrapping_add(1);
        self.sequence
    }

    /// Returns how the sample evolves; `None` for the paper's hold.
    #[cfg(feature = "field")]
    #[must_use]
    pub fn announced(&self) -> Option<&Announced<N>> {
        self.goes_on.then_some(&self.announced)
    }

    /// Returns the sample with this announcement.
    #[cfg(feature = "field")]
    pub(crate) fn announcing(self, announced: Announced<N>) -> Self {
        Self { goes_on: true, announced, ..self }
    }

    /// Advances by `steps` to this estimate; returns the announcement, which the caller has to advance by as
    /// many.
    #[cfg(feature = "field")]
    #[must_use]
    pub(crate) fn go_on(&mut self, estimate: StateVector<N>, steps: u32) -> &mut Announced<N> {
        self.sample = estimate;
        self.moved = self.moved.saturating_add(steps);
        &mut self.announced
    }

    /// Returns whether the sample arrived at the agent's step `now`.
    #[cfg(feature = "field")]
    #[inline]
    pub(crate) fn is_new_at(&self, now: Tick) -> bool {
        self.taken_over == now
    }

    /// Returns the steps by which the sample has to advance to belong to `now`: its time in transit, and
    /// the ticks that its holder has skipped.
    #[cfg(feature = "field")]
    pub(crate) fn behind(&self, now: Tick) -> u32 {
        let behind = self.age_here(now).saturating_sub(Tick::from(self.moved));
        u32::try_from(behind).unwrap_or(u32::MAX)
    }

    /// Returns the same sample, accepted by another agent at that agent's step `now`.
    pub(crate) fn taken_over(self, now: Tick) -> Self {
        Self { taken_over: now, ..self }
    }

    /// Estimates for how long this sample, which replaces `held`, was on its way over a link with this
    /// smallest delay; see [`crate::agent::exchange`].
    pub(crate) fn measure_lag(&mut self, held: Option<&Self>, delay: u32) {
        let observed = (self.taken_over as i64).wrapping_sub(self.tick as i64);
        let observed = observed.saturating_mul(LEAK);
        let held = held.filter(|held| self.tick > held.tick);
        let expected = held.and_then(|held| {
            let elapsed = self.taken_over.saturating_sub(held.taken_over);
            Some(held.offset?.saturating_add_unsigned(elapsed))
        });
        let offset = expected.map_or(observed, |expected| expected.min(observed));
        // Rounded, so that the rise of the minimum does not show in the next frames.
        let lag = observed.saturating_sub(offset).saturating_add(LEAK / 2) / LEAK;
        let lag = u32::try_from(lag).unwrap_or(u32::MAX);
        let (offset, lag) = if lag > LAG_MAX { (observed, 0) } else { (offset, lag) };
        (self.offset, self.lag) = (Some(offset), lag.saturating_add(delay));
    }

    /// Extrapolates the sample by `velocity` times `time` \[s\], unless the result is not finite.
    pub(crate) fn move_on(&mut self, velocity: &StateVector<N>, time: f32) {
        let mut moved = self.sample;
        add_scaled(&mut moved, time, velocity);
        if all_finite(&moved) {
            self.sample = moved;
        }
    }

    /// Returns the number of steps for which the sample was on its way, as estimated.
    #[must_use]
    pub fn lag(&self) -> u32 {
        self.lag
    }

    /// Returns the age of the sample on the clock of the agent that holds it: the steps since it
    /// arrived, and its time in transit.
    #[must_use]
    pub fn age_here(&self, now: Tick) -> Tick {
        now.saturating_sub(self.taken_over).saturating_add(Tick::from(self.lag))
    }

    /// Returns whether this sample was taken after `other`, including across the wrap of the sequence
    /// from `u32::MAX` to 0.
    #[inline]
    pub(crate) fn is_newer_than(&self, other: &Self) -> bool {
        is_newer(self.sequence, other.sequence) || self.tick > other.tick
    }

    /// Returns whether this sample replaces `held` at the receiver's step `now`: see the module
    /// documentation.
    #[inline]
    pub(crate) fn replaces(&self, held: &Self, now: Tick, silence: Tick) -> bool {
        self.is_newer_than(held) || now.saturating_sub(held.taken_over) > silence
    }

    /// Returns `x_tilde`, which has stood in for the estimate since the sample was taken.
    #[inline]
    #[must_use]
    pub fn estimate(&self) -> &StateVector<N> {
        &self.sample
    }

    /// Returns the tick at which the sample was taken.
    #[must_use]
    pub fn tick(&self) -> Tick {
        self.tick
    }

    /// Returns the number of the broadcast, counted from 0 for each agent.
    #[must_use]
    pub fn sequence(&self) -> u32 {
        self.sequence
    }

    /// Returns the number of steps since the sample was taken; 0 for a sample from the future.
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
            // Restarted with a running clock, and long ago without one.
            (110, 0, true),
            (20, 8, true),
            // Half of all numbers are ahead, half behind.
            (90, 7 + (1 << 31) - 1, true),
            (90, 7 + (1 << 31), false),
        ] {
            assert_eq!(hold(tick, sequence).is_newer_than(&held), newer, "{tick}, {sequence}");
        }
        assert!(hold(5, 0).is_newer_than(&hold(5, u32::MAX)));
        assert!(!hold(5, u32::MAX).is_newer_than(&hold(5, 0)));
    }

    #[test]
    fn older_looking_samples_wait_for_silence_on_the_receivers_clock() {
        // The sender's clock is far ahead of the receiver's.
        let held = hold(1_000_000, 500).taken_over(40);
        let restarted = hold(0, 0);
        assert!(!restarted.replaces(&held, 50, 10));
        assert!(restarted.replaces(&held, 51, 10));
        assert!(!restarted.replaces(&held, 39, 10));
    }
}
