//! How trainings went, as text and JSON.

use std::fmt::Write;

use serde::Serialize;

use super::summary::{ExplainedVariance, reason};
use crate::engine::TrainingRecord;
use crate::number::significant;
use crate::report::tables::DIGITS;

/// Up to this many trainings get a line each.
const LINES: usize = 12;

/// One training, as JSON has it. Errors are mean squared errors of the packaged network. \[squared state unit/s^2\]
#[derive(Debug, Serialize)]
pub(super) struct TrainingSummary {
    agent: usize,
    cycle: usize,
    /// After cleaning and thinning.
    samples: usize,
    epochs: usize,
    stopped_by: &'static str,
    training_error: f64,
    validation_error: Option<f64>,
    test_error: Option<f64>,
    explained_variance: ExplainedVariance,
    switched_in: bool,
}

impl TrainingSummary {
    fn new(record: &TrainingRecord) -> Self {
        let (report, quality) = (&record.report, &record.quality);
        Self {
            agent: record.agent,
            cycle: record.cycle,
            samples: record.samples,
            epochs: report.epochs.len().saturating_sub(1),
            stopped_by: reason(report.stop),
            training_error: quality.training.error,
            validation_error: quality.validation.map(|fit| fit.error),
            test_error: quality.test.map(|fit| fit.error),
            explained_variance: ExplainedVariance::of(quality),
            switched_in: record.switched_in,
        }
    }
}

/// All trainings of a run.
pub(super) fn summaries(records: &[TrainingRecord]) -> Vec<TrainingSummary> {
    records.iter().map(TrainingSummary::new).collect()
}

/// Share of the variance that the last training of `agent`, from 1, explains on its validation
/// samples; without any, on those that it was trained on.
pub(super) fn explained(records: &[TrainingRecord], agent: usize) -> Option<f64> {
    let quality = &records.iter().rfind(|record| record.agent == agent)?.quality;
    quality.validation.unwrap_or(quality.training).explained
}

/// How each training went, a line each.
pub(super) fn text(trainings: &[TrainingSummary]) -> String {
    if trainings.is_empty() {
        return String::new();
    }
    let mut text = String::from("Training\n");
    for training in trainings.iter().take(LINES) {
        let error =
            |error: Option<f64>| error.map_or("none".to_owned(), |e| significant(e, DIGITS));
        // Writing into a string cannot fail.
        let _ = writeln!(
            text,
            "  agent {}, cycle {}: {} samples, {} epochs, stopped by {}; mean squared error: \
             training {}, validation {}, test {}; variance explained: {}{}",
            training.agent,
            training.cycle,
            training.samples,
            training.epochs,
            training.stopped_by,
            error(Some(training.training_error)),
            error(training.validation_error),
            error(training.test_error),
            training.explained_variance,
            if training.switched_in { "" } else { "; NOT switched in" },
        );
    }
    if trainings.len() > LINES {
        let more = trainings.len() - LINES;
        let _ = writeln!(text, "  and {more} more trainings, in training.csv");
    }
    text + "\n"
}
