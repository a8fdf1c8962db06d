//! Limits how often a node erases flash and checks packages.
//!
//! Time is counted in its steps. Without a package a node takes no steps, so time stops and
//! there is no limit. Memory: 40 bytes.

use agent_core::store::{Limiter, RateLimit, StoreError};

/// What is left of the limits.
#[derive(Clone, Debug)]
pub(super) struct Limits {
    /// Uploads: they check a header, and erase a slot.
    pub(super) uploads: Limiter,
    /// Complete packages checked.
    pub(super) checks: Limiter,
    /// Activations, which check again.
    pub(super) activations: Limiter,
    /// Time that is not yet a whole millisecond. \[us\]
    rest: u32,
}

impl Limits {
    pub(super) const fn new(limit: RateLimit) -> Self {
        let limiter = Limiter::new(limit);
        let (checks, activations) = (Limiter::new(limit), Limiter::new(limit));
        Self { uploads: limiter, checks, activations, rest: 0 }
    }

    /// Lets `periods` of this length \[s\] pass.
    pub(super) fn advance(&mut self, periods: u32, period: f32) {
        // Longer than an hour is as good as an hour.
        let period = ((period * 1e6 + 0.5) as u32).clamp(1, 3_600_000_000);
        let elapsed = periods.saturating_mul(period).saturating_add(self.rest);
        self.rest = elapsed % 1000;
        for limiter in [&mut self.uploads, &mut self.checks, &mut self.activations] {
            limiter.advance(elapsed / 1000);
        }
    }
}

/// Pays for an action, if time passes for the node.
pub(super) fn take(limiter: &mut Limiter, has_time: bool) -> Result<(), StoreError> {
    if has_time { limiter.take() } else { Ok(()) }
}
