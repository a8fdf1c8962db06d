//! `.results-before.csv`: the rows of a study that is being extended.
//!
//! More seeds or initial states put rows between the existing ones. So these are set aside in a file
//! of their own, and `results.csv` is written once more from its first row: each run whose rows are
//! known takes them from there. The file is removed when the study is complete. It is written before
//! anything else changes, so no row is lost if the command ends at any moment.

use std::collections::BTreeMap;
use std::fs;
use std::io::{self, BufReader};
use std::path::Path;

use super::results;
use super::resume::{Expected, next_line, row_start, unreadable};
use crate::commands::{CommandError, ErrorCode};
use crate::files::output::{OutputError, write_result, write_whole};

/// Name of the file.
pub(super) const NAME: &str = ".results-before.csv";

/// Rows by how they begin, up to the number of the agent.
#[derive(Debug, Default)]
pub(super) struct Earlier {
    rows: BTreeMap<String, String>,
}

impl Earlier {
    /// Sets the rows in `folder` aside, and leaves only the header in `results.csv`.
    pub(super) fn set_aside(folder: &Path, expected: &impl Expected) -> Result<(), CommandError> {
        let mut earlier = Self::read(folder, expected)?;
        let file = folder.join(results::NAME);
        earlier.add(&file, expected)?;
        let header = expected.header().unwrap_or_default();
        write_whole(&folder.join(NAME), results::KIND, |file| {
            file.write_all(header.as_bytes())?;
            earlier.rows.values().try_for_each(|row| file.write_all(row.as_bytes()))
        })?;
        Ok(write_result(&file, results::KIND, |file| file.write_all(header.as_bytes()))?)
    }

    /// Reads the rows that were set aside in `folder`, if there are any.
    pub(super) fn read(folder: &Path, expected: &impl Expected) -> Result<Self, CommandError> {
        let mut earlier = Self::default();
        earlier.add(&folder.join(NAME), expected)?;
        Ok(earlier)
    }

    /// Removes the file.
    pub(super) fn remove(folder: &Path) -> Result<(), OutputError> {
        let path = folder.join(NAME);
        match fs::remove_file(&path) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => {
                Err(OutputError::Write { path, error })
            }
            _ => Ok(()),
        }
    }

    /// Whether no row is known.
    pub(super) fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// Returns the rows of a run that begin like this, if all are known.
    pub(super) fn rows(&self, starts: &[String]) -> Option<String> {
        starts.iter().map(|start| self.rows.get(start).map(String::as_str)).collect()
    }

    /// Adds the complete rows of a table, which may be missing.
    fn add(&mut self, path: &Path, expected: &impl Expected) -> Result<(), CommandError> {
        let failed = |error: io::Error| unreadable(path, &error);
        let file = match fs::File::open(path) {
            Ok(file) => file,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
            Err(error) => return Err(failed(error)),
        };
        let (mut reader, mut line) = (BufReader::new(file), String::new());
        let has_header = next_line(&mut reader, &mut line).map_err(failed)?;
        if has_header && Some(&line) != expected.header().as_ref() {
            return Err(refused(path, 1, "the columns are not those of this study"));
        }
        let mut number = 1;
        while has_header && next_line(&mut reader, &mut line).map_err(failed)? {
            number += 1;
            let start = row_start(&line, expected.measured())
                .ok_or_else(|| refused(path, number, "expected a row of results"))?;
            self.rows.insert(start.to_owned(), line.clone());
        }
        Ok(())
    }
}

fn refused(path: &Path, line: u64, problem: &str) -> CommandError {
    let text = format!(
        "{}:{line}: {problem}; remove the file to discard its rows, or choose another folder with --out",
        path.display()
    );
    CommandError::new(ErrorCode::OutputRefused, text).about(path)
}
