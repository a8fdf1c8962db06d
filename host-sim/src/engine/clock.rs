//! The clock of an agent: which of its own ticks belongs to a step.
//!
//! Agents step with the engine, so a clock that runs fast skips a number from time to time, as a late
//! node does, and one that runs slowly leaves a step out. The ticks in frames are the agent's own.

use agent_core::Tick;

use crate::random::{Purpose, Random};
use crate::scenario::{ClockSettings, Time};

/// The clock of one agent.
#[derive(Clone, Debug)]
pub(super) struct Clock {
    settings: ClockSettings,
    time: Time,
    agent: u64,
    missed: Random,
    jitter: Random,
    /// The agent's tick of its last step.
    last: Option<Tick>,
}

impl Clock {
    /// Creates the clock of `agent`, from 0; `None` if it is the engine's.
    pub(super) fn new(
        settings: &ClockSettings,
        time: &Time,
        agent: usize,
        seed: u64,
    ) -> Option<Self> {
        (*settings != ClockSettings::default()).then(|| Self {
            settings: *settings,
            time: *time,
            agent: agent as u64,
            missed: Random::new(seed, Purpose::MissedTick),
            jitter: Random::new(seed, Purpose::ClockJitter),
            last: None,
        })
    }

    /// Returns the agent's own tick at the engine's `tick`; `None` if it does not step.
    pub(super) fn step(&mut self, tick: Tick) -> Option<Tick> {
        if self.missed.happens(self.settings.missed, [self.agent, 0, tick]) {
            return None;
        }
        let rate = 1.0 + 1e-6 * self.settings.drift;
        let own = (self.settings.offset + rate * self.time.at(tick)) / self.time.step_size;
        let own = (own + 1e-6).floor() as Tick;
        if self.last.is_some_and(|last| own <= last) {
            return None;
        }
        self.last = Some(own);
        Some(own)
    }

    /// Returns how many steps late the agent measures at `tick`; negative for early.
    pub(super) fn lateness(&self, tick: Tick) -> f64 {
        if self.settings.jitter <= 0.0 {
            return 0.0;
        }
        let draw = 2.0 * self.jitter.uniform([self.agent, 0, tick]) - 1.0;
        draw * self.settings.jitter / self.time.step_size
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plant::Integrator;

    const TIME: Time = Time { duration: 100.0, step_size: 0.01, integrator: Integrator::Euler };

    fn ticks(settings: ClockSettings, steps: u64) -> Vec<Option<Tick>> {
        let mut clock = Clock::new(&settings, &TIME, 0, 3).unwrap();
        (0..steps).map(|tick| clock.step(tick)).collect()
    }

    #[test]
    fn the_engines_clock_needs_no_model() {
        assert!(Clock::new(&ClockSettings::default(), &TIME, 0, 0).is_none());
    }

    #[test]
    fn an_offset_shifts_all_ticks() {
        let ahead = ClockSettings { offset: 0.05, ..ClockSettings::default() };
        assert_eq!(ticks(ahead, 3), [Some(5), Some(6), Some(7)]);
    }

    #[test]
    fn a_fast_clock_skips_ticks_and_a_slow_one_leaves_steps_out() {
        // One in a hundred.
        let fast = ticks(ClockSettings { drift: 10_000.0, ..ClockSettings::default() }, 301);
        assert!(fast.iter().all(Option::is_some));
        assert_eq!(fast[300], Some(303));
        let slow = ticks(ClockSettings { drift: -10_000.0, ..ClockSettings::default() }, 301);
        assert_eq!(slow.iter().filter(|tick| tick.is_none()).count(), 3);
        assert_eq!(slow[300], Some(297));
    }

    #[test]
    fn missed_ticks_have_their_frequency() {
        let late = ticks(ClockSettings { missed: 0.1, ..ClockSettings::default() }, 10_000);
        let missed = late.iter().filter(|tick| tick.is_none()).count();
        assert!((900..1_100).contains(&missed), "{missed}");
        // A step after a missed one has the tick of its time.
        assert!((0..).zip(&late).all(|(tick, own)| own.is_none_or(|own| own == tick)));
    }
}
