//! A request to stop: set in one place, polled where work can stop cleanly.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Whether a stop is requested, and since when. A request cannot be withdrawn.
#[derive(Debug, Default)]
pub struct Stop {
    requested: AtomicBool,
    since: OnceLock<Instant>,
}

impl Stop {
    /// Requests the stop.
    pub fn request(&self) {
        self.since.get_or_init(Instant::now);
        self.requested.store(true, Ordering::Release);
    }

    /// Returns whether the stop has been requested.
    #[must_use]
    pub fn is_requested(&self) -> bool {
        self.requested.load(Ordering::Acquire)
    }

    /// Returns whether the stop was requested at least `time` ago, the time that work in progress
    /// has to finish cleanly.
    #[must_use]
    pub fn is_requested_for(&self, time: Duration) -> bool {
        self.is_requested() && self.since.get().is_none_or(|since| since.elapsed() >= time)
    }

    /// Returns the flag that the request sets.
    #[must_use]
    pub fn flag(&self) -> &AtomicBool {
        &self.requested
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn work_in_progress_has_time_to_finish() {
        let stop = Stop::default();
        assert!(!stop.is_requested() && !stop.is_requested_for(Duration::ZERO));
        stop.request();
        assert!(stop.is_requested() && stop.is_requested_for(Duration::ZERO));
        assert!(stop.flag().load(Ordering::Relaxed));
        assert!(!stop.is_requested_for(Duration::from_secs(3600)));
    }
}
