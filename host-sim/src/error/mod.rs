//! Errors as people and scripts see them: code, text, file and line. The command line and the Python
//! module report the library's errors in this one form.
//!
//! Every error type of the library that users can meet implements [`Reported`]: in `reported.rs`, or in the
//! module of the only command that reports it. This module itself knows no other.

mod code;

use std::fmt;
use std::path::{Path, PathBuf};

use serde::Serialize;

pub use code::ErrorCode;

/// An error with its code, as JSON reports it.
///
/// ```
/// use host_sim::error::{ErrorReport, Reported};
/// use host_sim::scenario::Scenario;
///
/// let error = Scenario::parse("mine.toml", "name = 'x'\ntimes = {}").unwrap_err();
/// let report = ErrorReport::of(&error);
/// assert_eq!(report.code().as_str(), "invalid-scenario");
/// assert_eq!(report.to_string(), error.to_string());
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct ErrorReport {
    code: ErrorCode,
    text: String,
    /// Path of the file concerned.
    file: Option<String>,
    /// Line in that file, from 1.
    line: Option<u64>,
}

/// An error that users can meet.
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

impl ErrorReport {
    /// Creates an error with this code.
    #[must_use]
    pub fn new(code: ErrorCode, text: impl Into<String>) -> Self {
        Self { code, text: text.into(), file: None, line: None }
    }

    /// Creates an error about the command line, or about the arguments of a function.
    #[must_use]
    pub fn usage(text: impl Into<String>) -> Self {
        Self::new(ErrorCode::Usage, text)
    }

    /// Reports an error of the library.
    #[must_use]
    pub fn of(error: &impl Reported) -> Self {
        let file = error.file().map(|file| file.display().to_string());
        Self { code: error.code(), text: error.to_string(), file, line: error.line() }
    }

    /// Sets the file concerned.
    #[must_use]
    pub fn about(mut self, path: &Path) -> Self {
        self.file = Some(path.display().to_string());
        self
    }

    /// Replaces the text by what `change` makes of it.
    #[must_use]
    pub fn reworded(mut self, change: impl FnOnce(&str) -> String) -> Self {
        self.text = change(&self.text);
        self
    }

    /// Replaces the file by what `change` makes of it.
    #[must_use]
    pub fn refiled(mut self, change: impl FnOnce(&str) -> String) -> Self {
        self.file = self.file.as_deref().map(change);
        self
    }
}

impl Reported for ErrorReport {
    fn code(&self) -> ErrorCode {
        self.code
    }

    fn file(&self) -> Option<PathBuf> {
        self.file.as_ref().map(PathBuf::from)
    }

    fn line(&self) -> Option<u64> {
        self.line
    }
}

impl fmt::Display for ErrorReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

impl std::error::Error for ErrorReport {}
