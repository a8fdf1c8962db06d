//! Examines the header of a sample file before it is parsed: the separator of its columns.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Seek, SeekFrom};
use std::path::Path;

use crate::files::text::Refusal;

/// Returns the first line that is neither blank nor a comment.
pub(super) fn first_line(head: &[u8]) -> String {
    let text = head.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(head);
    let lines = text.split(|byte| matches!(byte, b'\n' | b'\r')).map(<[u8]>::trim_ascii);
    let first = lines.into_iter().find(|line| !line.is_empty() && !line.starts_with(b"#"));
    String::from_utf8_lossy(first.unwrap_or_default()).into_owned()
}

/// Returns the separator of a header with at least three columns.
///
/// # Errors
/// If columns are separated by spaces, which is not supported.
pub(super) fn delimiter(header: &str) -> Result<u8, Refusal> {
    let columns = |delimiter: u8| {
        let mut reader = csv::ReaderBuilder::new()
            .has_headers(false)
            .delimiter(delimiter)
            .from_reader(header.as_bytes());
        reader.records().next().and_then(Result::ok).map_or(0, |record| record.len())
    };
    // A unit or note may contain a comma, so the separator with the most columns is chosen.
    let best = [b',', b';', b'\t', b'|'].into_iter().max_by_key(|&d| (columns(d), d == b','));
    match best.filter(|&delimiter| columns(delimiter) >= 3) {
        Some(delimiter) => Ok(delimiter),
        None if header.split_whitespace().count() >= 3 => Err((
            "columns are separated by spaces".to_owned(),
            "separate columns with commas, semicolons or tabs".to_owned(),
        )),
        // The missing columns are reported by name later.
        None => Ok(b','),
    }
}

/// Returns the line, from 1, of the record that follows `byte`, on `line`, after blank lines and
/// comments. Returns `line` if the file cannot be read a second time.
pub(super) fn line_of(path: &Path, byte: u64, line: u64) -> u64 {
    let blanks = || -> io::Result<u64> {
        // Opening a named pipe again would wait for another writer.
        if !std::fs::metadata(path)?.is_file() {
            return Ok(0);
        }
        let mut file = File::open(path)?;
        file.seek(SeekFrom::Start(byte))?;
        let mut reader = BufReader::new(file);
        let (mut blanks, mut after_return, mut in_comment) = (0, false, false);
        loop {
            let Some(&next) = reader.fill_buf()?.first() else { return Ok(blanks) };
            match next {
                b'\r' => blanks += 1,
                b'\n' => blanks += u64::from(!after_return),
                b'#' => in_comment = true,
                _ if in_comment => {}
                _ => return Ok(blanks),
            }
            in_comment &= !matches!(next, b'\r' | b'\n');
            after_return = next == b'\r';
            reader.consume(1);
        }
    };
    line + blanks().unwrap_or(0)
}
