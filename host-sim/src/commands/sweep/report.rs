//! What `sweep` says at its end.

use std::path::Path;

use serde::Serialize;

use super::results;
use super::runs::Outcome;
use super::study::Study;
use super::summary::{CellSummary, Summary};
use crate::commands::{CommandError, ErrorCode};
use crate::number::counted;
use crate::shell::{quoted, shell_word};
use crate::warning::Warning;

/// What the command prints as JSON.
#[derive(Serialize)]
pub(super) struct Report<'a> {
    pub(super) scenario: Option<&'a str>,
    #[serde(flatten)]
    pub(super) repeat: Repeat,
    /// The varied keys.
    pub(super) keys: &'a [String],
    /// Number of combinations of their values.
    pub(super) cells: usize,
    pub(super) seed: Option<u64>,
    pub(super) seeds: Option<u64>,
    pub(super) initial_states: Option<u64>,
    pub(super) shard: Option<&'a str>,
    /// Number of runs of the study, or of this part of it.
    pub(super) runs: u64,
    /// Of these, the number that was there before.
    pub(super) runs_before: u64,
    pub(super) runs_done: u64,
    pub(super) elapsed_s: f64,
    /// Time that all threads together spent in runs. \[s\]
    pub(super) engine_s: f64,
    pub(super) results: String,
    /// Runs of this command without a result.
    pub(super) failed: u64,
    /// The first of them, and why.
    pub(super) first_failure: Option<&'a str>,
    /// About the whole table.
    pub(super) warnings: &'a [Warning],
    /// Empty for a part of a study.
    pub(super) summary: &'a [CellSummary],
}

/// What is needed to repeat a study, and to see that it was repeated.
#[derive(Serialize)]
pub(super) struct Repeat {
    /// Version of the program that the rows are from.
    host_sim: Option<String>,
    scenario_hash: Option<String>,
    /// The words of the command.
    command: Option<Vec<String>>,
    /// Hash of the complete table.
    digest: Option<String>,
}

impl Repeat {
    pub(super) fn new(study: Option<&Study>, summary: &Summary) -> Self {
        let command = study.map(|study| study.command.clone());
        Self {
            host_sim: study.map(|study| study.host_sim.clone()),
            scenario_hash: study.map(|study| study.scenario_hash.clone()),
            command: command.filter(|words| !words.is_empty()),
            digest: (!summary.cells.is_empty()).then(|| summary.digest.clone()),
        }
    }

    /// Returns it as lines of text.
    pub(super) fn text(&self) -> String {
        let mut text = String::new();
        if let Some(digest) = &self.digest {
            let by = self.host_sim.as_ref().map(|version| format!(", by host-sim {version}"));
            text += &format!("Digest of the results {digest}{}\n", by.unwrap_or_default());
        }
        if let Some(words) = self.command.as_ref().filter(|_| self.digest.is_some()) {
            let words: Vec<String> = words.iter().map(|word| quoted(word)).collect();
            text += &format!("Repeat it with: {}\n", words.join(" "));
        }
        text
    }
}

/// Says how the parts of a study become one table.
pub(super) fn how_to_merge(out: &Path) -> String {
    let folder = shell_word(out);
    let merged = shell_word(&out.join(results::NAME));
    format!(
        "When all parts are complete:\n  cat {folder}/shard-*/{} > {merged}\n  host-sim sweep --summarise \
         {merged}\n",
        results::NAME
    )
}

/// Returns how the command ends.
///
/// # Errors
/// Runs are left, or every run failed.
pub(super) fn outcome(
    study: &Study,
    runs: &Outcome,
    before: u64,
    file: &Path,
    summary: &Summary,
) -> Result<(), CommandError> {
    let done = before + runs.done;
    if runs.left > 0 {
        let text = format!(
            "interrupted after {done} of {}; their rows are in {}, and the same command continues",
            counted(study.runs, "run", "runs"),
            file.parent().unwrap_or(file).display()
        );
        return Err(CommandError::new(ErrorCode::Interrupted, text));
    }
    let cells = &summary.cells;
    let has_none = !cells.is_empty() && cells.iter().all(|cell| cell.diverged == cell.runs);
    let text = match &runs.first_failure {
        Some((_, reason)) if before == 0 && (has_none || runs.failed == study.runs) => {
            format!("every run failed; the first: {reason}")
        }
        Some((_, reason)) if has_none => {
            format!("every run failed; the first in this invocation: {reason}")
        }
        None if has_none => {
            "every run failed, in an earlier invocation; run `host-sim run` with the settings of one \
             cell to see why"
            .to_owned()
        }
        _ => return Ok(()),
    };
    Err(CommandError::new(ErrorCode::Run, text))
}
