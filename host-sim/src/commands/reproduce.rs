//! `reproduce`: both of the paper's simulations, Table 1 and Figures 1 to 3.

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicU64;
use std::time::Instant;

use clap::Args;
use serde::Serialize;

use super::run_folder::RunFolder;
use super::{CommandError, Common, Format, SharedProgress, summary, written};
use super::{print_json, print_text};
use crate::analysis::Checks;
use crate::engine::statistics::AgentStatistics;
use crate::engine::{RunOptions, RunResult, run};
use crate::figures::{
    ErrorFigure, EventFigure, StateFigure, error_axis_limit, error_norms, events, states, write_all,
};
use crate::progress::ProgressBars;
use crate::report::paper::PUBLISHED;
use crate::report::tables::{AgentResult, ComparisonTable, change_percent};
use crate::scenario::{PAPER, Scenario, Time};

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
    let mut planned = written::planned(&scenario, "_without", false);
    planned.extend(written::planned(&scenario, "_with", false));
    planned.push("table1.csv".to_owned());
    planned.extend(written::pictures(FIGURES.map(|(stem, _)| stem)));
    let folder = RunFolder::claim(&arguments.out, &planned)?;
    let (without, with) = both_runs(&scenario, arguments.common.seed)?;
    let results = [&without, &with].map(|run| agent_results(run, &scenario.time));
    let table = ComparisonTable {
        without: &results[0],
        with: &results[1],
        published: &PUBLISHED,
        window: (scenario.evaluation.from, scenario.evaluation.to),
    };
    let (out, stage) = (&arguments.out, folder.stage());
    let (files, figures) = rayon::join(
        || write_tables(stage, &scenario, &table, &without, &with),
        || write_figures(stage, &scenario, &without, &with),
    );
    files.and(figures).map_err(|error| folder.placed(error))?;
    let (_, others) = folder.publish(&scenario, arguments.common.seed)?;
    let elapsed_s = start.elapsed().as_secs_f64();
    match arguments.common.format {
        Format::Json => print_json(&Report {
            seed: arguments.common.seed,
            recipe: &arguments.recipe,
            elapsed_s,
            agents: agent_reports(&scenario.time, &without, &with),
        }),
        Format::Text => {
            let mut text = format!("\n{}\n", table.to_text());
            text += &summary::trainings(&with.trainings);
            text += &summary::checks(&Checks::new(&scenario, &with));
            text += "Figures, as SVG and PNG\n";
            for (name, what) in FIGURES {
                text += &format!("  {}: {what}\n", out.join(name).display());
            }
            text += &format!(
                "Tables in {}: table1.csv, traces, broadcast times and training as CSV\n{others}\n\
                 Recipe {}, seed {}, {elapsed_s:.2} s\n",
                out.display(),
                arguments.recipe,
                arguments.common.seed,
            );
            print_text(&text)
        }
    }
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

/// Name of each figure's files, and what it shows.
const FIGURES: [(&str, &str); 4] = [
    ("figure1", "estimation errors, inner networks held constant"),
    ("figure2", "estimation errors, inner networks trained once"),
    ("figure3", "broadcast times around the switch to the trained networks"),
    ("figure4", "true state and every agent's estimate"),
];

/// Writes the figures.
fn write_figures(
    out: &Path,
    scenario: &Scenario,
    without: &RunResult,
    with: &RunResult,
) -> Result<(), CommandError> {
    let error_limit = Some(error_axis_limit(&[&without.traces, &with.traces]));
    let window = written::event_window(scenario);
    let event_ticks = written::events_of(with);
    let markers = written::markers(scenario);
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
        FIGURES.iter().enumerate().map(|(index, (stem, _))| (*stem, draw(index))).collect();
    write_all(out, &figures)?;
    Ok(())
}
