//! `run`: any scenario.

use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicU64;
use std::time::Instant;

use clap::Args;
use serde::Serialize;

use super::health::{self, HealthReport};
use super::{CommandError, Common, Format, SharedProgress, summary, warnings, written};
use super::{load_scenario, make_folder, print_json, print_text};
use crate::analysis::{Checks, DesignChecks};
use crate::engine::statistics::AgentStatistics;
use crate::engine::{RunOptions, RunResult, run};
use crate::figures::{
    ErrorFigure, EventFigure, StateFigure, error_norms, events, states, write_all,
};
use crate::packages::PackageBytes;
use crate::progress::ProgressBars;
use crate::report::checks::{self, ChecksReport};
use crate::report::csv::{Row, write_table};
use crate::scenario::{Record, Scenario};
use crate::warning::Warning;

/// Up to this many agents have a line each in the terminal.
const LINES: usize = 20;

/// Arguments of `run`.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// The scenario, a TOML file, or the name of a built-in one; `host-sim scenario paper` prints
    /// one to start from
    scenario: PathBuf,
    /// A weight package for the agent that it names, in place of the scenario's own network; once
    /// for each package
    #[arg(long, value_name = "PACKAGE")]
    weights: Vec<PathBuf>,
    /// Leaves the scenario's learning cycles out
    #[arg(long)]
    without_learning: bool,
    /// Folder for figures and tables [default: out/NAME, with the scenario's name]
    #[arg(long)]
    out: Option<PathBuf>,
    #[command(flatten)]
    pub(super) common: Common,
}

#[derive(Serialize)]
struct Report<'a> {
    scenario: &'a str,
    seed: u64,
    elapsed_s: f64,
    agents: Vec<AgentReport>,
    checks: ChecksReport,
    warnings: &'a [Warning],
}

#[derive(Serialize)]
struct AgentReport {
    agent: usize,
    rmse: Option<f64>,
    max_error: Option<f64>,
    broadcasts: u64,
    mean_interval: Option<f64>,
    min_interval: Option<f64>,
    /// Of an agent that was watched.
    #[serde(skip_serializing_if = "Option::is_none")]
    health: Option<HealthReport>,
}

pub(super) fn execute(arguments: &Arguments) -> Result<(), CommandError> {
    let start = Instant::now();
    let mut scenario = load_scenario(&arguments.scenario)?;
    give_packages(&mut scenario, &arguments.weights)?;
    if arguments.without_learning {
        scenario.learning.clear();
    }
    let out = match &arguments.out {
        Some(out) => out.clone(),
        None => Path::new("out").join(&scenario.name),
    };
    make_folder(&out)?;
    let design = DesignChecks::new(&scenario);
    let mut warnings = warnings::before(&scenario, &design);
    warnings::print(&warnings);
    let compare = arguments.common.format == Format::Text;
    let (result, baseline) = simulate(&scenario, arguments.common.seed, compare)?;
    let checks = Checks::of(design, &scenario, &result);
    let found = warnings::after(&scenario, &result, &checks);
    let agents = agent_reports(&scenario, &result);
    let before: Vec<_> =
        baseline.iter().flat_map(|run| &run.agents).map(AgentStatistics::rmse).collect();
    let files = write_files(&out, &scenario, &result, &agents)?;
    let elapsed_s = start.elapsed().as_secs_f64();
    match arguments.common.format {
        Format::Json => {
            warnings.extend(found);
            print_json(&Report {
                scenario: &scenario.name,
                seed: arguments.common.seed,
                elapsed_s,
                agents,
                checks: ChecksReport::new(&checks),
                warnings: &warnings,
            })?;
        }
        Format::Text => {
            let mut text = packages_in_use(&scenario);
            text += &agent_table(&scenario, &agents, &before);
            text += &summary::trainings(&result.trainings);
            text += &health::table(&result.agents);
            text += &checks::text(&checks);
            text += &warnings::lines(&found);
            text += &format!(
                "Written to {}: {}\n{}\nScenario {}, seed {}, {elapsed_s:.2} s\n",
                out.display(),
                files.join(", "),
                older_files(&out, &files),
                scenario.name,
                arguments.common.seed,
            );
            print_text(&text)?;
        }
    }
    warnings::unstable_run(&checks).map_or(Ok(()), |text| Err(CommandError::Unstable(text)))
}

/// Hands each package to its agent.
fn give_packages(scenario: &mut Scenario, files: &[PathBuf]) -> Result<(), CommandError> {
    for file in files {
        let package = PackageBytes::load(file)?;
        let agent = usize::from(package.package().node.agent);
        let agents = scenario.agents.len();
        let place = agent.checked_sub(1).and_then(|index| scenario.agents.get_mut(index));
        let place = place.ok_or_else(|| {
            CommandError::Usage(format!(
                "{}: is for agent {agent}, scenario {} has agents 1 to {agents}",
                file.display(),
                scenario.name
            ))
        })?;
        if place.package.replace(package).is_some() {
            let problem = format!("{}: a second package for agent {agent}", file.display());
            return Err(CommandError::Usage(problem + "; give one for each"));
        }
    }
    Ok(())
}

/// Which agents start with a package from outside.
fn packages_in_use(scenario: &Scenario) -> String {
    let agents = scenario.agents.iter().enumerate();
    let lines = agents.filter_map(|(index, agent)| {
        let bytes = agent.package.as_ref()?;
        let package = bytes.package();
        let (version, recipe) = (package.version, package.provenance.recipe);
        Some(format!("Agent {} starts with its package, version {version} ({recipe})\n", index + 1))
    });
    lines.collect()
}

/// The run, and beside it the same run without learning if there is any learning and `compare`
/// asks for it. That one is for comparison only: if it fails, there is none.
fn simulate(
    scenario: &Scenario,
    seed: u64,
    compare: bool,
) -> Result<(RunResult, Option<RunResult>), CommandError> {
    let bars = ProgressBars::new("simulating");
    let done = AtomicU64::new(0);
    let compare = compare && !scenario.learning.is_empty();
    let total = scenario.steps() * if compare { 2 } else { 1 };
    let learning = || {
        let progress = SharedProgress::new(&bars, &done, total);
        run(scenario, RunOptions { seed, learning: true, bounds: true }, &progress)
    };
    let baseline = || {
        let mut scenario = scenario.clone();
        scenario.record = Record { trace_stride: None, events: false, samples: false };
        let progress = SharedProgress::new(&bars, &done, total);
        let options = RunOptions { seed, learning: false, bounds: false };
        compare.then(|| run(&scenario, options, &progress).ok()).flatten()
    };
    let (result, baseline) = rayon::join(learning, baseline);
    Ok((result?, baseline))
}

/// A line that tells which files in `out` are not of this run, if there are any: nothing is
/// deleted, but nothing is to be mistaken either.
fn older_files(out: &Path, files: &[String]) -> String {
    let Ok(entries) = std::fs::read_dir(out) else { return String::new() };
    let names = entries.filter_map(|entry| entry.ok()?.file_name().into_string().ok());
    let mut older: Vec<String> = names.filter(|name| !files.contains(name)).collect();
    older.sort();
    match older.len() {
        0 => String::new(),
        1..=12 => format!("Not of this run: {}\n", older.join(", ")),
        count => format!("Not of this run: {count} other files there\n"),
    }
}

fn agent_reports(scenario: &Scenario, result: &RunResult) -> Vec<AgentReport> {
    let agents = result.agents.iter().enumerate();
    agents
        .map(|(index, agent)| AgentReport {
            agent: index + 1,
            rmse: agent.rmse(),
            max_error: agent.max_error(),
            broadcasts: agent.broadcasts(),
            mean_interval: agent.mean_interval(&scenario.time),
            min_interval: agent.min_interval(&scenario.time),
            health: agent.health.map(HealthReport),
        })
        .collect()
}

/// `before` holds the errors of the run without learning, or nothing.
fn agent_table(scenario: &Scenario, agents: &[AgentReport], before: &[Option<f64>]) -> String {
    let window = &scenario.evaluation;
    let mut text = format!(
        "\n|e_1i(t)| for t in [{}, {}] s, and times between broadcasts over the whole run\n\n\
         agent        RMSE{}     maximum  broadcasts  mean interval  shortest\n",
        window.from,
        window.to,
        if before.is_empty() { "" } else { "  without learning" },
    );
    let number = |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.4}"));
    for agent in agents.iter().take(LINES) {
        // Writing into a string cannot fail.
        let _ = writeln!(
            text,
            "{:5}  {:>10}{}  {:>10}  {:10}  {:>11} s  {:>6} s",
            agent.agent,
            number(agent.rmse),
            before.get(agent.agent - 1).map_or(String::new(), |&e| format!("{:>18}", number(e))),
            number(agent.max_error),
            agent.broadcasts,
            number(agent.mean_interval),
            number(agent.min_interval),
        );
    }
    if agents.len() > LINES {
        let mut errors: Vec<f64> = agents.iter().filter_map(|agent| agent.rmse).collect();
        errors.sort_by(f64::total_cmp);
        let _ = writeln!(text, "and {} more agents, in agents.csv", agents.len() - LINES);
        if let (Some(best), Some(worst)) = (errors.first(), errors.last()) {
            let median = errors[errors.len() / 2];
            let _ =
                writeln!(text, "RMSE of all: best {best:.4}, median {median:.4}, worst {worst:.4}");
        }
    }
    text.push('\n');
    text
}

/// Writes everything; returns the names of the files.
fn write_files(
    out: &Path,
    scenario: &Scenario,
    result: &RunResult,
    agents: &[AgentReport],
) -> Result<Vec<String>, CommandError> {
    let header = [
        "agent",
        "rmse [state unit]",
        "max_error [state unit]",
        "broadcasts",
        "mean_interval [s]",
        "min_interval [s]",
    ];
    let columns = |row: &mut Row<'_>, agent: &AgentReport| {
        row.integer(agent.agent as u64)?;
        row.optional(agent.rmse)?;
        row.optional(agent.max_error)?;
        row.integer(agent.broadcasts)?;
        row.optional(agent.mean_interval)?;
        row.optional(agent.min_interval)
    };
    write_table(&out.join("agents.csv"), &header, agents.iter(), columns)?;
    let (tables, figures) = rayon::join(
        || written::tables(out, "", scenario, result),
        || write_figures(out, scenario, result),
    );
    let mut files = vec!["agents.csv".to_owned()];
    files.extend(tables?);
    files.extend(figures?);
    files.extend(written::packages(out, result)?);
    Ok(files)
}

fn write_figures(
    out: &Path,
    scenario: &Scenario,
    result: &RunResult,
) -> Result<Vec<String>, CommandError> {
    let markers = written::markers(scenario);
    let event_ticks = written::events_of(result);
    let window = written::event_window(scenario);
    let (traces, name) = (&result.traces, scenario.name.as_str());
    let mut figures = Vec::new();
    if traces.rows() > 0 {
        let title = format!("{name}: estimation errors");
        let figure = ErrorFigure { title: &title, traces, markers: &markers, error_limit: None };
        figures.push(("errors", error_norms(&figure)));
        let title = format!("{name}: true state and estimates");
        figures.push(("states", states(&StateFigure { title: &title, traces })));
    }
    if scenario.record.events {
        let title = format!("{name}: broadcasts");
        let figure = EventFigure {
            title: &title,
            events: &event_ticks,
            step_size: scenario.time.step_size,
            from: window.from,
            to: window.to,
        };
        figures.push(("events", events(&figure)));
    }
    write_all(out, &figures)?;
    let names = figures.iter().flat_map(|(stem, _)| [format!("{stem}.svg"), format!("{stem}.png")]);
    Ok(names.collect())
}
