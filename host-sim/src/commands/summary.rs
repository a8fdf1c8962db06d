//! Training quality in reports.

use std::fmt;

use serde::Serialize;

use crate::learning::quality::Quality;
use crate::training::StopReason;

/// Share of the smoothed targets' variance explained by a network, in text and JSON.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub(super) struct ExplainedVariance {
    training: Option<f64>,
    validation: Option<f64>,
    /// On the last 15 % of the samples in time.
    last: Option<f64>,
}

impl ExplainedVariance {
    pub(super) fn of(quality: &Quality) -> Self {
        Self {
            training: quality.training.explained,
            validation: quality.validation.and_then(|fit| fit.explained),
            last: quality.last,
        }
    }
}

impl fmt::Display for ExplainedVariance {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let percent = |share: Option<f64>| match share {
            Some(share) => format!("{:.1} %", 100.0 * share),
            None => "none".to_owned(),
        };
        let [training, validation, last] = [self.training, self.validation, self.last].map(percent);
        write!(f, "training {training}, validation {validation}, last 15 % in time {last}")
    }
}

/// Returns what stopped a training.
pub(super) fn reason(stop: StopReason) -> &'static str {
    match stop {
        StopReason::Goal => "its goal",
        StopReason::Epochs => "the number of epochs",
        StopReason::Gradient => "a vanishing gradient",
        StopReason::DampingMax => "the largest damping",
        StopReason::Validation => "failures of validation",
        StopReason::Callback => "request",
        StopReason::NotFinite => "an error that is not finite",
    }
}
