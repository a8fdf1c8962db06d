//! Real time: when the next step is due, and how much of the speed is kept.

use std::time::{Duration, Instant};

/// How far the run may fall behind real time before it stops trying to catch up.
const LAG_MAX: Duration = Duration::from_secs(1);

/// Between two notices that the run is late.
const LATE_NOTICE: Duration = Duration::from_secs(10);

/// How well real time is kept.
#[derive(Default)]
pub(super) struct Pace {
    /// When the next step is due.
    next_step: Option<Instant>,
    begun: Option<Instant>,
    steps: u64,
    /// Time that the run has given up to catch up with.
    lost: Duration,
    noticed: Option<Instant>,
}

impl Pace {
    /// When the next step is due; the first is due at once.
    pub(super) fn due(&mut self) -> Instant {
        *self.next_step.get_or_insert_with(Instant::now)
    }

    /// A step that was due at `due` begins `now`. Returns how much of the speed is kept, if it is time
    /// to tell.
    pub(super) fn advance(&mut self, due: Instant, step: Duration, now: Instant) -> Option<f64> {
        self.begun.get_or_insert(now);
        self.steps += 1;
        let behind = now.saturating_duration_since(due);
        let gives_up = behind > LAG_MAX;
        self.next_step = Some(if gives_up { now } else { due } + step);
        if !gives_up {
            return None;
        }
        self.lost += behind;
        let quiet = self.noticed.is_some_and(|last| now - last < LATE_NOTICE);
        (!quiet).then(|| {
            self.noticed = Some(now);
            self.kept(step)
        })
    }

    /// The share of the speed that has been kept, at most 1: real time that was given up counts.
    pub(super) fn kept(&self, step: Duration) -> f64 {
        let wanted = step.as_secs_f64() * self.steps as f64;
        if self.lost.is_zero() { 1.0 } else { wanted / (wanted + self.lost.as_secs_f64()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP: Duration = Duration::from_millis(10);

    #[test]
    fn real_time_that_is_caught_up_with_is_kept_and_what_is_given_up_is_told() {
        let (mut pace, start) = (Pace::default(), Instant::now());
        let mut now = start;
        let mut advance = |pace: &mut Pace, late: Duration| {
            let due = pace.next_step.unwrap_or(now);
            now = due + late;
            pace.advance(due, STEP, now)
        };
        assert_eq!(advance(&mut pace, Duration::ZERO), None);
        assert_eq!(advance(&mut pace, LAG_MAX), None);
        assert_eq!((pace.kept(STEP), pace.next_step), (1.0, Some(start + 2 * STEP)));
        // Ten seconds for the work of one step: three steps in ten seconds.
        let share = advance(&mut pace, Duration::from_secs(10)).unwrap();
        assert!((0.0029..0.0031).contains(&share), "{share}");
        // That is told once in a while only.
        assert_eq!(advance(&mut pace, Duration::from_secs(2)), None);
        assert!(pace.kept(STEP) < share + 0.0005);
    }
}
