//! Samples row by row, from a file or from memory.

use std::path::Path;

use super::timing::timing;
use super::{Observed, Recording, RecordingError};
use crate::training::{DataError, Dataset};

/// What is wrong with a row, and how to correct it.
pub(super) type Wrong = (String, &'static str);

/// Samples so far.
pub(super) struct Rows {
    dimension: usize,
    times: Vec<f64>,
    inputs: Vec<f64>,
    targets: Vec<f64>,
    repeated: usize,
}

impl Rows {
    /// Creates an empty table for states with `dimension` components.
    pub(super) fn new(dimension: usize) -> Self {
        let (times, inputs, targets) = (Vec::new(), Vec::new(), Vec::new());
        Self { dimension, times, inputs, targets, repeated: 0 }
    }

    /// Adds a sample: its time \[s\], and estimate and derivative one after the other. The last sample once
    /// more is counted and left out.
    ///
    /// # Errors
    /// If the time is not above that of the sample before.
    pub(super) fn push(&mut self, time: f64, numbers: &[f64]) -> Result<(), Wrong> {
        let (estimate, derivative) = numbers.split_at(self.dimension);
        let Some(&before) = self.times.last().filter(|&&before| time <= before) else {
            self.times.push(time);
            self.inputs.extend_from_slice(estimate);
            self.targets.extend_from_slice(derivative);
            return Ok(());
        };
        let same =
            time == before && self.inputs.ends_with(estimate) && self.targets.ends_with(derivative);
        if !same {
            return Err((
                format!("time not increasing: {before} s, then {time} s"),
                "write samples at a fixed interval, in time order",
            ));
        }
        self.repeated += 1;
        Ok(())
    }

    /// Returns the recording.
    ///
    /// # Errors
    /// If there are fewer than two samples.
    pub(super) fn finish(
        self,
        outer_weights: Option<Vec<f32>>,
        observed: Option<Observed>,
    ) -> Result<Recording, Wrong> {
        let Self { dimension, times, inputs, targets, repeated } = self;
        if times.len() < 2 {
            let problem = format!("{} samples, expected at least 2", times.len());
            return Err((problem, "record more samples"));
        }
        let (interval, gaps, mut timing) = timing(&times);
        timing.repeated = repeated;
        let samples = Dataset::new(dimension, inputs, targets)
            .map_err(|error: DataError| (error.to_string(), "record more samples"))?;
        Ok(Recording { samples, gaps, start: times[0], interval, timing, outer_weights, observed })
    }
}

impl Recording {
    /// Takes samples from memory: of each the time \[s\], the estimate, shape `[n]` with `n = dimension`, and its
    /// derivative, shape `[n]`, one after the other in `rows`, and the outer weights to train for, if they are known,
    /// shape `[L, n]`. `name` stands for the file in errors, and the row, from 1, for the line.
    ///
    /// # Errors
    /// Returns the first problem, as [`Recording::load`].
    ///
    /// # Panics
    /// If `rows` is not a multiple of `1 + 2 n` long.
    pub fn from_rows(
        name: &Path,
        dimension: usize,
        rows: &[f64],
        outer_weights: Option<Vec<f32>>,
    ) -> Result<Self, RecordingError> {
        let wrong = |line: Option<u64>, problem: String, hint: &str| RecordingError {
            path: name.to_owned(),
            line,
            problem,
            hint: hint.to_owned(),
        };
        let width = 1 + 2 * dimension;
        assert_eq!(rows.len() % width, 0, "rows of {width} numbers");
        let mut samples = Rows::new(dimension);
        for (row, numbers) in rows.chunks_exact(width).enumerate() {
            let line = Some(row as u64 + 1);
            if let Some(column) = numbers.iter().position(|number| !number.is_finite()) {
                let problem =
                    format!("{:?} is {:?}", column_name(column, dimension), numbers[column]);
                return Err(wrong(line, problem, "use a finite number, or delete the row"));
            }
            samples
                .push(numbers[0], &numbers[1..])
                .map_err(|(problem, hint)| wrong(line, problem, hint))?;
        }
        samples.finish(outer_weights, None).map_err(|(problem, hint)| wrong(None, problem, hint))
    }
}

/// Returns the name that a column has in a file.
fn column_name(column: usize, dimension: usize) -> String {
    match column {
        0 => "time".to_owned(),
        column if column <= dimension => format!("xhat{column}"),
        column => format!("dxhat{}", column - dimension),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_read_as_the_lines_of_a_file() {
        let path = std::env::temp_dir().join(format!("{}-rows.csv", std::process::id()));
        std::fs::write(&path, "time,xhat1,dxhat1\n0.1,1,2\n0.2,3,4\n0.2,3,4\n0.4,5,6\n").unwrap();
        let loaded = Recording::load(&path, 1, 0).unwrap();
        let rows = [0.1, 1.0, 2.0, 0.2, 3.0, 4.0, 0.2, 3.0, 4.0, 0.4, 5.0, 6.0];
        assert_eq!(Recording::from_rows(&path, 1, &rows, None).unwrap(), loaded);
        std::fs::remove_file(&path).unwrap();
    }

    #[test]
    fn mistakes_name_their_row() {
        let cases: [(&[f64], &str); 4] = [
            (&[0.0, 1.0, 2.0, 1.0, f64::NAN, 2.0], "samples:2: \"xhat1\" is NaN; use a finite"),
            (&[0.0, 1.0, 2.0, 1.0, 1.0, f64::INFINITY], "samples:2: \"dxhat1\" is inf; use a"),
            (&[1.0, 1.0, 2.0, 0.5, 1.0, 2.0], "samples:2: time not increasing: 1 s, then 0.5 s; "),
            (&[0.0, 1.0, 2.0], "samples: 1 samples, expected at least 2; record more samples"),
        ];
        for (rows, expected) in cases {
            let error = Recording::from_rows(Path::new("samples"), 1, rows, None).unwrap_err();
            assert!(error.to_string().starts_with(expected), "{error}");
        }
    }
}
