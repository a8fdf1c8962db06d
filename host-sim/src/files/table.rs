//! CSV tables.
//!
//! The first line has the name and unit of every column. Numbers have the fewest digits that read
//! back as the same bits.

use std::io::{self, Write};
use std::path::Path;

use super::output::{FileKind, OutputError, write_result};

/// A line of a CSV file in progress.
pub struct Row<'a> {
    writer: csv::Writer<&'a mut dyn Write>,
    float: ryu::Buffer,
}

impl Row<'_> {
    /// Writes an integer.
    ///
    /// # Errors
    /// The error of the file, as for all methods here.
    pub fn integer(&mut self, value: u64) -> io::Result<()> {
        self.text(&value.to_string())
    }

    /// Writes a number in double precision; non-finite numbers become `NaN`, `inf` or `-inf`, which
    /// CSV readers understand.
    ///
    /// # Errors
    /// Same as [`Row::integer`].
    pub fn double(&mut self, value: f64) -> io::Result<()> {
        Ok(self.writer.write_field(self.float.format(value))?)
    }

    /// Writes a number in single precision.
    ///
    /// # Errors
    /// Same as [`Row::integer`].
    pub fn single(&mut self, value: f32) -> io::Result<()> {
        Ok(self.writer.write_field(self.float.format(value))?)
    }

    /// Writes a number, or an empty field.
    ///
    /// # Errors
    /// Same as [`Row::integer`].
    pub fn optional(&mut self, value: Option<f64>) -> io::Result<()> {
        match value {
            Some(value) => self.double(value),
            None => self.text(""),
        }
    }

    /// Writes a word, quoted if necessary.
    ///
    /// # Errors
    /// Same as [`Row::integer`].
    pub fn text(&mut self, value: &str) -> io::Result<()> {
        Ok(self.writer.write_field(value)?)
    }
}

/// Writes a CSV file: a header, and one line per item with the fields that `write` adds.
///
/// # Errors
/// If the file cannot be written, or a line and the header differ in the number of fields.
pub fn write_table<T>(
    path: &Path,
    header: &[impl AsRef<[u8]>],
    items: impl Iterator<Item = T>,
    mut write: impl FnMut(&mut Row<'_>, T) -> io::Result<()>,
) -> Result<(), OutputError> {
    write_result(path, FileKind::TABLE, |file| {
        let writer = csv::WriterBuilder::new().buffer_capacity(1 << 16).from_writer(file);
        let mut row = Row { writer, float: ryu::Buffer::new() };
        row.writer.write_record(header)?;
        for item in items {
            write(&mut row, item)?;
            row.writer.write_record(None::<&[u8]>)?;
        }
        row.writer.flush()
    })
}
