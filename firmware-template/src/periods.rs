//! Sampling periods, counted on a timer that runs freely.
//!
//! A counter of 32 bits that nobody stops counts on while the processor does not: also over the
//! erasure of a flash sector, during which interrupts wait and could only tell that there was *a*
//! period, not how many. Boards whose timer has fewer bits extend it before they come here.
//!
//! Cost: one division a call. Memory: 12 bytes. Invariants: a period is at least one tick, and
//! no period is lost or counted twice, as long as the calls come less than 2^32 ticks apart.

/// How many periods have begun.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Periods {
    /// Length of a period. \[tick\]
    length: u32,
    /// When the period that counted last began.
    begun: u32,
    started: bool,
}

impl Periods {
    /// Not yet counting. `heartbeat` \[tick\] is how often [`next`](Self::next) comes round
    /// until then, so that a node that has nothing to sample still wakes.
    #[must_use]
    pub const fn new(heartbeat: u32) -> Self {
        let length = if heartbeat == 0 { 1 } else { heartbeat };
        Self { length, begun: 0, started: false }
    }

    /// Counts periods of `period` \[s\] from `now` on, on a counter of `frequency` \[Hz\]. If it
    /// counts periods of that length already, it goes on with those.
    ///
    /// The length is rounded to whole ticks, at most 2^31 of them.
    pub fn start(&mut self, period: f32, frequency: f32, now: u32) {
        // The conversion saturates, and takes what is no number for 0.
        let length = ((period * frequency + 0.5) as u32).clamp(1, 1 << 31);
        if !self.started || self.length != length {
            *self = Self { length, begun: now, started: true };
        }
    }

    /// How many periods have begun since the last call, or since the start: 0 before that.
    pub fn elapsed(&mut self, now: u32) -> u32 {
        // `length` is not 0, which the compiler cannot know.
        let periods = now.wrapping_sub(self.begun).checked_div(self.length).unwrap_or(0);
        self.begun = self.begun.wrapping_add(periods.wrapping_mul(self.length));
        if self.started { periods } else { 0 }
    }

    /// Whether [`elapsed`](Self::elapsed) would move on. Asked after the compare register has been
    /// set, it tells whether that was too late to wake the processor.
    #[must_use]
    pub const fn is_due(&self, now: u32) -> bool {
        now.wrapping_sub(self.begun) >= self.length
    }

    /// When the next period begins, for a compare register that wakes the processor.
    #[must_use]
    pub const fn next(&self) -> u32 {
        self.begun.wrapping_add(self.length)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_period_counts_once_also_where_the_counter_wraps() {
        let mut periods = Periods::new(500);
        let start = u32::MAX - 2_500;
        periods.start(0.001, 1e6, start);
        let mut counted = 0;
        // 7 shares no factor with the period, so that every phase occurs.
        for now in (0..70_000).step_by(7) {
            counted += periods.elapsed(start.wrapping_add(now));
            assert_eq!(counted, now / 1_000);
            assert_eq!(periods.next(), start.wrapping_add((counted + 1) * 1_000));
        }
    }

    #[test]
    fn periods_that_were_missed_are_told() {
        let mut periods = Periods::new(500);
        periods.start(0.001, 84e6, 10);
        assert_eq!(periods.elapsed(10 + 84_000 * 2_000 + 5), 2_000);
        assert_eq!(periods.elapsed(10 + 84_000 * 2_001), 1);
    }

    #[test]
    fn another_start_keeps_the_phase_unless_the_period_changes() {
        let mut periods = Periods::new(500);
        periods.start(0.001, 1e6, 0);
        assert_eq!(periods.elapsed(1_200), 1);
        periods.start(0.001, 1e6, 1_300);
        assert_eq!(periods.next(), 2_000);
        periods.start(0.002, 1e6, 1_300);
        assert_eq!(periods.next(), 3_300);
    }

    #[test]
    fn nothing_counts_before_the_start_but_it_wakes() {
        let mut periods = Periods::new(500);
        assert_eq!(periods.next(), 500);
        assert!(!periods.is_due(499) && periods.is_due(500));
        assert_eq!(periods.elapsed(1_700), 0);
        assert_eq!(periods.next(), 2_000);
    }

    #[test]
    fn a_period_that_is_none_does_no_harm() {
        for period in [0.0, -1.0, f32::NAN] {
            let mut periods = Periods::new(500);
            periods.start(period, 1e6, 0);
            assert_eq!(periods.elapsed(3), 3);
        }
        let mut periods = Periods::new(500);
        periods.start(f32::INFINITY, 1e6, 0);
        assert_eq!(periods.next(), 1 << 31);
    }
}
