//! A recorded experiment in place of equations: what sensors measured and, if there is one, a reference
//! for the state.
//!
//! Between the rows of the recording, the reference is interpolated linearly, because it is only compared with. What
//! agents measure is by default the last row's value, because a node does not know the next one.
//! Before the first and after the last row nothing is known.

use crate::files::fnv::Fnv;

/// What agents measure between the rows of a recording.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Between {
    /// The value of the last row.
    #[default]
    Hold,
    /// The value on the line between the rows: it knows the next one.
    Linear,
    /// Nothing: there is a measurement only in the step of a row.
    Nothing,
}

/// A table of numbers over time.
#[derive(Clone, Debug, PartialEq)]
pub struct Recorded {
    /// Names of the state's components.
    pub states: Vec<String>,
    /// Time of each row, from 0, increasing. \[s\]
    pub time: Vec<f64>,
    /// Names of the columns.
    pub names: Vec<String>,
    /// The columns, in the order of the names; NaN where a cell is empty.
    pub columns: Vec<Vec<f64>>,
    /// Columns of the reference, one for each state; empty without one.
    pub reference: Vec<usize>,
    /// Columns of the known inputs, without an empty cell.
    pub inputs: Vec<usize>,
    /// What agents measure between rows.
    pub between: Between,
}

/// Times are multiples of the step up to rounding. \[s\]
const TOLERANCE: f64 = 1e-9;

impl Recorded {
    /// Returns the time of the last row. \[s\]
    #[must_use]
    pub fn duration(&self) -> f64 {
        self.time.last().copied().unwrap_or(0.0)
    }

    /// Returns a hash of all numbers and the names of their columns.
    #[must_use]
    pub fn hash(&self) -> u64 {
        let mut hash = Fnv::default();
        for name in &self.names {
            hash.add(name.as_bytes());
            hash.add(&[0]);
        }
        for number in self.time.iter().chain(self.columns.iter().flatten()) {
            hash.add(&number.to_le_bytes());
        }
        hash.finish()
    }

    /// Whether the true state is known.
    #[must_use]
    pub fn has_reference(&self) -> bool {
        !self.reference.is_empty()
    }

    /// Returns the column with this name.
    #[must_use]
    pub fn column(&self, name: &str) -> Option<usize> {
        self.names.iter().position(|known| known == name)
    }

    /// Writes the reference at `time` \[s\] to `x`, shape `[n]`: NaN without one.
    pub fn reference_at(&self, time: f64, x: &mut [f64]) {
        x.fill(f64::NAN);
        for (x, &column) in x.iter_mut().zip(&self.reference) {
            *x = self.interpolated(column, time).unwrap_or(f64::NAN);
        }
    }

    /// Writes the slope of the reference at `time` \[s\] to `dx`, shape `[n]`. \[state unit/s\]
    pub fn slope_at(&self, time: f64, dx: &mut [f64]) {
        dx.fill(f64::NAN);
        let row = self.row_at(time).unwrap_or(0).min(self.time.len().saturating_sub(2));
        let Some(&[start, end]) = self.time.get(row..row + 2).and_then(|t| t.first_chunk()) else {
            return;
        };
        for (dx, &column) in dx.iter_mut().zip(&self.reference) {
            let column = &self.columns[column];
            *dx = (column[row + 1] - column[row]) / (end - start);
        }
    }

    /// Writes the known inputs at `time` \[s\], those of the last row, to `u`, shape `[p]`.
    pub fn inputs_at(&self, time: f64, u: &mut [f64]) {
        let row = self.row_at(time).unwrap_or(0);
        for (u, &column) in u.iter_mut().zip(&self.inputs) {
            *u = self.columns[column][row];
        }
    }

    /// Returns an agent's measurement from a column in the step of length `step` \[s\] that starts at `time` \[s\];
    /// `None` if there is none.
    #[must_use]
    pub fn measured(&self, column: usize, time: f64, step: f64) -> Option<f64> {
        let row = self.row_at(time)?;
        let value = match self.between {
            Between::Hold => self.columns[column][row],
            Between::Linear => self.interpolated(column, time)?,
            Between::Nothing => {
                let is_new = self.row_at(time - step).is_none_or(|before| before < row);
                if is_new { self.columns[column][row] } else { f64::NAN }
            }
        };
        value.is_finite().then_some(value)
    }

    /// Returns the last row at or before `time` \[s\].
    fn row_at(&self, time: f64) -> Option<usize> {
        let after = self.time.partition_point(|&row| row <= time + TOLERANCE);
        after.checked_sub(1)
    }

    fn interpolated(&self, column: usize, time: f64) -> Option<f64> {
        let row = self.row_at(time)?;
        let column = &self.columns[column];
        let Some((&end, &next)) = self.time.get(row + 1).zip(column.get(row + 1)) else {
            return (time <= self.duration() + TOLERANCE).then_some(column[row]);
        };
        let start = self.time[row];
        let share = ((time - start) / (end - start)).clamp(0.0, 1.0);
        Some(column[row] + share * (next - column[row]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn recorded(between: Between) -> Recorded {
        Recorded {
            states: vec!["x".to_owned()],
            time: vec![0.0, 0.5, 2.0],
            names: vec!["y".to_owned()],
            columns: vec![vec![1.0, 2.0, 8.0]],
            reference: vec![0],
            inputs: Vec::new(),
            between,
        }
    }

    #[test]
    fn measurements_between_rows() {
        let at = |between: Between, time: f64| recorded(between).measured(0, time, 0.1);
        assert_eq!(
            [0.0, 0.4, 0.5, 1.9].map(|t| at(Between::Hold, t).unwrap()),
            [1.0, 1.0, 2.0, 2.0]
        );
        assert_eq!([0.0, 0.25, 1.25].map(|t| at(Between::Linear, t).unwrap()), [1.0, 1.5, 5.0]);
        let times = [0.0, 0.1, 0.4, 0.5, 0.6, 2.0];
        let expected = [Some(1.0), None, None, Some(2.0), None, Some(8.0)];
        assert_eq!(times.map(|t| at(Between::Nothing, t)), expected);
    }

    #[test]
    fn the_reference_is_interpolated_and_known_only_inside() {
        let reference = |time: f64| {
            let mut x = [0.0];
            recorded(Between::Hold).reference_at(time, &mut x);
            x[0]
        };
        assert_eq!([0.0, 1.25, 2.0].map(reference), [1.0, 5.0, 8.0]);
        assert!(reference(-0.1).is_nan() && reference(2.1).is_nan());
        let mut slope = [0.0];
        for (time, expected) in [(0.1, 2.0), (1.0, 4.0), (2.0, 4.0)] {
            recorded(Between::Hold).slope_at(time, &mut slope);
            assert_eq!(slope, [expected]);
        }
    }

    #[test]
    fn an_empty_cell_is_no_measurement() {
        let mut recorded = recorded(Between::Hold);
        recorded.columns[0][1] = f64::NAN;
        assert_eq!(recorded.measured(0, 1.0, 0.1), None);
        recorded.reference.clear();
        let mut x = [0.0];
        recorded.reference_at(0.0, &mut x);
        assert!(x[0].is_nan() && !recorded.has_reference());
    }
}
