//! `train`: trains a network on recorded samples and writes a weight package.

use std::fmt::Write;
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::time::Instant;

use clap::Args;
use serde::Serialize;

use super::key::Passphrase;
use super::package_format::PackageFormat;
use super::summary::ExplainedVariance;
use super::{
    Changes, CommandError, Common, Format, load_scenario, print_json, print_text, summary, versions,
};
use crate::commands::progress::ProgressBars;
use crate::engine::Progress;
use crate::files::output::OutputFile;
use crate::interruption::{self, SecondSignal};
use crate::offline::{
    Follower, OfflineTask, OfflineTraining, agent_index, network_of, serial_after,
};
use crate::packages::{PackageBytes, PackageSummary, Recording};
use crate::scenario::{Scenario, SimulationOnly};
use crate::shell::shell_word;
use crate::terminal;
use crate::training::{EpochReport, StopReason};
use crate::warning::Warning;

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
    /// Output format
    #[arg(long, value_enum, default_value_t)]
    format: Format,
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
    let format = arguments.format;
    // While prompting for a passphrase, Ctrl-C ends the program.
    let key = arguments.sign.as_deref().map(|path| arguments.passphrase.key(path)).transpose()?;
    let start = Instant::now();
    // A second Ctrl-C exits without waiting for the end of the epoch.
    interruption::listen(SecondSignal::Exit);
    let scenario = load_scenario(&arguments.scenario, &arguments.changes)?;
    let about = |error: SimulationOnly| CommandError::from(error).about(&arguments.scenario);
    scenario.check_for_nodes().map_err(about)?;
    let agents = agents(arguments, &scenario)?;
    let base = match &arguments.base {
        Some(path) => Some((PackageBytes::load(path)?, path.as_path())),
        None => None,
    };
    let task = OfflineTask {
        scenario: &scenario,
        agents: &agents,
        recipe: arguments.recipe.as_deref(),
        seed: arguments.common.seed,
        base: base.as_ref().map(|(package, path)| (package, *path)),
    };
    network_of(&scenario)?;
    task.recipe()?;
    task.check_base()?;
    let (mut samples, elsewhere) = task.load(&arguments.data)?;
    let places = places(arguments, &agents);
    let chosen = arguments.package_version;
    let serials = places
        .iter()
        .map(|place| {
            // Whether the file may be replaced is checked later.
            let replaced = if place.is_file() { PackageBytes::load(place).ok() } else { None };
            let replaced = replaced.as_ref().map(|replaced| (replaced, place.as_path()));
            serial_after(task.base.into_iter().chain(replaced), chosen)
        })
        .collect::<Result<Vec<_>, _>>()?;
    // Check the output paths before training.
    let outputs = places
        .iter()
        .map(|place| OutputFile::prepare(place, PackageBytes::KIND))
        .collect::<Result<Vec<_>, _>>()?;
    let mut bars = Bars { bars: ProgressBars::new("training"), agent: agents[0] + 1 };
    let end = (arguments.out.as_path(), Some(interruption::stop().flag()));
    let training = task.carry_out(&mut samples, &serials, elsewhere, &mut bars, end)?;
    bars.bars.finish();
    let mut written = Vec::with_capacity(places.len());
    let format_written = arguments.package_format;
    for ((package, place), output) in training.packages.iter().zip(&places).zip(outputs) {
        let package = package.clone();
        written.push(versions::save(package, chosen, format_written, key.as_ref(), place, output)?);
    }
    let elapsed_s = start.elapsed().as_secs_f64();
    let seed = arguments.common.seed;
    let report = report(&places, seed, &samples.recordings, &training, &written[0], elapsed_s);
    match format {
        Format::Json => print_json(&report),
        Format::Text => print_text(&text(&places, &report)),
    }
}

/// Shows the course of a training on the terminal.
struct Bars {
    bars: ProgressBars,
    /// The agent, from 1.
    agent: usize,
}

impl Follower for Bars {
    fn warn(&mut self, warning: &Warning) {
        self.bars.suspended(|| terminal::warning(warning));
    }

    fn epoch(&mut self, report: &EpochReport, most: usize) -> ControlFlow<()> {
        self.bars.step(report.epoch as u64, most as u64);
        self.bars.trained(self.agent, 1, report.epoch, report.train);
        if interruption::requested() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
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

fn report<'a>(
    places: &[PathBuf],
    seed: u64,
    recordings: &[Recording],
    training: &'a OfflineTraining<'a>,
    package: &PackageBytes,
    elapsed_s: f64,
) -> Report<'a> {
    let OfflineTraining { recipe, trained, .. } = training;
    let quality = &trained.quality;
    let timings = || recordings.iter().map(|recording| &recording.timing);
    Report {
        package: places[0].display().to_string(),
        packages: places.iter().map(|place| place.display().to_string()).collect(),
        summary: PackageSummary::new(package),
        recipe: &recipe.name,
        seed,
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
        "Written to {}{}: {}, {}\n\
         Recipe {}, seed {}, {:.2} s\n\
         Next: host-sim weights verify {}",
        report.packages.join(", "),
        if report.packages.len() > 1 { "; the first" } else { "" },
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
