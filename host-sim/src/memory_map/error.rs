//! Memory map errors: what is wrong, where, and how to fix it.

/// Why a memory map cannot be used. Formatted as one line: file, line, name, problem and hint.
///
/// `memory.x:25: WEIGHTS: ORIGIN is 0x100000000, which is not a 32-bit address; use an address
/// below 0x100000000`
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct MemoryMapError {
    /// The file, as the user named it.
    pub file: String,
    /// The line, from 1; `None` if the file cannot be read or the name does not appear in it.
    pub line: Option<usize>,
    /// The region, symbol or statement.
    pub name: Option<String>,
    /// What is wrong.
    pub problem: String,
    /// How to fix it.
    pub hint: String,
}

impl core::fmt::Display for MemoryMapError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "{}", self.file)?;
        if let Some(line) = self.line {
            write!(f, ":{line}")?;
        }
        if let Some(name) = &self.name {
            write!(f, ": {name}")?;
        }
        write!(f, ": {}; {}", self.problem, self.hint)
    }
}

impl core::error::Error for MemoryMapError {}

/// An error without the file name, which the reader does not know.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Fault {
    pub(super) line: usize,
    pub(super) name: Option<String>,
    pub(super) problem: String,
    pub(super) hint: String,
}

impl Fault {
    pub(super) fn new(line: usize, problem: impl Into<String>, hint: impl Into<String>) -> Self {
        Self { line, name: None, problem: problem.into(), hint: hint.into() }
    }

    /// Adds `name`, unless the error already has a more specific one.
    pub(super) fn about(mut self, name: &str) -> Self {
        self.name.get_or_insert_with(|| name.to_owned());
        self
    }

    pub(super) fn within(self, file: &str) -> MemoryMapError {
        MemoryMapError {
            file: file.to_owned(),
            line: Some(self.line),
            name: self.name,
            problem: self.problem,
            hint: self.hint,
        }
    }
}
