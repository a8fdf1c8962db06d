//! The trial of a package: decides whether it stays in use or its node returns to what it used
//! before.
//!
//! # What is judged
//! | quantity | over | limit |
//! | --- | --- | --- |
//! | restarts, overflows, skipped ticks | the whole trial | [`TrialLimits`] |
//! | RMS of the innovation | an attempt | [`TrialLimits::innovation_rms`], and [`RMS_FACTOR`] times that of what was in use before |
//! | RMS of the disagreement with the neighbours | an attempt | [`DISAGREEMENT_FACTOR`] times that before |
//! | RMS of the effort of the feedback | an attempt | [`RMS_FACTOR`] times that before |
//! | RMS of the innovation | the first block | [`SWITCH_FACTOR`] times that before |
//! | broadcasts per second | an attempt | [`TrialLimits::broadcasts_per_second`], or without it [`RATE_FACTOR`] times that before |
//! | blocks with a fault, such as an estimate outside the trained box | an attempt | the fraction before, and a quarter |
//!
//! An observer whose neighbours know the state can hide a bad package: the consensus term holds its
//! estimate. So the innovation alone does not decide. [`super::performance`] defines the quantities.
//!
//! # Attempts
//! A package passes with an attempt that lasts as long as the trial needs. An attempt that can no
//! longer pass ends at once and the next one begins, so a transient after the switch does no harm.
//! The trial ends three times that long after it has begun, or as soon as the time that is left is
//! too short for another attempt. Blocks with too few measurements, and those in which the chip stood
//! still, neither help nor harm; only the first block is compared in any case.
//!
//! Without a bound on the innovation, and without a record of what was in use before, nothing tells
//! a bad package from a good one: then only the operator can confirm it, before the deadline. The same
//! holds for a package whose output matrix differs from the previous one's: it changes what the innovation
//! is, and a wrong one can make all agents agree on a wrong state.
//!
//! # What happens at the deadline
//! The package goes, even if nothing was in use before: an agent without a package does no harm to
//! its neighbours, and one with a bad package may. Its reason is kept.
//!
//! Cost: about 40 operations per block. Memory: 160 bytes. Invariant: every comparison is written so
//! that infinity and NaN fail.

use core::num::NonZeroU32;

use serde::{Deserialize, Serialize};

use super::Tally;
use super::performance::{BLOCK, Block, Means, blocks_in};
use crate::Tick;
use crate::package::TrialLimits;

/// Largest RMS of the disagreement, relative to that of what was in use before. Networks trained again
/// are within 1.05, edges ten times too weak at 1.32.
pub const DISAGREEMENT_FACTOR: f32 = 1.2;

/// Largest RMS of innovation and effort, relative to those of what was in use before.
///
/// Measured: see docs/decisions/0017-trial.md.
pub const RMS_FACTOR: f32 = 1.35;

/// Largest RMS of the innovation in the first block, relative to that before: the estimate does not
/// jump at a switch, so it fits the measurement as before, unless the package has another idea of what
/// is measured. If all agents follow that idea, this is the only trace.
pub const SWITCH_FACTOR: f32 = 8.0;

/// Largest rate of broadcasts, relative to that of what was in use before, for a package that
/// promises none.
pub const RATE_FACTOR: f32 = 2.0;

/// An RMS of the innovation below this fraction of that of the measurements is as good as 0: the
/// resolution of a sensor with 12 bits.
const RESOLUTION: f32 = 1.0 / 4096.0;

/// Shortest trial. \[s\]
pub const SECONDS_MIN: u32 = 10;
/// Longest trial. \[s\]
pub const SECONDS_MAX: u32 = 24 * 60 * 60;

/// Deadline of a trial, as a multiple of its length.
const DEADLINE: u32 = 3;

/// Why a package is no longer in use. Numbers and names are part of the service protocol; new ones
/// go to the end.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[repr(u8)]
pub enum RevertReason {
    /// The operator asked for it.
    Operator,
    /// The node was reset during the trial.
    Reset,
    /// More restarts than the limit.
    Restarts,
    /// More steps that would have overflowed than the limit.
    Overflows,
    /// More skipped ticks than the limit.
    SkippedTicks,
    /// The innovation is too large.
    Innovation,
    /// The estimate is too far from those of the neighbours, or none of them is heard any longer.
    Disagreement,
    /// More broadcasts per second than the limit.
    Broadcasts,
    /// Too many steps outside the trained box, with an active projection, or with a fallback.
    Faults,
    /// Too few measurements before the deadline.
    Measurements,
    /// Nothing to compare with, or an output matrix that differs from the previous one, and no
    /// confirmation by the operator before the deadline.
    NotConfirmed,
    /// No agent can be built from the package.
    Unusable,
    /// The feedback has to correct too much of what the network predicts.
    Effort,
}

impl RevertReason {
    /// All reasons, in the order of their codes.
    pub const ALL: [Self; 13] = [
        Self::Operator,
        Self::Reset,
        Self::Restarts,
        Self::Overflows,
        Self::SkippedTicks,
        Self::Innovation,
        Self::Disagreement,
        Self::Broadcasts,
        Self::Faults,
        Self::Measurements,
        Self::NotConfirmed,
        Self::Unusable,
        Self::Effort,
    ];

    /// Returns the number under which a store keeps the reason.
    #[must_use]
    pub const fn code(self) -> u8 {
        self as u8
    }

    /// Returns the reason with this code; [`Self::Unusable`] for one that is not known.
    #[must_use]
    pub fn from_code(code: u8) -> Self {
        Self::ALL.get(usize::from(code)).copied().unwrap_or(Self::Unusable)
    }

    /// Returns the name in JSON.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Operator => "operator",
            Self::Reset => "reset",
            Self::Restarts => "restarts",
            Self::Overflows => "overflows",
            Self::SkippedTicks => "skipped_ticks",
            Self::Innovation => "innovation",
            Self::Disagreement => "disagreement",
            Self::Broadcasts => "broadcasts",
            Self::Faults => "faults",
            Self::Measurements => "measurements",
            Self::NotConfirmed => "not_confirmed",
            Self::Unusable => "unusable",
            Self::Effort => "effort",
        }
    }
}

/// How a trial stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Verdict {
    /// It continues.
    Running,
    /// It continues, and only the operator can confirm the package.
    AwaitsOperator,
    /// The package has passed.
    Passed,
    /// The package must not stay in use.
    Failed(RevertReason),
}

/// The trial of a package.
#[derive(Clone, Debug)]
pub struct Trial {
    limits: TrialLimits,
    before: Option<Means>,
    step_size: f32,
    began: Tick,
    /// Length of an attempt. \[blocks\]
    needed: u32,
    attempt: Attempt,
    /// Over the whole trial.
    tally: Tally,
    whole: Attempt,
    /// Why the last attempt could not pass.
    failed: Option<RevertReason>,
    verdict: Verdict,
}

/// Returns the mean square below which an innovation is as good as none.
fn resolution(before: &Means) -> f32 {
    RESOLUTION * RESOLUTION * before.output
}

/// Sums over the blocks of an attempt, or of all of the trial.
#[derive(Clone, Copy, Debug, Default)]
struct Attempt {
    blocks: u32,
    sums: Means,
}

impl Attempt {
    fn add(&mut self, means: &Means) {
        self.blocks = self.blocks.saturating_add(1);
        self.sums.add(means);
    }
}

impl Trial {
    /// Creates the trial of a package with steps of `step_size` \[s\], before the step at `tick`.
    /// `limits` are the tighter ones of package and node; `before` is the record of what was in use
    /// before.
    #[must_use]
    pub fn new(limits: &TrialLimits, before: Option<Means>, step_size: f32, tick: Tick) -> Self {
        let seconds = limits.seconds.unwrap_or(SECONDS_MIN).clamp(SECONDS_MIN, SECONDS_MAX);
        let is_judged = limits.innovation_rms.is_some() || before.is_some();
        Self {
            limits: *limits,
            before,
            step_size,
            began: tick,
            needed: blocks_in(seconds, step_size),
            attempt: Attempt::default(),
            tally: Tally::default(),
            whole: Attempt::default(),
            failed: None,
            verdict: if is_judged { Verdict::Running } else { Verdict::AwaitsOperator },
        }
    }

    /// Leaves the trial to the operator, for a package that cannot be compared with what was in use
    /// before. Limits of the whole trial still apply.
    #[must_use]
    pub fn left_to_operator(self) -> Self {
        Self { verdict: Verdict::AwaitsOperator, ..self }
    }

    /// Records a block that ended with the step at `tick`, and what happened in it.
    pub fn end_block(&mut self, block: &Block, tally: &Tally, tick: Tick) -> Verdict {
        if self.is_over() {
            return self.verdict;
        }
        self.tally.add(tally);
        if let Some(reason) = self.beyond_limits(&self.tally) {
            return self.fail(reason);
        }
        if let Some(before) = self.before.as_ref().filter(|_| self.whole.blocks == 0) {
            let limit = SWITCH_FACTOR * SWITCH_FACTOR * before.innovation + resolution(before);
            // Written so that NaN fails.
            let is_within = block.means.innovation <= limit;
            if block.taken > 0 && !is_within {
                return self.fail(RevertReason::Innovation);
            }
        }
        if block.is_whole() && tally.stalled_ticks == 0 {
            self.attempt.add(&block.means);
            self.whole.add(&block.means);
            if let Some(reason) = self.cannot_pass() {
                self.failed = Some(reason);
                self.attempt = Attempt::default();
            } else if self.attempt.blocks >= self.needed && self.verdict == Verdict::Running {
                self.verdict = Verdict::Passed;
                return self.verdict;
            }
        }
        self.at(tick)
    }

    /// Returns the verdict at `tick`: a trial that cannot pass before its deadline has failed.
    #[inline]
    pub fn at(&mut self, tick: Tick) -> Verdict {
        let left = self.deadline_ticks().saturating_sub(tick.saturating_sub(self.began));
        let needed = match self.verdict {
            Verdict::Running => {
                Tick::from(self.needed.saturating_sub(self.attempt.blocks)) * Tick::from(BLOCK)
            }
            // One tick before it, so that it ends at the deadline.
            Verdict::AwaitsOperator => 1,
            verdict => return verdict,
        };
        if left >= needed {
            return self.verdict;
        }
        match self.verdict {
            Verdict::AwaitsOperator => self.fail(RevertReason::NotConfirmed),
            _ => self.fail(self.failed.unwrap_or(RevertReason::Measurements)),
        }
    }

    /// Records what has happened in an unfinished block: a restart or an overflow may be one too many.
    pub fn happened(&mut self, tally: &Tally) -> Verdict {
        let mut all = self.tally;
        all.add(tally);
        match self.beyond_limits(&all) {
            Some(reason) if !self.is_over() => self.fail(reason),
            _ => self.verdict,
        }
    }

    fn is_over(&self) -> bool {
        matches!(self.verdict, Verdict::Passed | Verdict::Failed(_))
    }

    /// Ends the trial, because no agent can be built from the package.
    pub fn unusable(&mut self) -> Verdict {
        self.fail(RevertReason::Unusable)
    }

    fn fail(&mut self, reason: RevertReason) -> Verdict {
        self.verdict = Verdict::Failed(reason);
        self.verdict
    }

    /// Returns the limit of the whole trial that has been exceeded.
    fn beyond_limits(&self, tally: &Tally) -> Option<RevertReason> {
        let Tally { restarts, overflows, skipped_ticks, .. } = *tally;
        [
            (restarts, self.limits.restarts, RevertReason::Restarts),
            (overflows, self.limits.overflows, RevertReason::Overflows),
            (skipped_ticks, self.limits.skipped_ticks, RevertReason::SkippedTicks),
        ]
        .into_iter()
        .find(|(found, limit, _)| limit.is_some_and(|limit| *found > limit))
        .map(|(_, _, reason)| reason)
    }

    /// Returns why the current attempt cannot pass, whatever follows, if that is so.
    fn cannot_pass(&self) -> Option<RevertReason> {
        let Attempt { blocks, sums } = &self.attempt;
        let needed = self.needed as f32;
        // The sums of a whole attempt at its limit.
        let within = |sum: f32, mean: f32| sum <= mean * needed;
        if let Some(bound) = self.limits.innovation_rms
            && !within(sums.innovation, bound * bound)
        {
            return Some(RevertReason::Innovation);
        }
        let rate = self.limits.broadcasts_per_second.map(|rate| rate * self.step_size);
        let before_rate =
            self.before.as_ref().map(|before| RATE_FACTOR * before.broadcasts + 1.0 / needed);
        if let Some(rate) = rate.or(before_rate)
            && !within(sums.broadcasts, rate)
        {
            return Some(RevertReason::Broadcasts);
        }
        if let Some(before) = &self.before {
            let square = RMS_FACTOR * RMS_FACTOR;
            let resolution = resolution(before);
            if !within(sums.innovation, square * before.innovation + resolution) {
                return Some(RevertReason::Innovation);
            }
            let disagreement =
                DISAGREEMENT_FACTOR * DISAGREEMENT_FACTOR * before.disagreement + resolution;
            let unheard = *blocks as f32 - sums.heard;
            if before.heard > 0.5
                && (!within(sums.disagreement, disagreement) || !within(unheard, 0.5))
            {
                return Some(RevertReason::Disagreement);
            }
            if !within(sums.effort, square * before.effort + resolution) {
                return Some(RevertReason::Effort);
            }
            if !within(sums.faults, before.faults + 0.25) {
                return Some(RevertReason::Faults);
            }
        }
        None
    }

    fn deadline_ticks(&self) -> Tick {
        Tick::from(self.needed) * Tick::from(BLOCK * DEADLINE)
    }

    /// Returns how the trial stands.
    #[must_use]
    pub fn verdict(&self) -> Verdict {
        self.verdict
    }

    /// Returns how long the current attempt has lasted, how long it needs to last, and the latest end
    /// of the trial, counted from its start. \[s\]
    #[must_use]
    pub fn seconds(&self) -> [f32; 3] {
        let block = BLOCK as f32 * self.step_size;
        let needed = self.needed as f32 * block;
        [self.attempt.blocks as f32 * block, needed, needed * DEADLINE as f32]
    }

    /// Returns the steps of the current attempt so far, and those that it needs.
    #[must_use]
    pub fn steps(&self) -> (u32, NonZeroU32) {
        let needed = NonZeroU32::new(self.needed * BLOCK).unwrap_or(NonZeroU32::MIN);
        (self.attempt.blocks.saturating_mul(BLOCK), needed)
    }

    /// Returns the sums over the blocks of the whole trial, and their number.
    #[must_use]
    pub fn sums(&self) -> (&Means, u32) {
        (&self.whole.sums, self.whole.blocks)
    }

    /// Returns the means of what was in use before.
    #[must_use]
    pub fn before(&self) -> Option<&Means> {
        self.before.as_ref()
    }

    /// Returns `dt`. \[s\]
    #[must_use]
    pub fn step_size(&self) -> f32 {
        self.step_size
    }

    /// Records that the operator has ended the trial.
    pub fn end(&mut self, verdict: Verdict) {
        self.verdict = verdict;
    }
}

#[cfg(test)]
mod tests;
