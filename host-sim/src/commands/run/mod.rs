//! `run`: runs a scenario.

mod files;
mod reported;
mod results;

use std::path::{Path, PathBuf};

use clap::Args;

pub use reported::{PreparedRun, ReportedRun};

use super::baselines::Choice;
use super::observer_certificate::ObserverCertificate;
use super::output::FigureFormats;
use super::package_format::PackageFormat;
use super::run_folder::RunFolder;
use super::scenario_source::load_with_text;
use super::{
    Changes, CommandError, Common, ProgressBars, TableFormat, agent_table, health, methods,
    processor, radio, trainings, warnings,
};
use super::{print_outcome, print_text};
use crate::number::significant;
use crate::packages::PackageBytes;
use crate::plant::Between;
use crate::report::checks;
use crate::report::latex::latex;
use crate::scenario::{Method, Scenario};
use crate::terminal::one_line;

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
    /// Write a page about the run as well, report.html, to look at in a browser
    #[arg(long)]
    report: bool,
    /// Write traces and broadcasts as run.mcap as well, for Foxglove and PlotJuggler
    #[arg(long)]
    mcap: bool,
    #[command(flatten)]
    figures: FigureFormats,
    #[command(flatten)]
    package_format: PackageFormat,
    /// Output format
    #[arg(long, value_enum, default_value_t)]
    format: TableFormat,
    #[command(flatten)]
    pub(super) common: Common,
}

pub(super) fn execute(arguments: &Arguments) -> Result<(), CommandError> {
    let (mut scenario, text) = load_with_text(&arguments.scenario, &arguments.changes)?;
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
    let prepared = PreparedRun::new(&scenario, arguments.common.seed, &arguments.baselines)?;
    let folder = RunFolder::claim(&out, &files::planned(&scenario, arguments.figures))?;
    warnings::print(prepared.warnings());
    let run = {
        let bars = ProgressBars::new("simulating");
        prepared.carry_out(&bars)?
    };
    let options = files::Options {
        figures: arguments.figures,
        package_format: arguments.package_format,
        has_page: arguments.report,
        has_mcap: arguments.mcap,
    };
    files::write(folder.stage(), options, &run, &text).map_err(|error| folder.placed(error))?;
    let (files, others) = folder.publish(run.scenario(), arguments.common.seed)?;
    let outcome = run.outcome();
    match arguments.format {
        TableFormat::Json => print_outcome(&run.report(), outcome),
        TableFormat::Latex => {
            let window = &run.scenario.evaluation;
            let title = format!(
                "|e_1i(t)| for t in [{}, {}] s [state unit], and broadcasts over the whole run",
                window.from, window.to
            );
            let table = agent_table::table(&run.agents, &run.baselines, run.name(), usize::MAX);
            let mut text = latex(&title, &table);
            if !run.rows.is_empty() {
                text += &format!("\n{}", latex(methods::TITLE, &methods::table(&run.rows)));
            }
            warnings::print(run.warnings_found());
            let printed = print_text(&text);
            outcome.and(printed)
        }
        TableFormat::Text => {
            let mut text = text_of(&run);
            text += &format!(
                "Written to {}: {}\n{others}\nScenario {}, seed {}, {:.2} s\n",
                out.display(),
                files.join(", "),
                run.scenario.name,
                run.seed,
                run.elapsed_s(),
            );
            let printed = print_text(&text);
            outcome.and(printed)
        }
    }
}

/// Returns all that is reported of a run, except its files.
fn text_of(run: &ReportedRun) -> String {
    let scenario = &run.scenario;
    let mut text = packages_in_use(scenario);
    text += &initial_state_text(scenario);
    text += &recording_text(scenario);
    text += &agent_table::text(scenario, &run.agents, &run.baselines, run.name());
    text += run.baselines.note();
    text += &agent_table::traffic(&run.result, &run.agents);
    if run.agents.iter().any(|agent| agent.broadcasts_evaluated > 0) {
        text += &radio::text(&run.radio);
    }
    text += &processor::text(&run.processor);
    if !run.rows.is_empty() {
        text += &methods::text(&run.rows);
    }
    text += &trainings::text(&run.trainings);
    text += &health::table(&run.result.agents);
    text += &checks::text(&run.checks);
    text += &run.certificate.as_ref().map_or(String::new(), ObserverCertificate::text);
    text + &warnings::lines(run.warnings_found())
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
        "Recording: {rows} rows over {} s, one every {} s on average; agents step every {} s; between rows they \
         measure {}\n",
        significant(duration, 6),
        significant(duration / (rows - 1) as f64, 4),
        scenario.time.step_size,
        match recorded.between {
            Between::Hold => "the last row again",
            Between::Linear => "the line to the next row, which a sensor could not know",
            Between::Nothing => "nothing",
        }
    )
}
