//! What the command line does.
//!
//! Standard output carries results: text for people, or one JSON object with
//! `--format json`. Progress goes to standard error, and only to a terminal. Exit codes: 0
//! done, 2 bad usage or bad input, 1 anything else.

mod output;
mod reproduce;
mod run;
mod scenario;

use std::process::ExitCode;

use clap::{Args, Parser, Subcommand, ValueEnum};

use crate::engine::RunError;
use crate::report::ReportError;
use crate::scenario::ScenarioError;

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
    /// Runs both of the paper's simulations and sets the results beside the paper's.
    Reproduce(reproduce::Arguments),
    /// Runs a scenario file.
    Run(run::Arguments),
    /// Prints a built-in scenario, as a file to start from; without a name, lists them.
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
    /// Threads to use; 0 means all cores. The results are the same bits for any number
    #[arg(long, default_value_t = 0)]
    threads: usize,
}

/// Why a command failed.
#[derive(Debug, thiserror::Error)]
enum CommandError {
    #[error(transparent)]
    Scenario(#[from] ScenarioError),
    #[error("{0}")]
    Usage(String),
    #[error(transparent)]
    Run(#[from] RunError),
    #[error(transparent)]
    Report(#[from] ReportError),
    #[error("cannot write to standard output: {0}")]
    Output(#[from] std::io::Error),
    #[error("cannot start {0} threads; choose fewer with --threads")]
    Threads(usize),
}

impl CommandError {
    fn exit_code(&self) -> ExitCode {
        match self {
            Self::Scenario(_) | Self::Usage(_) => ExitCode::from(2),
            Self::Run(_) | Self::Report(_) | Self::Output(_) | Self::Threads(_) => ExitCode::from(1),
        }
    }
}

/// Parses the arguments of the process and does what they ask.
#[must_use]
pub fn main() -> ExitCode {
    // clap itself leaves with 2 on bad usage and with 0 after help.
    let line = CommandLine::parse();
    let command = line.command.unwrap_or(Command::Reproduce(line.reproduce));
    let done = match command {
        Command::Reproduce(arguments) => {
            with_threads(arguments.common.threads, || reproduce::execute(&arguments))
        }
        Command::Run(arguments) => {
            with_threads(arguments.common.threads, || run::execute(&arguments))
        }
        Command::Scenario(arguments) => scenario::execute(&arguments),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        // Whoever read our output has gone, as `head` does: nothing is wrong.
        Err(CommandError::Output(error)) if error.kind() == std::io::ErrorKind::BrokenPipe => {
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("error: {error}");
            error.exit_code()
        }
    }
}

fn with_threads(
    threads: usize,
    command: impl FnOnce() -> Result<(), CommandError> + Send,
) -> Result<(), CommandError> {
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .map_err(|_| CommandError::Threads(threads))?;
    pool.install(command)
}
