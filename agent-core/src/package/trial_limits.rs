//! What a package promises for its trial, and what a node demands of it.

use crate::math::parameter::{ParameterError, not_negative};

/// Limits within which a package on trial has to stay. A limit that is `None` does not apply.
///
/// A package carries the limits that its training can justify; a node has limits of its own in its
/// settings. The tighter of each pair applies: see [`Self::tighter`].
///
/// ```
/// use agent_core::package::TrialLimits;
///
/// let package = TrialLimits { restarts: Some(0), ..TrialLimits::NONE };
/// let node = TrialLimits { restarts: Some(3), seconds: Some(60), ..TrialLimits::NONE };
/// let limits = package.tighter(&node);
/// assert_eq!((limits.restarts, limits.seconds), (Some(0), Some(60)));
/// ```
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct TrialLimits {
    /// Shortest length of the trial. \[s\]
    pub seconds: Option<u32>,
    /// Largest RMS of the innovation `e_3`, over the trial and over all outputs. \[output unit\]
    pub innovation_rms: Option<f32>,
    /// Largest mean rate of broadcasts over the trial. \[1/s\]
    pub broadcasts_per_second: Option<f32>,
    /// Largest number of restarts of the agent.
    pub restarts: Option<u32>,
    /// Largest number of steps that would have overflowed.
    pub overflows: Option<u32>,
    /// Largest number of ticks without a step.
    pub skipped_ticks: Option<u32>,
}

impl TrialLimits {
    /// No limits.
    pub const NONE: Self = Self {
        seconds: None,
        innovation_rms: None,
        broadcasts_per_second: None,
        restarts: None,
        overflows: None,
        skipped_ticks: None,
    };

    /// Returns whether the limits that are present are finite.
    #[must_use]
    pub fn is_finite(&self) -> bool {
        [self.innovation_rms, self.broadcasts_per_second]
            .iter()
            .flatten()
            .all(|limit| limit.is_finite())
    }

    /// Checks the limits that are numbers.
    ///
    /// # Errors
    /// A limit that is negative or not finite.
    pub fn validate(&self) -> Result<(), ParameterError> {
        let rms = self.innovation_rms.unwrap_or(0.0);
        not_negative("trial.innovation_rms", rms)?;
        let rate = self.broadcasts_per_second.unwrap_or(0.0);
        not_negative("trial.broadcasts_per_second", rate)
    }

    /// Returns the tighter of each pair of limits: the longer trial, the smaller of everything else.
    #[must_use]
    pub fn tighter(&self, other: &Self) -> Self {
        Self {
            seconds: self.seconds.max(other.seconds),
            innovation_rms: smaller(self.innovation_rms, other.innovation_rms),
            broadcasts_per_second: smaller(self.broadcasts_per_second, other.broadcasts_per_second),
            restarts: smaller(self.restarts, other.restarts),
            overflows: smaller(self.overflows, other.overflows),
            skipped_ticks: smaller(self.skipped_ticks, other.skipped_ticks),
        }
    }
}

fn smaller<T: PartialOrd>(a: Option<T>, b: Option<T>) -> Option<T> {
    match (a, b) {
        (Some(a), Some(b)) => Some(if b < a { b } else { a }),
        (a, b) => a.or(b),
    }
}
