//! Recorded samples `(x_hat, d/dt x_hat)` of one agent, in memory and as a CSV file: what a
//! network is trained on, whether a simulated agent recorded it or a real one.
//!
//! | column | what |
//! | --- | --- |
//! | `time [s]` | when, at a fixed interval; where samples are missing, the recording has a gap |
//! | `xhat1` .. | the estimate, one column a component |
//! | `dxhat1` .. | its derivative |
//! | `w1_1` .. (may be left out) | `W_hat`, row (feature) and column (component); where rows leave them empty, the last that does not counts |
//!
//! Lines that begin with `#` are comments; at the head of a file they say where it comes from
//! ([`super::recording_source`]). Only the first word of a column's name matters, the rest is for its unit; columns can come in
//! any order, and others are ignored.

use std::fmt::Display;
use std::path::{Path, PathBuf};

use crate::output_file::OutputError;
use crate::report::csv::write_table;
use crate::training::{DataError, Dataset};

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
    /// `W_hat` that the network is to be trained for, row by row, shape `[L, n]`; `None` if the
    /// recording does not tell.
    pub outer_weights: Option<Vec<f32>>,
}

/// Why a file of samples cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("{}{}: {problem}; {mend}", path.display(), line.map_or(String::new(), |l| format!(":{l}")))]
pub struct RecordingError {
    /// The file.
    pub path: PathBuf,
    /// Line, from 1, if it is about one.
    pub line: Option<u64>,
    /// What is wrong.
    pub problem: String,
    /// What to do about it.
    pub mend: String,
}

/// From this many intervals on, the time between two samples is a gap: a sample is missing. What
/// is less is jitter of the clock that wrote the times.
const GAP: f64 = 1.5;

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
    /// A file that cannot be written.
    pub fn save(&self, path: &Path) -> Result<(), OutputError> {
        let weights = self.outer_weights.as_deref().unwrap_or(&[]);
        let time = |index| self.start + index as f64 * self.interval;
        write_samples(path, &self.samples, time, weights)
    }

    /// Reads samples of an agent with `dimension` state components and, if there is a network,
    /// `features` features.
    ///
    /// # Errors
    /// The first thing that is wrong, with file, line and mend.
    pub fn load(path: &Path, dimension: usize, features: usize) -> Result<Self, RecordingError> {
        let wrong = |line: Option<u64>, problem: String, mend: &str| RecordingError {
            path: path.to_owned(),
            line,
            problem,
            mend: mend.to_owned(),
        };
        let mut reader = csv::ReaderBuilder::new()
            .trim(csv::Trim::All)
            .comment(Some(b'#'))
            .from_path(path)
            .map_err(|e| {
                wrong(None, format!("cannot be read: {e}"), "give the path of a CSV file")
            })?;
        let mut line = 1;
        let headers = reader.headers().map_err(|e| unreadable(path, line, &e))?.clone();
        let columns = Columns::find(&headers, dimension, features)
            .map_err(|(problem, mend)| wrong(Some(1), problem, &mend))?;
        let (mut times, mut inputs, mut targets) = (Vec::new(), Vec::new(), Vec::new());
        let mut lines = Vec::new();
        let mut outer_weights = None;
        for record in reader.records() {
            let record = record.map_err(|e| unreadable(path, line + 1, &e))?;
            line = record.position().map_or(line + 1, csv::Position::line);
            let number = |column: usize| -> Result<f64, RecordingError> {
                let text = record.get(column).unwrap_or_default();
                text.parse().ok().filter(|value: &f64| value.is_finite()).ok_or_else(|| {
                    let name = headers.get(column).unwrap_or_default();
                    let problem = format!("{name:?} is {text:?}");
                    wrong(
                        Some(line),
                        problem,
                        "write a finite number, or leave the line out and with it the sample",
                    )
                })
            };
            lines.push(line);
            times.push(number(columns.time)?);
            for &column in &columns.estimate {
                inputs.push(number(column)?);
            }
            for &column in &columns.derivative {
                targets.push(number(column)?);
            }
            let filled = |&&column: &&usize| !record.get(column).unwrap_or_default().is_empty();
            if columns.weights.iter().find(filled).is_some() {
                let row = columns.weights.iter().map(|&column| Ok(number(column)? as f32));
                outer_weights = Some(row.collect::<Result<Vec<f32>, _>>()?);
            }
        }
        let (interval, gaps) = interval(&times).map_err(|(index, problem)| {
            let line = index.and_then(|index| lines.get(index).copied());
            wrong(line, problem, "write samples at a fixed interval, in the order of time")
        })?;
        let samples = Dataset::new(dimension, inputs, targets)
            .map_err(|e: DataError| wrong(None, e.to_string(), "record more samples"))?;
        Ok(Self { samples, gaps, start: times[0], interval, outer_weights })
    }
}

/// Writes `samples` as a CSV file; `time` of each, and the outer weights that belong to them, row by
/// row, or none.
///
/// # Errors
/// A file that cannot be written.
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

fn unreadable(path: &Path, line: u64, error: &dyn Display) -> RecordingError {
    RecordingError {
        path: path.to_owned(),
        line: Some(line),
        problem: format!("is no line of a CSV file: {error}"),
        mend: "give every line as many fields as the header".to_owned(),
    }
}

/// Where each quantity stands in a line.
struct Columns {
    time: usize,
    estimate: Vec<usize>,
    derivative: Vec<usize>,
    weights: Vec<usize>,
}

impl Columns {
    /// A problem and a mend if one is missing.
    fn find(
        headers: &csv::StringRecord,
        dimension: usize,
        features: usize,
    ) -> Result<Self, (String, String)> {
        let words: Vec<String> = headers
            .iter()
            .map(|name| name.split_whitespace().next().unwrap_or_default().to_ascii_lowercase())
            .collect();
        let expected = format!(
            "name the columns time, xhat1 to xhat{dimension}, dxhat1 to dxhat{dimension}, for the \
             {dimension} state components of the scenario"
        );
        let find = |name: &str| -> Result<usize, (String, String)> {
            let mut places = words.iter().enumerate().filter(|(_, word)| *word == name);
            match (places.next(), places.next()) {
                (Some((place, _)), None) => Ok(place),
                (None, _) => Err((format!("there is no column {name}"), expected.clone())),
                _ => Err((format!("there are two columns {name}"), expected.clone())),
            }
        };
        let too_many = format!("xhat{}", dimension + 1);
        if words.contains(&too_many) {
            return Err((format!("there is a column {too_many}"), expected));
        }
        let time = find("time")?;
        let unit = headers.get(time).and_then(|name| name.split_once('[')).map(|(_, unit)| unit);
        if let Some(unit) = unit.filter(|unit| unit.trim_end_matches(']').trim() != "s") {
            let problem = format!("the unit of time is [{unit}");
            return Err((problem, "write times in seconds, `time [s]`".to_owned()));
        }
        let all = |stem: &str| -> Result<Vec<usize>, _> {
            (1..=dimension).map(|c| find(&format!("{stem}{c}"))).collect()
        };
        let is_weight = |word: &String| {
            let indices = word.strip_prefix('w').and_then(|indices| indices.split_once('_'));
            indices.is_some_and(|(l, c)| l.parse::<u32>().is_ok() && c.parse::<u32>().is_ok())
        };
        let weights_found = words.iter().filter(|word| is_weight(word)).count();
        let weights = match weights_found {
            0 => Vec::new(),
            found if found == features * dimension => (0..found)
                .map(|i| find(&format!("w{}_{}", i / dimension + 1, i % dimension + 1)))
                .collect::<Result<_, _>>()?,
            found => {
                let problem = format!("there are {found} columns of outer weights");
                let mend = format!(
                    "write w1_1 to w{features}_{dimension} for the scenario's network, or none"
                );
                return Err((problem, mend));
            }
        };
        Ok(Self { time, estimate: all("xhat")?, derivative: all("dxhat")?, weights })
    }
}

/// The time between two samples, and the samples that a gap precedes; an index and a problem if
/// time does not advance.
fn interval(times: &[f64]) -> Result<(f64, Vec<usize>), (Option<usize>, String)> {
    if times.len() < 2 {
        return Err((None, format!("{} samples, at least 2 are needed", times.len())));
    }
    let steps: Vec<f64> = times.windows(2).map(|pair| pair[1] - pair[0]).collect();
    if let Some(index) = steps.iter().position(|&step| step <= 0.0) {
        let problem = format!(
            "is not after the line before: {} s, then {} s",
            times[index],
            times[index + 1]
        );
        return Err((Some(index + 1), problem));
    }
    let mut sorted = steps.clone();
    sorted.sort_by(f64::total_cmp);
    let median = sorted[sorted.len() / 2];
    let after_gap = steps.iter().enumerate().filter(|&(_, &step)| step >= GAP * median);
    let gaps: Vec<usize> = after_gap.map(|(index, _)| index + 1).collect();
    // Without gaps the mean is what rounded times mean.
    let regular: Vec<f64> = steps.into_iter().filter(|&step| step < GAP * median).collect();
    let sum = regular.iter().fold(0.0, |sum, step| sum + step);
    Ok((sum / regular.len() as f64, gaps))
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
            ("time,xhat1,dxhat1\n0,1,2\n1,2\n", "3: is no line of a CSV file"),
            ("time,xhat1,dxhat1\n0,1,2\n1,2,3\n0.5,1,2\n", "4: is not after"),
            ("time [ms],xhat1,dxhat1\n0,1,2\n1,2,3\n", "1: the unit of time is [ms]"),
            ("time,xhat1,dxhat1\n0,1,2\n0,1,2\n", "3: is not after"),
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
}
