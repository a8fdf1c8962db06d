//! Decides when a package on trial can be confirmed.

use core::num::NonZeroU32;

use super::HealthCounters;

/// Counts the good steps of a package that [`crate::store`] has on trial.
///
/// A step is good if it was taken and no health counter changed: the estimate is in the trained
/// box, the projection is inactive, and there was no overflow and no restart. A step refused
/// because of its measurement is ignored. Any other fault resets the count.
#[derive(Clone, Debug)]
pub struct Probation {
    needed: NonZeroU32,
    good: u32,
    faults: u32,
}

impl Probation {
    /// Creates the trial of a package that needs `needed` consecutive good steps, for an agent with
    /// the given counters.
    #[must_use]
    pub fn new(needed: NonZeroU32, counters: &HealthCounters) -> Self {
        Self { needed, good: 0, faults: faults(counters) }
    }

    /// Records an attempted step, after [`super::Health::observe`]; `taken` says whether it was
    /// taken. Returns whether the package can be confirmed.
    pub fn observe(&mut self, taken: bool, counters: &HealthCounters) -> bool {
        let faults = faults(counters);
        if faults != self.faults {
            self.faults = faults;
            self.good = 0;
        } else if taken {
            self.good = self.good.saturating_add(1);
        }
        self.good >= self.needed.get()
    }

    /// Returns the number of consecutive good steps so far.
    #[must_use]
    pub fn good_steps(&self) -> u32 {
        self.good
    }
}

/// Returns the sum of the counters that a package can be responsible for.
fn faults(counters: &HealthCounters) -> u32 {
    [
        counters.outside_box,
        counters.projection_active,
        counters.diverged,
        counters.fall_backs,
        counters.restarts,
    ]
    .into_iter()
    .fold(0, u32::wrapping_add)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_good_steps_in_a_row_count() {
        let mut counters = HealthCounters { outside_box: 7, ..HealthCounters::default() };
        let mut probation = Probation::new(NonZeroU32::new(3).unwrap(), &counters);
        assert!(!probation.observe(true, &counters));
        assert!(!probation.observe(true, &counters));
        counters.projection_active += 1;
        assert!(!probation.observe(true, &counters));
        assert_eq!(probation.good_steps(), 0);
        assert!(!probation.observe(true, &counters));
        // Sensor faults and foreign frames are not caused by the package.
        counters.measurements_not_finite += 1;
        counters.frames_refused += 1;
        assert!(!probation.observe(false, &counters));
        assert!(!probation.observe(true, &counters));
        assert!(probation.observe(true, &counters));
    }
}
