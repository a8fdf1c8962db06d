//! The file of a recording: complete lines, written soon after the samples arrive, so that they
//! survive a crash.
//!
//! Outer weights are written in the last line of each write; a reader uses the last ones. A failed
//! write is truncated, so that no partial line is left.

use std::fs::{File, OpenOptions};
use std::io::{BufRead, BufReader, ErrorKind, Read, Seek, SeekFrom, Write};
use std::os::unix::fs::FileTypeExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use crate::files::output::{OutputError, destination};
use crate::packages::RecordingSource;

/// How long a sample may be buffered.
const WAIT: Duration = Duration::from_millis(250);

/// Size of the buffer. \[byte\]
const WAITING_MAX: usize = 1 << 16;

/// Maximum length of a line when appending. \[byte\]
const LINE_MAX: u64 = 1 << 16;

/// Why recording failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RecordError {
    /// The file exists and is not empty.
    #[error(
        "{}: exists and is not empty; choose another file, or append to this recording with --append",
        path.display()
    )]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// The file cannot be used for this recording.
    #[error("{}: {problem}; choose another file", path.display())]
    Other {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        problem: String,
    },
    /// The file cannot be written.
    #[error(transparent)]
    Output(#[from] OutputError),
}

/// Columns of a line other than the time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Columns {
    dimension: usize,
    /// Number of outer weights.
    weights: usize,
}

/// A recording in progress.
#[derive(Debug)]
pub struct RecordFile {
    /// The path as given.
    path: PathBuf,
    /// The path with links resolved.
    place: PathBuf,
    file: File,
    /// Whether it is a regular file, which can be truncated.
    regular: bool,
    created: bool,
    /// Length up to the last complete line. \[byte\]
    length: u64,
    columns: Option<Columns>,
    head: String,
    /// Complete lines that are not yet written.
    waiting: Vec<u8>,
    /// The line of the newest sample, without outer weights.
    newest: Option<String>,
    last_time: Option<f64>,
    written: Instant,
}

impl RecordFile {
    /// Creates the file or opens an empty one; with `append`, also opens an earlier recording of
    /// the same agent.
    ///
    /// # Errors
    /// See [`RecordError`]; the file is then unchanged.
    pub fn open(path: &Path, append: bool, source: &RecordingSource) -> Result<Self, RecordError> {
        let failed = |error| OutputError::Write { path: path.to_owned(), error };
        let other = |problem: &str| RecordError::Other {
            path: path.to_owned(),
            problem: problem.to_owned(),
        };
        // Opening a pipe would wait for a reader.
        if std::fs::metadata(path).is_ok_and(|metadata| metadata.file_type().is_fifo()) {
            return Err(other("is a pipe, but a recording needs a file"));
        }
        // Follows links, also to missing files, and refuses disks.
        let place = destination(path)?.unwrap_or_else(|| path.to_owned());
        let mut options = OpenOptions::new();
        options.write(true);
        let (file, created) = match options.clone().create_new(true).read(true).open(&place) {
            Ok(file) => (file, true),
            Err(error) if error.kind() == ErrorKind::AlreadyExists => {
                (options.read(append).open(&place).map_err(failed)?, false)
            }
            Err(error) => return Err(failed(error).into()),
        };
        let metadata = file.metadata().map_err(failed)?;
        let mut opened = Self {
            path: path.to_owned(),
            place,
            regular: metadata.is_file(),
            file,
            created,
            length: 0,
            columns: None,
            head: source.head(),
            waiting: Vec::new(),
            newest: None,
            last_time: None,
            written: Instant::now(),
        };
        if opened.regular {
            if opened.file.try_lock().is_err() {
                return Err(other("another program is recording to it"));
            }
            match metadata.len() {
                0 => {}
                _ if append => opened.continue_from(source)?,
                _ => return Err(RecordError::Exists { path: path.to_owned() }),
            }
        }
        Ok(opened)
    }

    /// Reads an earlier recording, and removes a partial line at its end.
    fn continue_from(&mut self, source: &RecordingSource) -> Result<(), RecordError> {
        let path = self.path.clone();
        let failed = |error| OutputError::Write { path: path.clone(), error };
        let other = |problem: String| RecordError::Other { path: path.clone(), problem };
        let own = RecordingSource::read(&self.path).map_err(failed)?;
        if let (Some(own), Some(agent)) = (own.agent, source.agent)
            && own != agent
        {
            return Err(other(format!("is a recording of agent {own}, not of agent {agent}")));
        }
        if let (Some(own), Some(step)) = (own.step, source.step)
            && own as f32 != step as f32
        {
            return Err(other(format!("has a step of {own} s, but the node's is {step} s")));
        }
        let mut reader = BufReader::new(&self.file);
        let (mut line, mut length, mut columns, mut last_time) = (Vec::new(), 0, None, None);
        loop {
            line.clear();
            let read = (&mut reader).take(LINE_MAX).read_until(b'\n', &mut line).map_err(failed)?;
            if line.last() != Some(&b'\n') {
                if read as u64 == LINE_MAX {
                    return Err(other("has a line that is too long".to_owned()));
                }
                break;
            }
            length += read as u64;
            let text = String::from_utf8_lossy(&line);
            if text.starts_with('#') || text.trim().is_empty() {
                continue;
            }
            if columns.is_none() {
                columns =
                    Some(Columns::of_header(text.trim_end()).ok_or_else(|| {
                        other("not a recording of `host-sim monitor`".to_owned())
                    })?);
                continue;
            }
            let time = text.split(',').next().and_then(|time| time.parse::<f64>().ok());
            last_time = time.filter(|time| time.is_finite());
            if last_time.is_none() {
                return Err(other("has a line without a time".to_owned()));
            }
        }
        if columns.is_none() {
            return Err(other("not a recording of `host-sim monitor`".to_owned()));
        }
        self.file.set_len(length).map_err(failed)?;
        (self.length, self.columns, self.last_time) = (length, columns, last_time);
        Ok(())
    }

    /// Returns the number of state components, once there is a sample.
    #[must_use]
    pub fn dimension(&self) -> Option<usize> {
        self.columns.map(|columns| columns.dimension)
    }

    /// Returns the time of the last sample. \[s\]
    #[must_use]
    pub fn last_time(&self) -> Option<f64> {
        self.last_time
    }

    /// Adds a sample of finite numbers. The outer weights, row-major, apply to the whole recording.
    ///
    /// # Errors
    /// The system's error.
    pub fn push(
        &mut self,
        time: f64,
        estimate: &[f32],
        derivative: &[f32],
        outer_weights: &[f32],
    ) -> Result<(), RecordError> {
        if self.columns.is_none() {
            let columns = Columns { dimension: estimate.len(), weights: outer_weights.len() };
            self.columns = Some(columns);
            self.waiting.extend_from_slice(self.head.as_bytes());
            self.waiting.extend_from_slice(columns.header().as_bytes());
        }
        self.end_line(&[]);
        let mut number = ryu::Buffer::new();
        let mut line = number.format(time).to_owned();
        for &value in estimate.iter().chain(derivative) {
            line.push(',');
            line.push_str(number.format(f64::from(value)));
        }
        (self.newest, self.last_time) = (Some(line), Some(time));
        if self.waiting.len() >= WAITING_MAX { self.flush(outer_weights) } else { Ok(()) }
    }

    /// Completes the newest line with these outer weights, or with empty fields.
    fn end_line(&mut self, outer_weights: &[f32]) {
        let (Some(line), Some(columns)) = (self.newest.take(), self.columns) else { return };
        self.waiting.extend_from_slice(line.as_bytes());
        let fits = outer_weights.len() == columns.weights;
        let mut number = ryu::Buffer::new();
        for index in 0..columns.weights {
            self.waiting.push(b',');
            if let Some(&weight) = outer_weights.get(index).filter(|_| fits) {
                self.waiting.extend_from_slice(number.format(weight).as_bytes());
            }
        }
        self.waiting.push(b'\n');
    }

    /// Writes buffered lines if they are due.
    ///
    /// # Errors
    /// The system's error.
    pub fn flush_if_due(&mut self, outer_weights: &[f32]) -> Result<(), RecordError> {
        if self.written.elapsed() >= WAIT { self.flush(outer_weights) } else { Ok(()) }
    }

    fn flush(&mut self, outer_weights: &[f32]) -> Result<(), RecordError> {
        self.written = Instant::now();
        self.end_line(outer_weights);
        if self.waiting.is_empty() {
            return Ok(());
        }
        let waiting = std::mem::take(&mut self.waiting);
        let write = || -> std::io::Result<()> {
            if self.regular {
                self.file.seek(SeekFrom::Start(self.length))?;
            }
            self.file.write_all(&waiting)
        };
        let mut write = write;
        if let Err(error) = write() {
            if self.regular {
                // Best effort: otherwise a partial line is left.
                let _ = self.file.set_len(self.length);
            }
            return Err(OutputError::Write { path: self.path.clone(), error }.into());
        }
        self.length += waiting.len() as u64;
        Ok(())
    }

    /// Writes the remaining lines and syncs the file. An empty file is removed on drop.
    ///
    /// # Errors
    /// The system's error.
    pub fn finish(&mut self, outer_weights: &[f32]) -> Result<(), RecordError> {
        self.flush(outer_weights)?;
        if self.regular {
            // Some file systems report a full disk only here.
            let synced = self.file.sync_data();
            synced.map_err(|error| OutputError::Write { path: self.path.clone(), error })?;
        }
        Ok(())
    }
}

impl Drop for RecordFile {
    fn drop(&mut self) {
        if self.created && self.regular && self.length == 0 {
            // Best effort: an empty file is harmless.
            let _ = std::fs::remove_file(&self.place);
        }
    }
}

impl Columns {
    fn header(self) -> String {
        let Self { dimension: n, weights } = self;
        let mut names = vec!["time [s]".to_owned()];
        names.extend((1..=n).map(|c| format!("xhat{c} [state unit]")));
        names.extend((1..=n).map(|c| format!("dxhat{c} [state unit/s]")));
        names.extend((0..weights).map(|i| format!("w{}_{}", i / n + 1, i % n + 1)));
        names.join(",") + "\n"
    }

    fn of_header(header: &str) -> Option<Self> {
        let count = |stem: &str| header.split(',').filter(|name| name.starts_with(stem)).count();
        let columns = Self { dimension: count("xhat"), weights: count("w") };
        (columns.dimension > 0 && columns.header().trim_end() == header).then_some(columns)
    }
}
