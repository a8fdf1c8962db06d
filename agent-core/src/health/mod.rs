//! Detects run-time faults, counts and reports them, and recommends what to do.
//!
//! [`Health`] observes the outcome of every step and every refused frame without changing either,
//! and makes two recommendations: whether to use the inner network ([`Health::network_in_use`]) and
//! whether to restart the agent ([`Advice`]).
//!
//! | fault | detected by | counter |
//! | --- | --- | --- |
//! | inputs unlike the training data | `x_hat(t_(k+1))`, the next input of the network, outside [`StateBox`] | `outside_box` |
//! | outer weights near their bound | the projection acts: `|W_hat|^2 > theta_0^2` after a step with the network, including a step that was scaled back onto the bound | `projection_active` |
//! | infinite or NaN inputs | refused by step and inbox | `measurements_not_finite`, `frames_not_finite` |
//! | divergence | a step that would overflow; an estimate outside the plausible region | `diverged`, `implausible` |
//! | broadcasts closer than Theorem 2 allows (`Zeno Bound`) | ticks between two samples | `early_broadcasts` |
//! | a late node | ticks without a step | `skipped_ticks` |
//!
//! # The interval of Theorem 2
//! On the trajectories for which the bound `b` was computed, the estimate moves at most `e_2i_max
//! dt` per step, so the trigger fires after `j >= b / dt` steps at the earliest. The alarm
//! condition is `j < floor(b / dt)`. Neither the rounding of the quotient nor a late step, which
//! moves the estimate by one `dt` while several ticks pass, can cause a false alarm; a violation by
//! less than one step is missed. Bounds below two steps are not monitored.
//!
//! # Fallback
//! After `after` consecutive unhealthy steps the observer runs without the network, and after
//! `return_after` consecutive healthy ones it uses the network again; [`FallBack`] selects what
//! makes a step unhealthy. During a fallback the outer weights stay constant and the projection
//! does not act, so neither is considered; they resume unchanged. A step refused because of its
//! input says nothing about the network: it neither interrupts nor extends a sequence.
//!
//! # Restart
//! A step that overflows is not taken and does no harm by itself. But if the estimate or a
//! neighbour's held sample is huge, all following steps overflow too. A huge measurement that does
//! not overflow throws the outer weights onto their bound, where they stay useless long after the
//! feedback, which shrinks an error by `1 - dt k` per step, has recovered the estimate. The agent
//! therefore restarts from the centre of the trained box and the package's outer weights
//! - immediately, when a step leaves the plausible region, which is the trained box widened by
//!   [`HealthSettings::plausible_margin`] widths;
//! - after [`HealthSettings::restart_after`] consecutive steps that overflow.
//!
//! Neighbours' samples outside the plausible region are dropped; they would otherwise drive the
//! estimate out again. An untrained network has an unbounded box; its plausible region ends where a
//! sample could make a step overflow ([`AgentParams::ceiling`]). Whatever the region, a sample
//! beyond that limit is dropped when a step has overflowed, so that it does not wait for ever.
//! [`Health::restart`] performs the restart; `docs/decisions/0009-restarts.md` has the
//! measurements.
//!
//! Everything is a function of the steps' outcomes: nodes with the same inputs behave identically.
//!
//! Memory: 136 bytes of state, `16 N + 28` of parameters. Cost per step: `2 N` comparisons for a
//! healthy estimate and up to `4 N` otherwise. With `N = 3` a healthy step without a broadcast
//! takes about 95 instructions on a Cortex-M4F, counted by hand in the machine code.
//!
//! [`StateBox`]: crate::agent::region::StateBox

mod counters;
mod params;
pub mod performance;
pub mod trial;
mod watched;

pub use counters::{BoardErrors, HealthCounters};
pub use params::{FallBack, HealthParams, HealthSettings};
pub use performance::Performance;
pub use trial::{RevertReason, Trial, Verdict};
pub use watched::{WatchedAgent, WatchedStep};

use crate::Tick;
use crate::agent::hold::HoldSlots;
use crate::agent::inbox::Inbox;
use crate::agent::{AgentParams, AgentState, StepError, StepOutput};
use crate::math::parameter::ParameterError;
use crate::wire::frame::{Frame, FrameError};

/// Recommendation after a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub enum Advice {
    /// Continue, and broadcast the frame returned by the step.
    Continue,
    /// Call [`Health::restart`] and broadcast the frame it returns in place of the step's.
    Restart,
}

/// The health record of an agent.
///
/// ```
/// use agent_core::wire::frame::FrameError;
/// use agent_core::Health;
///
/// let mut health = Health::new();
/// assert!(health.network_in_use());
/// health.frame_refused(&FrameError::Checksum);
/// assert_eq!(health.counters().frames_refused, 1);
/// ```
#[derive(Clone, Debug, Default)]
pub struct Health {
    counters: HealthCounters,
    /// Tick of the last attempted step.
    last_tick: Option<Tick>,
    /// Tick of the agent's last sample; the first belongs to tick 0.
    last_broadcast: Tick,
    fallen_back: bool,
    /// Consecutive steps towards a fallback, or towards the return.
    row: u32,
    /// Consecutive overflowing steps; `u32::MAX` if the estimate is implausible.
    overflows: u32,
    last_report: Option<Tick>,
    /// Whether anything was counted since the last report.
    is_changed: bool,
    tally: Tally,
    /// Skipped ticks that are not the package's.
    excused: u32,
}

/// What happened since [`Health::take_tally`] was last called: unlike the counters, which stop at
/// `u32::MAX`, it never misses anything.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Tally {
    /// Faults that a package can be responsible for: steps outside the trained box or with an active
    /// projection, overflows, fallbacks and restarts.
    pub faults: u32,
    /// Restarts of the agent.
    pub restarts: u32,
    /// Steps that would have overflowed.
    pub overflows: u32,
    /// Ticks between two attempted steps.
    pub skipped_ticks: u32,
    /// Ticks for which the chip was stalled, which are not the fault of the package.
    pub stalled_ticks: u32,
}

impl Tally {
    /// Adds another tally.
    pub fn add(&mut self, other: &Self) {
        for (sum, other) in [
            (&mut self.faults, other.faults),
            (&mut self.restarts, other.restarts),
            (&mut self.overflows, other.overflows),
            (&mut self.skipped_ticks, other.skipped_ticks),
            (&mut self.stalled_ticks, other.stalled_ticks),
        ] {
            *sum = sum.saturating_add(other);
        }
    }
}

impl Health {
    /// Creates the record of an agent that has not taken a step.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Records the attempted step at `tick`, its outcome, and the resulting state.
    #[inline]
    pub fn observe<const N: usize, const FEATURES: usize, S>(
        &mut self,
        params: &HealthParams<N>,
        tick: Tick,
        outcome: &Result<StepOutput<N>, StepError>,
        state: &AgentState<N, FEATURES, S>,
    ) -> Advice
    where
        S: HoldSlots<N>,
    {
        // Whether the step was unhealthy, and for how many consecutive steps the agent has been
        // unusable.
        let (unhealthy, lost) = match outcome {
            Ok(output) => {
                self.notice_time(tick);
                if let Some(frame) = &output.broadcast {
                    self.notice_broadcast(params, frame.tick);
                }
                let (unhealthy, lost) = self.notice_state(params, state);
                (unhealthy, if lost { u32::MAX } else { 0 })
            }
            Err(StepError::Diverged) => {
                self.notice_time(tick);
                self.count(|counters| &mut counters.diverged);
                count(&mut self.tally.overflows);
                count(&mut self.tally.faults);
                // A kind that is not selected does not count as healthy either.
                let unhealthy = params.fall_back.is_some_and(|f| f.diverged).then_some(true);
                (unhealthy, self.overflows.saturating_add(1))
            }
            Err(StepError::MeasurementNotFinite { .. }) => {
                self.notice_time(tick);
                self.count(|counters| &mut counters.measurements_not_finite);
                return Advice::Continue;
            }
            Err(_) => {
                self.count(|counters| &mut counters.steps_refused);
                return Advice::Continue;
            }
        };
        if let (Some(fall_back), Some(unhealthy)) = (&params.fall_back, unhealthy) {
            self.fall_back_or_return(fall_back, unhealthy);
        }
        self.overflows = lost;
        match params.restart_after {
            Some(after) if lost >= after.get() => Advice::Restart,
            _ => Advice::Continue,
        }
    }

    /// Returns whether the step was unhealthy and whether the agent is unusable.
    #[inline]
    fn notice_state<const N: usize, const FEATURES: usize, S>(
        &mut self,
        params: &HealthParams<N>,
        state: &AgentState<N, FEATURES, S>,
    ) -> (Option<bool>, bool)
    where
        S: HoldSlots<N>,
    {
        let outside = !params.trained.contains(state.estimate());
        let lost = outside && !params.plausible.contains(state.estimate());
        let projection_active =
            !self.fallen_back && state.outer_weights().norm_squared() > params.radius_squared;
        let stale = state.stale_frames();
        if outside || projection_active || stale > 0 {
            self.is_changed = true;
            self.tally.faults =
                self.tally.faults.saturating_add(u32::from(outside || projection_active));
            let counters = &mut self.counters;
            counters.frames_stale = counters.frames_stale.saturating_add(stale);
            for (happened, counter) in [
                (outside, &mut counters.outside_box),
                (lost, &mut counters.implausible),
                (projection_active, &mut counters.projection_active),
            ] {
                if happened {
                    count(counter);
                }
            }
        }
        let unhealthy = params.fall_back.map(|kinds| {
            kinds.outside_box && outside || kinds.projection_active && projection_active
        });
        (unhealthy, lost)
    }

    #[inline]
    fn notice_time(&mut self, tick: Tick) {
        if let Some(last) = self.last_tick {
            let skipped = tick.saturating_sub(last).saturating_sub(1);
            if skipped > 0 {
                self.skipped(skipped);
            }
        }
        self.last_tick = Some(tick);
    }

    #[cold]
    #[inline(never)]
    fn skipped(&mut self, ticks: Tick) {
        let ticks = u32::try_from(ticks).unwrap_or(u32::MAX);
        self.is_changed = true;
        let excused = core::mem::take(&mut self.excused).min(ticks);
        let (counters, tally) = (&mut self.counters, &mut self.tally);
        counters.skipped_ticks = counters.skipped_ticks.saturating_add(ticks);
        tally.skipped_ticks = tally.skipped_ticks.saturating_add(ticks - excused);
        tally.stalled_ticks = tally.stalled_ticks.saturating_add(excused);
    }

    fn notice_broadcast<const N: usize>(&mut self, params: &HealthParams<N>, tick: Tick) {
        if tick.saturating_sub(self.last_broadcast) < Tick::from(params.interval_min) {
            self.count(|counters| &mut counters.early_broadcasts);
        }
        self.last_broadcast = tick;
    }

    fn fall_back_or_return(&mut self, fall_back: &FallBack, unhealthy: bool) {
        if unhealthy == self.fallen_back {
            self.row = 0;
            return;
        }
        self.row += 1;
        let limit = if self.fallen_back { fall_back.return_after } else { fall_back.after };
        if self.row >= limit.get() {
            self.row = 0;
            if self.fallen_back {
                self.count(|counters| &mut counters.returns);
            } else {
                self.count(|counters| &mut counters.fall_backs);
                count(&mut self.tally.faults);
            }
            self.fallen_back = !self.fallen_back;
        }
    }

    /// Records a frame that the inbox refused.
    pub fn frame_refused(&mut self, error: &FrameError) {
        self.count(|counters| match error {
            FrameError::NotFinite { .. } => &mut counters.frames_not_finite,
            FrameError::Implausible { .. } => &mut counters.frames_implausible,
            _ => &mut counters.frames_refused,
        });
    }

    /// Returns whether to pass the inner network to the next step.
    #[inline]
    #[must_use]
    pub fn network_in_use(&self) -> bool {
        !self.fallen_back
    }

    /// Restarts the agent after the attempted step at `tick`: see the module documentation.
    /// `outer_weights` are the package's, row by row, shape `[L, N]`. Returns the frame to
    /// broadcast in place of the step's.
    ///
    /// # Errors
    /// Outer weights of the wrong size or not finite; nothing is changed then.
    pub fn restart<const N: usize, const FEATURES: usize, S, I>(
        &mut self,
        params: &HealthParams<N>,
        agent: &AgentParams<'_, N>,
        state: &mut AgentState<N, FEATURES, S>,
        inbox: &mut Inbox<N, I>,
        tick: Tick,
        outer_weights: &[f32],
    ) -> Result<Frame<N>, ParameterError>
    where
        S: HoldSlots<N>,
        I: HoldSlots<N>,
    {
        let frame = state.restart(agent, tick, params.trained.centre(), outer_weights)?;
        state.forget_neighbours_outside(&params.plausible);
        inbox.discard_outside(&params.plausible);
        self.last_broadcast = frame.tick;
        self.overflows = 0;
        self.count(|counters| &mut counters.restarts);
        count(&mut self.tally.restarts);
        count(&mut self.tally.faults);
        Ok(frame)
    }

    /// Records a measurement that was not finite and that the step will not use.
    #[cold]
    pub fn measurement_refused(&mut self) {
        self.count(|counters| &mut counters.measurements_not_finite);
    }

    /// Returns the counters.
    #[must_use]
    pub fn counters(&self) -> &HealthCounters {
        &self.counters
    }

    /// Returns the counters if a report is due: something has changed since the last report, and at
    /// least [`HealthSettings::telemetry_interval`] ticks have passed. A counter that has reached
    /// `u32::MAX` does not hide that something was counted.
    pub fn due<const N: usize>(
        &mut self,
        params: &HealthParams<N>,
        tick: Tick,
    ) -> Option<HealthCounters> {
        let interval = Tick::from(params.telemetry_interval);
        let early = self.last_report.is_some_and(|last| tick.saturating_sub(last) < interval);
        if early || !self.is_changed {
            return None;
        }
        self.last_report = Some(tick);
        self.is_changed = false;
        Some(self.counters)
    }

    /// Returns what has happened since [`Self::take_tally`] was last called.
    #[must_use]
    pub fn tally(&self) -> &Tally {
        &self.tally
    }

    /// Returns what has happened since the last call.
    pub fn take_tally(&mut self) -> Tally {
        core::mem::take(&mut self.tally)
    }

    /// Does not hold `ticks` of those skipped before the next step against the package: the chip stood
    /// still.
    #[inline]
    pub fn excuse(&mut self, ticks: u32) {
        self.excused = ticks;
    }

    /// Counts something that is to be reported.
    #[inline]
    fn count(&mut self, counter: impl FnOnce(&mut HealthCounters) -> &mut u32) {
        self.is_changed = true;
        count(counter(&mut self.counters));
    }
}

#[inline]
fn count(counter: &mut u32) {
    *counter = counter.saturating_add(1);
}

#[cfg(test)]
mod tests;
