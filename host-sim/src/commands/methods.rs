//! A run compared with other methods on the same plant, links, sensors and frames: one row each of errors,
//! broadcasts and bytes, with what the method knows.

use std::path::Path;

use rayon::prelude::*;
use serde::Serialize;

use super::warnings::extrapolation;
use crate::engine::statistics::AgentStatistics;
use crate::engine::{Progress, RunError, RunOptions, remedy, run};
use crate::figures::{
    Figure, FrontierFigure, FrontierForm, FrontierPoint, INNOVATION_LABEL, RMSE_LABEL, frontier,
};
use crate::files::output::OutputError;
use crate::files::table::write_table;
use crate::number::significant;
use crate::report::columns::Table;
use crate::scenario::{Method, Record, Scenario};
use crate::warning::{Warning, WarningCode};

/// Up to this many agents have columns of their own.
const COLUMNS: usize = 6;

/// What a method reached.
#[derive(Debug, Serialize)]
pub(super) struct Row {
    #[serde(serialize_with = "name")]
    pub(super) method: Method,
    /// What it knows of the plant, in words.
    knows: &'static str,
    /// RMSE of each agent in the evaluation window; empty if the run failed.
    rmse: Vec<Option<f64>>,
    /// RMS of each agent's innovation there, if a recording is the plant; empty if the run failed.
    innovation_rms: Vec<Option<f64>>,
    /// Of all agents in the evaluation window.
    broadcasts: Option<u64>,
    /// Length of their frames.
    bytes: Option<u64>,
    /// Why the run failed.
    reason: Option<String>,
    /// A warning about polynomials outside the range of their samples.
    #[serde(skip)]
    extrapolation: Option<String>,
}

fn name<S: serde::Serializer>(method: &Method, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(method.name())
}

impl Row {
    /// Returns the row of a method with these results.
    pub(super) fn new(method: Method, agents: &[AgentStatistics]) -> Self {
        let sum = |of: fn(&AgentStatistics) -> u64| Some(agents.iter().map(of).sum());
        Self {
            method,
            knows: method.knows(),
            rmse: agents.iter().map(AgentStatistics::rmse).collect(),
            innovation_rms: agents.iter().map(AgentStatistics::innovation_rms).collect(),
            broadcasts: sum(|agent| agent.broadcasts_evaluated),
            bytes: sum(|agent| agent.bytes_evaluated),
            reason: None,
            extrapolation: None,
        }
    }

    pub(super) fn failed(method: Method, error: &RunError) -> Self {
        let reason = Some(error.to_string());
        Self { broadcasts: None, bytes: None, reason, ..Self::new(method, &[]) }
    }

    /// Returns the row of a method whose errors are excessive.
    fn diverged(scenario: &Scenario, error: f64) -> Self {
        let advice = remedy(scenario);
        let reason =
            format!("it diverged: an error of {error:.1e} in the evaluation window; {advice}");
        let (method, reason) = (scenario.method, Some(reason));
        Self { broadcasts: None, bytes: None, reason, ..Self::new(method, &[]) }
    }

    /// Returns the errors of the agents, or their innovations if errors cannot be known.
    fn errors(&self, has_errors: bool) -> &[Option<f64>] {
        if has_errors { &self.rmse } else { &self.innovation_rms }
    }

    fn largest_error(&self, has_errors: bool) -> Option<f64> {
        let errors = self.errors(has_errors).iter();
        let errors: Option<Vec<f64>> =
            errors.map(|error| error.filter(|error| error.is_finite())).collect();
        errors?.into_iter().reduce(f64::max)
    }

    /// Returns what is wrong with the run, if anything.
    pub(super) fn warning(&self) -> Option<Warning> {
        let method = self.method.name();
        let failed = self.reason.as_ref().map(|reason| {
            let text = format!("the method {method} failed, so its errors are missing: {reason}");
            Warning::new(WarningCode::BaselineFailed, text)
        });
        let outside = self.extrapolation.as_ref();
        failed
            .or_else(|| outside.map(|text| Warning::new(WarningCode::Extrapolation, text.as_str())))
    }
}

/// Runs the scenario with each of these methods, in parallel. `progress` is called once per run.
pub(super) fn carry_out<P: Progress>(
    scenario: &Scenario,
    methods: &[Method],
    seed: u64,
    progress: impl Fn() -> P + Sync,
) -> Vec<Row> {
    let one = |&method: &Method| {
        let scenario = Scenario { method, record: Record::NOTHING, ..scenario.clone() };
        let options = RunOptions { seed, learning: true, bounds: false };
        match run(&scenario, options, &progress()) {
            Ok(result) => match result.excessive_error() {
                None => Row {
                    extrapolation: extrapolation(&scenario, &result.agents),
                    ..Row::new(method, &result.agents)
                },
                Some(error) => Row::diverged(&scenario, error),
            },
            Err(error) => Row::failed(method, &error),
        }
    };
    methods.par_iter().map(one).collect()
}

/// Whether errors are known; otherwise only innovations are.
fn have_errors(rows: &[Row]) -> bool {
    let has = |numbers: &[Option<f64>]| numbers.iter().any(Option::is_some);
    rows.iter().any(|row| has(&row.rmse)) || !rows.iter().any(|row| has(&row.innovation_rms))
}

/// Heading of the table.
pub(super) const TITLE: &str = "Methods on the same plant, links and sensors";

/// Formats the rows.
pub(super) fn text(rows: &[Row]) -> String {
    format!("{TITLE}\n\n{}\n", table(rows).text())
}

/// Returns the rows as a table.
pub(super) fn table(rows: &[Row]) -> Table {
    let agents = rows.iter().map(|row| row.rmse.len()).max().unwrap_or(0);
    let columns: Vec<String> = match agents {
        0..=COLUMNS => (1..=agents).map(|agent| format!("agent {agent}")).collect(),
        _ => vec!["largest".to_owned()],
    };
    let mut headings = vec![["", "method"]];
    let has_errors = have_errors(rows);
    let error = if has_errors { "RMSE" } else { "innovation RMS" };
    headings.extend(columns.iter().map(|column| [error, column.as_str()]));
    headings.extend([["evaluated", "broadcasts"], ["evaluated", "bytes"], ["", "knows"]]);
    let entries: Vec<Vec<String>> = rows
        .iter()
        .map(|row| {
            let number = |value: Option<f64>| value.map_or("-".to_owned(), |v| significant(v, 3));
            let count = |value: Option<u64>| value.map_or("-".to_owned(), |v| v.to_string());
            let mut entries = vec![row.method.name().to_owned()];
            match agents {
                0..=COLUMNS => entries.extend(
                    (0..agents)
                        .map(|agent| number(row.errors(has_errors).get(agent).copied().flatten())),
                ),
                _ => entries.push(number(row.largest_error(has_errors))),
            }
            entries.extend([count(row.broadcasts), count(row.bytes), row.knows.to_owned()]);
            entries
        })
        .collect();
    Table::new(&headings, entries)
}

/// Writes `methods.csv`, one line for each method and agent.
pub(super) fn write_csv(path: &Path, rows: &[Row]) -> Result<(), OutputError> {
    let header =
        ["method", "agent", "rmse", "innovation_rms", "broadcasts_all", "bytes_all", "knows"];
    let agents = rows.iter().map(|row| row.rmse.len()).max().unwrap_or(0);
    let lines = rows.iter().flat_map(|row| (0..agents).map(move |index| (row, index)));
    write_table(path, &header, lines, |line, (row, index)| {
        line.text(row.method.name())?;
        line.integer(index as u64 + 1)?;
        for errors in [&row.rmse, &row.innovation_rms] {
            line.optional(errors.get(index).copied().flatten())?;
        }
        for count in [row.broadcasts, row.bytes] {
            match count {
                Some(count) => line.integer(count)?,
                None => line.text("")?,
            }
        }
        line.text(row.knows)
    })
}

/// Draws the largest error of an agent against the broadcasts of all, one mark for each method; `None` if
/// no method has both.
pub(super) fn picture(scenario: &Scenario, rows: &[Row]) -> Option<Figure> {
    let has_errors = have_errors(rows);
    let point = |row: &Row| {
        let (error, broadcasts) = (row.largest_error(has_errors)?, row.broadcasts? as f64);
        Some(FrontierPoint {
            broadcasts: [broadcasts; 3],
            error: [error; 3],
            is_certified: true,
            is_own: row.method == scenario.method,
        })
    };
    let forms: Vec<_> = rows
        .iter()
        .filter_map(|row| Some(FrontierForm { name: row.method.name(), points: vec![point(row)?] }))
        .collect();
    let own = rows.iter().find(|row| row.method == scenario.method)?;
    let target = own.largest_error(has_errors)?;
    let failed = rows.iter().filter(|row| point(row).is_none());
    let failed: Vec<&str> = failed.map(|row| row.method.name()).collect();
    let missing = match failed.as_slice() {
        [] => String::new(),
        names => format!(" (without a result: {})", names.join(", ")),
    };
    let title = format!("{}: methods on the same plant, links and sensors{missing}", scenario.name);
    let window = scenario.evaluation;
    let broadcasts_label =
        format!("broadcasts of all agents, t in [{}, {}] s", window.from, window.to);
    Some(frontier(&FrontierFigure {
        title: &title,
        broadcasts_label: &broadcasts_label,
        error_label: if has_errors { RMSE_LABEL } else { INNOVATION_LABEL },
        forms,
        target: (target, target),
        target_label: match has_errors {
            true => "error of the run itself",
            false => "innovation of the run itself",
        },
        has_certificates: false,
        own_label: "the run itself",
    }))
}
