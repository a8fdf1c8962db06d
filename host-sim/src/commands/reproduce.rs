//! `reproduce`: both of the paper's simulations, Table 1 and Figures 1 to 3.

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicU64;
use std::time::Instant;

use clap::Args;
use serde::Serialize;

use super::{CommandError, Common, Format, SharedProgress, summary, warnings, written};
use super::{make_folder, print_json, print_text};
use crate::analysis::Checks;
use crate::engine::statistics::AgentStatistics;
use crate::engine::{RunOptions, RunResult, run};
use crate::figures::{
    ErrorFigure, EventFigure, StateFigure, error_axis_limit, error_norms, events, states, write_all,
};
use crate::progress::ProgressBars;
use crate::report::checks::{self, ChecksReport};
use crate::report::paper::PUBLISHED;
use crate::report::tables::{AgentResult, ComparisonTable, change_percent};
use crate::scenario::{PAPER, Scenario, Time};
use crate::warning::Warning;

/// Arguments of `reproduce`.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// How the inner networks are trained
    #[arg(long, default_value = "better", value_parser = ["paper", "better"])]
    recipe: String,
    /// Folder for figures and tables
    #[arg(long, default_value = "out")]
    out: PathBuf,
    #[command(flatten)]
    pub(super) common: Common,
}

#[derive(Serialize)]
struct Report<'a> {
    seed: u64,
    recipe: &'a str,
    elapsed_s: f64,
    agents: Vec<AgentReport>,
    checks: ChecksReport,
    warnings: &'a [Warning],
}

#[derive(Serialize)]
struct AgentReport {
    agent: usize,
    rmse_without: Option<f64>,
    rmse_with: Option<f64>,
    change_percent: Option<f64>,
    mean_interval_without: Option<f64>,
    mean_interval_with: Option<f64>,
    broadcasts_without: u64,
    broadcasts_with: u64,
}

pub(super) fn execute(arguments: &Arguments) -> Result<(), CommandError> {
    let start = Instant::now();
    let mut scenario = Scenario::parse("paper.toml", PAPER)?;
    for cycle in &mut scenario.learning {
        cycle.recipe.clone_from(&arguments.recipe);
    }
    make_folder(&arguments.out)?;
    let (without, with) = both_runs(&scenario, arguments.common.seed)?;
    let results = [&without, &with].map(|run| agent_results(run, &scenario.time));
    let table = ComparisonTable {
        without: &results[0],
        with: &results[1],
        published: &PUBLISHED,
        window: (scenario.evaluation.from, scenario.evaluation.to),
    };
    let checks = Checks::new(&scenario, &with);
    let mut warnings = warnings::before(&scenario, &checks.design);
    warnings.extend(warnings::after(&scenario, &with, &checks));
    let out = &arguments.out;
    let (files, figures) = rayon::join(
        || write_tables(out, &scenario, &table, &without, &with),
        || write_figures(out, &scenario, &without, &with),
    );
    files?;
    let figures = figures?;
    let elapsed_s = start.elapsed().as_secs_f64();
    match arguments.common.format {
        Format::Json => print_json(&Report {
            seed: arguments.common.seed,
            recipe: &arguments.recipe,
            elapsed_s,
            agents: agent_reports(&scenario.time, &without, &with),
            checks: ChecksReport::new(&checks),
            warnings: &warnings,
        })?,
        Format::Text => {
            let mut text = format!("\n{}\n", table.to_text());
            text += &summary::trainings(&with.trainings);
            text += &checks::text(&checks);
            text += &warnings::lines(&warnings);
            text += "Figures, as SVG and PNG\n";
            for (name, what) in figures {
                text += &format!("  {}: {what}\n", out.join(name).display());
            }
            text += &format!(
                "Tables in {}: table1.csv, traces, broadcast times and training as CSV\n\n\
                 Recipe {}, seed {}, {elapsed_s:.2} s\n",
                out.display(),
                arguments.recipe,
                arguments.common.seed,
            );
            print_text(&text)?;
        }
    }
    warnings::unstable_run(&checks).map_or(Ok(()), |text| Err(CommandError::Unstable(text)))
}

/// The simulation with inner networks held constant, and the one that trains them.
fn both_runs(scenario: &Scenario, seed: u64) -> Result<(RunResult, RunResult), CommandError> {
    let bars = ProgressBars::new("simulating");
    let (done, total) = (AtomicU64::new(0), 2 * scenario.steps());
    let simulate = |learning| {
        let progress = SharedProgress::new(&bars, &done, total);
        run(scenario, RunOptions { seed, learning, bounds: learning }, &progress)
    };
    let (without, with) = rayon::join(|| simulate(false), || simulate(true));
    bars.finish();
    Ok((without?, with?))
}

fn agent_results(run: &RunResult, time: &Time) -> Vec<AgentResult> {
    let result = |agent: &AgentStatistics| AgentResult {
        rmse: agent.rmse(),
        mean_interval: agent.mean_interval(time),
    };
    run.agents.iter().map(result).collect()
}

fn agent_reports(time: &Time, without: &RunResult, with: &RunResult) -> Vec<AgentReport> {
    let agents = without.agents.iter().zip(&with.agents).enumerate();
    let report = |(index, (without, with)): (usize, (&AgentStatistics, &AgentStatistics))| {
        let (rmse_without, rmse_with) = (without.rmse(), with.rmse());
        AgentReport {
            agent: index + 1,
            rmse_without,
            rmse_with,
            change_percent: change_percent(rmse_without, rmse_with),
            mean_interval_without: without.mean_interval(time),
            mean_interval_with: with.mean_interval(time),
            broadcasts_without: without.broadcasts(),
            broadcasts_with: with.broadcasts(),
        }
    };
    agents.map(report).collect()
}

fn write_tables(
    out: &Path,
    scenario: &Scenario,
    table: &ComparisonTable<'_>,
    without: &RunResult,
    with: &RunResult,
) -> Result<(), CommandError> {
    table.write_csv(&out.join("table1.csv"))?;
    written::tables(out, "_without", scenario, without)?;
    written::tables(out, "_with", scenario, with)?;
    Ok(())
}

/// Writes the figures; returns the name of each and what it shows.
fn write_figures(
    out: &Path,
    scenario: &Scenario,
    without: &RunResult,
    with: &RunResult,
) -> Result<[(&'static str, &'static str); 4], CommandError> {
    let error_limit = Some(error_axis_limit(&[&without.traces, &with.traces]));
    let window = written::event_window(scenario);
    let event_ticks = written::events_of(with);
    let markers = written::markers(scenario);
    let shown = [
        ("figure1", "estimation errors, inner networks held constant"),
        ("figure2", "estimation errors, inner networks trained once"),
        ("figure3", "broadcast times around the switch to the trained networks"),
        ("figure4", "true state and every agent's estimate"),
    ];
    let draw = |index: usize| match index {
        0 => error_norms(&ErrorFigure {
            title: "Figure 1: without learning",
            traces: &without.traces,
            markers: &[],
            error_limit,
        }),
        1 => error_norms(&ErrorFigure {
            title: "Figure 2: with learning",
            traces: &with.traces,
            markers: &markers,
            error_limit,
        }),
        2 => events(&EventFigure {
            title: "Figure 3: broadcasts with learning",
            events: &event_ticks,
            step_size: scenario.time.step_size,
            from: window.from,
            to: window.to,
        }),
        _ => states(&StateFigure { title: "Figure 4: with learning", traces: &with.traces }),
    };
    let figures: Vec<_> =
        shown.iter().enumerate().map(|(index, (stem, _))| (*stem, draw(index))).collect();
    write_all(out, &figures)?;
    Ok(shown)
}
