//! Recorded samples `(x_hat, d/dt x_hat)` of one agent, in memory and as a CSV file: what a
//! network is trained on, whether a simulated agent recorded it or a real one.
//!
//! | column | what |
//! | --- | --- |
//! | `time [s]` | when, at a fixed interval; where samples are missing, the recording has a gap; `[ms]`, `[us]`, `[ns]`, `[min]`, `[h]` are converted, without a unit it is seconds |
//! | `xhat1` .. | the estimate, one column a component |
//! | `dxhat1` .. | its derivative |
//! | `w1_1` .. (may be left out) | `W_hat`, row (feature) and column (component); where rows leave them empty, the last that does not counts |
//!
//! Lines that begin with `#` are comments; at the head of a file they say where it comes from
//! ([`super::recording_source`]). Units stand behind the names, as in `time (ms)`, `time_ms`, `xhat1 [V]`; only that of time is
//! converted, and one that is not known is refused. Columns can come in any order, separated by
//! commas, semicolons, tabs or bars, and others are ignored.

mod columns;
mod source;
mod timing;

use std::path::{Path, PathBuf};

use crate::files::input::is_too_large;
use crate::files::output::OutputError;
use crate::files::table::write_table;
use crate::training::{DataError, Dataset};
use columns::Columns;
pub use timing::Timing;
use timing::timing;

/// Samples of one agent, and what belongs to them.
#[derive(Clone, Debug, PartialEq)]
pub struct Recording {
    /// `(x_hat, d/dt x_hat)` as recorded, in the order of time.
    pub samples: Dataset,
    /// Where a gap precedes a sample: its index. Between gaps samples are equidistant.
    pub gaps: Vec<usize>,
    /// When the first was taken. \[s\]
    pub start: f64,
    /// Time between two samples. \[s\]
    pub interval: f64,
    /// What is missing in the gaps, and how regular the rest is.
    pub timing: Timing,
    /// `W_hat` that the network is to be trained for, row by row, shape `[L, n]`; `None` if the
    /// recording does not have it.
    pub outer_weights: Option<Vec<f32>>,
}

/// Why a file of samples cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("{}{}: {problem}; {hint}", path.display(), line.map_or(String::new(), |l| format!(":{l}")))]
pub struct RecordingError {
    /// The file.
    pub path: PathBuf,
    /// Line, from 1, if it is about one.
    pub line: Option<u64>,
    /// What is wrong.
    pub problem: String,
    /// What to do about it.
    pub hint: String,
}

/// From here on, a time without a unit is the Unix time of another unit than the second. \[s\]
const UNIX_SECONDS_MAX: f64 = 1e11;

/// A longer gap counts as one of so many samples: more than any window has, and few enough that
/// the ticks of a million such gaps are still counts.
const MISSING_MAX: u64 = 1 << 40;

impl Recording {
    /// The samples between gaps, one data set for each piece.
    ///
    /// # Panics
    /// If a gap is not inside the samples; a loaded recording's are.
    pub fn pieces(&self) -> impl Iterator<Item = Dataset> + '_ {
        let starts = [0].into_iter().chain(self.gaps.iter().copied());
        let ends = self.gaps.iter().copied().chain([self.samples.len()]);
        starts
            .zip(ends)
            .filter_map(|(start, end)| self.samples.select(&(start..end).collect::<Vec<_>>()))
    }

    /// Writes the samples as a CSV file.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn save(&self, path: &Path) -> Result<(), OutputError> {
        let weights = self.outer_weights.as_deref().unwrap_or(&[]);
        let time = |index| self.start + index as f64 * self.interval;
        write_samples(path, &self.samples, time, weights)
    }

    /// Reads samples of an agent with `dimension` state components and, if there is a network,
    /// `features` features.
    ///
    /// # Errors
    /// The first thing that is wrong, with file, line and hint.
    pub fn load(path: &Path, dimension: usize, features: usize) -> Result<Self, RecordingError> {
        let wrong = |line: Option<u64>, problem: String, hint: &str| RecordingError {
            path: path.to_owned(),
            line,
            problem,
            hint: hint.to_owned(),
        };
        let (head, content) = source::open(path).map_err(|error| {
            wrong(None, format!("cannot be read: {error}"), "give the path of a CSV file")
        })?;
        source::check_text(&head).map_err(|(problem, hint)| wrong(None, problem, &hint))?;
        let delimiter = source::delimiter(&source::first_line(&head))
            .map_err(|(problem, hint)| wrong(Some(1), problem, &hint))?;
        let mut reader = csv::ReaderBuilder::new()
            .delimiter(delimiter)
            .trim(csv::Trim::All)
            .comment(Some(b'#'))
            .from_reader(content);
        let unreadable = |at: &csv::Position, error: &csv::Error| {
            let line = Some(source::line_of(path, at.byte(), at.line()));
            match error.kind() {
                csv::ErrorKind::UnequalLengths { expected_len, len, .. } => wrong(
                    line,
                    format!("has {len} fields, the header {expected_len}"),
                    "give every line as many fields as the header",
                ),
                csv::ErrorKind::Io(error) if is_too_large(error) => wrong(
                    None,
                    format!("cannot be read: {error}"),
                    "record less, or save it to files of less than 4 GiB with a line for each sample",
                ),
                _ => wrong(line, format!("cannot be read: {error}"), "write lines of a CSV file"),
            }
        };
        let start = reader.position().clone();
        let headers = reader.byte_headers().map_err(|error| unreadable(&start, &error))?;
        let headers: Vec<String> =
            headers.iter().map(|name| String::from_utf8_lossy(name).into_owned()).collect();
        let header_line = source::line_of(path, 0, 1);
        let columns = Columns::find(&headers, dimension, features)
            .map_err(|(problem, hint)| wrong(Some(header_line), problem, &hint))?;
        let (mut times, mut inputs, mut targets) = (Vec::new(), Vec::new(), Vec::new());
        let mut outer_weights = None;
        let (mut record, mut repeated) = (csv::ByteRecord::new(), 0);
        loop {
            let at = reader.position().clone();
            if !reader.read_byte_record(&mut record).map_err(|error| unreadable(&at, &error))? {
                break;
            }
            let line = || Some(source::line_of(path, at.byte(), at.line()));
            let number = |column: usize| -> Result<f64, RecordingError> {
                let bytes = record.get(column).unwrap_or_default();
                let number = std::str::from_utf8(bytes).ok().and_then(|text| text.parse().ok());
                number.filter(|value: &f64| value.is_finite()).ok_or_else(|| {
                    let text = String::from_utf8_lossy(bytes);
                    let hint = number_hint(&text, column == columns.time);
                    wrong(line(), format!("{:?} is {text:?}", headers[column]), hint)
                })
            };
            let time = number(columns.time)?;
            if columns.time_scale.is_none() && time.abs() > UNIX_SECONDS_MAX {
                return Err(wrong(
                    line(),
                    format!("the time {time:e} s is not one since 1970"),
                    "write its unit into the header, as in `time [ms]`",
                ));
            }
            let time = columns.time_scale.map_or(time, |scale| scaled(time, scale));
            let first = inputs.len();
            for &column in &columns.estimate {
                inputs.push(number(column)?);
            }
            for &column in &columns.derivative {
                targets.push(number(column)?);
            }
            if let Some(&before) = times.last().filter(|&&before| time <= before) {
                let same = first >= dimension
                    && time == before
                    && inputs[first - dimension..first] == inputs[first..]
                    && targets[first - dimension..first] == targets[first..];
                if !same {
                    return Err(wrong(
                        line(),
                        format!("is not after the line before: {before} s, then {time} s"),
                        "write samples at a fixed interval, in the order of time",
                    ));
                }
                inputs.truncate(first);
                targets.truncate(first);
                repeated += 1;
            } else {
                times.push(time);
            }
            let filled = |&&column: &&usize| !record.get(column).unwrap_or_default().is_empty();
            if columns.weights.iter().find(filled).is_some() {
                let row = columns.weights.iter().map(|&column| Ok(number(column)? as f32));
                outer_weights = Some(row.collect::<Result<Vec<f32>, _>>()?);
            }
        }
        if times.len() < 2 {
            let problem = format!("{} samples, at least 2 are needed", times.len());
            return Err(wrong(None, problem, "record more samples"));
        }
        let (interval, gaps, mut timing) = timing(&times);
        timing.repeated = repeated;
        let samples = Dataset::new(dimension, inputs, targets)
            .map_err(|e: DataError| wrong(None, e.to_string(), "record more samples"))?;
        Ok(Self { samples, gaps, start: times[0], interval, timing, outer_weights })
    }

    /// When each sample was taken, counted in intervals from the first.
    #[must_use]
    pub fn ticks(&self) -> Vec<u64> {
        let mut ticks: Vec<u64> = (0..self.samples.len() as u64).collect();
        let ends = self.gaps.iter().skip(1).copied().chain([ticks.len()]);
        let mut missing = 0u64;
        for (index, (&gap, end)) in self.gaps.iter().zip(ends).enumerate() {
            // At least one sample is missing in a gap.
            let lost = self.timing.missing.get(index).copied().unwrap_or(1);
            missing = missing.saturating_add(lost.min(MISSING_MAX));
            for tick in &mut ticks[gap..end] {
                *tick = tick.saturating_add(missing);
            }
        }
        ticks
    }
}

/// `time` in seconds. What has an exact inverse is divided by it: 3 ms are the number that `0.003`
/// stands for.
fn scaled(time: f64, scale: f64) -> f64 {
    if scale < 1.0 { time / (1.0 / scale).round() } else { time * scale }
}

/// What to do about a field that is not a finite number.
fn number_hint(text: &str, is_time: bool) -> &'static str {
    let digits = |text: &str| !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    let decimal_comma =
        text.trim_start_matches(['-', '+']).split_once(',').is_some_and(|(whole, rest)| {
            digits(whole) && rest.split(['e', 'E']).next().is_some_and(digits)
        });
    if decimal_comma {
        return "write decimal points in place of decimal commas";
    }
    let is_date = text.starts_with(|c: char| c.is_ascii_digit())
        && (text.contains(':') || text.matches(['-', '/']).count() == 2);
    if is_time && is_date {
        return "write times in seconds, not as dates or times of day";
    }
    if text.contains('\u{fffd}') {
        return "save the file as UTF-8, with a finite number here";
    }
    "write a finite number, or leave the line out and with it the sample"
}

/// Writes `samples` as a CSV file; `time` of each, and the outer weights that belong to them, row by
/// row, or none.
///
/// # Errors
/// If the file cannot be written.
pub fn write_samples(
    path: &Path,
    samples: &Dataset,
    time: impl Fn(usize) -> f64,
    outer_weights: &[f32],
) -> Result<(), OutputError> {
    let n = samples.dimension();
    let mut header = vec!["time [s]".to_owned()];
    header.extend((1..=n).map(|c| format!("xhat{c} [state unit]")));
    header.extend((1..=n).map(|c| format!("dxhat{c} [state unit/s]")));
    header.extend((0..outer_weights.len()).map(|i| format!("w{}_{}", i / n + 1, i % n + 1)));
    let last = samples.len() - 1;
    write_table(path, &header, 0..=last, |row, index| {
        row.double(time(index))?;
        let place = index * n..(index + 1) * n;
        for &value in &samples.inputs()[place.clone()] {
            row.double(value)?;
        }
        for &value in &samples.targets()[place] {
            row.double(value)?;
        }
        for &weight in outer_weights {
            if index == last { row.single(weight)? } else { row.text("")? }
        }
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    struct File(PathBuf);

    impl File {
        fn new(name: &str, text: &str) -> Self {
            let path = std::env::temp_dir().join(format!("{}-{name}", std::process::id()));
            std::fs::write(&path, text).unwrap();
            Self(path)
        }
    }

    impl Drop for File {
        fn drop(&mut self) {
            let _ = std::fs::remove_file(&self.0);
        }
    }

    #[test]
    fn a_recording_reads_back_as_it_was_written() {
        let inputs = vec![0.1, 1.0 / 3.0, -2e-8, 4.0, 5.0, 6.5];
        let targets = vec![1.5, -0.25, 1e9, 3.0, 2.0, 1.0];
        let recording = Recording {
            samples: Dataset::new(2, inputs, targets).unwrap(),
            gaps: Vec::new(),
            start: 10.0,
            interval: 0.001,
            timing: Timing::default(),
            outer_weights: Some(vec![0.1, 0.2, 0.3, 0.4, 0.5, 0.6]),
        };
        let file = File::new("recording.csv", "");
        recording.save(&file.0).unwrap();
        let read = Recording::load(&file.0, 2, 3).unwrap();
        assert_eq!(read.samples, recording.samples);
        assert_eq!(read.outer_weights, recording.outer_weights);
        assert_eq!((read.interval as f32, read.gaps.len()), (0.001, 0));
    }

    #[test]
    fn columns_come_in_any_order_and_others_are_ignored() {
        let text = "note,dxhat1 [V/s],Time,xhat1\nhello,2,0.5,1\n,4,0.6,3\n";
        let file = File::new("order.csv", text);
        let read = Recording::load(&file.0, 1, 4).unwrap();
        assert_eq!(
            (read.samples.inputs(), read.samples.targets()),
            (&[1.0, 3.0][..], &[2.0, 4.0][..])
        );
        assert_eq!(read.outer_weights, None);
    }

    #[test]
    fn a_missing_sample_is_a_gap_and_jitter_is_none() {
        let text = "time,xhat1,dxhat1\n0,1,2\n1.1,1,2\n2,1,2\n4,3,4\n5,3,4\n9,5,6\n";
        let file = File::new("gap.csv", text);
        let read = Recording::load(&file.0, 1, 4).unwrap();
        assert_eq!((read.interval, read.gaps), (1.0, vec![3, 5]));
    }

    #[test]
    fn every_mistake_is_reported_with_its_line() {
        let cases = [
            ("time,xhat1\n0,1\n", "1: there is no column dxhat1"),
            ("time,xhat1,dxhat1,xhat1\n", "1: there are two columns xhat1"),
            ("time,xhat1,dxhat1,xhat2\n", "1: there is a column xhat2"),
            ("time,xhat1,dxhat1,w1_1\n", "1: there are 1 columns of outer weights"),
            ("time,xhat1,dxhat1\n0,1,2\n1,x,2\n", "3: \"xhat1\" is \"x\""),
            ("time,xhat1,dxhat1\n0,1,2\n1,NaN,2\n", "3: \"xhat1\" is \"NaN\""),
            ("time,xhat1,dxhat1\n0,1,2\n1,2\n", "3: has 2 fields, the header 3"),
            ("time,xhat1,dxhat1\n0,1,2\n1,2,3\n0.5,1,2\n", "4: is not after"),
            ("time [m],xhat1,dxhat1\n0,1,2\n1,2,3\n", "1: the unit of time in \"time [m]\""),
            ("time,xhat1,dxhat1\n0,1,2\n0,1,3\n", "3: is not after"),
            ("time,xhat1,dxhat1\n\n\n0,1,2\n\n1,x,2\n", "6: \"xhat1\" is \"x\""),
            ("time,xhat1,dxhat1\r\n\r\n\r\n0,1,2\r\n\r\n1,2\r\n", "6: has 2 fields"),
            ("\n\ntime,xhat1\n", "3: there is no column dxhat1"),
            ("0,1,2\n1,2,3\n", "1: the first line holds numbers, not names"),
            ("time xhat1 dxhat1\n0 1 2\n", "1: has columns separated by blanks"),
            (
                "time;xhat1;dxhat1\n0;1;2\n1;1,5;2\n",
                "3: \"xhat1\" is \"1,5\"; write decimal points",
            ),
            (
                "time,xhat1,dxhat1\n2024-01-01 12:00:00,1,2\n",
                "2: \"time\" is \"2024-01-01 12:00:00\"; write times in seconds, not as dates",
            ),
            (
                "time,xhat1,dxhat1\n1700000000000,1,2\n",
                "2: the time 1.7e12 s is not one since 1970; write its unit",
            ),
            ("<!DOCTYPE html>\n<html>", ": is an HTML or XML page"),
            ("{\"time\": [0, 1]}", ": is JSON"),
            ("t\0i\0m\0e\0,\0x\0h\0", ": is UTF-16; save it as UTF-8"),
            ("\0t\0i\0m\0e\0,\0x\0h", ": is UTF-16; save it as UTF-8"),
            ("time,xhat1,dxhat1\n\0\0\0", ": is binary data"),
            ("PK\u{3}\u{4}...", ": is a zip archive, as .xlsx"),
            ("PAR1...", ": is a Parquet file"),
            ("", ": is empty"),
            ("time,xhat1,dxhat1\n0,1,2\n", ": 1 samples, at least 2"),
        ];
        for (text, expected) in cases {
            let file = File::new("wrong.csv", text);
            let message = Recording::load(&file.0, 1, 2).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
            assert!(message.contains("wrong.csv") && message.contains("; "), "{message}");
        }
        let missing = Recording::load(Path::new("no/such.csv"), 1, 2).unwrap_err().to_string();
        assert!(missing.contains("no/such.csv"), "{missing}");
    }

    #[test]
    fn separators_marks_and_line_ends_do_not_matter() {
        let text = "time [s],\"xhat1 [a, b]\",dxhat1,note\n0,\"1\",2,x\n0.5,3,-4e-1,y\n";
        let expected = {
            let file = File::new("plain.csv", text);
            Recording::load(&file.0, 1, 0).unwrap()
        };
        assert_eq!(expected.samples.targets(), [2.0, -0.4]);
        let quoted = text.replace("a, b", "a b");
        let mut texts = vec![
            format!("\u{feff}{text}").into_bytes(),
            text.replace('\n', "\r\n").into_bytes(),
            text.replace('\n', "\r").into_bytes(),
            text.replace("x\n", "\u{b5}\n").into_bytes(),
        ];
        texts.extend([";", "\t", "|"].map(|sign| quoted.replace(',', sign).into_bytes()));
        // Latin-1 in a column that is not used.
        let mut latin = text.as_bytes().to_vec();
        let place = latin.windows(2).position(|pair| pair == b"x\n").unwrap();
        latin[place] = 0xB5;
        texts.push(latin);
        for text in texts {
            let file = File::new("separated.csv", "");
            std::fs::write(&file.0, &text).unwrap();
            let read = Recording::load(&file.0, 1, 0).unwrap_or_else(|error| panic!("{error}"));
            assert_eq!(read, expected, "{}", String::from_utf8_lossy(&text));
        }
    }

    #[test]
    fn times_in_other_units_are_those_in_seconds() {
        let with = |header: &str, times: [&str; 3]| {
            let [a, b, c] = times;
            let text = format!("{header},xhat1,dxhat1\n{a},1,2\n{b},3,4\n{c},5,6\n");
            let file = File::new("units.csv", &text);
            Recording::load(&file.0, 1, 0).unwrap()
        };
        let seconds = with("time [s]", ["0.003", "0.004", "0.005"]);
        assert_eq!(with("time (ms)", ["3", "4", "5"]), seconds);
        assert_eq!(with("t [\u{b5}s]", ["3000", "4000", "5000"]), seconds);
        let minutes = with("time/min", ["1", "2", "3"]);
        assert_eq!((minutes.start, minutes.interval), (60.0, 60.0));
    }

    #[test]
    fn a_sample_that_is_there_twice_counts_once() {
        let text = "time,xhat1,dxhat1\n0,1,2\n1,3,4\n1,3,4\n3,5,6\n4,7,8\n5,7,8\n";
        let file = File::new("twice.csv", text);
        let read = Recording::load(&file.0, 1, 0).unwrap();
        assert_eq!((read.samples.len(), read.timing.repeated), (5, 1));
        assert_eq!((read.gaps.clone(), read.timing.missing.clone()), (vec![2], vec![1]));
        assert_eq!(read.ticks(), [0, 1, 3, 4, 5]);
    }

    #[cfg(unix)]
    #[test]
    fn devices_that_never_end_are_refused() {
        for (device, problem) in
            [("/dev/zero", "binary data"), ("/dev/null", "is empty"), ("/", "cannot be read")]
        {
            let message = Recording::load(Path::new(device), 1, 2).unwrap_err().to_string();
            assert!(message.contains(device) && message.contains(problem), "{message}");
        }
    }
}
