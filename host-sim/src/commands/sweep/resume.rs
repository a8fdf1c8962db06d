//! Finds where an interrupted `results.csv` ends.
//!
//! The file must begin with exactly the rows that the study writes first. A last line without an
//! end, and the rows of a run that is not complete, are cut off.

use std::fs::{File, OpenOptions};
use std::io::{self, BufRead, BufReader, Seek, SeekFrom, Write};
use std::path::Path;

use super::results;
use crate::commands::{CommandError, ErrorCode};
use crate::files::output::{OutputError, destination};
use crate::files::text::LINE_MAX;

/// How the rows of a study begin.
pub(super) trait Expected {
    /// Returns the first line of the file; `None` for a part without one.
    fn header(&self) -> Option<String>;

    /// Returns the number of columns after `agent`.
    fn measured(&self) -> usize;

    /// Returns the starts of the rows of a run; `None` after the last run.
    fn rows(&self, run: u64) -> Option<Vec<String>>;
}

/// Opens the results of a study at the end of its last complete run, or creates the file. Returns the
/// number of complete runs, counted from `first`.
pub(super) fn open(
    path: &Path,
    first: u64,
    expected: &impl Expected,
) -> Result<(File, u64), CommandError> {
    let failed =
        |error: io::Error| CommandError::from(OutputError::Write { path: path.to_owned(), error });
    if path.exists() && !path.is_file() {
        destination(path)?;
        let what = "a folder or a device";
        return Err(OutputError::NotAFile { path: path.to_owned(), what }.into());
    }
    let mut file = OpenOptions::new()
        .read(true)
        .write(true)
        .create(true)
        .truncate(false)
        .open(path)
        .map_err(failed)?;
    let mut reader = BufReader::new(&mut file);
    let (mut end, mut line, mut number) = (0, String::new(), 0u64);
    let refused = |number: u64, problem: &str| {
        let text = format!(
            "{}:{number}: {problem}; remove the file to start over, or choose another folder with --out",
            path.display()
        );
        CommandError::new(ErrorCode::OutputRefused, text).about(path)
    };
    let mut missing_header = expected.header();
    if let Some(header) = &missing_header
        && next_line(&mut reader, &mut line).map_err(|error| unreadable(path, &error))?
    {
        number += 1;
        if line != *header {
            return Err(refused(number, "the columns are not those of this study"));
        }
        end += line.len() as u64;
        missing_header = None;
    }
    let mut run = first;
    'runs: while let Some(rows) = expected.rows(run) {
        let mut length = 0;
        for start in rows {
            if !next_line(&mut reader, &mut line).map_err(|error| unreadable(path, &error))? {
                break 'runs;
            }
            number += 1;
            if !is_row(&line, &start, expected.measured()) {
                let problem = format!("expected a row that starts with {start}");
                return Err(refused(number, &problem));
            }
            length += line.len() as u64;
        }
        end += length;
        run += 1;
    }
    if expected.rows(run).is_none()
        && next_line(&mut reader, &mut line).map_err(|error| unreadable(path, &error))?
    {
        return Err(refused(number + 1, "there are more rows than the study has"));
    }
    drop(reader);
    file.set_len(end).map_err(failed)?;
    file.seek(SeekFrom::Start(end)).map_err(failed)?;
    if let Some(header) = missing_header {
        file.write_all(header.as_bytes()).map_err(failed)?;
    }
    Ok((file, run - first))
}

/// Reads a line with its end; `false` at the end of the file, or if the line has no end.
pub(super) fn next_line(reader: &mut impl BufRead, line: &mut String) -> io::Result<bool> {
    line.clear();
    let mut bytes = Vec::new();
    let limit = LINE_MAX as u64;
    if io::Read::take(&mut *reader, limit).read_until(b'\n', &mut bytes)? as u64 == limit {
        return Err(io::Error::new(io::ErrorKind::InvalidData, "a line is too long"));
    }
    line.push_str(&String::from_utf8_lossy(&bytes));
    Ok(line.ends_with('\n'))
}

fn is_row(line: &str, start: &str, measured: usize) -> bool {
    line.starts_with(start) && row_start(line, measured) == Some(start)
}

/// Returns the start of a row with this many measured columns, up to the comma before them.
pub(super) fn row_start(line: &str, measured: usize) -> Option<&str> {
    let line = line.trim_end_matches('\n');
    let (comma, _) = line.rmatch_indices(',').nth(measured.checked_sub(1)?)?;
    let has_end = line.ends_with(",true") || line.ends_with(",false");
    has_end.then(|| &line[..=comma])
}

pub(super) fn unreadable(path: &Path, error: &io::Error) -> CommandError {
    let text =
        format!("{}: cannot be read: {error}; choose another folder with --out", path.display());
    CommandError::new(ErrorCode::OutputFailed, text).about(path)
}

/// Whether a file looks like results that `study` does not know about.
pub(super) fn is_foreign(path: &Path) -> bool {
    path.symlink_metadata().is_ok() && !results::KIND.replaces(path)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    /// Three runs of two agents each.
    struct Three;

    impl Expected for Three {
        fn header(&self) -> Option<String> {
            Some("h,seed\n".to_owned())
        }

        fn measured(&self) -> usize {
            5
        }

        fn rows(&self, run: u64) -> Option<Vec<String>> {
            (run < 3).then(|| (1..=2).map(|agent| format!("{run},{agent},")).collect())
        }
    }

    const WHOLE: &str = "h,seed\n0,1,1,2,3,4,false\n0,2,1,2,3,4,false\n1,1,,,,,true\n1,2,,,,,true\n\
                         2,1,1,2,3,4,false\n2,2,1,2,3,4,false\n";

    fn with(name: &str, text: &str) -> Result<(String, u64), String> {
        let path = std::env::temp_dir().join(format!("host-sim-{name}-{}", std::process::id()));
        fs::write(&path, text).unwrap();
        let opened = open(&path, 0, &Three);
        let left = fs::read_to_string(&path).unwrap();
        fs::remove_file(&path).unwrap();
        opened.map(|(_, runs)| (left, runs)).map_err(|error| error.to_string())
    }

    #[test]
    fn every_prefix_is_cut_to_complete_runs() {
        for length in 0..=WHOLE.len() {
            let (left, runs) = with("prefix", &WHOLE[..length]).unwrap();
            let lines = WHOLE[..length].matches('\n').count() as u64;
            assert_eq!(runs, lines.saturating_sub(1) / 2, "{length}");
            let expected: Vec<&str> =
                WHOLE.split_inclusive('\n').take(1 + 2 * runs as usize).collect();
            assert_eq!(left, expected.concat(), "{length}");
        }
    }

    #[test]
    fn other_content_is_refused_and_stays() {
        for (text, problem) in [
            ("a,b\n", ":1: the columns"),
            ("h,seed\n0,2,1,2,3,4,false\n", ":2: expected a row that starts with 0,1,"),
            ("h,seed\n0,1,1,2,3,false\n", ":2: expected a row"),
            ("h,seed\n0,1,1,2,3,4,perhaps\n", ":2: expected a row"),
        ] {
            let error = with("other", text).unwrap_err();
            assert!(error.contains(problem), "{error}");
        }
        let error = with("more", &format!("{WHOLE}more\n")).unwrap_err();
        assert!(error.contains(":8: there are more rows"), "{error}");
    }
}
