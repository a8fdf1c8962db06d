//! The cells of a study: the combinations of values that its keys take.
//!
//! | option | cells |
//! | --- | --- |
//! | `--vary` | all combinations; the last key changes fastest |
//! | `--latin N` | N points of a Latin hypercube over the ranges |
//! | `--points FILE` | the rows of a CSV file whose header names the keys |
//!
//! In a Latin hypercube each range is divided into N parts of the same size, and each part holds one
//! point. Which points share a part, and where they are within it, is drawn from the seed.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};

use rayon::prelude::*;

use super::vary::{Range, Spec, Vary};
use crate::commands::progress::ProgressBars;
use crate::commands::{CommandError, ErrorCode};
use crate::engine::{Progress as _, check_support};
use crate::files::fnv::Fnv;
use crate::files::input::Limited;
use crate::files::text;
use crate::plant::Recorded;
use crate::random::{Purpose, Random};
use crate::scenario::{Change, Record, Scenario, ScenarioSource};

/// Most cells of a study.
const CELLS_MAX: usize = 1_000_000;
/// Largest file of `--points`. \[bytes\]
const POINTS_BYTES_MAX: u64 = 256 << 20;

/// Keys and their values in every cell.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Cells {
    pub(super) keys: Vec<String>,
    /// One row per cell, as many values as keys.
    pub(super) rows: Vec<Vec<String>>,
    /// The option that they come from, for errors.
    origin: &'static str,
}

impl Cells {
    /// Combines all values of all keys.
    pub(super) fn grid(varied: &[Vary]) -> Result<Self, CommandError> {
        let mut rows: Vec<Vec<String>> = vec![Vec::new()];
        for vary in varied {
            let values = vary.spec.values().ok_or_else(|| {
                CommandError::usage(format!(
                    "--vary {}: how many values? Write lo:hi:N or lo:hi:logN, or draw points with --latin N",
                    vary.text
                ))
            })?;
            if rows.len().saturating_mul(values.len()) > CELLS_MAX {
                return Err(too_many());
            }
            let extended = |row: &Vec<String>| {
                let with = |value| [row.as_slice(), std::slice::from_ref(value)].concat();
                values.iter().map(with).collect::<Vec<_>>()
            };
            rows = rows.iter().flat_map(extended).collect();
        }
        Self { keys: keys(varied), rows, origin: "--vary" }.checked()
    }

    /// Draws the points of a Latin hypercube.
    pub(super) fn latin(varied: &[Vary], count: usize, seed: u64) -> Result<Self, CommandError> {
        if count > CELLS_MAX {
            return Err(too_many());
        }
        let random = Random::new(seed, Purpose::LatinHypercube);
        let column = |(dimension, vary): (usize, &Vary)| match &vary.spec {
            Spec::Range(range) if range.is_drawn() => Ok(drawn(*range, count, random, dimension)),
            _ => Err(CommandError::usage(format!(
                "--vary {}: points of --latin are drawn from a range; write {}=lo:hi or lo:hi:log",
                vary.text, vary.key
            ))),
        };
        let columns: Vec<Vec<String>> =
            varied.iter().enumerate().map(column).collect::<Result<_, _>>()?;
        let row = |k: usize| columns.iter().map(|column| column[k].clone()).collect();
        let rows = (0..count).map(row).collect();
        Self { keys: keys(varied), rows, origin: "--vary" }.checked()
    }

    /// Reads a CSV file.
    pub(super) fn points(path: &Path) -> Result<Self, CommandError> {
        let refused = |line: Option<u64>, problem: &str, hint: &str| {
            let line = line.map_or(String::new(), |line| format!(":{line}"));
            let text = format!("{}{line}: {problem}; {hint}", path.display());
            CommandError::usage(text).about(path)
        };
        let hint = "check the path given to --points";
        let (head, content) = text::open(path)
            .map_err(|error| refused(None, &format!("cannot be read: {error}"), hint))?;
        text::check_text(&head).map_err(|(problem, hint)| refused(None, &problem, &hint))?;
        let content = Limited::new(content, POINTS_BYTES_MAX);
        let too_long = "check the path given to --points, or give fewer points";
        let hint = "write a line with keys, and one line of values for each cell";
        let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).from_reader(content);
        let invalid = |error: &csv::Error| {
            let line = error.position().map(csv::Position::line);
            match error.kind() {
                csv::ErrorKind::Io(error) => {
                    refused(None, &format!("cannot be read: {error}"), too_long)
                }
                _ => refused(line, &format!("invalid CSV: {error}"), hint),
            }
        };
        let header = reader.headers().map_err(|error| invalid(&error))?;
        let keys: Vec<String> = header.iter().map(str::to_owned).collect();
        let mut rows = Vec::new();
        for record in reader.records() {
            let record = record.map_err(|error| invalid(&error))?;
            let line = record.position().map(csv::Position::line);
            if let Some(column) = record.iter().position(str::is_empty) {
                let problem = format!("{} has no value", keys[column]);
                return Err(refused(line, &problem, "write a value for each key"));
            }
            if rows.len() == CELLS_MAX {
                return Err(too_many());
            }
            rows.push(record.iter().map(str::to_owned).collect());
        }
        if keys.iter().all(String::is_empty) || rows.is_empty() {
            return Err(refused(None, "has no cells", hint));
        }
        Self { keys, rows, origin: "--points" }.checked()
    }

    /// Refuses keys that are not paths or appear twice.
    fn checked(self) -> Result<Self, CommandError> {
        let example = self.rows.first().map_or(Vec::new(), Clone::clone);
        let mut changes: Vec<Change> = Vec::new();
        for (key, value) in self.keys.iter().zip(&example) {
            let change = Change::new(self.origin, key, value)
                .map_err(|error| CommandError::usage(format!("{} {key}: {error}", self.origin)))?;
            if changes.iter().any(|other| other.is_about_same_key(&change)) {
                let problem =
                    format!("{} {key}: the key is varied twice; give it once", self.origin);
                return Err(CommandError::usage(problem));
            }
            changes.push(change);
        }
        let mut seen = BTreeSet::new();
        for (cell, row) in self.rows.iter().enumerate() {
            // Equal values can be written differently.
            let values: Vec<String> = self.changes(cell)?.iter().map(Change::shown).collect();
            if !seen.insert(values) {
                let values = row.join(", ");
                let problem =
                    format!("{}: the values {values} appear twice; give them once", self.origin);
                return Err(CommandError::usage(problem));
            }
        }
        Ok(self)
    }

    /// Returns the changes that make the base scenario the one of a cell.
    pub(super) fn changes(&self, cell: usize) -> Result<Vec<Change>, CommandError> {
        let change = |(key, value): (&String, &String)| {
            let change = Change::new(self.origin, key, value).map_err(|error| {
                CommandError::usage(format!("{} {key}={value}: {error}", self.origin))
            })?;
            if change.shown().contains(char::is_control) {
                let problem =
                    format!("{change}: has a control character, which a table cannot hold");
                return Err(CommandError::usage(problem));
            }
            Ok(change)
        };
        self.keys.iter().zip(&self.rows[cell]).map(change).collect()
    }

    /// Reads and checks the scenarios of all cells, and returns those of `wanted`, without recording.
    ///
    /// # Errors
    /// That of the first cell that is refused, or whose state has a different dimension; or if some cells
    /// use a recording and some do not.
    pub(super) fn load(
        &self,
        base: &ScenarioSource,
        wanted: std::ops::Range<usize>,
        dimension: Option<usize>,
    ) -> Result<Loaded, CommandError> {
        let (bars, count) = (ProgressBars::counting("checking", "cells"), self.rows.len() as u64);
        let checked = AtomicU64::new(0);
        let load = |index: usize| -> Result<(Option<u64>, Option<Cell>), CommandError> {
            bars.step(checked.fetch_add(1, Ordering::Relaxed), count);
            let changes = self.changes(index)?;
            let (scenario, _) = base.load(&changes)?;
            check_support(&scenario, scenario.method).map_err(|error| {
                let place = if changes.is_empty() { base.name.clone() } else { in_words(&changes) };
                CommandError::new(ErrorCode::Run, format!("{place}: {error}"))
            })?;
            if let Some(expected) = dimension.filter(|&n| n != scenario.dimension()) {
                let found = scenario.dimension();
                return Err(CommandError::usage(format!(
                    "{}: the state has {found} components, and the drawn initial states have {expected}; \
                     leave --initial-states out, or vary other keys",
                    in_words(&changes)
                )));
            }
            let recording = scenario.plant.recording().map(Recorded::hash);
            let cell = || Cell {
                values: changes.iter().map(Change::shown).collect(),
                scenario: Scenario { record: Record::NOTHING, ..scenario },
            };
            Ok((recording, wanted.contains(&index).then(cell)))
        };
        let all: Vec<_> = (0..self.rows.len()).into_par_iter().map(load).collect();
        let (recordings, cells): (Vec<Option<u64>>, Vec<Option<Cell>>) =
            all.into_iter().collect::<Result<Vec<_>, _>>()?.into_iter().unzip();
        let is_recorded = recordings.first().is_some_and(Option::is_some);
        if let Some(other) = recordings.iter().position(|other| other.is_some() != is_recorded) {
            let (first, other) = (in_words(&self.changes(0)?), in_words(&self.changes(other)?));
            let (recorded, simulated) = if is_recorded { (first, other) } else { (other, first) };
            return Err(CommandError::usage(format!(
                "{recorded} uses a recording, and {simulated} simulates a plant: their results have different \
                 columns; run a separate study for each"
            )));
        }
        let mut hash = Fnv::default();
        for value in self.keys.iter().chain(self.rows.iter().flatten()) {
            hash.add(value.as_bytes());
            hash.add(&[0]);
        }
        recordings.iter().flatten().for_each(|recording| hash.add(&recording.to_le_bytes()));
        Ok(Loaded {
            cells: cells.into_iter().flatten().collect(),
            is_recorded,
            hash: hash.finish(),
        })
    }
}

/// Cells that were read.
#[derive(Clone, Debug)]
pub(super) struct Loaded {
    /// Those that are run.
    pub(super) cells: Vec<Cell>,
    /// Whether all cells use a recording; otherwise none does.
    pub(super) is_recorded: bool,
    /// Hash of the values of all cells, and of their recordings.
    pub(super) hash: u64,
}

fn in_words(changes: &[Change]) -> String {
    changes.iter().map(Change::to_string).collect::<Vec<_>>().join(", ")
}

/// A cell that is run.
#[derive(Clone, Debug)]
pub(super) struct Cell {
    /// Of the varied keys, as tables show them.
    pub(super) values: Vec<String>,
    pub(super) scenario: Scenario,
}

fn keys(varied: &[Vary]) -> Vec<String> {
    varied.iter().map(|vary| vary.key.clone()).collect()
}

fn too_many() -> CommandError {
    CommandError::usage(format!("more than {CELLS_MAX} cells; vary fewer keys, or fewer values"))
}

/// Draws one number from each of `count` equal parts of a range, in random order.
fn drawn(range: Range, count: usize, random: Random, dimension: usize) -> Vec<String> {
    let uniform = |k: usize, purpose: u64| random.uniform([dimension as u64, k as u64, purpose]);
    let mut parts: Vec<usize> = (0..count).collect();
    // Fisher and Yates.
    for k in (1..count).rev() {
        parts.swap(k, ((k + 1) as f64 * uniform(k, 0)) as usize);
    }
    let within = |(k, part): (usize, usize)| range.at((part as f64 + uniform(k, 1)) / count as f64);
    parts.into_iter().enumerate().map(within).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::PAPER;

    fn varied(texts: &[&str]) -> Vec<Vary> {
        texts.iter().map(|text| text.parse().unwrap()).collect()
    }

    fn base() -> ScenarioSource {
        ScenarioSource { name: "paper".to_owned(), text: PAPER.to_owned() }
    }

    #[test]
    fn the_last_key_of_a_grid_changes_fastest() {
        let cells = Cells::grid(&varied(&["a=1,2", "b=x,y,z"])).unwrap();
        let rows: Vec<String> = cells.rows.iter().map(|row| row.concat()).collect();
        assert_eq!(rows, ["1x", "1y", "1z", "2x", "2y", "2z"]);
        assert_eq!(Cells::grid(&[]).unwrap().rows, [Vec::<String>::new()]);
    }

    #[test]
    fn a_latin_hypercube_has_one_point_in_each_part_of_each_range() {
        let cells = Cells::latin(&varied(&["a=0.0:10.0", "b=1:1024:log"]), 10, 3).unwrap();
        let parts = |column: usize, part: fn(f64) -> f64| {
            let mut parts: Vec<i64> =
                cells.rows.iter().map(|row| part(row[column].parse().unwrap()) as i64).collect();
            let order = parts.clone();
            parts.sort_unstable();
            assert_eq!(parts, (0..10).collect::<Vec<_>>());
            order
        };
        assert_ne!(parts(0, |a| a), parts(1, |b| b.log2()));
        assert_ne!(cells, Cells::latin(&varied(&["a=0.0:10.0", "b=1:1024:log"]), 10, 4).unwrap());
    }

    #[test]
    fn contradictions_are_refused() {
        for (cells, problem) in [
            (Cells::grid(&varied(&["a=1", "a = 2"])), "the key is varied twice"),
            (Cells::grid(&varied(&["a=1:2"])), "how many values?"),
            (Cells::grid(&varied(&["a..b=1"])), "invalid key"),
            (Cells::grid(&varied(&["a=1:2:1000", "b=1:2:1001"])), "more than 1000000 cells"),
            (Cells::grid(&varied(&["a=1,2,1"])), "the values 1 appear twice"),
            (Cells::grid(&varied(&["a=x,\"x\""])), "the values \"x\" appear twice"),
            (Cells::latin(&varied(&["a=1:2:3"]), 4, 0), "are drawn from a range"),
        ] {
            let error = cells.unwrap_err().to_string();
            assert!(error.contains(problem), "{error}");
        }
    }

    #[test]
    fn a_refused_cell_is_named_and_other_cells_are_loaded() {
        let cells = Cells::grid(&varied(&["design.epsilon=500,-1"])).unwrap();
        let error = cells.load(&base(), 0..1, None).unwrap_err().to_string();
        assert!(
            error.contains("paper: --vary design.epsilon=-1: design.epsilon: is -1"),
            "{error}"
        );
        let cells = Cells::grid(&varied(&["design.epsilon=500,600", "design.gain.scale=1,2"]));
        let loaded = cells.unwrap().load(&base(), 1..3, Some(3)).unwrap();
        assert!(!loaded.is_recorded);
        let loaded = loaded.cells;
        let values: Vec<String> = loaded.iter().map(|cell| cell.values.join(" ")).collect();
        assert_eq!(values, ["500 2", "600 1"]);
        assert_eq!(loaded[0].scenario.design.epsilon, 500.0);
        assert_eq!(loaded[0].scenario.record, Record::NOTHING);
    }
}
