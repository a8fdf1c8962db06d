//! Measures the quantities that the theorems bound. Memory does not grow with the length of the
//! run.

use crate::analysis::{LumpedSamples, UltimateBound};
use crate::scenario::Scenario;

/// Measurements for the theorems' bounds.
#[derive(Clone, Debug, PartialEq)]
pub struct Bounds {
    /// Number of states of plant and agents examined: at the start of every step, and the final
    /// one.
    pub states: u64,
    /// The error relative to Theorem 1's bound; `None` if the theorem does not apply
    /// (`k_2 <= 1/kappa`).
    pub ultimate: Option<BoundShare>,
    /// Growth of the error.
    pub growth: Growth,
    /// Samples for checking Theorem 1's premise on `rho`.
    pub lumped: LumpedSamples,
}

/// `|e_1(t)|^2`, all agents stacked, as a share of Theorem 1's bound at the same time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BoundShare {
    /// The bound.
    pub bound: UltimateBound,
    /// The largest share; excluding t = 0 if the bound equals the error there, as it does without a
    /// network.
    pub largest: f64,
    /// Time of the largest share. \[s\]
    pub largest_at: f64,
    /// The largest share in the evaluation window.
    pub largest_evaluated: f64,
    /// The largest `|e_1(t)|` in the evaluation window. \[state unit\]
    pub error_evaluated: f64,
}

/// Growth of the error, all agents stacked, relative to the state.
///
/// An observer that always estimates zero has an error no larger than the state. So an error is
/// excessive if it is more than [`Growth::FAR`] times the larger of the initial error and the
/// largest state. It counts as growing without bound if, in addition, it is more than twice as
/// large in the last tenth of the run as around the middle, or the step is known to be too long.
/// The root mean square over a tenth smooths oscillations.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Growth {
    /// `|e_1(0)|`. \[state unit\]
    pub initial: f64,
    /// The largest `|x_0|` times the square root of the number of agents. \[state unit\]
    pub plant: f64,
    /// Root mean square of `|e_1|` over the fifth tenth of the run. \[state unit\]
    pub middle: f64,
    /// Root mean square of `|e_1|` over the last tenth of the run. \[state unit\]
    pub last: f64,
}

impl Growth {
    /// Ratio of error to state above which an error is excessive.
    pub const FAR: f64 = 10.0;

    /// Returns whether the error grew without bound. `stable_step` says whether the step is short
    /// enough for the observer itself.
    #[must_use]
    pub fn without_bound(&self, stable_step: bool) -> bool {
        if !self.last.is_finite() {
            return true;
        }
        let far = self.last > Self::FAR * self.initial.max(self.plant);
        far && (self.last > 2.0 * self.middle || !stable_step)
    }
}

/// A root mean square over a range of steps.
#[derive(Clone, Debug)]
struct RootMeanSquare {
    ticks: std::ops::RangeInclusive<u64>,
    sum: f64,
    count: u64,
}

impl RootMeanSquare {
    fn over(ticks: std::ops::RangeInclusive<u64>) -> Self {
        Self { ticks, sum: 0.0, count: 0 }
    }

    fn add(&mut self, tick: u64, squared: f64) {
        if self.ticks.contains(&tick) {
            self.sum += squared;
            self.count += 1;
        }
    }

    fn value(&self) -> f64 {
        (self.sum / self.count.max(1) as f64).sqrt()
    }
}

/// Takes the measurements during a run.
pub(super) struct BoundsMeter<'s> {
    scenario: &'s Scenario,
    measured: Bounds,
    evaluation: std::ops::Range<u64>,
    middle: RootMeanSquare,
    last: RootMeanSquare,
    plant_squared: f64,
}

impl<'s> BoundsMeter<'s> {
    pub(super) fn new(scenario: &'s Scenario) -> Self {
        let (steps, time) = (scenario.steps(), &scenario.time);
        let share = |bound| BoundShare {
            bound,
            largest: 0.0,
            largest_at: 0.0,
            largest_evaluated: 0.0,
            error_evaluated: 0.0,
        };
        let measured = Bounds {
            states: 0,
            ultimate: UltimateBound::new(scenario).map(share),
            growth: Growth::default(),
            lumped: LumpedSamples::new(scenario),
        };
        // Ordered to avoid overflow.
        let part = |tenths: u64| steps / 10 * tenths + steps % 10 * tenths / 10;
        Self {
            scenario,
            measured,
            evaluation: scenario.evaluation.ticks(time),
            middle: RootMeanSquare::over(part(4)..=part(5)),
            last: RootMeanSquare::over(part(9).max(1).min(steps)..=steps),
            plant_squared: 0.0,
        }
    }

    /// Returns whether the lumped uncertainty is sampled at `tick`.
    #[inline]
    pub(super) fn samples_lumped(&self, tick: u64) -> bool {
        self.measured.lumped.is_due(tick)
    }

    pub(super) fn lumped(&mut self) -> &mut LumpedSamples {
        &mut self.measured.lumped
    }

    /// Records `|e_1|^2`, all agents stacked, and `x_0` at `tick`.
    #[inline]
    pub(super) fn note(&mut self, tick: u64, squared: f64, truth: &[f64]) {
        let measured = &mut self.measured;
        measured.states += 1;
        if tick == 0 {
            measured.growth.initial = squared.sqrt();
        }
        let size = truth.iter().fold(0.0, |sum, x| sum + x * x);
        self.plant_squared = self.plant_squared.max(size);
        self.middle.add(tick, squared);
        self.last.add(tick, squared);
        if let Some(share) = &mut measured.ultimate {
            let at = self.scenario.time.at(tick);
            let part = squared / share.bound.at(at);
            let trivial = tick == 0 && share.bound.weight_error == 0.0;
            // NaN counts as the largest.
            if !trivial && (part > share.largest || part.is_nan()) {
                (share.largest, share.largest_at) = (part, at);
            }
            if self.evaluation.contains(&tick) {
                share.largest_evaluated = share.largest_evaluated.max(part);
                share.error_evaluated = share.error_evaluated.max(squared.sqrt());
            }
        }
    }

    pub(super) fn finish(mut self) -> Bounds {
        let agents = self.scenario.agents.len() as f64;
        let growth = &mut self.measured.growth;
        growth.plant = (agents * self.plant_squared).sqrt();
        growth.middle = self.middle.value();
        growth.last = self.last.value();
        self.measured
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::PAPER;

    fn growth(error: impl Fn(f64) -> f64) -> Growth {
        let scenario = Scenario::parse("paper.toml", PAPER).unwrap();
        let mut meter = BoundsMeter::new(&scenario);
        for tick in 0..=scenario.steps() {
            let error = error(tick as f64 / scenario.steps() as f64);
            meter.note(tick, error * error, &[3.0, 4.0, 0.0]);
        }
        meter.finish().growth
    }

    #[test]
    fn bounded_errors_do_not_count_as_growth() {
        // The state has norm 5, the three agents' errors together start at 8.
        for error in [
            &(|_: f64| 8.0) as &dyn Fn(f64) -> f64,
            &|t| 8.0 * libm::exp(-9.0 * t),
            &|t| 8.0 + 40.0 * t,
            // Large, but not growing from the middle on.
            &|t| 8.0 + 1e3 * t.min(0.4),
            // A burst in the middle.
            &|t| if (0.5..0.6).contains(&t) { 1e9 } else { 1.0 },
        ] {
            let found = growth(error);
            assert!(!found.without_bound(true), "{found:?}");
        }
    }

    #[test]
    fn growing_errors_are_detected() {
        for error in
            [&(|t: f64| libm::exp(12.0 * t)) as &dyn Fn(f64) -> f64, &|t| 1e3 * t, &|_| f64::NAN]
        {
            let found = growth(error);
            assert!(found.without_bound(true), "{found:?}");
        }
        // Large from early on: counts only if the step is too long.
        let large = growth(|t| 8.0 + 1e3 * t.min(0.1));
        assert_eq!((large.without_bound(true), large.without_bound(false)), (false, true));
        let found = growth(|_| 8.0);
        assert_eq!(found, Growth { initial: 8.0, plant: 75f64.sqrt(), middle: 8.0, last: 8.0 });
    }
}
