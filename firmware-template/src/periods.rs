//! Counts sampling periods on a free-running timer.
//!
//! A free-running 32-bit counter keeps counting while the processor is stopped, for example during
//! the erasure of a flash sector. Pending interrupts would only show that *some* period has begun,
//! not how many. Boards whose timer has fewer bits extend it first.
//!
//! Cost: one division per call. Memory: 16 bytes. Invariants: a period is at least one tick, and no
//! period is lost or counted twice, as long as calls are less than 2^32 ticks apart.

/// Counts the periods that have begun.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Periods {
    /// Length of a period. \[tick\]
    length: u32,
    /// Start of the last counted period.
    begun: u32,
    started: bool,
    /// Of the last call of [`Self::nothing_is_due`].
    seen: u32,
}

impl Periods {
    /// Creates a counter that is not started. Until it is, [`next`](Self::next) advances by
    /// `heartbeat` \[tick\], so that a node with nothing to sample still wakes up.
    #[must_use]
    pub const fn new(heartbeat: u32) -> Self {
        let length = if heartbeat == 0 { 1 } else { heartbeat };
        Self { length, begun: 0, started: false, seen: 0 }
    }

    /// Starts counting periods of `period` \[s\] at `now`, on a counter of `frequency` \[Hz\]. If
    /// periods of that length are already being counted, nothing changes.
    ///
    /// The length is rounded to whole ticks, at most 2^31.
    pub fn start(&mut self, period: f32, frequency: f32, now: u32) {
        // The conversion saturates and maps NaN to 0.
        let length = ((period * frequency + 0.5) as u32).clamp(1, 1 << 31);
        if !self.started || self.length != length {
            *self = Self { length, begun: now, started: true, seen: self.seen };
        }
    }

    /// Returns how many periods have begun since the last call or the start; 0 before the start.
    pub fn elapsed(&mut self, now: u32) -> u32 {
        // `length` is not 0, but the compiler cannot know that.
        let periods = now.wrapping_sub(self.begun).checked_div(self.length).unwrap_or(0);
        self.begun = self.begun.wrapping_add(periods.wrapping_mul(self.length));
        if self.started { periods } else { 0 }
    }

    /// Returns whether [`elapsed`](Self::elapsed) would return more than 0. Called after setting
    /// the compare register, it shows whether that was too late to wake the processor.
    #[must_use]
    pub const fn is_due(&self, now: u32) -> bool {
        now.wrapping_sub(self.begun) >= self.length
    }

    /// Returns whether the counter counts and no period is due: a board may then feed its watchdog,
    /// although no work has been done. Call before [`elapsed`](Self::elapsed).
    pub const fn nothing_is_due(&mut self, now: u32) -> bool {
        let counts = now != self.seen;
        self.seen = now;
        counts && !self.is_due(now)
    }

    /// Returns the start of the next period, for a compare register that wakes the processor.
    #[must_use]
    pub const fn next(&self) -> u32 {
        self.begun.wrapping_add(self.length)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_watchdog_is_fed_only_while_time_passes_and_nothing_is_due() {
        let mut periods = Periods::new(500);
        periods.start(1e-3, 1e6, 100);
        let fed = [200, 900, 900, 1_099, 1_100, 5_000].map(|now| periods.nothing_is_due(now));
        // A counter that has stopped, and a period that has begun, do not feed it.
        assert_eq!(fed, [true, true, false, true, false, false]);
        assert_eq!(periods.elapsed(5_000), 4);
        assert!(periods.nothing_is_due(5_001));
    }

    #[test]
    fn every_period_counts_once_across_the_wrap() {
        let mut periods = Periods::new(500);
        let start = u32::MAX - 2_500;
        periods.start(0.001, 1e6, start);
        let mut counted = 0;
        // 7 is coprime to the period, so that every phase occurs.
        for now in (0..70_000).step_by(7) {
            counted += periods.elapsed(start.wrapping_add(now));
            assert_eq!(counted, now / 1_000);
            assert_eq!(periods.next(), start.wrapping_add((counted + 1) * 1_000));
        }
    }

    #[test]
    fn missed_periods_are_reported() {
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
    fn before_the_start_it_wakes_but_counts_nothing() {
        let mut periods = Periods::new(500);
        assert_eq!(periods.next(), 500);
        assert!(!periods.is_due(499) && periods.is_due(500));
        assert_eq!(periods.elapsed(1_700), 0);
        assert_eq!(periods.next(), 2_000);
    }

    #[test]
    fn an_invalid_period_is_harmless() {
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
