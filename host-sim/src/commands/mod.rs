//! The command line.
//!
//! Results go to standard output: as text, or as one JSON object with `--format json`, which also
//! covers errors. Messages go to standard error, and so does progress if that is a terminal.
//!
//! Exit codes: 0 success; 2 bad usage, bad input or refusal; 1 any other failure; 128 plus the
//! signal number after a signal. A reader that closes the output early (`head`) does not change the
//! exit code. Messages that cannot be written are dropped.

mod agent_table;
mod baselines;
#[cfg(unix)]
mod board_report;
mod certified;
mod check;
#[cfg(unix)]
mod connection;
#[cfg(unix)]
mod cosim;
mod design;
mod error;
mod frontier;
mod health;
mod initial_states;
mod key;
mod keygen;
mod methods;
#[cfg(unix)]
mod monitor;
#[cfg(unix)]
mod node;
#[cfg(unix)]
mod node_keys;
#[cfg(unix)]
mod node_report;
mod observer_certificate;
mod output;
mod package_format;
mod processor;
mod progress;
#[cfg(unix)]
mod push;
mod radio;
mod report;
mod reproduce;
mod run;
mod run_folder;
mod scenario;
mod scenario_source;
mod seeds;
mod summary;
mod sweep;
mod train;
mod trainings;
mod versions;
mod warnings;
mod weights;

use std::process::ExitCode;
use std::sync::atomic::{AtomicU64, Ordering};

use clap::{Args, Parser, Subcommand, ValueEnum};
use serde::Serialize;

use crate::engine::Progress;
use crate::interruption;
use crate::terminal;
use crate::training::EpochReport;
pub use baselines::Choice;
pub use error::{CommandError, ErrorCode};
pub use run::{PreparedRun, ReportedRun};

use progress::ProgressBars;
use scenario_source::{Changes, load_scenario};

/// Simulates distributed, event-triggered state estimation with deep networks.
///
/// Without a command, `reproduce` is run.
#[derive(Debug, Parser)]
#[command(name = "host-sim", version, args_conflicts_with_subcommands = true)]
struct CommandLine {
    #[command(subcommand)]
    command: Option<Command>,
    #[command(flatten)]
    reproduce: reproduce::Arguments,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Run both of the paper's simulations and compare the results with the published ones
    Reproduce(reproduce::Arguments),
    /// Run a scenario
    Run(run::Arguments),
    /// Check a scenario without running it: gain, step, trigger, bounds
    ///
    /// Exits with 0 even if there are warnings, with 1 if a run would be meaningless (for example
    /// if the step is too long for the observer), and with 2 on bad input.
    Check(check::Arguments),
    /// Choose the gain and the constants of the theorems for a scenario, and write them into a copy of
    /// it
    Design(design::Arguments),
    /// Compare forms of the observer: error against broadcasts, bytes and battery life
    Frontier(frontier::Arguments),
    /// Run a scenario with varied keys, seeds and initial states: one table of all runs
    ///
    /// The same command continues a study that was interrupted. `--shard K/N` runs one of N parts, on
    /// any machine; their tables, concatenated, are the table of the whole study.
    Sweep(sweep::Arguments),
    /// Run a scenario together with emulated or real nodes and compare every bit
    #[cfg(unix)]
    Cosim(cosim::Arguments),
    /// Show a running node's messages, and record its samples for `train`
    #[cfg(unix)]
    Monitor(monitor::Arguments),
    /// Send a weight package to a running node
    #[cfg(unix)]
    Push(push::Arguments),
    /// Query a running node's status, make it confirm, revert or reset, or give it keys
    #[cfg(unix)]
    Node(node::Arguments),
    /// Train a network on recorded samples and write a weight package
    Train(train::Arguments),
    /// Inspect, verify, sign, convert and place weight packages
    #[command(subcommand)]
    Weights(weights::Command),
    /// Write a weight package to a chip through probe-rs and verify it
    Flash(weights::FlashArguments),
    /// Create a folder with an operator's keys, or rotate the network key in it
    Keygen(keygen::Arguments),
    /// Write a page about the results in a folder: one HTML file to look at in a browser
    Report(report::Arguments),
    /// Print a built-in scenario to start from, or list the names of all
    Scenario(scenario::Arguments),
}

/// How results are printed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
enum Format {
    /// Text for people
    #[default]
    Text,
    /// One JSON object
    Json,
}

/// How the results of commands with tables for papers are printed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
enum TableFormat {
    /// Text for people
    #[default]
    Text,
    /// One JSON object
    Json,
    /// The tables for LaTeX
    Latex,
}

/// Options of every command that runs or trains something.
#[derive(Clone, Debug, Args)]
struct Common {
    /// Random seed
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Number of threads, 0 for one per core; results do not depend on it, to the last bit
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u16).range(..=1024))]
    threads: u16,
}

/// Parses the process's arguments and runs the command.
#[must_use]
pub fn main() -> ExitCode {
    interruption::install();
    let json = error::json_wanted(std::env::args_os().skip(1));
    let line = match CommandLine::try_parse() {
        Ok(line) => line,
        Err(problem) => return error::bad_usage(&problem, json),
    };
    let done = match line.command.unwrap_or(Command::Reproduce(line.reproduce)) {
        Command::Reproduce(arguments) => {
            with_threads(arguments.common.threads, || reproduce::execute(&arguments))
        }
        Command::Run(arguments) => {
            with_threads(arguments.common.threads, || run::execute(&arguments))
        }
        Command::Check(arguments) => check::execute(&arguments),
        Command::Design(arguments) => {
            with_threads(arguments.common.threads, || design::execute(&arguments))
        }
        Command::Frontier(arguments) => {
            with_threads(arguments.common.threads, || frontier::execute(&arguments))
        }
        Command::Sweep(arguments) => {
            with_threads(arguments.common.threads, || sweep::execute(&arguments))
        }
        #[cfg(unix)]
        Command::Cosim(arguments) => {
            with_threads(arguments.common.threads, || cosim::execute(&arguments))
        }
        #[cfg(unix)]
        Command::Monitor(arguments) => monitor::execute(&arguments),
        #[cfg(unix)]
        Command::Push(arguments) => push::execute(&arguments),
        #[cfg(unix)]
        Command::Node(arguments) => node::execute(&arguments),
        Command::Train(arguments) => {
            with_threads(arguments.common.threads, || train::execute(&arguments))
        }
        Command::Weights(command) => weights::execute(&command),
        Command::Flash(arguments) => weights::flash(&arguments),
        Command::Keygen(arguments) => keygen::execute(&arguments),
        Command::Report(arguments) => report::execute(&arguments),
        Command::Scenario(arguments) => scenario::execute(&arguments),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => error::report(&error, json),
    }
}

fn with_threads(
    threads: u16,
    command: impl FnOnce() -> Result<(), CommandError> + Send,
) -> Result<(), CommandError> {
    let pool =
        rayon::ThreadPoolBuilder::new().num_threads(threads.into()).build().map_err(|_| {
            let text = format!("cannot start {threads} threads; choose fewer with --threads");
            CommandError::new(ErrorCode::Threads, text)
        })?;
    pool.install(command)
}

/// Prints `value` as one JSON object on its own line.
fn print_json(value: &impl Serialize) -> Result<(), CommandError> {
    terminal::print_json(value).map_err(CommandError::Output)
}

/// Prints `text`.
fn print_text(text: &str) -> Result<(), CommandError> {
    terminal::print(text).map_err(CommandError::Output)
}

/// Prints a result that includes the error of `outcome`, which is then not printed again. A failure
/// to print is reported only if `outcome` is a success.
fn print_outcome(
    result: &impl Serialize,
    outcome: Result<(), CommandError>,
) -> Result<(), CommandError> {
    #[derive(Serialize)]
    struct WithError<'r, R: Serialize> {
        #[serde(flatten)]
        result: &'r R,
        #[serde(skip_serializing_if = "Option::is_none")]
        error: Option<error::ErrorReport>,
    }
    let error = outcome.as_ref().err().map(CommandError::report);
    let printed = print_json(&WithError { result, error });
    match outcome {
        Ok(()) => printed,
        Err(error) => Err(error.printed()),
    }
}

/// The progress of one of several concurrent runs, as part of that of all.
struct SharedProgress<'p> {
    whole: &'p dyn Progress,
    done: &'p AtomicU64,
    total: u64,
    own: AtomicU64,
}

impl<'p> SharedProgress<'p> {
    fn new(whole: &'p dyn Progress, done: &'p AtomicU64, total: u64) -> Self {
        Self { whole, done, total, own: AtomicU64::new(0) }
    }
}

impl Progress for SharedProgress<'_> {
    fn step(&self, tick: u64, _steps: u64) {
        let before = self.own.swap(tick, Ordering::Relaxed);
        let advanced = tick.saturating_sub(before);
        let done = self.done.fetch_add(advanced, Ordering::Relaxed) + advanced;
        self.whole.step(done, self.total);
    }

    fn epoch(&self, agent: usize, cycle: usize, report: &EpochReport) {
        self.whole.epoch(agent, cycle, report);
    }

    fn is_stopped(&self) -> bool {
        self.whole.is_stopped()
    }
}
