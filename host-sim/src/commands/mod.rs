//! What the command line does.
//!
//! Standard output carries results: text for people, or one JSON object with
//! `--format json`, also for errors. Messages go to standard error; so does progress, and only to a
//! terminal. Exit codes: 0 done; 2 bad usage, bad input, or refused; 1 anything else; 128 and the
//! number of the signal that ended it. A reader that closes the output (`head`) does not
//! change the exit code; messages that cannot be written are lost, and nothing else is.

mod agent_table;
mod baselines;
#[cfg(unix)]
mod board_report;
mod check;
#[cfg(unix)]
mod cosim;
mod error;
mod health;
mod key;
#[cfg(unix)]
mod monitor;
#[cfg(unix)]
mod node;
mod output;
mod progress;
#[cfg(unix)]
mod push;
mod reproduce;
mod run;
mod run_folder;
mod scenario;
mod seeds;
mod summary;
mod train;
mod trainings;
mod versions;
mod warnings;
mod weights;

use std::path::Path;
use std::process::ExitCode;
use std::sync::atomic::{AtomicU64, Ordering};

use clap::{Args, Parser, Subcommand, ValueEnum};
use serde::Serialize;

use crate::engine::Progress;
use crate::interruption;
use crate::scenario::{Network, Scenario, built_in};
use crate::terminal;
use crate::training::EpochReport;
use error::{CommandError, ErrorCode};
use progress::ProgressBars;

/// Simulates distributed, event-triggered state estimation with deep networks.
///
/// Without a command: reproduce.
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
    /// Runs both of the paper's simulations and sets the results beside the paper's
    Reproduce(reproduce::Arguments),
    /// Runs a scenario file
    Run(run::Arguments),
    /// Tells what there is to know of a scenario without running it: gain, step, trigger, bounds
    ///
    /// Ends with 0, also with warnings; with 1 where a run would be meaningless, as with a step that
    /// is too long for the observer; with 2 on bad input.
    Check(check::Arguments),
    /// Runs a scenario together with emulated or real nodes and compares every bit
    #[cfg(unix)]
    Cosim(cosim::Arguments),
    /// Shows what a running node tells, and records its samples for `train`
    #[cfg(unix)]
    Monitor(monitor::Arguments),
    /// Brings a weight package into a running node
    #[cfg(unix)]
    Push(push::Arguments),
    /// Asks a running node for its status, or to confirm, revert or reset
    #[cfg(unix)]
    Node(node::Arguments),
    /// Trains a network on recorded samples and writes a weight package
    Train(train::Arguments),
    /// Looks at weight packages, checks, signs, converts and places them
    #[command(subcommand)]
    Weights(weights::Command),
    /// Writes a weight package into a chip through probe-rs and reads it back
    Flash(weights::FlashArguments),
    /// Prints a built-in scenario, as a file to start from; without a name, lists them
    Scenario(scenario::Arguments),
}

/// How results are printed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
enum Format {
    /// Tables for people.
    #[default]
    Text,
    /// One JSON object.
    Json,
}

/// What every command that runs something takes.
#[derive(Clone, Debug, Args)]
struct Common {
    /// Seed of all that is random
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// How results are printed on standard output
    #[arg(long, value_enum, default_value_t)]
    format: Format,
    /// Threads to use, 0 for one a core; the results are the same bits for any number
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u16).range(..=1024))]
    threads: u16,
}

/// Parses the arguments of the process and does what they ask.
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

/// Prints `value` as one JSON object on a line of its own.
fn print_json(value: &impl Serialize) -> Result<(), CommandError> {
    terminal::print_json(value).map_err(CommandError::Output)
}

/// Prints `text`.
fn print_text(text: &str) -> Result<(), CommandError> {
    terminal::print(text).map_err(CommandError::Output)
}

/// Prints a result that says what `outcome` is: the error is then not printed again, and a
/// failure to print matters only after a success.
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

/// The built-in scenario of that name, or the one in the file `path`. A built-in name is that of the
/// scenario whatever lies in the current folder; `./NAME` is the file.
fn load_scenario(path: &Path) -> Result<Scenario, CommandError> {
    let Some((name, text)) = path.to_str().and_then(|name| Some((name, built_in(name)?))) else {
        return Ok(Scenario::load(path)?);
    };
    if path.is_file() {
        terminal::note(format_args!(
            "{name} is the built-in scenario; write ./{name} for the file of that name"
        ));
    }
    Ok(Scenario::parse(name, text)?)
}

/// The index, from 0, of the agent that the command line calls `number`, from 1.
fn agent_index(scenario: &Scenario, number: usize) -> Result<usize, CommandError> {
    let agents = scenario.agents.len();
    number.checked_sub(1).filter(|&index| index < agents).ok_or_else(|| {
        let name = &scenario.name;
        CommandError::usage(format!("--agent {number}: scenario {name} has agents 1 to {agents}"))
    })
}

/// The scenario's network, without which there is no package.
fn network_of(scenario: &Scenario) -> Result<&Network, CommandError> {
    scenario.network.as_ref().ok_or_else(|| {
        let name = &scenario.name;
        let problem = format!("scenario {name} has no network; add [network] and [outer_law]");
        CommandError::usage(problem)
    })
}

/// One of several runs that go on at the same time and share the progress bars.
struct SharedProgress<'p> {
    bars: &'p ProgressBars,
    done: &'p AtomicU64,
    total: u64,
    own: AtomicU64,
}

impl<'p> SharedProgress<'p> {
    fn new(bars: &'p ProgressBars, done: &'p AtomicU64, total: u64) -> Self {
        Self { bars, done, total, own: AtomicU64::new(0) }
    }
}

impl Progress for SharedProgress<'_> {
    fn stepped(&self, tick: u64, _steps: u64) {
        let before = self.own.swap(tick, Ordering::Relaxed);
        let advanced = tick.saturating_sub(before);
        let done = self.done.fetch_add(advanced, Ordering::Relaxed) + advanced;
        self.bars.stepped(done, self.total);
    }

    fn epoch(&self, agent: usize, cycle: usize, report: &EpochReport) {
        self.bars.epoch(agent, cycle, report.epoch, report.train);
    }
}
