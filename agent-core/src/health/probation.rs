//! When a package on trial has proved itself.

use core::num::NonZeroU32;

use super::HealthCounters;

/// Counts the good steps of a package that [`crate::store`] has on trial.
///
/// A step is good if it was taken and the agent's health noticed nothing: estimate inside the
/// trained box, projection at rest, no overflow, no restart. A step that was refused for its
/// measurement is no step of the package: it counts neither way. Anything else that is noticed
/// starts the count anew.
#[derive(Clone, Debug)]
pub struct Probation {
    needed: NonZeroU32,
    good: u32,
    faults: u32,
}

impl Probation {
    /// The trial of a package that takes `needed` good steps in a row to be confirmed, of an agent
    /// with these counters.
    #[must_use]
    pub fn new(needed: NonZeroU32, counters: &HealthCounters) -> Self {
        Self { needed, good: 0, faults: faults(counters) }
    }

    /// Takes notice of an attempt at a step, after [`super::Health::observe`] has; `taken` says
    /// whether it was taken. Returns whether the package can be confirmed.
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

    /// Good steps in a row so far.
    #[must_use]
    pub fn good_steps(&self) -> u32 {
        self.good
    }
}

/// Everything that a package can be to blame for.
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
        // Sensor trouble and foreign frames are none of the package's.
        counters.measurements_not_finite += 1;
        counters.frames_refused += 1;
        assert!(!probation.observe(false, &counters));
        assert!(!probation.observe(true, &counters));
        assert!(probation.observe(true, &counters));
    }
}
