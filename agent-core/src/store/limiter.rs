//! Limits how often something that wears flash out or takes long is done: a token bucket.
//!
//! The bucket holds time instead of tokens, so that it needs no fractions: one action costs the
//! interval between two of them, and a full bucket holds the cost of a burst. Time is passed in.
//! The bucket is full after a reset.
//!
//! Memory: 12 bytes each.

use super::StoreError;

/// How often an action may be taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RateLimit {
    /// In the long run: this many per hour. 0 means no limit.
    pub per_hour: u16,
    /// At most this many in a row; at least 1.
    pub burst: u8,
}

impl RateLimit {
    /// 20 an hour, in bursts of 4: a page of flash that lasts for 10,000 erasures lasts three weeks
    /// of nothing but updates, and a lifetime of reasonable ones.
    pub const DEFAULT: Self = Self { per_hour: 20, burst: 4 };
    /// No limit.
    pub const NONE: Self = Self { per_hour: 0, burst: 1 };
}

impl Default for RateLimit {
    fn default() -> Self {
        Self::DEFAULT
    }
}

/// What is left of a limit.
#[derive(Clone, Debug)]
pub struct Limiter {
    /// Cost of an action. \[ms\]
    interval: u32,
    /// \[ms\]
    capacity: u32,
    /// \[ms\]
    level: u32,
}

const HOUR: u32 = 3_600_000;

impl Limiter {
    /// Creates a full bucket.
    #[must_use]
    pub const fn new(limit: RateLimit) -> Self {
        let interval = match HOUR.checked_div(limit.per_hour as u32) {
            Some(interval) => interval,
            None => 0,
        };
        let burst = if limit.burst == 0 { 1 } else { limit.burst };
        let capacity = interval.saturating_mul(burst as u32);
        Self { interval, capacity, level: capacity }
    }

    /// Lets time pass.
    #[inline]
    pub fn advance(&mut self, milliseconds: u32) {
        self.level = self.level.saturating_add(milliseconds).min(self.capacity);
    }

    /// Pays for an action.
    ///
    /// # Errors
    /// [`StoreError::TooOften`], which says when there will be enough.
    pub fn take(&mut self) -> Result<(), StoreError> {
        match self.level.checked_sub(self.interval) {
            Some(level) => {
                self.level = level;
                Ok(())
            }
            None => {
                let missing = self.interval.saturating_sub(self.level);
                Err(StoreError::TooOften { retry_after_seconds: missing.div_ceil(1000) })
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_burst_and_then_the_rate() {
        let mut limiter = Limiter::new(RateLimit::DEFAULT);
        for _ in 0..4 {
            assert_eq!(limiter.take(), Ok(()));
        }
        let wait = |seconds| Err(StoreError::TooOften { retry_after_seconds: seconds });
        assert_eq!(limiter.take(), wait(180));
        limiter.advance(179_001);
        assert_eq!(limiter.take(), wait(1));
        limiter.advance(999);
        assert_eq!(limiter.take(), Ok(()));
        // A year later the bucket is full, not more.
        limiter.advance(u32::MAX);
        assert_eq!([0; 5].map(|_| limiter.take().is_ok()), [true, true, true, true, false]);
        // Of an hour's attempts, one a second, the rate's share succeeds.
        let done = (0..36_000).filter(|_| {
            limiter.advance(1000);
            limiter.take().is_ok()
        });
        assert_eq!(done.count(), 200);
    }

    #[test]
    fn without_a_limit_nothing_is_refused() {
        let mut limiter = Limiter::new(RateLimit::NONE);
        assert!((0..1000).all(|_| limiter.take().is_ok()));
        let mut single = Limiter::new(RateLimit { per_hour: 1, burst: 0 });
        assert_eq!(single.take(), Ok(()));
        assert_eq!(single.take(), Err(StoreError::TooOften { retry_after_seconds: 3600 }));
    }
}
