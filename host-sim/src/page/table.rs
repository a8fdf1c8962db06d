//! Fields of small tables.

use std::path::Path;
use std::str::FromStr;

use csv::StringRecord;

use super::TableError;
use crate::files::text;

/// A row of the table at a path.
pub(super) struct Row<'r> {
    path: &'r Path,
    record: StringRecord,
}

impl Row<'_> {
    fn text(&self, column: usize) -> &str {
        self.record.get(column).unwrap_or_default()
    }

    /// Returns the error that the field is not what was expected.
    pub(super) fn wrong(&self, column: usize, expected: &'static str) -> TableError {
        TableError::Field {
            path: self.path.to_owned(),
            line: self.record.position().map_or(0, csv::Position::line),
            field: self.text(column).to_owned(),
            expected,
        }
    }

    pub(super) fn number<T: FromStr>(&self, column: usize) -> Result<T, TableError> {
        self.text(column).parse().map_err(|_| self.wrong(column, "a number"))
    }

    /// Returns a number, or NaN of an empty field.
    pub(super) fn optional(&self, column: usize) -> Result<f64, TableError> {
        if self.text(column).is_empty() { Ok(f64::NAN) } else { self.number(column) }
    }
}

/// Calls `take` with each row of the table at `path`, until it returns `false`.
///
/// # Errors
/// If the file cannot be read as CSV, or `take` fails.
pub(super) fn each_row(
    path: &Path,
    mut take: impl FnMut(&Row<'_>) -> Result<bool, TableError>,
) -> Result<(), TableError> {
    let failed = |error| TableError::Read { path: path.to_owned(), error };
    let (_, content) = text::open(path).map_err(|error| failed(error.into()))?;
    let mut reader = csv::Reader::from_reader(content);
    for record in reader.records() {
        if !take(&Row { path, record: record.map_err(failed)? })? {
            break;
        }
    }
    Ok(())
}
