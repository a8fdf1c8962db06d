//! What a node reports beyond its status: performance, trial, and resets.

use serde::{Deserialize, Serialize};

use crate::health::performance::Means;
use crate::health::{RevertReason, Verdict};
use crate::math::numeric::square_root;

/// Bytes of the name of a source file that are kept of a panic's place.
pub const FILE_NAME: usize = 24;

/// The answer to [`Request::Report`](super::Request::Report).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// How the package in use performs; `None` until there is something to report.
    pub performance: Option<Performance>,
    /// The trial in progress, or else the last one since the node started.
    pub trial: Option<TrialReport>,
    /// The last package that was rolled back.
    pub last_revert: Option<LastRevert>,
    /// Epoch of the package in use.
    pub epoch: Option<u32>,
    /// How often the node has started, if it keeps that.
    pub boots: Option<u32>,
    /// Why it has started.
    pub reset_cause: ResetCause,
    /// Where the firmware panicked before the last reset, if it did.
    pub panic: Option<PanicPlace>,
    /// Ticks missed because the chip was stalled while flash was erased or written.
    pub stalled_ticks: u32,
}

/// Root mean squares and rates.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Performance {
    /// RMS of the innovation over steps and outputs. \[output unit\]
    pub innovation_rms: f32,
    /// RMS of the disagreement with the neighbours. \[state unit\]
    pub disagreement_rms: f32,
    /// RMS of what the feedback had to add to the network's prediction. \[state unit/s\]
    pub effort_rms: f32,
    /// \[1/s\]
    pub broadcasts_per_second: f32,
    /// Fraction of the blocks with a fault.
    pub faults: f32,
}

impl Performance {
    /// Creates it from sums over `blocks` blocks of steps of `step_size` \[s\].
    #[must_use]
    pub fn new(sums: &Means, blocks: u32, step_size: f32) -> Self {
        let blocks = blocks.max(1) as f32;
        Self {
            innovation_rms: square_root(sums.innovation / blocks),
            disagreement_rms: square_root(sums.disagreement / blocks),
            effort_rms: square_root(sums.effort / blocks),
            broadcasts_per_second: sums.broadcasts / (blocks * step_size),
            faults: sums.faults / blocks,
        }
    }
}

/// A trial.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrialReport {
    /// Seconds of the current attempt so far. \[s\]
    pub good_seconds: f32,
    /// Seconds that an attempt needs. \[s\]
    pub needed_seconds: f32,
    /// Latest end of the trial, counted from its start. \[s\]
    pub deadline_seconds: f32,
    /// How it stands.
    pub verdict: Verdict,
    /// Over the whole trial; `None` before the first block.
    pub found: Option<Performance>,
    /// What was in use before.
    pub before: Option<Performance>,
}

impl TrialReport {
    /// Creates the report of a trial.
    #[must_use]
    pub fn new(trial: &crate::health::Trial) -> Self {
        let [good_seconds, needed_seconds, deadline_seconds] = trial.seconds();
        let step_size = trial.step_size();
        let (sums, blocks) = trial.sums();
        Self {
            good_seconds,
            needed_seconds,
            deadline_seconds,
            verdict: trial.verdict(),
            found: (blocks > 0).then(|| Performance::new(sums, blocks, step_size)),
            before: trial.before().map(|before| Performance::new(before, 1, step_size)),
        }
    }
}

/// A package that was rolled back.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LastRevert {
    /// Its version.
    pub version: u32,
    /// Its epoch.
    pub epoch: u32,
    /// Why.
    pub reason: RevertReason,
}

/// Why a node has started.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum ResetCause {
    /// The board cannot tell.
    #[default]
    Unknown,
    /// The supply was switched on.
    PowerOn,
    /// The supply voltage was too low.
    BrownOut,
    /// The reset pin.
    Pin,
    /// The watchdog: due work was not done.
    Watchdog,
    /// The firmware asked for it.
    Software,
    /// The firmware panicked or the processor reported a fault.
    Panic,
}

impl ResetCause {
    /// Returns the name in JSON.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Unknown => "unknown",
            Self::PowerOn => "power_on",
            Self::BrownOut => "brown_out",
            Self::Pin => "pin",
            Self::Watchdog => "watchdog",
            Self::Software => "software",
            Self::Panic => "panic",
        }
    }
}

/// A place in the source.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PanicPlace {
    /// The end of the file's name, padded with zeros at its end.
    pub file: [u8; FILE_NAME],
    /// The line.
    pub line: u32,
}

impl PanicPlace {
    /// Creates the place of a panic in `file`.
    #[must_use]
    pub fn new(file: &str, line: u32) -> Self {
        let name = file.as_bytes();
        let end = name.get(name.len().saturating_sub(FILE_NAME)..).unwrap_or_default();
        let mut file = [0; FILE_NAME];
        file.iter_mut().zip(end).for_each(|(place, byte)| *place = *byte);
        Self { file, line }
    }
}
