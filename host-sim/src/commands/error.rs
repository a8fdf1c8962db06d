//! Errors of commands, for people and scripts. Library errors are converted through [`Reported`].

use std::ffi::OsString;
use std::fmt;
use std::io;
use std::path::Path;
use std::process::ExitCode;

use agent_core::package::Refusal;
use serde::Serialize;

pub use crate::error::ErrorCode;
pub(super) use crate::error::{ErrorReport, Reported};

use crate::packages::refusal;
use crate::terminal;

/// Why a command failed.
#[derive(Debug)]
pub enum CommandError {
    /// An error with a code, which determines the exit code.
    Failed {
        /// Code, text, file and line.
        report: Box<ErrorReport>,
        /// Whether an already printed result contains this error.
        is_printed: bool,
    },
    /// Standard output cannot be written: exit code 1.
    Output(io::Error),
}

impl<E: Reported> From<E> for CommandError {
    fn from(error: E) -> Self {
        Self::Failed { report: Box::new(ErrorReport::of(&error)), is_printed: false }
    }
}

impl CommandError {
    /// Creates an error with this code.
    pub(super) fn new(code: ErrorCode, text: impl Into<String>) -> Self {
        ErrorReport::new(code, text).into()
    }

    /// Creates an error about the command line.
    pub(super) fn usage(text: impl Into<String>) -> Self {
        ErrorReport::usage(text).into()
    }

    /// Creates an error about the package at `path`, which a node would refuse.
    pub(super) fn refused(path: &Path, refusal: &Refusal) -> Self {
        refusal::refused(path, refusal).into()
    }

    /// Creates an error about the package at `path`, which a node would refuse for this reason.
    pub(super) fn unfit(path: &Path, refusal: &str, hint: &str) -> Self {
        refusal::unfit(path, refusal, hint).into()
    }

    /// Creates an error about the folder `path`, which another command is writing to.
    pub(super) fn folder_in_use(path: &Path) -> Self {
        let text = format!(
            "{}: another command is writing to this folder; wait for it to finish, or choose \
             another folder with --out",
            path.display()
        );
        Self::new(ErrorCode::FolderInUse, text).about(path)
    }

    /// Creates an error about results at `path`, which cannot be read.
    pub(super) fn unreadable(path: &Path, error: impl fmt::Display) -> Self {
        let path_shown = path.display();
        let text =
            format!("{path_shown}: cannot be read: {error}; rerun the command that wrote it");
        Self::new(ErrorCode::Results, text).about(path)
    }

    fn changed(self, change: impl FnOnce(ErrorReport) -> ErrorReport) -> Self {
        match self {
            Self::Failed { report, is_printed } => {
                Self::Failed { report: Box::new(change(*report)), is_printed }
            }
            output => output,
        }
    }

    /// Sets the file concerned.
    pub(super) fn about(self, path: &Path) -> Self {
        self.changed(|report| report.about(path))
    }

    /// Prepends `prefix` to the text.
    pub(super) fn within(self, prefix: &str) -> Self {
        self.changed(|report| report.reworded(|text| format!("{prefix}: {text}")))
    }

    /// Marks the error as part of a result that is already printed.
    pub(super) fn printed(self) -> Self {
        match self {
            Self::Failed { report, .. } => Self::Failed { report, is_printed: true },
            output => output,
        }
    }

    /// Replaces the folder `from` with `to` in text and file.
    pub(super) fn renamed(self, from: &Path, to: &Path) -> Self {
        // With a trailing separator, except for an empty path.
        let shown = |folder: &Path| folder.join("").display().to_string();
        let (from, to) = (shown(from), shown(to));
        let renamed = |text: &str| text.replace(&from, &to);
        self.changed(|report| report.reworded(renamed).refiled(renamed))
    }

    /// Returns the error's code.
    #[must_use]
    pub fn code(&self) -> ErrorCode {
        match self {
            Self::Failed { report, .. } => report.code(),
            Self::Output(_) => ErrorCode::StandardOutput,
        }
    }

    /// Returns the error in its JSON form.
    #[must_use]
    pub fn report(&self) -> ErrorReport {
        match self {
            Self::Failed { report, .. } => (**report).clone(),
            Self::Output(_) => ErrorReport::new(self.code(), self.to_string()),
        }
    }
}

impl fmt::Display for CommandError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Failed { report, .. } => report.fmt(f),
            Self::Output(error) => write!(f, "cannot write to standard output: {error}"),
        }
    }
}

/// Prints the error on standard output, as its only JSON object. A failure is ignored: the text is
/// also printed on standard error.
fn print_alone(error: &ErrorReport) {
    #[derive(Serialize)]
    struct Printed<'e> {
        error: &'e ErrorReport,
    }
    let _ = terminal::print_json(&Printed { error });
}

/// Prints an error, with `json` also on standard output, and returns the exit code.
pub(super) fn report(error: &CommandError, json: bool) -> ExitCode {
    match error {
        // The reader closed the pipe, as `head` does.
        CommandError::Output(error) if error.kind() == io::ErrorKind::BrokenPipe => {
            return ExitCode::SUCCESS;
        }
        CommandError::Failed { report, is_printed: false } if json => print_alone(report),
        _ => {}
    }
    terminal::error(error);
    ExitCode::from(error.code().exit())
}

/// Prints clap's help and version as results, and anything else as a usage error.
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
        print_alone(&ErrorReport::usage(text));
    }
    terminal::note(text.trim_end());
    ExitCode::from(ErrorCode::Usage.exit())
}

/// Returns whether the command line requests JSON, even if it is otherwise invalid.
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
    use super::*;

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
    fn a_staged_file_is_reported_by_its_final_path() {
        let staged =
            CommandError::usage("out/.stage/a.csv: no").about(Path::new("out/.stage/a.csv"));
        let report = staged.renamed(Path::new("out/.stage"), Path::new("out")).report();
        assert_eq!(report.to_string(), "out/a.csv: no");
        assert_eq!(report.file(), Some("out/a.csv".into()));
    }
}
