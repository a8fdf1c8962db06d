//! What a person reads on the terminal after a run.

use std::fmt::{self, Write};

use serde::Serialize;

use crate::engine::TrainingRecord;
use crate::packages::quality::Quality;
use crate::training::StopReason;

/// Up to this many agents have a line each.
const LINES: usize = 12;

/// Share of the smoothed targets' variance that a network explains, in text and JSON.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub(super) struct ExplainedVariance {
    training: Option<f64>,
    validation: Option<f64>,
    /// In the last 15 % of the samples' time.
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

/// How each training went, a line each.
pub(super) fn trainings(records: &[TrainingRecord]) -> String {
    let mut text = String::new();
    for record in records.iter().take(LINES) {
        let report = &record.report;
        let quality = &record.quality;
        let part = |error: Option<f64>| error.map_or("none".to_owned(), |e| format!("{e:.3e}"));
        // Writing into a string cannot fail.
        let _ = writeln!(
            text,
            "  agent {}, cycle {}: {} samples, {} epochs, stopped by {}; mean squared error: \
             training {:.3e}, validation {}, test {}; variance explained: {}{}",
            record.agent,
            record.cycle,
            record.samples,
            report.epochs.len() - 1,
            reason(report.stop),
            quality.training.error,
            part(quality.validation.map(|fit| fit.error)),
            part(quality.test.map(|fit| fit.error)),
            ExplainedVariance::of(quality),
            if record.switched_in { "" } else { "; NOT switched in" },
        );
    }
    if records.len() > LINES {
        let _ = writeln!(text, "  and {} more trainings, in training.csv", records.len() - LINES);
    }
    if text.is_empty() { text } else { format!("Training\n{text}\n") }
}

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
