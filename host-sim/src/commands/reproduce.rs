//! `reproduce`: runs both of the paper's simulations and writes Table 1 and Figures 1 to 3.

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicU64;
use std::time::Instant;

use clap::Args;
use serde::Serialize;

use super::baselines::Baseline;
use super::output::FigureFormats;
use super::run_folder::RunFolder;
use super::seeds::{self, SeedRun};
use super::trainings::{self, TrainingSummary};
use super::{CommandError, Common, SharedProgress, TableFormat, print_outcome, print_text};
use super::{output, warnings};
use crate::commands::progress::ProgressBars;
use crate::engine::statistics::AgentStatistics;
use crate::engine::{RunOptions, RunResult, run};
use crate::figures::{
    ErrorFigure, EventFigure, StateFigure, error_axis_limit, error_norms, events, states, write_all,
};
use crate::report::checks::{self, ChecksReport};
use crate::report::latex::latex;
use crate::report::paper::PUBLISHED;
use crate::report::tables::{AgentResult, ComparisonTable, change_percent};
use crate::report::theorems::Checks;
use crate::scenario::{PAPER, Scenario, Time};
use crate::warning::Warning;

/// Arguments of `reproduce`.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Training recipe of the inner networks
    #[arg(long, default_value = "better", value_parser = ["paper", "better"])]
    recipe: String,
    /// Number of seeds to learn with, starting at --seed; with more than one, the median and range
    /// of each agent's errors and broadcasts are reported
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=10_000))]
    seeds: u64,
    /// Output folder for figures and tables
    #[arg(long, default_value = "out")]
    out: PathBuf,
    #[command(flatten)]
    figures: FigureFormats,
    /// Output format
    #[arg(long, value_enum, default_value_t)]
    format: TableFormat,
    #[command(flatten)]
    pub(super) common: Common,
}

#[derive(Serialize)]
struct Report<'a> {
    seed: u64,
    recipe: &'a str,
    elapsed_s: f64,
    agents: Vec<AgentReport>,
    trainings: Vec<TrainingSummary>,
    /// Present with several seeds.
    seeds: Option<seeds::Report>,
    checks: ChecksReport,
    warnings: &'a [Warning],
}

#[derive(Serialize)]
struct AgentReport {
    agent: usize,
    rmse_no_network: Option<f64>,
    rmse_without: Option<f64>,
    rmse_with: Option<f64>,
    change_percent_no_network: Option<f64>,
    /// Relative to the untrained network.
    change_percent: Option<f64>,
    explained_variance: Option<f64>,
    mean_interval_no_network: Option<f64>,
    mean_interval_without: Option<f64>,
    mean_interval_with: Option<f64>,
    broadcasts_no_network: u64,
    broadcasts_without: u64,
    broadcasts_with: u64,
}

/// The paper's two simulations, and one without a network.
struct Runs {
    no_network: RunResult,
    without: RunResult,
    with: RunResult,
}

pub(super) fn execute(arguments: &Arguments) -> Result<(), CommandError> {
    let start = Instant::now();
    let mut scenario = Scenario::parse("paper.toml", PAPER)?;
    for cycle in &mut scenario.learning {
        cycle.recipe.clone_from(&arguments.recipe);
    }
    let seed = arguments.common.seed;
    let end = seed.checked_add(arguments.seeds).ok_or_else(|| {
        let problem =
            format!("--seed {seed}: fewer than {} seeds remain after it", arguments.seeds);
        CommandError::usage(problem + "; choose a smaller one")
    })?;
    let mut planned = output::planned(&scenario, "_without", false);
    planned.extend(output::planned(&scenario, "_with", false));
    planned.push("table1.csv".to_owned());
    planned.extend((arguments.seeds > 1).then(|| "seeds.csv".to_owned()));
    planned.extend(arguments.figures.names(FIGURES.map(|(stem, _)| stem)));
    let folder = RunFolder::claim(&arguments.out, &planned)?;
    let (runs, others) = simulate(&scenario, seed..end)?;
    let Runs { no_network, without, with } = &runs;
    let results = [no_network, without, with].map(|run| agent_results(run, &scenario.time));
    let table = ComparisonTable {
        no_network: &results[0],
        without: &results[1],
        with: &results[2],
        published: &PUBLISHED,
        window: (scenario.evaluation.from, scenario.evaluation.to),
    };
    let seeds = (arguments.seeds > 1).then(|| {
        let first = SeedRun::new(seed, &with.agents, &scenario.time);
        [vec![first], others].concat()
    });
    let checks = Checks::new(&scenario, with);
    let mut warnings = warnings::before(&scenario, &checks.design);
    let found = warnings::after(&scenario, with, &checks, &warnings);
    warnings.extend(found);
    let (out, stage) = (&arguments.out, folder.stage());
    let (files, figures) = rayon::join(
        || write_tables(stage, &scenario, &table, &runs, seeds.as_deref()),
        || write_figures(stage, arguments.figures, &scenario, &runs),
    );
    files.and(figures).map_err(|error| folder.placed(error))?;
    let (_, others) = folder.publish(&scenario, seed)?;
    let seeds = seeds.map(|seeds| seeds::Report::new(&seeds, &no_network.agents, &without.agents));
    let trainings = trainings::summaries(&with.trainings);
    let outcome = warnings::outcome(&scenario, &checks);
    let elapsed_s = start.elapsed().as_secs_f64();
    match arguments.format {
        TableFormat::Json => {
            let report = Report {
                seed,
                recipe: &arguments.recipe,
                elapsed_s,
                agents: agent_reports(&scenario.time, &runs),
                trainings,
                seeds,
                checks: ChecksReport::new(&checks),
                warnings: &warnings,
            };
            print_outcome(&report, outcome)
        }
        TableFormat::Latex => {
            let tables = table.tables();
            let seeds = seeds.as_ref().map(seeds::Report::tables);
            let tables = tables.iter().chain(seeds.iter().flatten());
            let texts = tables.map(|(title, table)| latex(title, table));
            warnings::print(&warnings);
            let printed = print_text(&texts.collect::<Vec<_>>().join("\n"));
            outcome.and(printed)
        }
        TableFormat::Text => {
            let mut text = format!("\n{}\n", table.to_text());
            text += &seeds.map_or_else(String::new, |seeds| seeds.text());
            text += &trainings::text(&trainings);
            text += &checks::text(&checks);
            text += &warnings::lines(&warnings);
            let formats =
                if arguments.figures.has_pdf() { "SVG, PNG and PDF" } else { "SVG and PNG" };
            text += &format!("Figures, as {formats}\n");
            for (name, what) in FIGURES {
                text += &format!("  {}: {what}\n", out.join(name).display());
            }
            text += &format!(
                "Tables in {}: table1.csv, {}traces, broadcast times and training as CSV\n{others}\n\
                 Recipe {}, seed {seed}, {elapsed_s:.2} s\n",
                out.display(),
                if arguments.seeds > 1 { "seeds.csv, " } else { "" },
                arguments.recipe,
            );
            let printed = print_text(&text);
            outcome.and(printed)
        }
    }
}

/// Runs all simulations of the first seed and the learning ones of the others, in parallel.
fn simulate(
    scenario: &Scenario,
    seeds: std::ops::Range<u64>,
) -> Result<(Runs, Vec<SeedRun>), CommandError> {
    let bars = ProgressBars::new("simulating");
    let (done, seed) = (AtomicU64::new(0), seeds.start);
    let total = scenario.steps() * (2 + seeds.end - seeds.start);
    let progress = || SharedProgress::new(&bars, &done, total);
    let simulate =
        |learning| run(scenario, RunOptions { seed, learning, bounds: learning }, &progress());
    let ((without, with), (no_network, others)) = rayon::join(
        || rayon::join(|| simulate(false), || simulate(true)),
        || {
            rayon::join(
                || Baseline::NoNetwork.run(scenario, seed, &progress()),
                || seeds::run_all(scenario, seed + 1..seeds.end, progress),
            )
        },
    );
    bars.finish();
    Ok((Runs { no_network: no_network?, without: without?, with: with? }, others?))
}

fn agent_results(run: &RunResult, time: &Time) -> Vec<AgentResult> {
    let result = |agent: &AgentStatistics| AgentResult {
        rmse: agent.rmse(),
        mean_interval: agent.mean_interval(time),
    };
    run.agents.iter().map(result).collect()
}

fn agent_reports(time: &Time, runs: &Runs) -> Vec<AgentReport> {
    let report = |index: usize| {
        let agents = [&runs.no_network, &runs.without, &runs.with].map(|run| &run.agents[index]);
        let [rmse_no_network, rmse_without, rmse_with] = agents.map(AgentStatistics::rmse);
        let intervals = agents.map(|agent| agent.mean_interval(time));
        let broadcasts = agents.map(AgentStatistics::broadcasts);
        AgentReport {
            agent: index + 1,
            rmse_no_network,
            rmse_without,
            rmse_with,
            change_percent_no_network: change_percent(rmse_no_network, rmse_with),
            change_percent: change_percent(rmse_without, rmse_with),
            explained_variance: trainings::explained(&runs.with.trainings, index + 1),
            mean_interval_no_network: intervals[0],
            mean_interval_without: intervals[1],
            mean_interval_with: intervals[2],
            broadcasts_no_network: broadcasts[0],
            broadcasts_without: broadcasts[1],
            broadcasts_with: broadcasts[2],
        }
    };
    (0..runs.with.agents.len()).map(report).collect()
}

fn write_tables(
    out: &Path,
    scenario: &Scenario,
    table: &ComparisonTable<'_>,
    runs: &Runs,
    seeds: Option<&[SeedRun]>,
) -> Result<(), CommandError> {
    table.write_csv(&out.join("table1.csv"))?;
    if let Some(seeds) = seeds {
        seeds::write_csv(&out.join("seeds.csv"), seeds)?;
    }
    output::tables(out, "_without", scenario, &runs.without)?;
    output::tables(out, "_with", scenario, &runs.with)?;
    Ok(())
}

/// File stem and description of each figure.
const FIGURES: [(&str, &str); 4] = [
    ("figure1", "estimation errors, inner networks held constant"),
    ("figure2", "estimation errors, inner networks trained once"),
    ("figure3", "broadcast times around the switch to the trained networks"),
    ("figure4", "true state and every agent's estimate"),
];

/// Writes the figures.
fn write_figures(
    out: &Path,
    formats: FigureFormats,
    scenario: &Scenario,
    runs: &Runs,
) -> Result<(), CommandError> {
    let Runs { no_network, without, with } = runs;
    let no_network = Some(no_network.agents.as_slice());
    let references = [None, Some(without.agents.as_slice())]
        .map(|untrained| output::references(scenario, [no_network, untrained]));
    let shown_runs = [&without.traces, &with.traces];
    let error_limit = Some(error_axis_limit(&shown_runs, &references[1]));
    let window = output::event_window(scenario);
    let event_ticks = output::events_of(with);
    let markers = output::markers(&with.cycles, &with.trainings);
    let draw = |index: usize| match index {
        0 => error_norms(&ErrorFigure {
            title: "Figure 1: untrained networks",
            traces: &without.traces,
            markers: &[],
            references: &references[0],
            error_limit,
        }),
        1 => error_norms(&ErrorFigure {
            title: "Figure 2: with learning",
            traces: &with.traces,
            markers: &markers,
            references: &references[1],
            error_limit,
        }),
        2 => events(&EventFigure {
            title: "Figure 3: broadcasts with learning",
            events: &event_ticks,
            step_size: scenario.time.step_size,
            from: window.from,
            to: window.to,
        }),
        _ => states(&StateFigure {
            title: "Figure 4: with learning",
            traces: &with.traces,
            names: &scenario.plant.state_names(),
            truth: Some("true state"),
        }),
    };
    let figures: Vec<_> =
        FIGURES.iter().enumerate().map(|(index, (stem, _))| (*stem, draw(index))).collect();
    write_all(out, &figures, formats.wanted())?;
    Ok(())
}
