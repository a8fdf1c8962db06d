//! Real-time pacing: when the next step is due, and the achieved speed.

use std::time::{Duration, Instant};

/// How far the run may fall behind real time before it stops trying to catch up.
const LAG_MAX: Duration = Duration::from_secs(1);

/// Minimum interval between notices that the run is late.
const LATE_NOTICE: Duration = Duration::from_secs(10);

/// Real-time pacing of a run.
#[derive(Default)]
pub(super) struct Pace {
    /// When the next step is due.
    next_step: Option<Instant>,
    started: Option<Instant>,
    steps: u64,
    /// Delay that the run has stopped trying to catch up with.
    lost: Duration,
    noticed: Option<Instant>,
}

impl Pace {
    /// Returns when the next step is due; the first is due immediately.
    pub(super) fn due(&mut self) -> Instant {
        *self.next_step.get_or_insert_with(Instant::now)
    }

    /// Starts `now` a step that was due at `due`. Returns the achieved fraction of the speed if a
    /// notice is due.
    pub(super) fn advance(&mut self, due: Instant, step: Duration, now: Instant) -> Option<f64> {
        self.started.get_or_insert(now);
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

    /// Returns the achieved fraction of the speed, at most 1; only lost time counts.
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
    fn only_delays_that_are_not_caught_up_with_are_reported() {
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
        // One step is ten seconds late: three steps in ten seconds.
        let share = advance(&mut pace, Duration::from_secs(10)).unwrap();
        assert!((0.0029..0.0031).contains(&share), "{share}");
        // Notices are limited in rate.
        assert_eq!(advance(&mut pace, Duration::from_secs(2)), None);
        assert!(pace.kept(STEP) < share + 0.0005);
    }
}
