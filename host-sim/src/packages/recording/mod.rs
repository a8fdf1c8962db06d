//! Recorded samples `(x_hat, d/dt x_hat)` of a simulated or real agent, in memory and as a CSV
//! file.
//!
//! | column | meaning |
//! | --- | --- |
//! | `time [s]` | sampling time, at a fixed interval; missing samples are gaps; `[ms]`, `[us]`, `[ns]`, `[min]` and `[h]` are converted, and the default is seconds |
//! | `xhat1` .. | the estimate, one column per component |
//! | `u1` .. (only written) | known inputs of the plant, if there are any |
//! | `dxhat1` .. | its derivative |
//! | `w1_1` .. (optional) | `W_hat`, row (feature) and column (component); the last nonempty line counts |
//! | `innovation_rms`, `broadcasts_per_second` (optional) | what the agent did meanwhile, see [`Observed`]; the last nonempty line counts |
//!
//! Lines starting with `#` are comments; at the head of the file they state its origin
//! ([`super::recording_source`]). Units follow the names, as in `time (ms)`, `time_ms` or `xhat1
//! [V]`; only units of time are converted, and unknown ones are refused. Columns can be in any
//! order, separated by commas, semicolons, tabs or bars; other columns are ignored.

mod columns;
mod rows;
mod source;
mod timing;

use std::path::{Path, PathBuf};

use crate::files::input::is_too_large;
use crate::files::output::OutputError;
use crate::files::table::write_table;
use crate::files::text;
use crate::training::Dataset;
use columns::Columns;
use rows::Rows;
pub use timing::Timing;

/// Recorded samples of one agent.
#[derive(Clone, Debug, PartialEq)]
pub struct Recording {
    /// `(x_hat, d/dt x_hat)` as recorded, in time order.
    pub samples: Dataset,
    /// Indices of the samples that follow a gap. Between gaps, samples are equidistant.
    pub gaps: Vec<usize>,
    /// Time of the first sample. \[s\]
    pub start: f64,
    /// Time between two samples. \[s\]
    pub interval: f64,
    /// Missing samples and regularity.
    pub timing: Timing,
    /// `W_hat` to train the network for, row-major, shape `[L, n]`; `None` if not recorded.
    pub outer_weights: Option<Vec<f32>>,
    /// What the agent did meanwhile; `None` if not recorded.
    pub observed: Option<Observed>,
}

/// What an agent did while the last half of its samples was collected: when the observer has settled.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observed {
    /// RMS of the innovation `e_3`, over steps and outputs. \[output unit\]
    pub innovation_rms: f64,
    /// Mean rate of broadcasts. \[1/s\]
    pub broadcasts_per_second: f64,
}

/// Why a sample file cannot be loaded.
#[derive(Debug, thiserror::Error)]
#[error("{}{}: {problem}; {hint}", path.display(), line.map_or(String::new(), |l| format!(":{l}")))]
pub struct RecordingError {
    /// The file.
    pub path: PathBuf,
    /// The line concerned, from 1, if any.
    pub line: Option<u64>,
    /// What is wrong.
    pub problem: String,
    /// How to correct it.
    pub hint: String,
}

/// Larger times without a unit are taken for Unix times that are not in seconds. \[s\]
const UNIX_SECONDS_MAX: f64 = 1e11;

/// Upper limit of the missing samples counted per gap: more than any window has, and low enough
/// that the ticks after a million such gaps do not overflow.
const MISSING_MAX: u64 = 1 << 40;

impl Recording {
    /// Returns the segments between gaps, one data set each.
    ///
    /// # Panics
    /// If a gap is outside the samples, which cannot happen for a loaded recording.
    pub fn pieces(&self) -> impl Iterator<Item = Dataset> + '_ {
        let starts = [0].into_iter().chain(self.gaps.iter().copied());
        let ends = self.gaps.iter().copied().chain([self.samples.len()]);
        starts
            .zip(ends)
            .filter_map(|(start, end)| self.samples.select(&(start..end).collect::<Vec<_>>()))
    }

    /// Joins recordings of several agents, for one network for all: samples one after the other, with a
    /// gap between them that no window bridges, and the outer weights of the first. `None` without samples.
    #[must_use]
    pub fn joined(recordings: &[Self]) -> Option<Self> {
        let first = recordings.first()?;
        let part = |pick: fn(&Dataset) -> &[f64]| -> Vec<f64> {
            recordings.iter().flat_map(|recording| pick(&recording.samples)).copied().collect()
        };
        let samples = first.samples.of_shape(part(Dataset::inputs), part(Dataset::targets));
        let mut joined = Self { samples: samples.ok()?, gaps: Vec::new(), ..first.clone() };
        joined.timing.missing.clear();
        let mut before = 0;
        for recording in recordings {
            if before > 0 {
                joined.gaps.push(before);
                joined.timing.missing.push(MISSING_MAX);
            }
            joined.gaps.extend(recording.gaps.iter().map(|gap| before + gap));
            joined.timing.missing.extend(&recording.timing.missing);
            before += recording.samples.len();
        }
        Some(joined)
    }

    /// Writes the samples as a CSV file.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn save(&self, path: &Path) -> Result<(), OutputError> {
        self.save_labelled(path, None)
    }

    /// Writes the samples as a CSV file that says whose they are.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn save_labelled(
        &self,
        path: &Path,
        labels: Option<&SampleLabels<'_>>,
    ) -> Result<(), OutputError> {
        let weights = self.outer_weights.as_deref().unwrap_or(&[]);
        let time = |index| self.start + index as f64 * self.interval;
        write_samples(path, &self.samples, time, weights, self.observed.as_ref(), labels)
    }

    /// Reads samples of an agent with `dimension` state components and, if there is a network,
    /// `features` features.
    ///
    /// # Errors
    /// Returns the first problem, with file, line and hint.
    pub fn load(path: &Path, dimension: usize, features: usize) -> Result<Self, RecordingError> {
        let wrong = |line: Option<u64>, problem: String, hint: &str| RecordingError {
            path: path.to_owned(),
            line,
            problem,
            hint: hint.to_owned(),
        };
        let (head, content) = text::open(path).map_err(|error| {
            wrong(None, format!("cannot read: {error}"), "give the path of a CSV file")
        })?;
        text::check_text(&head).map_err(|(problem, hint)| wrong(None, problem, &hint))?;
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
                    format!("{len} fields, but the header has {expected_len}"),
                    "use the same number of fields in every line",
                ),
                csv::ErrorKind::Io(error) if is_too_large(error) => wrong(
                    None,
                    format!("cannot read: {error}"),
                    "record less, or split the recording into files of at most 4 GiB; write one sample per line",
                ),
                _ => {
                    wrong(line, format!("cannot read: {error}"), "check that the file is valid CSV")
                }
            }
        };
        let start = reader.position().clone();
        let headers = reader.byte_headers().map_err(|error| unreadable(&start, &error))?;
        let headers: Vec<String> =
            headers.iter().map(|name| String::from_utf8_lossy(name).into_owned()).collect();
        let header_line = source::line_of(path, 0, 1);
        let columns = Columns::find(&headers, dimension, features)
            .map_err(|(problem, hint)| wrong(Some(header_line), problem, &hint))?;
        let (mut rows, mut numbers) = (Rows::new(dimension), Vec::with_capacity(2 * dimension));
        let (mut outer_weights, mut observed) = (None, None);
        let mut record = csv::ByteRecord::new();
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
                    format!("time {time:e} s is not plausible in seconds"),
                    "state the unit in the header, as in `time [ms]`",
                ));
            }
            let time = columns.time_scale.map_or(time, |scale| scaled(time, scale));
            numbers.clear();
            for &column in columns.estimate.iter().chain(&columns.derivative) {
                numbers.push(number(column)?);
            }
            rows.push(time, &numbers).map_err(|(problem, hint)| wrong(line(), problem, hint))?;
            if let Some([rms, rate]) = columns.observed {
                let number = |column: usize| -> Option<f64> {
                    let text = std::str::from_utf8(record.get(column)?).ok()?;
                    text.parse().ok().filter(|number| (0.0..f64::MAX).contains(number))
                };
                let both = number(rms).zip(number(rate));
                observed = both
                    .map(|(innovation_rms, broadcasts_per_second)| Observed {
                        innovation_rms,
                        broadcasts_per_second,
                    })
                    .or(observed);
            }
            let filled = |&&column: &&usize| !record.get(column).unwrap_or_default().is_empty();
            if columns.weights.iter().find(filled).is_some() {
                let row = columns.weights.iter().map(|&column| Ok(number(column)? as f32));
                outer_weights = Some(row.collect::<Result<Vec<f32>, _>>()?);
            }
        }
        rows.finish(outer_weights, observed).map_err(|(problem, hint)| wrong(None, problem, hint))
    }

    /// Returns the time of each sample, in intervals since the first.
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

/// Returns `time` in seconds. Divides by the inverse where it is exact, so that 3 ms equals the
/// number parsed from `0.003`.
fn scaled(time: f64, scale: f64) -> f64 {
    if scale < 1.0 { time / (1.0 / scale).round() } else { time * scale }
}

/// Returns a hint for a field that is not a finite number.
fn number_hint(text: &str, is_time: bool) -> &'static str {
    let digits = |text: &str| !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    let decimal_comma =
        text.trim_start_matches(['-', '+']).split_once(',').is_some_and(|(whole, rest)| {
            digits(whole) && rest.split(['e', 'E']).next().is_some_and(digits)
        });
    if decimal_comma {
        return "use decimal points instead of decimal commas";
    }
    let is_date = text.starts_with(|c: char| c.is_ascii_digit())
        && (text.contains(':') || text.matches(['-', '/']).count() == 2);
    if is_time && is_date {
        return "use times in seconds, not dates or times of day";
    }
    if text.contains('\u{fffd}') {
        return "save the file as UTF-8, with a finite number here";
    }
    "use a finite number, or delete the line"
}

/// What a file of samples says of them besides their numbers.
#[derive(Clone, Copy, Debug)]
pub struct SampleLabels<'l> {
    /// The agent, from 1.
    pub agent: usize,
    /// `dt`. \[s\]
    pub step: f64,
    /// Names of the plant's known inputs.
    pub inputs: &'l [String],
}

/// Writes `samples` as a CSV file, with the `time` of each and, if any, the outer weights, row-major,
/// what was observed, and whose they are.
///
/// # Errors
/// If the file cannot be written.
pub fn write_samples(
    path: &Path,
    samples: &Dataset,
    time: impl Fn(usize) -> f64,
    outer_weights: &[f32],
    observed: Option<&Observed>,
    labels: Option<&SampleLabels<'_>>,
) -> Result<(), OutputError> {
    let (n, width) = (samples.dimension(), samples.width());
    let mut header = vec!["time [s]".to_owned()];
    header.extend((1..=n).map(|c| format!("xhat{c} [state unit]")));
    header.extend((0..samples.known_inputs()).map(|place| {
        match labels.and_then(|labels| labels.inputs.get(place)) {
            Some(name) => format!("input.{name} [input unit]"),
            None => format!("u{} [input unit]", place + 1),
        }
    }));
    header.extend((1..=n).map(|c| format!("dxhat{c} [state unit/s]")));
    header.extend((0..outer_weights.len()).map(|i| format!("w{}_{}", i / n + 1, i % n + 1)));
    let observed = observed.map(|observed| {
        header.push("innovation_rms [output unit]".to_owned());
        header.push("broadcasts_per_second [1/s]".to_owned());
        [observed.innovation_rms, observed.broadcasts_per_second]
    });
    if labels.is_some() {
        header.extend(["agent", "step [s]"].map(str::to_owned));
    }
    let last = samples.len() - 1;
    write_table(path, &header, 0..=last, |row, index| {
        row.double(time(index))?;
        let place = |n: usize| index * n..(index + 1) * n;
        for &value in &samples.inputs()[place(width)] {
            row.double(value)?;
        }
        for &value in &samples.targets()[place(n)] {
            row.double(value)?;
        }
        for &weight in outer_weights {
            if index == last { row.single(weight)? } else { row.text("")? }
        }
        for &number in observed.iter().flatten() {
            if index == last { row.double(number)? } else { row.text("")? }
        }
        if let Some(labels) = labels {
            row.integer(labels.agent as u64)?;
            row.double(labels.step)?;
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
    fn a_recording_round_trips() {
        let inputs = vec![0.1, 1.0 / 3.0, -2e-8, 4.0, 5.0, 6.5];
        let targets = vec![1.5, -0.25, 1e9, 3.0, 2.0, 1.0];
        let recording = Recording {
            samples: Dataset::new(2, inputs, targets).unwrap(),
            gaps: Vec::new(),
            start: 10.0,
            interval: 0.001,
            timing: Timing::default(),
            outer_weights: Some(vec![0.1, 0.2, 0.3, 0.4, 0.5, 0.6]),
            observed: Some(Observed { innovation_rms: 1.0 / 3.0, broadcasts_per_second: 0.0 }),
        };
        let file = File::new("recording.csv", "");
        recording.save(&file.0).unwrap();
        let read = Recording::load(&file.0, 2, 3).unwrap();
        assert_eq!(read.samples, recording.samples);
        assert_eq!(read.outer_weights, recording.outer_weights);
        assert_eq!(read.observed, recording.observed);
        assert_eq!((read.interval as f32, read.gaps.len()), (0.001, 0));
    }

    #[test]
    fn columns_can_be_in_any_order_and_others_are_ignored() {
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
    fn a_missing_sample_is_a_gap_but_jitter_is_not() {
        let text = "time,xhat1,dxhat1\n0,1,2\n1.1,1,2\n2,1,2\n4,3,4\n5,3,4\n9,5,6\n";
        let file = File::new("gap.csv", text);
        let read = Recording::load(&file.0, 1, 4).unwrap();
        assert_eq!((read.interval, read.gaps), (1.0, vec![3, 5]));
    }

    #[test]
    fn every_mistake_is_reported_with_its_line() {
        let cases = [
            ("time,xhat1\n0,1\n", "1: missing column dxhat1"),
            ("time,xhat1,dxhat1,xhat1\n", "1: duplicate column xhat1"),
            ("time,xhat1,dxhat1,xhat2\n", "1: unexpected column xhat2"),
            ("time,xhat1,dxhat1,w1_1\n", "1: 1 columns of outer weights"),
            ("time,xhat1,dxhat1\n0,1,2\n1,x,2\n", "3: \"xhat1\" is \"x\""),
            ("time,xhat1,dxhat1\n0,1,2\n1,NaN,2\n", "3: \"xhat1\" is \"NaN\""),
            ("time,xhat1,dxhat1\n0,1,2\n1,2\n", "3: 2 fields, but the header has 3"),
            ("time,xhat1,dxhat1\n0,1,2\n1,2,3\n0.5,1,2\n", "4: time not increasing"),
            ("time [m],xhat1,dxhat1\n0,1,2\n1,2,3\n", "1: unknown unit of time in \"time [m]\""),
            ("time,xhat1,dxhat1\n0,1,2\n0,1,3\n", "3: time not increasing"),
            ("time,xhat1,dxhat1\n\n\n0,1,2\n\n1,x,2\n", "6: \"xhat1\" is \"x\""),
            ("time,xhat1,dxhat1\r\n\r\n\r\n0,1,2\r\n\r\n1,2\r\n", "6: 2 fields"),
            ("\n\ntime,xhat1\n", "3: missing column dxhat1"),
            ("0,1,2\n1,2,3\n", "1: the first line has numbers instead of column names"),
            ("time xhat1 dxhat1\n0 1 2\n", "1: columns are separated by spaces"),
            ("time;xhat1;dxhat1\n0;1;2\n1;1,5;2\n", "3: \"xhat1\" is \"1,5\"; use decimal points"),
            (
                "time,xhat1,dxhat1\n2024-01-01 12:00:00,1,2\n",
                "2: \"time\" is \"2024-01-01 12:00:00\"; use times in seconds, not dates",
            ),
            (
                "time,xhat1,dxhat1\n1700000000000,1,2\n",
                "2: time 1.7e12 s is not plausible in seconds; state the unit",
            ),
            ("<!DOCTYPE html>\n<html>", ": is an HTML or XML page"),
            ("{\"time\": [0, 1]}", ": is JSON"),
            ("t\0i\0m\0e\0,\0x\0h\0", ": is UTF-16; save it as UTF-8"),
            ("\0t\0i\0m\0e\0,\0x\0h", ": is UTF-16; save it as UTF-8"),
            ("time,xhat1,dxhat1\n\0\0\0", ": is binary data"),
            ("PK\u{3}\u{4}...", ": is a zip archive, like .xlsx"),
            ("PAR1...", ": is a Parquet file"),
            ("", ": is empty"),
            ("time,xhat1,dxhat1\n0,1,2\n", ": 1 samples, expected at least 2"),
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
    fn separators_byte_order_marks_and_line_ends_do_not_matter() {
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
    fn times_are_converted_to_seconds() {
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
    fn a_repeated_sample_counts_once() {
        let text = "time,xhat1,dxhat1\n0,1,2\n1,3,4\n1,3,4\n3,5,6\n4,7,8\n5,7,8\n";
        let file = File::new("twice.csv", text);
        let read = Recording::load(&file.0, 1, 0).unwrap();
        assert_eq!((read.samples.len(), read.timing.repeated), (5, 1));
        assert_eq!((read.gaps.clone(), read.timing.missing.clone()), (vec![2], vec![1]));
        assert_eq!(read.ticks(), [0, 1, 3, 4, 5]);
    }

    #[cfg(unix)]
    #[test]
    fn endless_devices_are_refused() {
        for (device, problem) in
            [("/dev/zero", "binary data"), ("/dev/null", "is empty"), ("/", "cannot read")]
        {
            let message = Recording::load(Path::new(device), 1, 2).unwrap_err().to_string();
            assert!(message.contains(device) && message.contains(problem), "{message}");
        }
    }
}
