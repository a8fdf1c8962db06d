//! How a command's error reaches people and scripts: a code, a text, a file, a line.

use std::ffi::OsString;
use std::path::Path;
use std::process::ExitCode;

use serde::{Serialize, Serializer};

use super::CommandError;
use crate::engine::RunError;
use crate::figures::FigureError;
use crate::files::output::OutputError;
use crate::flash::FlashError;
use crate::learning::trained::TrainedError;
use crate::packages::PackageFileError;
use crate::signing::KeyFileError;
use crate::tensors::TensorProblem;
use crate::terminal;
#[cfg(unix)]
use crate::{
    cosim::{CosimError, fault::Fault, firmware::FirmwareError},
    service::{LineError, ServiceError, push::PushError},
};

/// Declares the codes, each with its name in JSON and the exit code that goes with it.
macro_rules! error_codes {
    ($($(#[doc = $doc:literal])* $variant:ident = $name:literal, $exit:literal;)*) => {
        /// What an error is about. Scripts can rely on the names; `docs/errors.md` explains each.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub(super) enum ErrorCode {
            $($(#[doc = $doc])* $variant,)*
        }

        impl ErrorCode {
            /// Every code.
            #[cfg(test)]
            pub(super) const ALL: &'static [Self] = &[$(Self::$variant,)*];

            /// The code as JSON has it.
            pub(super) fn as_str(self) -> &'static str {
                match self {
                    $(Self::$variant => $name,)*
                }
            }

            /// How the process ends.
            pub(super) fn exit(self) -> u8 {
                match self {
                    $(Self::$variant => $exit,)*
                }
            }
        }
    };
}

error_codes! {
    /// The command line is wrong.
    Usage = "usage", 2;
    /// A scenario cannot be read.
    Scenario = "invalid-scenario", 2;
    /// A package file cannot be read as one.
    Package = "invalid-package", 2;
    /// A node would refuse the package, or has refused it.
    PackageRefused = "package-refused", 2;
    /// A network does not become a package.
    Network = "invalid-network", 2;
    /// Samples cannot be read.
    Samples = "invalid-samples", 2;
    /// A key cannot be read.
    Key = "invalid-key", 2;
    /// A memory map cannot be read.
    MemoryMap = "invalid-memory-map", 2;
    /// A package does not fit into flash, or not in this format.
    Image = "invalid-image", 2;
    /// Something else is where a file is to be written.
    OutputRefused = "output-refused", 2;
    /// A file cannot be written.
    OutputFailed = "output-failed", 1;
    /// Another command is writing into the same folder.
    FolderInUse = "folder-in-use", 1;
    /// Standard output cannot be written.
    StandardOutput = "stdout-failed", 1;
    /// The system has no random numbers.
    Random = "no-randomness", 1;
    /// Threads cannot be started.
    Threads = "no-threads", 1;
    /// The simulation cannot go on.
    Run = "run-failed", 1;
    /// An expression of the plant or the disturbance is not defined where it was evaluated.
    Expression = "expression-undefined", 1;
    /// The estimates grew without bound, or would.
    Unstable = "unstable", 1;
    /// The plant's state grew without bound.
    Diverged = "plant-diverged", 1;
    /// A network cannot be trained.
    Training = "training-failed", 1;
    /// A network explains nothing, and was not packed.
    NotPacked = "not-packed", 1;
    /// A figure cannot be drawn.
    Figure = "figure-failed", 1;
    /// probe-rs is not there.
    ProbeRs = "probe-rs-missing", 1;
    /// The chip was not flashed, or reads back differently.
    Flash = "flash-failed", 1;
    /// There is no firmware for emulated nodes.
    Firmware = "firmware-failed", 1;
    /// A node's steps differ from the simulated ones.
    Mismatches = "mismatches", 1;
    /// A node cannot go on.
    Node = "node-failed", 1;
    /// A node does not do what it is asked.
    NodeRefused = "node-refused", 2;
    /// Another push to the node is under way.
    AnotherPush = "another-push", 1;
    /// A node cannot be reached or does not answer.
    Unreachable = "node-unreachable", 1;
    /// A signal asked for the end.
    Interrupted = "interrupted", 1;
}

impl Serialize for ErrorCode {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.as_str())
    }
}

impl CommandError {
    pub(super) fn code(&self) -> ErrorCode {
        match self {
            Self::Usage(_) => ErrorCode::Usage,
            Self::Scenario(_) => ErrorCode::Scenario,
            Self::Refused { .. } => ErrorCode::PackageRefused,
            Self::Draft(_) => ErrorCode::Network,
            Self::Key(error) => match error {
                KeyFileError::Random(_) => ErrorCode::Random,
                KeyFileError::Exists { .. } => ErrorCode::OutputRefused,
                KeyFileError::Write { .. } => ErrorCode::OutputFailed,
                KeyFileError::WritePublic(error) => output(error),
                _ => ErrorCode::Key,
            },
            Self::Tensors(error) => match &error.problem {
                TensorProblem::Write(_) => ErrorCode::OutputFailed,
                TensorProblem::Refused(error) => output(error),
                _ => ErrorCode::Network,
            },
            Self::MemoryMap(_) => ErrorCode::MemoryMap,
            Self::Image(_) => ErrorCode::Image,
            Self::Package(_) => ErrorCode::Package,
            Self::Recording(_) => ErrorCode::Samples,
            Self::Training(error) => match error {
                TrainedError::Draft(_) => ErrorCode::Network,
                _ => ErrorCode::Training,
            },
            Self::NotPacked(_) => ErrorCode::NotPacked,
            Self::Run(error) | Self::Seed { error, .. } => run(error),
            Self::Unstable(_) => ErrorCode::Unstable,
            Self::File(error) | Self::Figure(FigureError::Write(error)) => output(error),
            Self::Figure(_) => ErrorCode::Figure,
            Self::FolderInUse { .. } => ErrorCode::FolderInUse,
            Self::Output(_) => ErrorCode::StandardOutput,
            Self::Threads(_) => ErrorCode::Threads,
            Self::Flash(error) => match error {
                FlashError::NotInstalled { .. } => ErrorCode::ProbeRs,
                FlashError::TemporaryFile { .. } => ErrorCode::OutputFailed,
                FlashError::Interrupted { .. } => ErrorCode::Interrupted,
                _ => ErrorCode::Flash,
            },
            Self::Printed(error) => error.code(),
            #[cfg(unix)]
            Self::Cosim(error) => match error {
                CosimError::NoNetwork { .. } | CosimError::Health { .. } => ErrorCode::Scenario,
                CosimError::Interrupted => ErrorCode::Interrupted,
                CosimError::Run(error) => run(error),
                CosimError::Node(error) => match error.fault {
                    Fault::Interrupted => ErrorCode::Interrupted,
                    _ => ErrorCode::Node,
                },
                CosimError::Occupied { .. } => ErrorCode::OutputRefused,
                CosimError::Output(error) => output(error),
                _ => ErrorCode::OutputFailed,
            },
            #[cfg(unix)]
            Self::Mismatches(_) => ErrorCode::Mismatches,
            #[cfg(unix)]
            Self::Firmware(error) => match error {
                FirmwareError::NotFound(_) => ErrorCode::Usage,
                FirmwareError::Interrupted => ErrorCode::Interrupted,
                _ => ErrorCode::Firmware,
            },
            #[cfg(unix)]
            Self::Address(_) | Self::Push(PushError::Address(_)) => ErrorCode::Unreachable,
            #[cfg(unix)]
            Self::Service(error) | Self::Push(PushError::Service(error)) => match error {
                ServiceError::Refused(_) => ErrorCode::NodeRefused,
                ServiceError::Line(LineError::Interrupted) => ErrorCode::Interrupted,
                _ => ErrorCode::Unreachable,
            },
            #[cfg(unix)]
            Self::Push(PushError::Another(_)) => ErrorCode::AnotherPush,
            #[cfg(unix)]
            Self::Push(PushError::Flash(_)) => ErrorCode::Node,
            #[cfg(unix)]
            Self::Push(_) => ErrorCode::Package,
            #[cfg(unix)]
            Self::Refusal { .. } => ErrorCode::PackageRefused,
            #[cfg(unix)]
            Self::Node(_) => ErrorCode::Node,
            #[cfg(unix)]
            Self::Interrupted(_) => ErrorCode::Interrupted,
            #[cfg(unix)]
            Self::RecordRefused { .. } => ErrorCode::OutputRefused,
        }
    }

    /// The file that the error is about.
    fn file(&self) -> Option<String> {
        let shown = |path: &Path| Some(path.display().to_string());
        match self {
            Self::Scenario(error) => Some(error.file.clone()),
            Self::MemoryMap(error) => Some(error.file.clone()),
            Self::Recording(error) => shown(&error.path),
            Self::Tensors(error) => shown(&error.path),
            Self::Refused { path, .. } | Self::FolderInUse { path } => shown(path),
            #[cfg(unix)]
            Self::Refusal { path, .. } | Self::RecordRefused { path, .. } => shown(path),
            Self::Package(
                PackageFileError::Read { path, .. }
                | PackageFileError::TooLong { path }
                | PackageFileError::Package { path, .. },
            ) => shown(path),
            Self::Key(error) => error.path().and_then(shown),
            Self::Figure(FigureError::Render { path, .. }) => shown(path),
            Self::File(error) | Self::Figure(FigureError::Write(error)) => shown(error.path()),
            Self::Printed(error) => error.file(),
            _ => None,
        }
    }

    /// The line in that file, from 1.
    fn line(&self) -> Option<u64> {
        match self {
            Self::Scenario(error) => error.line.map(|line| line as u64),
            Self::MemoryMap(error) => error.line.map(|line| line as u64),
            Self::Recording(error) => error.line,
            Self::Printed(error) => error.line(),
            _ => None,
        }
    }
}

fn output(error: &OutputError) -> ErrorCode {
    if error.is_refusal() { ErrorCode::OutputRefused } else { ErrorCode::OutputFailed }
}

fn run(error: &RunError) -> ErrorCode {
    match error {
        RunError::Refused { .. }
        | RunError::PackageNode { .. }
        | RunError::PackageLayers { .. }
        | RunError::PackageWithoutNetwork { .. } => ErrorCode::PackageRefused,
        RunError::PlantDiverged { .. } => ErrorCode::Diverged,
        RunError::Expression(_) => ErrorCode::Expression,
        RunError::Training { .. } => ErrorCode::Training,
        _ => ErrorCode::Run,
    }
}

/// An error as JSON has it.
#[derive(Debug, Serialize)]
pub(super) struct ErrorReport {
    code: ErrorCode,
    text: String,
    file: Option<String>,
    line: Option<u64>,
}

impl ErrorReport {
    pub(super) fn new(error: &CommandError) -> Self {
        let text = error.to_string();
        Self { code: error.code(), text, file: error.file(), line: error.line() }
    }

    /// Prints it on standard output, as the one JSON object there. If that fails, the text on
    /// standard error has to do.
    fn print(self) {
        #[derive(Serialize)]
        struct Printed {
            error: ErrorReport,
        }
        let _ = terminal::print_json(&Printed { error: self });
    }
}

/// Prints an error, with `json` also on standard output, and returns the exit code.
pub(super) fn report(error: &CommandError, json: bool) -> ExitCode {
    if let CommandError::Output(error) = error
        && error.kind() == std::io::ErrorKind::BrokenPipe
    {
        // The reader has closed the pipe, as `head` does: nothing is wrong.
        return ExitCode::SUCCESS;
    }
    if json && !matches!(error, CommandError::Printed(_) | CommandError::Output(_)) {
        ErrorReport::new(error).print();
    }
    terminal::error(error);
    ExitCode::from(error.code().exit())
}

/// What clap has to say: help and version are results, everything else is bad usage.
pub(super) fn bad_usage(problem: &clap::Error, json: bool) -> ExitCode {
    if !problem.use_stderr() {
        return match terminal::print(&problem.render().to_string()) {
            Ok(()) => ExitCode::SUCCESS,
            Err(error) => report(&CommandError::Output(error), false),
        };
    }
    let text = problem.render().to_string();
    if json {
        let first = text.split("\n\n").next().unwrap_or_default();
        let text = first.trim_start_matches("error: ").trim_end().to_owned();
        ErrorReport { code: ErrorCode::Usage, text, file: None, line: None }.print();
    }
    terminal::note(text.trim_end());
    ExitCode::from(ErrorCode::Usage.exit())
}

/// Whether the command line asks for JSON, also one that is wrong in other places.
pub(super) fn json_wanted(arguments: impl Iterator<Item = OsString>) -> bool {
    let is_json = |formats: &str| formats.split(',').any(|format| format == "json");
    let mut is_format = false;
    for argument in arguments.take_while(|argument| argument != "--") {
        let argument = argument.to_string_lossy();
        let formats = argument.strip_prefix("--format=").or(is_format.then_some(&*argument));
        if formats.is_some_and(is_json) {
            return true;
        }
        is_format = argument == "--format";
    }
    false
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use super::*;
    use crate::tensors::TensorError;

    #[test]
    fn the_list_of_codes_is_complete_and_true() {
        let text = include_str!("../../../docs/errors.md");
        let row = |line: &str| {
            let mut cells = line.strip_prefix("| `")?.split('|');
            let code = cells.next()?.trim().trim_end_matches('`').to_owned();
            Some((code, cells.next()?.trim().parse().ok()?))
        };
        let listed: Vec<(String, u8)> = text.lines().filter_map(row).collect();
        let codes: Vec<_> =
            ErrorCode::ALL.iter().map(|code| (code.as_str().to_owned(), code.exit())).collect();
        assert_eq!(listed, codes);
        let mut names: Vec<_> = codes.into_iter().map(|(code, _)| code).collect();
        names.sort();
        names.dedup();
        assert_eq!(names.len(), ErrorCode::ALL.len(), "a code twice");
    }

    #[test]
    fn json_is_found_in_every_spelling() {
        let wanted = |line: &str| json_wanted(line.split(' ').map(OsString::from));
        for line in ["run --format json", "--format=json", "weights image --format bin,json x"] {
            assert!(wanted(line), "{line}");
        }
        for line in ["run json", "run --format text json", "run -- --format json", "--out=json"] {
            assert!(!wanted(line), "{line}");
        }
    }

    #[test]
    fn errors_of_the_disk_and_refusals_are_told_apart_wherever_they_come_from() {
        let path = || PathBuf::from("file");
        let full = || OutputError::Write { path: path(), error: std::io::Error::other("full") };
        let other = || OutputError::OtherKind { path: path(), kind: "a package" };
        let key = |error| CommandError::Key(KeyFileError::WritePublic(error));
        let tensors =
            |problem: TensorProblem| CommandError::Tensors(TensorError { path: path(), problem });
        for error in [
            CommandError::File(full()),
            CommandError::Figure(FigureError::Write(full())),
            key(full()),
            tensors(TensorProblem::Write(std::io::Error::other("full"))),
        ] {
            assert_eq!((error.code().as_str(), error.code().exit()), ("output-failed", 1));
            assert_eq!(error.file().as_deref(), Some("file"));
        }
        for error in [CommandError::File(other()), key(other())] {
            assert_eq!((error.code().as_str(), error.code().exit()), ("output-refused", 2));
        }
        let printed = CommandError::Printed(Box::new(CommandError::File(full())));
        assert_eq!(
            (printed.code(), printed.file()),
            (ErrorCode::OutputFailed, Some("file".into()))
        );
    }

    #[cfg(unix)]
    #[test]
    fn what_a_node_refuses_ends_as_a_refusal() {
        use agent_core::service::Problem;
        let refused = CommandError::Service(ServiceError::Refused(Problem::NoPackage));
        assert_eq!((refused.code().as_str(), refused.code().exit()), ("node-refused", 2));
        let gone = CommandError::Service(LineError::Closed.into());
        assert_eq!((gone.code().as_str(), gone.code().exit()), ("node-unreachable", 1));
    }
}
