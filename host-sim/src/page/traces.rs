//! Errors, states and innovations over time, thinned to what a screen can show.
//!
//! Up to twice a number of points are kept. Each stands for the same number of rows, a power of two: times,
//! states and estimates are those of the first of them, errors and innovations the largest. Memory and
//! time: one pass over the tables, and only the points are held.

use std::collections::BTreeMap;
use std::fs::File;
use std::path::Path;

use csv::ByteRecord;
use serde::Serialize;

use super::TableError;
use super::number::{DIGITS, Short};

/// Numbers that are kept at most, times two.
const NUMBERS: usize = 300_000;
/// Points that are kept at most, times two.
const POINTS: usize = 3_000;
/// Points that are kept at least, if there are as many rows.
const POINTS_MIN: usize = 100;
/// Digits of times: a step of a run of days.
const TIME_DIGITS: usize = 10;
/// Digits of states and estimates: those of single precision.
const STATE_DIGITS: usize = 7;

/// Traces of a run, by point.
#[derive(Debug, PartialEq, Serialize)]
pub struct Thinned {
    /// Number of rows that each point stands for.
    rows_per_point: u64,
    /// Shape `[points]`. \[s\]
    time: Vec<Short>,
    /// `x_0` by component, shape `[n][points]`. \[state unit\]
    truth: Vec<Vec<Short>>,
    estimates: Vec<Estimates>,
    /// `|e_1i|` by agent, shape `[N][points]`. \[state unit\]
    errors: Vec<Vec<Short>>,
    /// `|e_3i|` by agent, shape `[N][points]`; empty if not recorded. \[output unit\]
    innovations: Vec<Vec<Short>>,
}

/// The estimates of one agent.
#[derive(Debug, PartialEq, Serialize)]
struct Estimates {
    /// From 1.
    agent: usize,
    /// By component, shape `[n][points]`. \[state unit\]
    values: Vec<Vec<Short>>,
}

/// What a column holds.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Column {
    Time,
    Truth,
    /// Of this agent, from 1.
    Estimate(usize),
    Error,
    Innovation,
    /// An estimate of an agent that is not shown.
    Unused,
}

impl Column {
    fn merges_to_largest(self) -> bool {
        matches!(self, Self::Error | Self::Innovation)
    }

    fn digits(self) -> usize {
        match self {
            Self::Time => TIME_DIGITS,
            Self::Truth | Self::Estimate(_) => STATE_DIGITS,
            Self::Error | Self::Innovation | Self::Unused => DIGITS,
        }
    }
}

/// Columns of points.
struct Points {
    kinds: Vec<Column>,
    values: Vec<Vec<f64>>,
    /// Rows that each complete point stands for.
    rows: u64,
    /// Rows of the last point so far.
    rows_of_last: u64,
    most: usize,
}

impl Points {
    fn new(kinds: Vec<Column>) -> Self {
        let kept = kinds.iter().filter(|&&kind| kind != Column::Unused).count();
        let most = 2 * (NUMBERS / kept.max(1)).clamp(POINTS_MIN, POINTS);
        let values = vec![Vec::new(); kinds.len()];
        Self { kinds, values, rows: 1, rows_of_last: 1, most }
    }

    fn len(&self) -> usize {
        self.values.first().map_or(0, Vec::len)
    }

    fn add(&mut self, row: &[f64]) {
        if self.len() > 0 && self.rows_of_last < self.rows {
            self.rows_of_last += 1;
            let columns = self.kinds.iter().zip(&mut self.values).zip(row);
            for ((_, values), &new) in columns.filter(|((kind, _), _)| kind.merges_to_largest()) {
                if let Some(last) = values.last_mut() {
                    *last = larger(*last, new);
                }
            }
            return;
        }
        if self.len() == self.most {
            self.halve();
            // The last point may now have room for this row.
            return self.add(row);
        }
        self.rows_of_last = 1;
        let columns = self.kinds.iter().zip(&mut self.values).zip(row);
        for ((_, values), &new) in columns.filter(|((kind, _), _)| **kind != Column::Unused) {
            values.push(new);
        }
    }

    /// Joins every two points.
    fn halve(&mut self) {
        // `most` is even, so the last point is complete again.
        self.rows_of_last += self.rows;
        self.rows *= 2;
        for (kind, values) in self.kinds.iter().zip(&mut self.values) {
            let joined = values.chunks(2).map(|pair| match kind.merges_to_largest() {
                true => pair.iter().copied().reduce(larger).unwrap_or(f64::NAN),
                false => pair[0],
            });
            *values = joined.collect();
        }
    }
}

/// Returns the larger of two numbers, or the one that is a number.
fn larger(a: f64, b: f64) -> f64 {
    a.max(b)
}

/// A table that is read row by row.
struct Table<'p> {
    path: &'p Path,
    reader: csv::Reader<File>,
    record: ByteRecord,
}

impl<'p> Table<'p> {
    fn open(path: &'p Path) -> Result<Self, TableError> {
        let failed = |error| TableError::Read { path: path.to_owned(), error };
        let reader = csv::ReaderBuilder::new().from_path(path).map_err(failed)?;
        Ok(Self { path, reader, record: ByteRecord::new() })
    }

    fn header(&mut self) -> Result<Vec<String>, TableError> {
        let header = self.reader.headers();
        let header =
            header.map_err(|error| TableError::Read { path: self.path.to_owned(), error })?;
        Ok(header.iter().map(str::to_owned).collect())
    }

    /// Adds the numbers of the next row, those of `used` columns; NaN where a field is empty. Returns whether
    /// there was one.
    fn next(&mut self, used: &[Column], row: &mut Vec<f64>) -> Result<bool, TableError> {
        let read = self.reader.read_byte_record(&mut self.record);
        if !read.map_err(|error| TableError::Read { path: self.path.to_owned(), error })? {
            return Ok(false);
        }
        for (field, column) in self.record.iter().zip(used) {
            let number = match (field, column) {
                (b"", _) | (_, Column::Unused) => Some(f64::NAN),
                _ => std::str::from_utf8(field).ok().and_then(|field| field.parse().ok()),
            };
            row.push(number.ok_or_else(|| TableError::Field {
                path: self.path.to_owned(),
                line: self.record.position().map_or(0, csv::Position::line),
                field: String::from_utf8_lossy(field).into_owned(),
                expected: "a number",
            })?);
        }
        Ok(true)
    }
}

/// Reads `traces.csv` of this many agents, and `innovations.csv` if there is one. Estimates are kept of agents
/// that `is_shown`, from 1.
///
/// # Errors
/// If a table cannot be read or is not of its kind.
pub fn read(
    traces: &Path,
    innovations: Option<&Path>,
    agents: usize,
    is_shown: impl Fn(usize) -> bool,
) -> Result<Thinned, TableError> {
    let mut table = Table::open(traces)?;
    let wrong = |path: &Path, expected| TableError::Kind { path: path.to_owned(), expected };
    let not_traces = || wrong(traces, "the table of this run's traces");
    let mut kinds = Vec::new();
    for (index, name) in table.header()?.iter().enumerate() {
        kinds.push(column(index, name, &is_shown).ok_or_else(not_traces)?);
    }
    if kinds.iter().filter(|&&kind| kind == Column::Error).count() != agents {
        return Err(not_traces());
    }
    let columns = kinds.len();
    let mut other = innovations.map(Table::open).transpose()?;
    let not_innovations =
        || wrong(innovations.unwrap_or(traces), "the table of the innovations in these traces");
    if let Some(other) = &mut other {
        let mut expected = vec!["time [s]".to_owned()];
        expected.extend((1..=agents).map(|agent| format!("agent{agent} [output unit]")));
        if other.header()? != expected {
            return Err(not_innovations());
        }
        kinds.push(Column::Time);
        kinds.extend((0..agents).map(|_| Column::Innovation));
    }
    let mut of_points = kinds.clone();
    if let Some(second_time) = of_points.get_mut(columns) {
        *second_time = Column::Unused;
    }
    let mut points = Points::new(of_points);
    let mut row = Vec::with_capacity(kinds.len());
    while table.next(&kinds[..columns], &mut row)? {
        if let Some(other) = &mut other {
            let is_there = other.next(&kinds[columns..], &mut row)?;
            if !is_there || row.get(columns) != row.first() {
                return Err(not_innovations());
            }
        }
        points.add(&row);
        row.clear();
    }
    Ok(thinned(points))
}

fn column(index: usize, name: &str, is_shown: &impl Fn(usize) -> bool) -> Option<Column> {
    if index == 0 {
        return (name == "time [s]").then_some(Column::Time);
    }
    let name = name.strip_suffix(" [state unit]")?;
    let of_agent = name.strip_prefix("agent").and_then(|rest| rest.split_once('.'));
    let Some((agent, what)) = of_agent else { return Some(Column::Truth) };
    let agent = agent.parse().ok()?;
    Some(match what {
        "error" => Column::Error,
        _ if is_shown(agent) => Column::Estimate(agent),
        _ => Column::Unused,
    })
}

fn thinned(points: Points) -> Thinned {
    let mut thinned = Thinned {
        rows_per_point: points.rows,
        time: Vec::new(),
        truth: Vec::new(),
        estimates: Vec::new(),
        errors: Vec::new(),
        innovations: Vec::new(),
    };
    let mut estimates: BTreeMap<usize, Vec<Vec<Short>>> = BTreeMap::new();
    for (kind, values) in points.kinds.into_iter().zip(points.values) {
        let digits = kind.digits();
        let values: Vec<Short> = values.into_iter().map(|value| Short(value, digits)).collect();
        match kind {
            Column::Time => thinned.time = values,
            Column::Truth => thinned.truth.push(values),
            Column::Estimate(agent) => estimates.entry(agent).or_default().push(values),
            Column::Error => thinned.errors.push(values),
            Column::Innovation => thinned.innovations.push(values),
            Column::Unused => {}
        }
    }
    let of_agents = estimates.into_iter();
    thinned.estimates = of_agents.map(|(agent, values)| Estimates { agent, values }).collect();
    thinned
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_row_counts_and_the_largest_error_stays() {
        for rows in [1_u64, 5, 6_000, 6_001, 40_001, 100_000] {
            let mut points = Points::new(vec![Column::Time, Column::Truth, Column::Error]);
            for row in 0..rows {
                let error = if row == rows / 3 { 1e3 } else { (row % 7) as f64 };
                points.add(&[row as f64, -(row as f64), error]);
            }
            let per_point = points.rows;
            let count = points.len() as u64;
            assert_eq!(count, rows.div_ceil(per_point), "{rows}");
            assert!(count <= 2 * POINTS as u64 && (rows < 6_000 || count > POINTS as u64));
            let time: Vec<f64> = (0..count).map(|point| (point * per_point) as f64).collect();
            assert_eq!(points.values[0], time, "{rows}");
            let peak = rows / 3 / per_point;
            assert_eq!(points.values[2][usize::try_from(peak).unwrap()], 1e3, "{rows}");
        }
    }

    #[test]
    fn columns_are_told_by_their_names() {
        let column = |index, name: &str| column(index, name, &|agent| agent == 2);
        assert_eq!(column(0, "time [s]"), Some(Column::Time));
        assert_eq!(column(1, "time [state unit]"), Some(Column::Truth));
        assert_eq!(column(2, "agent1.xhat [state unit]"), Some(Column::Unused));
        assert_eq!(column(2, "agent2.xhat [state unit]"), Some(Column::Estimate(2)));
        assert_eq!(column(2, "agent12.error [state unit]"), Some(Column::Error));
        assert_eq!(column(0, "agent"), None);
        assert_eq!(column(3, "x"), None);
    }
}
