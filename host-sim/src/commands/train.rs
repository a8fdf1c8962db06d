//! `train`: trains a network on recorded samples and writes a weight package.

use std::fmt::Write;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::time::Instant;

use agent_core::package::Serial;
use clap::Args;
use serde::Serialize;

use super::key::Passphrase;
use super::package_format::PackageFormat;
use super::summary::ExplainedVariance;
use super::{
    Changes, CommandError, Common, ErrorCode, Format, agent_index, load_scenario, network_of,
    print_json, print_text, summary, versions,
};
use crate::analysis::TriggerConstants;
use crate::commands::progress::ProgressBars;
use crate::engine::{Progress, RunError};
use crate::files::output::OutputFile;
use crate::flow::{FleetSamples, Plan, fleet_packages};
use crate::interruption::{self, SecondSignal};
use crate::learning::agent_config;
use crate::learning::agent_config::agent_id;
use crate::learning::trained::{INITIAL_VERSION, Prepared, Trained, TrainedError, TrainingTask};
use crate::packages::recording_source::{RecordingSource, SourceScenario};
use crate::packages::{PackageBytes, PackageSummary, Recording};
use crate::scenario::{Recipe, Scenario, SimulationOnly};
use crate::shell::shell_word;
use crate::terminal;
use crate::training::{EpochReport, StopReason};
use crate::warning::{Warning, WarningCode};

/// Arguments of `train`.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Recorded samples: CSV files with the columns time, xhat1.., dxhat1.. and optionally w1_1..;
    /// `run` writes such files if the scenario sets record.samples = true
    #[arg(required = true)]
    data: Vec<PathBuf>,
    /// Scenario that describes agent, network and recipe: a file or the name of a built-in scenario
    #[arg(long)]
    scenario: PathBuf,
    #[command(flatten)]
    changes: Changes,
    /// Numbers of the agents that get the network, from 1, separated by commas
    #[arg(long, required = true, value_delimiter = ',', value_name = "AGENTS")]
    agent: Vec<usize>,
    /// Package file to write; for several agents a folder, in which each gets agentN.weights
    #[arg(long)]
    out: PathBuf,
    /// Training recipe of the scenario [default: that of the agent's first learning cycle]
    #[arg(long)]
    recipe: Option<String>,
    /// Package currently in use: provides outer weights if the samples have none, and the version
    /// to increment
    #[arg(long)]
    base: Option<PathBuf>,
    /// Version of the package [default: one more than that of --base or of the replaced file, else
    /// 2]
    #[arg(long)]
    package_version: Option<u32>,
    /// Private key to sign the package with
    #[arg(long)]
    sign: Option<PathBuf>,
    #[command(flatten)]
    passphrase: Passphrase,
    #[command(flatten)]
    package_format: PackageFormat,
    #[command(flatten)]
    pub(super) common: Common,
}

#[derive(Serialize)]
struct Report<'a> {
    package: String,
    /// All files written, one for each agent.
    packages: Vec<String>,
    #[serde(flatten)]
    summary: PackageSummary,
    recipe: &'a str,
    seed: u64,
    recorded_samples: usize,
    interval_s: f64,
    gaps: usize,
    missing_samples: u64,
    repeated_samples: usize,
    uneven_intervals: usize,
    largest_jitter_s: f64,
    pieces: usize,
    pieces_left_out: usize,
    samples_left_out: usize,
    windows_left_out: usize,
    samples: usize,
    epochs: usize,
    stopped_by: &'static str,
    /// Signal that interrupted the training, or `null`.
    stopped: Option<&'static str>,
    smoothing_window_s: f64,
    decimation: usize,
    training_error: f64,
    validation_error: Option<f64>,
    test_error: Option<f64>,
    explained_variance: ExplainedVariance,
    warnings: &'a [Warning],
    signed: bool,
    elapsed_s: f64,
}

pub(super) fn execute(arguments: &Arguments) -> Result<(), CommandError> {
    let format = arguments.common.format.without_tables()?;
    // While prompting for a passphrase, Ctrl-C ends the program.
    let key = arguments.sign.as_deref().map(|path| arguments.passphrase.key(path)).transpose()?;
    let start = Instant::now();
    // A second Ctrl-C exits without waiting for the end of the epoch.
    interruption::listen(SecondSignal::Exit);
    let scenario = load_scenario(&arguments.scenario, &arguments.changes)?;
    let about = |error: SimulationOnly| CommandError::from(error).about(&arguments.scenario);
    scenario.check_for_nodes().map_err(about)?;
    let agents = agents(arguments, &scenario)?;
    let index = agents[0];
    let network = network_of(&scenario)?;
    let (recipe, cycle) = recipe(arguments, &scenario, index)?;
    let features = network.architecture.features();
    let base = arguments.base.as_deref().map(PackageBytes::load).transpose()?;
    if let (Some(base), Some(path)) = (&base, &arguments.base) {
        check_base(&scenario, &agents, base, path)?;
    }
    let (recorded_by, elsewhere) = check_sources(arguments, &scenario, &agents)?;
    let load = |path: &PathBuf| Recording::load(path, scenario.dimension(), features);
    let mut recordings: Vec<Recording> =
        arguments.data.iter().map(load).collect::<Result<_, _>>()?;
    for recording in &mut recordings {
        if let (None, Some(base)) = (&recording.outer_weights, &base) {
            recording.outer_weights = Some(base.package().outer_weights.to_vec());
        }
    }
    check_intervals(arguments, &recordings)?;
    let plan = plan(&scenario, cycle)?;
    let samples = FleetSamples::new(plan.as_ref(), &recorded_by, &recordings)
        .ok_or_else(|| CommandError::usage("no samples; give at least one recording".to_owned()))?;
    let FleetSamples { recording, harmonics } = &samples;
    let places = places(arguments, &agents);
    let members = agents
        .iter()
        .zip(&places)
        .map(|(&agent, place)| Ok((agent, serial(arguments, base.as_ref(), place)?)))
        .collect::<Result<Vec<_>, CommandError>>()?;
    // Check the output paths before training.
    let outputs = places
        .iter()
        .map(|place| OutputFile::prepare(place, PackageBytes::KIND))
        .collect::<Result<Vec<_>, _>>()?;
    let Serial { epoch, version } = members[0].1;
    let task = TrainingTask {
        scenario: &scenario,
        network,
        recipe,
        agent: index,
        cycle,
        seed: arguments.common.seed,
        epoch,
        version,
    };
    let with_file = |error: TrainedError| match error {
        // The result is wrong, not the samples.
        TrainedError::NotFinite { .. } | TrainedError::Size { .. } | TrainedError::Draft(_) => {
            CommandError::from(error)
        }
        _ => {
            let path = &arguments.data[0];
            CommandError::usage(format!("{}: {error}", names(&arguments.data))).about(path)
        }
    };
    let mut prepared = task.prepare(recording).map_err(with_file)?;
    let dense = arguments.data.iter().zip(&recordings);
    let dense = dense.filter_map(|(path, recording)| dense_samples(path, &scenario, recording));
    prepared.warnings.extend(elsewhere.into_iter().chain(dense));
    let printed = prepared.warnings.len();
    prepared.warnings.iter().for_each(warn);
    let mut trained = train(&task, prepared).map_err(with_file)?;
    // An interrupted training packs the best network so far, even if it explains little; the other
    // warnings report that.
    let interrupted = trained.report.stop == StopReason::Callback;
    if interrupted {
        trained.warnings.retain(|warning| warning.code != WarningCode::NotSwitchedIn);
    }
    trained.warnings[printed..].iter().for_each(warn);
    if !trained.accepted && !interrupted {
        let problem = "not written, because the network explains no more than a constant; see the \
                       warnings above";
        let text = format!("{}: {problem}", arguments.out.display());
        return Err(CommandError::new(ErrorCode::NotPacked, text).about(&arguments.out));
    }
    let chosen = arguments.package_version;
    let package_format = arguments.package_format;
    let packages = fleet_packages(&scenario, plan.as_ref(), harmonics, &trained.package, &members)
        .map_err(RunError::Observer)?;
    let mut written = Vec::with_capacity(packages.len());
    for ((package, place), output) in packages.into_iter().zip(&places).zip(outputs) {
        written.push(versions::save(package, chosen, package_format, key.as_ref(), place, output)?);
    }
    let elapsed_s = start.elapsed().as_secs_f64();
    let report = report(&places, &task, &recordings, &trained, &written[0], elapsed_s);
    match format {
        Format::Json => print_json(&report),
        Format::Text => print_text(&text(&places, &report)),
    }
}

/// Returns the agents that get the network, from 0.
fn agents(arguments: &Arguments, scenario: &Scenario) -> Result<Vec<usize>, CommandError> {
    let mut agents = Vec::with_capacity(arguments.agent.len());
    for &number in &arguments.agent {
        let index = agent_index(scenario, number)?;
        if agents.contains(&index) {
            return Err(CommandError::usage(format!(
                "--agent {number}: given twice; give it once"
            )));
        }
        agents.push(index);
    }
    Ok(agents)
}

/// Returns the files to write, one for each agent.
fn places(arguments: &Arguments, agents: &[usize]) -> Vec<PathBuf> {
    if agents.len() == 1 {
        return vec![arguments.out.clone()];
    }
    let out = &arguments.out;
    agents.iter().map(|index| out.join(format!("agent{}.weights", index + 1))).collect()
}

/// Checks that the package in use is one of an agent that is trained for.
fn check_base(
    scenario: &Scenario,
    agents: &[usize],
    base: &PackageBytes,
    path: &Path,
) -> Result<(), CommandError> {
    let trigger = TriggerConstants::new(scenario);
    let own = agents.iter().find(|&&index| base.package().node.agent == agent_id(index));
    let index = *own.unwrap_or(&agents[0]);
    let node = agent_config(scenario, &trigger, index);
    let Some(parameter) = node.first_difference(&base.package().node) else { return Ok(()) };
    let (problem, number) =
        (format!("{}: its {parameter} differs from that of", path.display()), index + 1);
    Err(CommandError::usage(format!(
        "{problem} agent {number} in the scenario; give a package of this agent as --base"
    ))
    .about(path))
}

/// Returns the plan of the field observer, if nodes run it once this cycle's network is in use.
fn plan(scenario: &Scenario, cycle: usize) -> Result<Option<Plan<'_>>, CommandError> {
    let plan = Plan::new(scenario).map_err(RunError::Observer)?;
    let applied = scenario.learning.get(cycle).map(|cycle| scenario.time.tick(cycle.apply_at));
    Ok(plan.filter(|plan| applied.is_none_or(|tick| tick >= plan.starts_at())))
}

/// Warns if samples are closer together than a node could record them.
fn dense_samples(path: &Path, scenario: &Scenario, recording: &Recording) -> Option<Warning> {
    let (interval, step) = (recording.interval, scenario.time.step_size);
    (interval < 0.5 * step).then(|| {
        let text = format!(
            "{}: samples are {interval:e} s apart, but the scenario's step is {step:e} s; check the \
             time unit in the header",
            path.display(),
        );
        Warning::new(WarningCode::DenseSamples, text)
    })
}

/// Returns which agent, from 0, recorded each file, and warnings about them.
///
/// # Errors
/// As far as the files say, if one is from an agent that gets no network, or has a different step.
fn check_sources(
    arguments: &Arguments,
    scenario: &Scenario,
    agents: &[usize],
) -> Result<(Vec<usize>, Vec<Warning>), CommandError> {
    let (mut recorded_by, mut warnings) = (Vec::new(), Vec::new());
    for path in &arguments.data {
        // Errors are reported when the samples are read.
        let source = RecordingSource::read(path).unwrap_or_default();
        let said = source.agent.and_then(|own| usize::try_from(own).ok());
        let known = said.filter(|own| arguments.agent.contains(own));
        let number = known.unwrap_or(agents[0] + 1);
        let (name, hash, step) = (scenario.name.as_str(), scenario.hash, scenario.time.step_size);
        let scenario = SourceScenario { name, hash, step };
        warnings.extend(source.check(path, number, &scenario)?);
        recorded_by.push(number - 1);
    }
    Ok((recorded_by, warnings))
}

/// Checks that all recordings have the same time between samples, because they are averaged over the same
/// windows.
fn check_intervals(arguments: &Arguments, recordings: &[Recording]) -> Result<(), CommandError> {
    let (first, interval) = (&arguments.data[0], recordings[0].interval);
    let differs = |other: f64| (other - interval).abs() > 1e-6 * interval;
    match arguments.data.iter().zip(recordings).find(|(_, other)| differs(other.interval)) {
        None => Ok(()),
        Some((path, other)) => Err(CommandError::usage(format!(
            "{}: samples are {} s apart, and those of {} {interval} s; record them at the same interval, or \
             train on one of them",
            path.display(),
            other.interval,
            first.display(),
        ))
        .about(path)),
    }
}

fn names(paths: &[PathBuf]) -> String {
    paths.iter().map(|path| path.display().to_string()).collect::<Vec<_>>().join(", ")
}

/// Returns the recipe and the learning cycle, from 0, that it belongs to.
fn recipe<'s>(
    arguments: &Arguments,
    scenario: &'s Scenario,
    index: usize,
) -> Result<(&'s Recipe, usize), CommandError> {
    let own = scenario.learning.iter().position(|cycle| cycle.agents.contains(&index));
    let only = match &scenario.recipes[..] {
        [only] => Some(only.name.as_str()),
        _ => None,
    };
    let name = arguments
        .recipe
        .as_deref()
        .or(own.map(|cycle| scenario.learning[cycle].recipe.as_str()))
        .or(only);
    let found = name.and_then(|name| scenario.recipe(name));
    let recipe = found.ok_or_else(|| {
        let names: Vec<_> = scenario.recipes.iter().map(|recipe| recipe.name.as_str()).collect();
        CommandError::usage(match names[..] {
            [] => format!("scenario {} has no recipe; add [recipes.NAME]", scenario.name),
            _ => format!("choose a recipe with --recipe: {}", names.join(", ")),
        })
    })?;
    Ok((recipe, own.unwrap_or(0)))
}

/// Returns the epoch of the base and of the file to replace, and the version after theirs or the
/// chosen one.
fn serial(
    arguments: &Arguments,
    base: Option<&PackageBytes>,
    place: &Path,
) -> Result<Serial, CommandError> {
    // Whether the file may be replaced is checked later.
    let replaced = if place.is_file() { PackageBytes::load(place).ok() } else { None };
    let before = base
        .zip(arguments.base.as_deref())
        .into_iter()
        .chain(replaced.as_ref().map(|replaced| (replaced, place)))
        .map(|(package, path)| (package.package().serial(), path))
        .max();
    let epoch = before.map_or(0, |(serial, _)| serial.epoch);
    if let Some(version) = arguments.package_version {
        return Ok(Serial { epoch, version });
    }
    match before {
        Some((serial, path)) => Ok(Serial { epoch, version: versions::after(serial, path)? }),
        None => Ok(Serial { epoch, version: INITIAL_VERSION + 1 }),
    }
}

/// Trains until done or interrupted; an interruption keeps the best network so far.
fn train(task: &TrainingTask<'_>, prepared: Prepared<'_, '_>) -> Result<Trained, TrainedError> {
    let bars = ProgressBars::new("training");
    let total = task.recipe.trainer.trainer().epochs_max() as u64;
    let mut report_epoch = |epoch: &EpochReport| {
        bars.step(epoch.epoch as u64, total);
        bars.trained(task.agent + 1, task.cycle + 1, epoch.epoch, epoch.train);
        if interruption::requested() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    };
    let trained = prepared.carry_out_until(&mut report_epoch, Some(interruption::stop().flag()));
    bars.finish();
    trained
}

fn warn(warning: &Warning) {
    terminal::warning(warning);
}

fn report<'a>(
    places: &[PathBuf],
    task: &TrainingTask<'a>,
    recordings: &[Recording],
    trained: &'a Trained,
    package: &PackageBytes,
    elapsed_s: f64,
) -> Report<'a> {
    let quality = &trained.quality;
    let timings = || recordings.iter().map(|recording| &recording.timing);
    Report {
        package: places[0].display().to_string(),
        packages: places.iter().map(|place| place.display().to_string()).collect(),
        summary: PackageSummary::new(package),
        recipe: &task.recipe.name,
        seed: task.seed,
        recorded_samples: recordings.iter().map(|recording| recording.samples.len()).sum(),
        interval_s: recordings[0].interval,
        gaps: recordings.iter().map(|recording| recording.gaps.len()).sum(),
        missing_samples: timings()
            .fold(0, |sum: u64, timing| sum.saturating_add(timing.missing_samples())),
        repeated_samples: timings().map(|timing| timing.repeated).sum(),
        uneven_intervals: timings().map(|timing| timing.uneven).sum(),
        largest_jitter_s: timings().fold(0.0, |largest, timing| timing.jitter.max(largest)),
        pieces: trained.cleaning.pieces,
        pieces_left_out: trained.cleaning.pieces_left_out,
        samples_left_out: trained.cleaning.samples_left_out,
        windows_left_out: trained.cleaning.windows_left_out,
        samples: trained.samples,
        epochs: trained.report.epochs.len().saturating_sub(1),
        stopped_by: match trained.report.stop {
            StopReason::Callback => "interruption",
            stop => summary::reason(stop),
        },
        stopped: match trained.report.stop {
            StopReason::Callback => interruption::signal().map(interruption::Signal::as_str),
            _ => None,
        },
        smoothing_window_s: trained.smoothing_window,
        decimation: trained.decimation,
        training_error: quality.training.error,
        validation_error: quality.validation.map(|fit| fit.error),
        test_error: quality.test.map(|fit| fit.error),
        explained_variance: ExplainedVariance::of(quality),
        warnings: &trained.warnings,
        signed: package.is_signed(),
        elapsed_s,
    }
}

fn text(places: &[PathBuf], report: &Report<'_>) -> String {
    let error = |error: Option<f64>| error.map_or("none".to_owned(), |e| format!("{e:.3e}"));
    let kept = if report.stopped_by == "interruption" { " (the best network so far)" } else { "" };
    let intervals = report.recorded_samples as f64 + report.missing_samples as f64;
    let seconds = intervals * report.interval_s;
    let mut text = format!(
        "Read {} samples, one every {:.6} s, {seconds:.3} s in all, {}\n{}\
         Trained on {} of them (averaged over {} s, decimated by {}), {} epochs, stopped by \
         {}{kept}\n\
         Mean squared error: training {}, validation {}, test {}\n\
         Variance explained: {}\n",
        report.recorded_samples,
        report.interval_s,
        gaps(report),
        regularity(report),
        report.samples,
        report.smoothing_window_s,
        report.decimation,
        report.epochs,
        report.stopped_by,
        error(Some(report.training_error)),
        error(report.validation_error),
        error(report.test_error),
        report.explained_variance,
    );
    // Writing into a string cannot fail.
    let _ = writeln!(
        text,
        "Written to {}: {}, {}\n\
         Recipe {}, seed {}, {:.2} s\n\
         Next: host-sim weights verify {}",
        report.packages.join(", "),
        report.summary,
        if report.signed { "signed" } else { "not signed" },
        terminal::one_line(report.recipe),
        report.seed,
        report.elapsed_s,
        shell_word(&places[0]),
    );
    text
}

fn gaps(report: &Report<'_>) -> String {
    match (report.gaps, report.missing_samples) {
        (0, _) => "no gaps".to_owned(),
        (1, missing) => format!("1 gap ({missing} missing)"),
        (gaps, missing) => format!("{gaps} gaps ({missing} missing)"),
    }
}

/// Returns one line for each irregularity of the samples.
fn regularity(report: &Report<'_>) -> String {
    let mut text = String::new();
    // Writing into a string cannot fail.
    if report.repeated_samples > 0 {
        let _ = writeln!(text, "Skipped {} repeated samples", report.repeated_samples);
    }
    if report.uneven_intervals > 0 {
        let _ = writeln!(
            text,
            "Sampling is uneven: {} intervals deviate by more than a quarter, by up to {:.3e} s; they \
             are treated as equal",
            report.uneven_intervals, report.largest_jitter_s
        );
    }
    if report.samples_left_out > 0 {
        let _ = writeln!(
            text,
            "Skipped {} samples: {} of {} segments between gaps are shorter than the smoothing window",
            report.samples_left_out, report.pieces_left_out, report.pieces
        );
    }
    if report.windows_left_out > 0 {
        let _ = writeln!(
            text,
            "Skipped {} smoothing windows with more than half of their samples missing",
            report.windows_left_out
        );
    }
    text
}
