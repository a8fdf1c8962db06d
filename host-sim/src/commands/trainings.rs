//! Training results, as text and JSON.

use std::fmt::Write;

use serde::Serialize;

use super::summary::{ExplainedVariance, reason};
use crate::engine::TrainingRecord;
use crate::number::significant;
use crate::report::tables::DIGITS;

/// Number of training runs listed individually.
const LINES: usize = 12;

/// A training in the JSON report. Errors are mean squared errors of the packaged network. \[squared
/// state unit/s^2\]
#[derive(Debug, Serialize)]
pub(super) struct TrainingSummary {
    agent: usize,
    cycle: usize,
    /// When the cycle started by itself. \[s\]
    #[serde(skip_serializing_if = "Option::is_none")]
    started_at: Option<f64>,
    /// Number of samples after cleaning and decimation.
    samples: usize,
    epochs: usize,
    stopped_by: &'static str,
    training_error: f64,
    validation_error: Option<f64>,
    test_error: Option<f64>,
    explained_variance: ExplainedVariance,
    switched_in: bool,
    /// Frequency of the disturbance found in each direction, with the field observer. \[rad/s\]
    #[serde(skip_serializing_if = "Vec::is_empty")]
    frequencies: Vec<Option<f64>>,
}

impl TrainingSummary {
    fn new(record: &TrainingRecord) -> Self {
        let (report, quality) = (&record.report, &record.quality);
        Self {
            agent: record.agent,
            cycle: record.cycle,
            started_at: record.started_at,
            samples: record.samples,
            epochs: report.epochs.len().saturating_sub(1),
            stopped_by: reason(report.stop),
            training_error: quality.training.error,
            validation_error: quality.validation.map(|fit| fit.error),
            test_error: quality.test.map(|fit| fit.error),
            explained_variance: ExplainedVariance::of(quality),
            switched_in: record.switched_in,
            frequencies: match record.harmonics.iter().any(Option::is_some) {
                true => record.harmonics.iter().map(|found| Some((*found)?.frequency)).collect(),
                false => Vec::new(),
            },
        }
    }
}

/// Summarises all trainings of a run.
pub(super) fn summaries(records: &[TrainingRecord]) -> Vec<TrainingSummary> {
    records.iter().map(TrainingSummary::new).collect()
}

/// Returns the share of variance explained by the last training of `agent`, from 1, on its
/// validation samples, or on its training samples if there are none.
pub(super) fn explained(records: &[TrainingRecord], agent: usize) -> Option<f64> {
    let quality = &records.iter().rfind(|record| record.agent == agent)?.quality;
    quality.validation.unwrap_or(quality.training).explained
}

/// Returns one line per training.
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
            "  agent {}, cycle {}{}: {} samples, {} epochs, stopped by {}; mean squared error: \
             training {}, validation {}, test {}; variance explained: {}{}",
            training.agent,
            training.cycle,
            training.started_at.map_or(String::new(), |time| {
                format!(" (started by the rate of broadcasts at t = {} s)", significant(time, 5))
            }),
            training.samples,
            training.epochs,
            training.stopped_by,
            error(Some(training.training_error)),
            error(training.validation_error),
            error(training.test_error),
            training.explained_variance,
            if training.switched_in { "" } else { "; NOT switched in" },
        );
        if !training.frequencies.is_empty() {
            let found = training.frequencies.iter().map(|frequency| {
                frequency.map_or("none".to_owned(), |frequency| significant(frequency, 3))
            });
            let found: Vec<_> = found.collect();
            let _ = writeln!(text, "    disturbance: {} rad/s", found.join(", "));
        }
    }
    if trainings.len() > LINES {
        let more = trainings.len() - LINES;
        let _ = writeln!(text, "  and {more} more training runs, in training.csv");
    }
    text + "\n"
}
