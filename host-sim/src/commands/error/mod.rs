//! Errors of commands: code, text, file and line, for people and scripts.
//!
//! Library errors are converted through [`Reported`], which is implemented in `library` or in the
//! module of the only command that reports the error.

mod code;
mod library;

use std::ffi::OsString;
use std::fmt;
use std::io;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use agent_core::package::Refusal;
use serde::Serialize;

pub use code::ErrorCode;

use crate::packages::refusal::{hint, kind};
use crate::terminal;

/// Why a command failed.
#[derive(Debug)]
pub enum CommandError {
    /// The command line or a file it names is invalid or refused: exit code 2.
    BadInput(Box<ErrorReport>),
    /// Any other failure: exit code 1.
    Failed(Box<ErrorReport>),
    /// Standard output cannot be written: exit code 1.
    Output(io::Error),
}

/// An error in the JSON report.
#[derive(Clone, Debug, Serialize)]
pub struct ErrorReport {
    code: ErrorCode,
    text: String,
    /// Path of the file concerned.
    file: Option<String>,
    /// Line in that file, from 1.
    line: Option<u64>,
    /// Whether an already printed result contains this error.
    #[serde(skip)]
    printed: bool,
}

/// An error of the library that commands report.
pub trait Reported: fmt::Display {
    /// Returns the error's code.
    fn code(&self) -> ErrorCode;

    /// Returns the path of the file concerned.
    fn file(&self) -> Option<PathBuf> {
        None
    }

    /// Returns the line in that file, from 1.
    fn line(&self) -> Option<u64> {
        None
    }
}

impl<E: Reported> From<E> for CommandError {
    fn from(error: E) -> Self {
        let file = error.file().map(|file| file.display().to_string());
        ErrorReport {
            file,
            line: error.line(),
            ..ErrorReport::new(error.code(), error.to_string())
        }
        .into_error()
    }
}

impl ErrorReport {
    fn new(code: ErrorCode, text: String) -> Self {
        Self { code, text, file: None, line: None, printed: false }
    }

    fn into_error(self) -> CommandError {
        match self.code.exit() {
            2 => CommandError::BadInput(Box::new(self)),
            _ => CommandError::Failed(Box::new(self)),
        }
    }

    /// Prints the error on standard output, as its only JSON object. A failure is ignored: the text
    /// is also printed on standard error.
    fn print(self) {
        #[derive(Serialize)]
        struct Printed {
            error: ErrorReport,
        }
        let _ = terminal::print_json(&Printed { error: self });
    }
}

impl CommandError {
    /// Creates an error with this code.
    pub(super) fn new(code: ErrorCode, text: impl Into<String>) -> Self {
        ErrorReport::new(code, text.into()).into_error()
    }

    /// Creates an error about the command line.
    pub(super) fn usage(text: impl Into<String>) -> Self {
        Self::new(ErrorCode::Usage, text)
    }

    /// Creates an error about the package at `path`, which a node would refuse.
    pub(super) fn refused(path: &Path, refusal: &Refusal) -> Self {
        Self::unfit(path, &refusal.to_string(), hint(kind(refusal)))
    }

    /// Creates an error about the package at `path`, which a node would refuse for this reason.
    pub(super) fn unfit(path: &Path, refusal: &str, hint: &str) -> Self {
        let path_shown = path.display();
        let text = format!("{path_shown}: a node would refuse it: {refusal}; {hint}");
        Self::new(ErrorCode::PackageRefused, text).about(path)
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
            format!("{path_shown}: cannot read: {error}; run the command that wrote it again");
        Self::new(ErrorCode::Results, text).about(path)
    }

    /// Sets the file concerned.
    pub(super) fn about(mut self, path: &Path) -> Self {
        if let Self::BadInput(report) | Self::Failed(report) = &mut self {
            report.file = Some(path.display().to_string());
        }
        self
    }

    /// Prepends `prefix` to the text.
    pub(super) fn within(mut self, prefix: &str) -> Self {
        if let Self::BadInput(report) | Self::Failed(report) = &mut self {
            report.text = format!("{prefix}: {}", report.text);
        }
        self
    }

    /// Marks the error as part of a result that is already printed.
    pub(super) fn printed(mut self) -> Self {
        if let Self::BadInput(report) | Self::Failed(report) = &mut self {
            report.printed = true;
        }
        self
    }

    /// Replaces the folder `from` with `to` in text and file.
    pub(super) fn renamed(mut self, from: &Path, to: &Path) -> Self {
        if let Self::BadInput(report) | Self::Failed(report) = &mut self {
            // With a trailing separator, except for an empty path.
            let shown = |folder: &Path| folder.join("").display().to_string();
            let (from, to) = (shown(from), shown(to));
            report.text = report.text.replace(&from, &to);
            report.file = report.file.take().map(|file| file.replace(&from, &to));
        }
        self
    }

    /// Returns the error's code.
    pub(super) fn code(&self) -> ErrorCode {
        match self {
            Self::BadInput(report) | Self::Failed(report) => report.code,
            Self::Output(_) => ErrorCode::StandardOutput,
        }
    }

    /// Returns the error in its JSON form.
    pub(super) fn report(&self) -> ErrorReport {
        match self {
            Self::BadInput(report) | Self::Failed(report) => (**report).clone(),
            Self::Output(_) => ErrorReport::new(self.code(), self.to_string()),
        }
    }
}

impl fmt::Display for CommandError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::BadInput(report) | Self::Failed(report) => f.write_str(&report.text),
            Self::Output(error) => write!(f, "cannot write to standard output: {error}"),
        }
    }
}

/// Prints an error, with `json` also on standard output, and returns the exit code.
pub(super) fn report(error: &CommandError, json: bool) -> ExitCode {
    match error {
        // The reader closed the pipe, as `head` does.
        CommandError::Output(error) if error.kind() == io::ErrorKind::BrokenPipe => {
            return ExitCode::SUCCESS;
        }
        CommandError::BadInput(report) | CommandError::Failed(report)
            if json && !report.printed =>
        {
            (**report).clone().print();
        }
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
        ErrorReport::new(ErrorCode::Usage, text).print();
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
    fn the_kind_follows_the_exit_code() {
        for &code in ErrorCode::ALL {
            let bad_input = matches!(CommandError::new(code, ""), CommandError::BadInput(_));
            assert_eq!(bad_input, code.exit() == 2, "{}", code.as_str());
        }
    }

    #[test]
    fn a_staged_file_is_reported_by_its_final_path() {
        let staged =
            CommandError::usage("out/.stage/a.csv: no").about(Path::new("out/.stage/a.csv"));
        let report = staged.renamed(Path::new("out/.stage"), Path::new("out")).report();
        assert_eq!((&*report.text, report.file.as_deref()), ("out/a.csv: no", Some("out/a.csv")));
    }
}
