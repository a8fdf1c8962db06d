//! `run`: runs a scenario.

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicU64;
use std::time::Instant;

use clap::Args;
use serde::Serialize;

use agent_core::observer::field::Coupling;

use super::agent_table::AgentReport;
use super::baselines::{self, Baseline, Baselines, Choice, Comparison, Plan, States, has_packages};
use super::health::{self, HealthReport};
use super::package_format::PackageFormat;
use super::run_folder::RunFolder;
use super::trainings::{self, TrainingSummary};
use super::{
    Changes, CommandError, Common, SharedProgress, TableFormat, agent_table, certified, methods,
    output, warnings,
};
use super::{load_scenario, print_outcome, print_text};
use crate::commands::progress::ProgressBars;
use crate::engine::link::LayerCount;
use crate::engine::{RunOptions, RunResult, run};
use crate::figures::{
    ErrorFigure, EventFigure, StateFigure, error_norms, events, states, write_all,
};
use crate::number::significant;
use crate::packages::PackageBytes;
use crate::report::checks::{self, ChecksReport};
use crate::report::latex::latex;
use crate::report::theorems::{Checks, DesignChecks};
use crate::scenario::{Method, Scenario};
use crate::terminal::one_line;
use crate::warning::Warning;

/// Arguments of `run`.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Scenario: a TOML file or the name of a built-in scenario; `host-sim scenario paper` prints
    /// one to start from
    scenario: PathBuf,
    #[command(flatten)]
    changes: Changes,
    /// Weight package for the agent it names, instead of the scenario's network; can be given
    /// several times
    #[arg(long, value_name = "PACKAGE")]
    weights: Vec<PathBuf>,
    /// Skip the scenario's learning cycles
    #[arg(long)]
    without_learning: bool,
    /// Methods to compare with, separated by commas [default: no-network and untrained if there is
    /// learning or a package, else none]
    #[arg(long, value_enum, value_delimiter = ',', value_name = "METHODS")]
    baselines: Vec<Choice>,
    /// Output folder for figures and tables [default: out/NAME or out/NAME-without-learning, where
    /// NAME is the scenario's name]
    #[arg(long)]
    out: Option<PathBuf>,
    #[command(flatten)]
    package_format: PackageFormat,
    #[command(flatten)]
    pub(super) common: Common,
}

#[derive(Serialize)]
struct Report<'a> {
    scenario: &'a str,
    seed: u64,
    /// The plant's state at `t = 0`. \[state unit\]
    initial_state: &'a [f64],
    elapsed_s: f64,
    baselines: States,
    /// The run compared with other methods, if there are any.
    methods: &'a [methods::Row],
    agents: Vec<AgentReport>,
    trainings: Vec<TrainingSummary>,
    /// What each layer of the link did; empty for the paper's link.
    link: &'a [LayerCount],
    checks: ChecksReport,
    #[serde(skip_serializing_if = "Option::is_none")]
    observer: Option<&'a ObserverCertificate>,
    warnings: &'a [Warning],
}

pub(super) fn execute(arguments: &Arguments) -> Result<(), CommandError> {
    let start = Instant::now();
    let scenario = load_scenario(&arguments.scenario, &arguments.changes)?;
    let mut scenario = scenario.drawn(arguments.common.seed).into_owned();
    give_packages(&mut scenario, &arguments.weights)?;
    if arguments.without_learning {
        if scenario.method == Method::Regression {
            let problem = "--without-learning: method = \"regression\" fits the samples of learning cycles; leave \
                           one of them out";
            return Err(CommandError::usage(problem));
        }
        scenario.learning.clear();
    }
    let out = match &arguments.out {
        Some(out) => out.clone(),
        None if arguments.without_learning => {
            Path::new("out").join(format!("{}-without-learning", scenario.name))
        }
        None => Path::new("out").join(&scenario.name),
    };
    let mut planned = output::planned(&scenario, "", true);
    planned.push("agents.csv".to_owned());
    planned.push("methods.csv".to_owned());
    planned.extend(output::pictures(["errors", "states", "events", "methods"]));
    let folder = RunFolder::claim(&out, &planned)?;
    let design = DesignChecks::new(&scenario);
    let mut warnings = warnings::before(&scenario, &design);
    warnings::print(&warnings);
    let plan = Plan::new(&scenario, &arguments.baselines);
    let others = baselines::methods(&scenario, &arguments.baselines)?;
    let (result, baselines, others) = simulate(&scenario, arguments.common.seed, plan, &others)?;
    let rows = method_rows(&scenario, &result, &baselines, others);
    let checks = Checks::of(design, &scenario, &result);
    let mut found = warnings::after(&scenario, &result, &checks, &warnings);
    found.extend(baselines.warnings());
    let own = [Method::NoNetwork, Method::Untrained];
    let others = rows.iter().filter(|row| !own.contains(&row.method));
    found.extend(others.filter_map(methods::Row::warning));
    let agents = agent_reports(&scenario, &result, &baselines);
    let certificate = ObserverCertificate::new(&scenario, &result);
    let trainings = trainings::summaries(&result.trainings);
    let format = arguments.package_format;
    write_files(folder.stage(), format, &scenario, &result, &baselines, &agents)
        .and_then(|()| write_methods(folder.stage(), &scenario, &rows))
        .map_err(|error| folder.placed(error))?;
    let (files, others) = folder.publish(&scenario, arguments.common.seed)?;
    let outcome = warnings::outcome(&checks);
    let elapsed_s = start.elapsed().as_secs_f64();
    match arguments.common.format {
        TableFormat::Json => {
            warnings.extend(found);
            let report = Report {
                scenario: &scenario.name,
                seed: arguments.common.seed,
                initial_state: &scenario.initial_state,
                elapsed_s,
                baselines: baselines.states(),
                methods: &rows,
                agents,
                trainings,
                link: &result.layers,
                checks: ChecksReport::new(&checks),
                observer: certificate.as_ref(),
                warnings: &warnings,
            };
            print_outcome(&report, outcome)
        }
        TableFormat::Latex => {
            let (window, name) = (&scenario.evaluation, name_of(&scenario));
            let title = format!(
                "|e_1i(t)| for t in [{}, {}] s [state unit], and broadcasts over the whole run",
                window.from, window.to
            );
            let mut text =
                latex(&title, &agent_table::table(&agents, &baselines, name, usize::MAX));
            if !rows.is_empty() {
                text += &format!("\n{}", latex(methods::TITLE, &methods::table(&rows)));
            }
            let printed = print_text(&text);
            outcome.and(printed)
        }
        TableFormat::Text => {
            let mut text = packages_in_use(&scenario)
                + &initial_state_text(&scenario)
                + &recording_text(&scenario);
            text += &agent_table::text(&scenario, &agents, &baselines, name_of(&scenario));
            text += &agent_table::traffic(&result, &agents);
            if !rows.is_empty() {
                text += &methods::text(&rows);
            }
            text += &trainings::text(&trainings);
            text += &health::table(&result.agents);
            text += &checks::text(&checks);
            text += &certificate.as_ref().map_or(String::new(), ObserverCertificate::text);
            text += &warnings::lines(&found);
            text += &format!(
                "Written to {}: {}\n{others}\nScenario {}, seed {}, {elapsed_s:.2} s\n",
                out.display(),
                files.join(", "),
                scenario.name,
                arguments.common.seed,
            );
            let printed = print_text(&text);
            outcome.and(printed)
        }
    }
}

/// What is certified of a run with the field observer.
#[derive(Debug, Serialize)]
struct ObserverCertificate {
    certified: bool,
    /// Bound on `|e_1|`, all agents stacked, after a long time. \[state unit\]
    bound: Option<f64>,
    /// Why nothing is certified.
    reasons: Vec<String>,
}

impl ObserverCertificate {
    /// `None` for the paper's observer, which the theorems' checks cover.
    fn new(scenario: &Scenario, result: &RunResult) -> Option<Self> {
        let observer = scenario.observer.as_ref()?;
        let bound = certified::bound(scenario, result);
        let mut reasons = Vec::new();
        if bound.is_none() {
            reasons.extend(
                scenario.trigger.departure().map(|when| format!("agents broadcast {when}")),
            );
            let departures = scenario.departures().into_iter().map(str::to_owned);
            reasons.extend(departures.filter(|clause| !clause.contains("[observer]")));
            if observer.exchange.is_some() {
                reasons.push(
                    "the preset \"robust\" sets gaps, repetitions and a heartbeat".to_owned(),
                );
            }
            if observer.coupling == Coupling::Current {
                reasons.push("the certificate of current estimates is not computed".to_owned());
            }
            if reasons.is_empty() {
                reasons.push("its inequality does not hold for these gains".to_owned());
            }
        }
        Some(Self { certified: bound.is_some(), bound, reasons })
    }

    fn text(&self) -> String {
        match self.bound {
            Some(bound) => format!(
                "Field observer: certified; after a long time |e_1| of all agents together stays below {} \
                 (docs/field-observer.md)\n",
                significant(bound, 3)
            ),
            None => format!("Field observer: nothing is certified: {}\n", self.reasons.join("; ")),
        }
    }
}

/// Assigns each package to its agent.
fn give_packages(scenario: &mut Scenario, files: &[PathBuf]) -> Result<(), CommandError> {
    for file in files {
        let package = PackageBytes::load(file)?;
        let agent = package.package().node.agent as usize;
        let agents = scenario.agents.len();
        let place = agent.checked_sub(1).and_then(|index| scenario.agents.get_mut(index));
        let place = place.ok_or_else(|| {
            CommandError::usage(format!(
                "{}: package for agent {agent}, but scenario {} has agents 1 to {agents}",
                file.display(),
                scenario.name
            ))
            .about(file)
        })?;
        if place.package.replace(package).is_some() {
            let problem = format!("{}: second package for agent {agent}", file.display());
            return Err(CommandError::usage(problem + "; give at most one per agent").about(file));
        }
    }
    Ok(())
}

/// Lists the agents that start with a given package.
fn packages_in_use(scenario: &Scenario) -> String {
    let agents = scenario.agents.iter().enumerate();
    let lines = agents.filter_map(|(index, agent)| {
        let bytes = agent.package.as_ref()?;
        let package = bytes.package();
        let (version, recipe) = (package.version, one_line(package.provenance.recipe));
        Some(format!("Agent {} starts with package version {version} ({recipe})\n", index + 1))
    });
    lines.collect()
}

/// Says which initial state the seed drew, if it did.
fn initial_state_text(scenario: &Scenario) -> String {
    if scenario.initial_spread.is_none() {
        return String::new();
    }
    let state: Vec<_> = scenario.initial_state.iter().map(|x| significant(*x, 6)).collect();
    format!("Initial state, drawn: [{}]\n", state.join(", "))
}

/// Describes the recording in place of the plant, if there is one.
fn recording_text(scenario: &Scenario) -> String {
    let Some(recorded) = scenario.plant.recording() else { return String::new() };
    let (rows, duration) = (recorded.time.len(), recorded.duration());
    format!(
        "Recording: {rows} rows over {} s, one every {} s on average; agents step every {} s\n",
        significant(duration, 6),
        significant(duration / (rows - 1) as f64, 4),
        scenario.time.step_size,
    )
}

/// Returns the name of the run beside its baselines.
fn name_of(scenario: &Scenario) -> &'static str {
    if scenario.method != Method::Observer {
        scenario.method.name()
    } else if !scenario.learning.is_empty() {
        "learned"
    } else if has_packages(scenario) {
        "packages"
    } else if scenario.network.is_some() {
        Baseline::Untrained.name()
    } else {
        Baseline::NoNetwork.name()
    }
}

/// Returns a row for each method, the run itself first; none unless the run is compared with other methods
/// than its baselines.
fn method_rows(
    scenario: &Scenario,
    result: &RunResult,
    baselines: &Baselines,
    others: Vec<methods::Row>,
) -> Vec<methods::Row> {
    if others.is_empty() {
        return Vec::new();
    }
    let mut rows = vec![methods::Row::new(scenario.method, &result.agents)];
    for (baseline, method) in
        [(Baseline::NoNetwork, Method::NoNetwork), (Baseline::Untrained, Method::Untrained)]
    {
        let agents = baselines.agents(baseline, &result.agents);
        rows.extend(agents.map(|agents| methods::Row::new(method, agents)));
        rows.extend(baselines.failure(baseline).map(|error| methods::Row::failed(method, error)));
    }
    rows.extend(others);
    rows
}

fn write_methods(
    out: &Path,
    scenario: &Scenario,
    rows: &[methods::Row],
) -> Result<(), CommandError> {
    if rows.is_empty() {
        return Ok(());
    }
    methods::write_csv(&out.join("methods.csv"), rows)?;
    if let Some(picture) = methods::picture(scenario, rows) {
        write_all(out, &[("methods", picture)])?;
    }
    Ok(())
}

/// Runs the scenario, its baselines and other methods in parallel.
fn simulate(
    scenario: &Scenario,
    seed: u64,
    plan: Plan,
    others: &[Method],
) -> Result<(RunResult, Baselines, Vec<methods::Row>), CommandError> {
    let bars = ProgressBars::new("simulating");
    let done = AtomicU64::new(0);
    let others_runs: u64 = others.iter().map(|method| method.runs()).sum();
    let total = scenario.steps() * (scenario.method.runs() + plan.count() + others_runs);
    let progress = || SharedProgress::new(&bars, &done, total);
    let options = RunOptions { seed, learning: true, bounds: true };
    let (result, (baselines, others)) = rayon::join(
        || run(scenario, options, &progress()),
        || {
            rayon::join(
                || plan.carry_out(scenario, seed, progress),
                || methods::carry_out(scenario, others, seed, progress),
            )
        },
    );
    bars.finish();
    Ok((result?, baselines, others))
}

fn agent_reports(
    scenario: &Scenario,
    result: &RunResult,
    baselines: &Baselines,
) -> Vec<AgentReport> {
    let agents = result.agents.iter().enumerate();
    agents
        .map(|(index, agent)| {
            let comparison = Comparison::new(baselines, &result.agents, index);
            AgentReport {
                agent: index + 1,
                rmse: agent.rmse(),
                rmse_no_network: comparison.rmse_no_network,
                rmse_untrained: comparison.rmse_untrained,
                change_percent_no_network: comparison.change_no_network,
                change_percent: comparison.change_untrained,
                explained_variance: trainings::explained(&result.trainings, index + 1),
                max_error: agent.max_error(),
                innovation_rms: agent.innovation_rms(),
                broadcasts: agent.broadcasts(),
                frames_sent: agent.broadcasts(),
                broadcasts_evaluated: agent.broadcasts_evaluated,
                bytes_evaluated: agent.bytes_evaluated,
                frames_delivered: agent.traffic.map(|traffic| traffic.delivered),
                frames_lost: agent.traffic.map(|traffic| traffic.lost),
                bytes_sent: agent.bytes_sent,
                airtime_s: agent.traffic.map(|traffic| traffic.airtime),
                broadcasts_no_network: comparison.broadcasts_no_network,
                broadcasts_untrained: comparison.broadcasts_untrained,
                mean_interval: agent.mean_interval(&scenario.time),
                min_interval: agent.min_interval(&scenario.time),
                health: agent.health.map(HealthReport),
            }
        })
        .collect()
}

/// Writes all tables, figures and packages.
fn write_files(
    out: &Path,
    format: PackageFormat,
    scenario: &Scenario,
    result: &RunResult,
    baselines: &Baselines,
    agents: &[AgentReport],
) -> Result<(), CommandError> {
    agent_table::write_csv(&out.join("agents.csv"), agents)?;
    let (tables, figures) = rayon::join(
        || output::tables(out, "", scenario, result),
        || write_figures(out, scenario, result, baselines),
    );
    tables?;
    figures?;
    output::packages(out, format, scenario, result)
}

fn write_figures(
    out: &Path,
    scenario: &Scenario,
    result: &RunResult,
    baselines: &Baselines,
) -> Result<(), CommandError> {
    let markers = output::markers(scenario, &result.trainings);
    let event_ticks = output::events_of(result);
    let window = output::event_window(scenario);
    let (traces, name) = (&result.traces, scenario.name.as_str());
    let mut figures = Vec::new();
    if traces.rows() > 0 && scenario.plant.is_known() {
        let title = format!("{name}: estimation errors");
        let errors = Baseline::ALL.map(|baseline| {
            baselines
                .is_shown(baseline)
                .then(|| baselines.agents(baseline, &result.agents))
                .flatten()
        });
        let references = output::references(scenario, errors);
        let figure = ErrorFigure {
            title: &title,
            traces,
            markers: &markers,
            references: &references,
            error_limit: None,
        };
        figures.push(("errors", error_norms(&figure)));
    }
    if traces.rows() > 0 {
        let truth = match scenario.plant.recording() {
            None => Some("true state"),
            Some(recorded) => recorded.has_reference().then_some("reference"),
        };
        let title = match truth {
            Some(truth) => format!("{name}: {truth} and estimates"),
            None => format!("{name}: estimates"),
        };
        let names = scenario.plant.state_names();
        let figure = StateFigure { title: &title, traces, names: &names, truth };
        figures.push(("states", states(&figure)));
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
