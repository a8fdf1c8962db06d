//! `run`: any scenario.

use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicU64;
use std::time::Instant;

use clap::Args;
use serde::Serialize;

use super::health::{self, HealthReport};
use super::run_folder::RunFolder;
use super::{CommandError, Common, Format, SharedProgress, summary, warnings, written};
use super::{load_scenario, print_json, print_text};
use crate::analysis::Checks;
use crate::engine::statistics::AgentStatistics;
use crate::engine::{RunOptions, RunResult, run};
use crate::figures::{
    ErrorFigure, EventFigure, StateFigure, error_norms, events, states, write_all,
};
use crate::packages::PackageBytes;
use crate::progress::ProgressBars;
use crate::report::csv::{Row, write_table};
use crate::scenario::{Record, Scenario};
use crate::terminal::one_line;

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
    /// Folder for figures and tables [default: out/NAME, with the scenario's name, or
    /// out/NAME-without-learning]
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
        None if arguments.without_learning => {
            Path::new("out").join(format!("{}-without-learning", scenario.name))
        }
        None => Path::new("out").join(&scenario.name),
    };
    let mut planned = written::planned(&scenario, "", true);
    planned.push("agents.csv".to_owned());
    planned.extend(written::pictures(["errors", "states", "events"]));
    let folder = RunFolder::claim(&out, &planned)?;
    warnings::print(&scenario);
    let compare = arguments.common.format == Format::Text;
    let (result, baseline) = simulate(&scenario, arguments.common.seed, compare)?;
    let agents = agent_reports(&scenario, &result);
    let before: Vec<_> =
        baseline.iter().flat_map(|run| &run.agents).map(AgentStatistics::rmse).collect();
    write_files(folder.stage(), &scenario, &result, &agents)
        .map_err(|error| folder.placed(error))?;
    let (files, others) = folder.publish(&scenario, arguments.common.seed)?;
    let elapsed_s = start.elapsed().as_secs_f64();
    match arguments.common.format {
        Format::Json => print_json(&Report {
            scenario: &scenario.name,
            seed: arguments.common.seed,
            elapsed_s,
            agents,
        }),
        Format::Text => {
            let mut text = packages_in_use(&scenario);
            text += &agent_table(&scenario, &agents, &before);
            text += &summary::trainings(&result.trainings);
            text += &health::table(&result.agents);
            text += &summary::checks(&Checks::new(&scenario, &result));
            text += &format!(
                "Written to {}: {}\n{others}\nScenario {}, seed {}, {elapsed_s:.2} s\n",
                out.display(),
                files.join(", "),
                scenario.name,
                arguments.common.seed,
            );
            print_text(&text)
        }
    }
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
        let (version, recipe) = (package.version, one_line(package.provenance.recipe));
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

/// Writes everything.
fn write_files(
    out: &Path,
    scenario: &Scenario,
    result: &RunResult,
    agents: &[AgentReport],
) -> Result<(), CommandError> {
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
    tables?;
    figures?;
    written::packages(out, result)
}

fn write_figures(out: &Path, scenario: &Scenario, result: &RunResult) -> Result<(), CommandError> {
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
    Ok(())
}
