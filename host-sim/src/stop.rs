//! A request to stop: one place makes it, others look at it where they can stop in good order.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// Whether something is to stop, and since when. It is never taken back.
#[derive(Debug, Default)]
pub struct Stop {
    requested: AtomicBool,
    since: OnceLock<Instant>,
}

impl Stop {
    /// Asks for the stop.
    pub fn request(&self) {
        self.since.get_or_init(Instant::now);
        self.requested.store(true, Ordering::Release);
    }

    /// Whether the stop has been asked for.
    #[must_use]
    pub fn is_requested(&self) -> bool {
        self.requested.load(Ordering::Acquire)
    }

    /// Whether the stop was asked for at least `time` ago: what is under way may have that long to
    /// finish in good order.
    #[must_use]
    pub fn is_requested_for(&self, time: Duration) -> bool {
        self.is_requested() && self.since.get().is_none_or(|since| since.elapsed() >= time)
    }

    /// The flag that becomes true with the request.
    #[must_use]
    pub fn flag(&self) -> &AtomicBool {
        &self.requested
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_under_way_has_its_time() {
        let stop = Stop::default();
        assert!(!stop.is_requested() && !stop.is_requested_for(Duration::ZERO));
        stop.request();
        assert!(stop.is_requested() && stop.is_requested_for(Duration::ZERO));
        assert!(stop.flag().load(Ordering::Relaxed));
        assert!(!stop.is_requested_for(Duration::from_secs(3600)));
    }
}
