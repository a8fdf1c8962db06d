//! `summary.csv`: mean, median and interval of the results of each cell.
//!
//! All numbers come from the rows of `results.csv`, so a table put together from several parts has
//! the same summary as one that was written in one go. For each cell there is a row for each agent
//! and one for `all`: the largest error of an agent, and the broadcasts and bytes of all agents
//! together.
//!
//! The interval is from the 2.5th to the 97.5th percentile over the runs with a result, interpolated
//! between neighbouring values. The number of runs without one is counted beside it.

use std::collections::BTreeSet;
use std::fs;
use std::io::{self, Read};
use std::path::Path;

use serde::Serialize;

use super::results::{NUMBER_MAX, keys_of, line};
use crate::commands::{CommandError, ErrorCode};
use crate::files::fnv::Fnv;
use crate::files::output::{FileKind, OutputError, write_result};
use crate::files::text;
use crate::number::{counted, significant};
use crate::report::columns::Table;
use crate::warning::{Warning, WarningCode};

/// Name of the file.
pub(super) const NAME: &str = "summary.csv";

/// Percentiles of the interval, as fractions.
const INTERVAL: [f64; 2] = [0.025, 0.975];

/// Cells that the text shows at most.
const SHOWN_MAX: usize = 40;

pub(super) const KIND: FileKind = FileKind {
    name: "the summary of a sweep",
    recognises: |bytes| {
        let line = bytes.split(|&byte| byte == b'\n').next().unwrap_or_default();
        line.ends_with(b"max_error_low,max_error_high")
            || line.ends_with(b"innovation_rms_low,innovation_rms_high")
    },
};

/// Removes the summary of a table that changes from a folder.
pub(super) fn remove(folder: &Path) -> Result<(), OutputError> {
    let path = folder.join(NAME);
    if !path.is_file() || !KIND.is_at(&path) {
        return Ok(());
    }
    fs::remove_file(&path).map_err(|error| OutputError::Write { path, error })
}

/// Mean, median and interval of some values.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub(super) struct Interval {
    pub(super) mean: f64,
    pub(super) median: f64,
    pub(super) low: f64,
    pub(super) high: f64,
}

impl Interval {
    /// `None` without values.
    fn of(mut values: Vec<f64>) -> Option<Self> {
        if values.is_empty() {
            return None;
        }
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        values.sort_by(f64::total_cmp);
        let at = |part: f64| {
            let place = part * (values.len() - 1) as f64;
            let (below, above) = (values[place.floor() as usize], values[place.ceil() as usize]);
            below + (place - place.floor()) * (above - below)
        };
        let [low, high] = INTERVAL.map(at);
        Some(Self { mean, median: at(0.5), low, high })
    }
}

/// What a row measured.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Measured {
    /// In the order of [`MEASURES`].
    values: [f64; 5],
}

/// The measured columns.
const MEASURES: [&str; 5] = ["rmse", "broadcasts", "bytes", "max_error", "innovation_rms"];

/// The results of one cell.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct CellSummary {
    /// Of the varied keys.
    pub(super) values: Vec<String>,
    /// Number of runs.
    pub(super) runs: u64,
    /// Number of runs without a result.
    pub(super) diverged: u64,
    #[serde(flatten)]
    pub(super) all: Measures,
    pub(super) agents: Vec<Measures>,
}

/// The measured numbers over all runs with a result.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub(super) struct Measures {
    pub(super) rmse: Option<Interval>,
    pub(super) broadcasts: Option<Interval>,
    pub(super) bytes: Option<Interval>,
    pub(super) max_error: Option<Interval>,
    /// Of a recording.
    pub(super) innovation_rms: Option<Interval>,
}

impl Measures {
    fn of(rows: &[Measured]) -> Self {
        let column = |index: usize| {
            let values = rows.iter().map(|row| row.values[index]);
            Interval::of(values.filter(|value| value.is_finite()).collect())
        };
        Self {
            rmse: column(0),
            broadcasts: column(1),
            bytes: column(2),
            max_error: column(3),
            innovation_rms: column(4),
        }
    }

    /// In the order of [`MEASURES`].
    fn all(&self) -> [Option<Interval>; 5] {
        [self.rmse, self.broadcasts, self.bytes, self.max_error, self.innovation_rms]
    }
}

/// The results of a study.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Summary {
    pub(super) keys: Vec<String>,
    /// Whether the study uses a recording.
    pub(super) is_recorded: bool,
    pub(super) cells: Vec<CellSummary>,
    /// Hash of the whole table, hexadecimal: equal for equal results.
    pub(super) digest: String,
}

/// The rows of a cell in progress.
struct Collected {
    values: Vec<String>,
    /// Seed and initial state of the last run.
    last: Option<[String; 2]>,
    /// For each run the measured numbers of each agent; `None` for one without a result.
    runs: Vec<Option<Vec<Measured>>>,
}

/// The fewest and the most rows of a run. A run with fewer rows than others was cut off.
#[derive(Default)]
struct RowsOfRuns {
    /// With the line of the run's last row.
    fewest: Option<(u64, Option<u64>)>,
    most: u64,
}

impl RowsOfRuns {
    fn note(&mut self, rows: u64, line: Option<u64>) {
        if rows > 0 && self.fewest.is_none_or(|(fewest, _)| rows < fewest) {
            self.fewest = Some((rows, line));
        }
        self.most = self.most.max(rows);
    }

    /// Returns what is wrong, and the line.
    fn cut(&self) -> Option<(String, Option<u64>)> {
        let (fewest, line) = self.fewest.filter(|&(fewest, _)| fewest < self.most)?;
        Some((format!("the run ends after {fewest} of {} agents", self.most), line))
    }
}

impl Collected {
    fn summary(self) -> CellSummary {
        let complete: Vec<&Vec<Measured>> = self.runs.iter().flatten().collect();
        let together = |agents: &&Vec<Measured>| {
            let largest = |index: usize| {
                agents.iter().map(|agent| agent.values[index]).fold(f64::NAN, f64::max)
            };
            let sum = |index: usize| agents.iter().map(|agent| agent.values[index]).sum();
            Measured { values: [largest(0), sum(1), sum(2), largest(3), largest(4)] }
        };
        let count = complete.iter().map(|agents| agents.len()).max().unwrap_or(0);
        let agent = |index: usize| {
            let rows = complete.iter().filter_map(|agents| agents.get(index).copied());
            Measures::of(&rows.collect::<Vec<_>>())
        };
        CellSummary {
            runs: self.runs.len() as u64,
            diverged: (self.runs.len() - complete.len()) as u64,
            all: Measures::of(&complete.iter().map(together).collect::<Vec<_>>()),
            agents: (0..count).map(agent).collect(),
            values: self.values,
        }
    }
}

fn refusal(path: &Path, line: Option<u64>, problem: &str, hint: &str) -> CommandError {
    let line = line.map_or(String::new(), |line| format!(":{line}"));
    let text = format!("{}{line}: {problem}; {hint}", path.display());
    CommandError::new(ErrorCode::Samples, text).about(path)
}

impl Summary {
    /// Reads `results.csv`.
    pub(super) fn read(path: &Path) -> Result<Self, CommandError> {
        let refused = |line: Option<u64>, problem: &str| {
            let hint = "pass the results.csv of a sweep, or those of all its parts, concatenated in the order \
                        of their numbers";
            refusal(path, line, problem, hint)
        };
        let cut_off = |(problem, line): (String, Option<u64>)| {
            let hint = "run the study again to complete the table, or remove the run's rows";
            refusal(path, line, &problem, hint)
        };
        let (head, content) =
            text::open(path).map_err(|error| refused(None, &format!("cannot be read: {error}")))?;
        text::check_text(&head).map_err(|(problem, _)| refused(None, &problem))?;
        let mut reader = csv::Reader::from_reader(Hashed { inner: content, hash: Fnv::default() });
        let header = reader.headers().map_err(|error| refused(Some(1), &error.to_string()))?;
        let header: Vec<String> = header.iter().map(str::to_owned).collect();
        let (keys, is_recorded) =
            keys_of(&header).ok_or_else(|| refused(Some(1), "is not the header of results"))?;
        let mut cells: Vec<CellSummary> = Vec::new();
        let mut current: Option<Collected> = None;
        let (mut seen, mut next) = (BTreeSet::new(), 1);
        // Only keys that begin so can change the number of agents.
        let is_fixed = header[..keys]
            .iter()
            .all(|key| !["agents", "graph", "plant"].iter().any(|k| key.starts_with(k)));
        let (mut sizes, mut line) = (RowsOfRuns::default(), None);
        for record in reader.records() {
            let record = record.map_err(|error| match error.kind() {
                csv::ErrorKind::Io(error) => refused(None, &format!("cannot be read: {error}")),
                _ => refused(error.position().map(csv::Position::line), "is not a row of results"),
            })?;
            let number = record.position().map(csv::Position::line);
            let row = Row::read(&record, keys, is_recorded)
                .ok_or_else(|| refused(number, "invalid row"))?;
            let is_same = current.as_ref().is_some_and(|cell| cell.values == row.values);
            let is_new_run = row.agent == 1
                || !is_same
                || current.as_ref().is_some_and(|cell| cell.last.as_ref() != Some(&row.run));
            if is_new_run {
                sizes.note(next - 1, line);
            }
            if !is_same {
                if !is_fixed && let Some(cut) = std::mem::take(&mut sizes).cut() {
                    return Err(cut_off(cut));
                }
                cells.extend(current.take().map(Collected::summary));
            }
            let cell = current.get_or_insert_with(|| Collected {
                values: row.values.clone(),
                last: None,
                runs: Vec::new(),
            });
            if is_new_run {
                if !seen.insert((row.values, row.run.clone())) {
                    return Err(refused(number, "a run that is in the table already"));
                }
                cell.last = Some(row.run);
                cell.runs.push(Some(Vec::new()));
                next = 1;
            }
            if row.agent != next {
                return Err(refused(number, &format!("agent {}, expected {next}", row.agent)));
            }
            next += 1;
            line = number;
            if let Some(run) = cell.runs.last_mut() {
                match (row.measured, run.as_mut()) {
                    (Some(measured), Some(agents)) => agents.push(measured),
                    _ => *run = None,
                }
            }
        }
        sizes.note(next - 1, line);
        if let Some(cut) = sizes.cut() {
            return Err(cut_off(cut));
        }
        cells.extend(current.map(Collected::summary));
        if cells.is_empty() {
            return Err(refused(None, "has no runs"));
        }
        let digest = format!("{:#018x}", reader.get_ref().hash.finish());
        Ok(Self { keys: header[..keys].to_vec(), is_recorded, cells, digest })
    }

    /// Returns what a reader has to know to draw the right conclusions. `all` are the runs and cells of the complete
    /// study, if they are known.
    pub(super) fn remarks(&self, all: Option<(u64, usize)>) -> Vec<Warning> {
        let missing = all.filter(|&(runs, _)| runs > self.runs()).map(|(runs, cells)| {
            format!(
                "the study is not complete: the table has {} of {runs} runs, and {} of {cells} cells; let the study run to its end, \
                 or add the missing parts",
                self.runs(),
                self.cells.len(),
            )
        });
        [
            (WarningCode::IncompleteStudy, missing.or_else(|| self.incomplete())),
            (WarningCode::WithoutEffect, self.without_effect()),
            (WarningCode::WithoutSpread, self.without_spread()),
        ]
        .into_iter()
        .filter_map(|(code, text)| Some(Warning::new(code, text?)))
        .collect()
    }

    /// Says so if all cells have the same results.
    fn without_effect(&self) -> Option<String> {
        let (first, others) = self.cells.split_first()?;
        let is_same = |cell: &CellSummary| {
            (cell.diverged, &cell.all, &cell.agents) == (first.diverged, &first.all, &first.agents)
        };
        let (is_result, keys) = (first.diverged < first.runs, self.keys.join(" and "));
        (is_result && !others.is_empty() && others.iter().all(is_same)).then(|| {
            format!(
                "all {} cells have the same results: {keys} has no effect in this scenario",
                self.cells.len()
            )
        })
    }

    /// Says so if several runs of each cell have the same results.
    fn without_spread(&self) -> Option<String> {
        let is_narrow = |cell: &CellSummary| {
            let measured = cell.all.all().into_iter().flatten();
            cell.runs > 1
                && cell.diverged == 0
                && measured.clone().count() > 0
                && measured.clone().all(|interval| interval.low == interval.high)
        };
        (!self.cells.is_empty() && self.cells.iter().all(is_narrow)).then(|| {
            "all runs of a cell have the same results: nothing in this scenario depends on the seed".to_owned()
        })
    }

    /// Returns what looks incomplete: cells with fewer runs than others.
    fn incomplete(&self) -> Option<String> {
        let most = self.cells.iter().map(|cell| cell.runs).max()?;
        let few = self.cells.iter().find(|cell| cell.runs < most)?;
        let (values, runs) = (few.values.join(", "), few.runs);
        Some(format!(
            "the study is not complete: the cell {values} has {runs} of {most} runs; add the missing parts, or let \
             the study run to its end"
        ))
    }

    /// Returns the number of all runs.
    pub(super) fn runs(&self) -> u64 {
        self.cells.iter().map(|cell| cell.runs).sum()
    }

    /// Writes `summary.csv`.
    pub(super) fn write(&self, folder: &Path) -> Result<(), OutputError> {
        let mut header = self.keys.clone();
        header.extend(["agent", "runs", "diverged"].map(str::to_owned));
        let levels = ["mean", "median", "low", "high"];
        let count = if self.is_recorded { MEASURES.len() } else { MEASURES.len() - 1 };
        let measures = MEASURES.iter().take(count);
        header.extend(measures.flat_map(|of| levels.map(|level| format!("{of}_{level}"))));
        write_result(&folder.join(NAME), KIND, |file| {
            file.write_all(csv_line(&header).as_bytes())?;
            for cell in &self.cells {
                let agents =
                    cell.agents.iter().zip(1..).map(|(agent, number)| (number.to_string(), agent));
                for (agent, measures) in agents.chain([("all".to_owned(), &cell.all)]) {
                    let mut fields = cell.values.clone();
                    fields.extend([agent, cell.runs.to_string(), cell.diverged.to_string()]);
                    for interval in measures.all().into_iter().take(count) {
                        fields.extend(entries(interval));
                    }
                    file.write_all(csv_line(&fields).as_bytes())?;
                }
            }
            Ok(())
        })
    }

    /// Whether errors are known; otherwise only innovations are.
    pub(super) fn has_errors(&self) -> bool {
        !self.is_recorded || self.cells.iter().any(|cell| cell.all.rmse.is_some())
    }

    /// Returns the largest error of an agent, or the largest innovation where there are no errors.
    pub(super) fn error_of(&self, cell: &CellSummary) -> Option<Interval> {
        if self.has_errors() { cell.all.rmse } else { cell.all.innovation_rms }
    }

    /// Returns a table of all agents together, of these cells.
    pub(super) fn table(&self, cells: usize) -> Table {
        let mut headings: Vec<[&str; 2]> = self.keys.iter().map(|key| ["", key.as_str()]).collect();
        headings.extend([["", "runs"], ["", "diverged"]]);
        let error = match self.has_errors() {
            true => "largest RMSE of an agent",
            false => "largest innovation RMS of an agent",
        };
        let groups = [error, "broadcasts of all agents"];
        let levels = ["median", "2.5 %", "97.5 %"];
        headings.extend(groups.iter().flat_map(|group| levels.map(|level| [*group, level])));
        let row = |cell: &CellSummary| {
            let mut row: Vec<String> = cell.values.iter().map(|value| short(value)).collect();
            row.extend([cell.runs.to_string(), cell.diverged.to_string()]);
            row.extend(levels_of(self.error_of(cell), |x| significant(x, 4)));
            row.extend(levels_of(cell.all.broadcasts, |x| format!("{x:.0}")));
            row
        };
        Table::new(&headings, self.cells.iter().take(cells).map(row).collect())
    }

    /// Formats a table of all agents together.
    pub(super) fn text(&self) -> String {
        let mut text = self.table(SHOWN_MAX).text();
        if let Some(more) = self.cells.len().checked_sub(SHOWN_MAX).filter(|&more| more > 0) {
            text +=
                &format!("... and {} in {NAME}\n", counted(more as u64, "more cell", "more cells"));
        }
        text
    }
}

/// Hashes what is read.
struct Hashed<R> {
    inner: R,
    hash: Fnv,
}

impl<R: Read> Read for Hashed<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let length = self.inner.read(buffer)?;
        self.hash.add(&buffer[..length]);
        Ok(length)
    }
}

/// A row of `results.csv`.
struct Row {
    values: Vec<String>,
    /// Seed and initial state.
    run: [String; 2],
    /// From 1.
    agent: u64,
    /// `None` for a run without a result.
    measured: Option<Measured>,
}

impl Row {
    fn read(record: &csv::StringRecord, keys: usize, is_recorded: bool) -> Option<Self> {
        let field = |index: usize| record.get(index);
        let number = |index: usize| match field(index)? {
            "" => Some(f64::NAN),
            text => text.parse().ok().filter(|number| (0.0..=NUMBER_MAX).contains(number)),
        };
        let count =
            |index: usize| number(index).filter(|count| count.is_nan() || count.fract() == 0.0);
        let run = [field(keys)?.to_owned(), field(keys + 1)?.to_owned()];
        let first = keys + 3;
        let innovation = if is_recorded { number(first + 4)? } else { f64::NAN };
        let measured = match field(first + 4 + usize::from(is_recorded))? {
            "true" => None,
            "false" => Some(Measured {
                values: [
                    number(first)?,
                    count(first + 1)?,
                    count(first + 2)?,
                    number(first + 3)?,
                    innovation,
                ],
            }),
            _ => return None,
        };
        let agent = field(keys + 2)?.parse().ok()?;
        let values = record.iter().take(keys).map(str::to_owned).collect();
        Some(Self { values, run, agent, measured })
    }
}

fn csv_line(fields: &[String]) -> String {
    line(&fields.iter().map(String::as_str).collect::<Vec<_>>())
}

fn entries(interval: Option<Interval>) -> [String; 4] {
    match interval {
        Some(Interval { mean, median, low, high }) => {
            [mean, median, low, high].map(|value| ryu::Buffer::new().format(value).to_owned())
        }
        None => Default::default(),
    }
}

fn levels_of(interval: Option<Interval>, entry: impl Fn(f64) -> String) -> [String; 3] {
    match interval {
        Some(Interval { median, low, high, .. }) => [median, low, high].map(entry),
        None => ["-"; 3].map(str::to_owned),
    }
}

/// Shortens a number that was drawn or computed.
fn short(value: &str) -> String {
    match value.parse::<f64>() {
        Ok(number) if value.len() > 8 => significant(number, 5),
        _ => value.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    fn read(name: &str, text: &str) -> Result<Summary, String> {
        let path = std::env::temp_dir().join(format!("host-sim-{name}-{}", std::process::id()));
        fs::write(&path, text).unwrap();
        let summary = Summary::read(&path);
        fs::remove_file(&path).unwrap();
        summary.map_err(|error| error.to_string())
    }

    const HEADER: &str = "k,seed,initial_state,agent,rmse,broadcasts,bytes,max_error,diverged\n";

    #[test]
    fn percentiles_are_interpolated() {
        assert_eq!(Interval::of(Vec::new()), None);
        let one = Interval::of(vec![3.0]).unwrap();
        assert_eq!(one, Interval { mean: 3.0, median: 3.0, low: 3.0, high: 3.0 });
        let many = Interval::of((0..=40).rev().map(f64::from).collect()).unwrap();
        assert_eq!(many, Interval { mean: 20.0, median: 20.0, low: 1.0, high: 39.0 });
        assert_eq!(Interval::of(vec![1.0, 2.0]).unwrap().median, 1.5);
    }

    #[test]
    fn runs_without_a_result_are_counted_and_left_out() {
        let rows = "a,0,1,1,0.1,5,50,0.5,false\na,0,1,2,0.3,7,70,0.4,false\n\
                    a,1,1,1,,,,,true\na,1,1,2,,,,,true\n\
                    b,0,1,1,0.2,1,10,0.2,false\nb,0,1,2,0.1,2,20,0.1,false\n";
        let summary = read("summary", &format!("{HEADER}{rows}")).unwrap();
        assert_eq!(summary.keys, ["k"]);
        let [first, second] = &summary.cells[..] else { panic!("{summary:?}") };
        assert_eq!((first.runs, first.diverged, second.runs), (2, 1, 1));
        let median = |interval: Option<Interval>| interval.unwrap().median;
        assert_eq!((median(first.all.rmse), median(first.all.broadcasts)), (0.3, 12.0));
        assert_eq!((median(first.all.bytes), median(first.all.max_error)), (120.0, 0.5));
        assert_eq!(median(first.agents[1].max_error), 0.4);
        let text = summary.text();
        assert!(text.contains("0.3000") && text.lines().count() == 5, "{text}");
    }

    #[test]
    fn a_run_that_was_cut_off_is_refused() {
        let row = |cell: &str, seed: u64, agent: u64| {
            format!("{cell},{seed},1,{agent},0.1,5,50,0.5,false\n")
        };
        let run = |cell: &str, seed: u64, agents: u64| -> String {
            (1..=agents).map(|agent| row(cell, seed, agent)).collect()
        };
        let whole = [run("a", 0, 3), run("a", 1, 3), run("b", 0, 3), run("b", 1, 3)];
        assert_eq!(read("whole", &format!("{HEADER}{}", whole.concat())).unwrap().runs(), 4);
        for (cut, agents, line) in [(0, 2, 3), (1, 1, 5), (2, 2, 9), (3, 1, 11)] {
            let mut rows = whole.clone();
            rows[cut] = run(&rows[cut][..1], cut as u64 % 2, agents);
            let error = read("cut", &format!("{HEADER}{}", rows.concat())).unwrap_err();
            let expected = format!(":{line}: the run ends after {agents} of 3 agents");
            assert!(error.contains(&expected), "{error}");
        }
        // Diverged runs have a row for each agent, too.
        let diverged = format!("{}b,0,1,1,,,,,true\n", run("a", 0, 2));
        assert!(read("diverged", &format!("{HEADER}{diverged}")).is_err());
        // A cell can have other agents than the next.
        let graphs = HEADER.replacen('k', "graph.edges", 1);
        let rows = [run("a", 0, 3), run("b", 0, 2)].concat();
        assert_eq!(read("graphs", &format!("{graphs}{rows}")).unwrap().runs(), 2);
        let rows = [run("a", 0, 3), run("b", 0, 2), run("b", 1, 3)].concat();
        assert!(read("graphs", &format!("{graphs}{rows}")).is_err());
    }

    #[test]
    fn a_cell_without_any_result_has_no_numbers() {
        let summary = read("none", &format!("{HEADER}a,0,1,1,,,,,true\n")).unwrap();
        assert_eq!((summary.cells[0].diverged, summary.cells[0].all.rmse), (1, None));
        assert!(summary.text().contains('-'));
    }

    #[test]
    fn other_tables_are_refused() {
        let error = read("second", "b,0,1,1,0.2,1,10,0.2,false\n").unwrap_err();
        assert!(error.contains(":1: is not the header") && error.contains("order"), "{error}");
        for row in [
            "a,0,1,1,0.1,5,50,0.5,maybe",
            "a,0,1,1,-0.1,5,50,0.5,false",
            "a,0,1,1,1e400,5,50,0.5,false",
            "a,0,1,1,nan,5,50,0.5,false",
            "a,0,1,1,1e300,5,50,0.5,false",
            "a,0,1,1,0.1,5.5,50,0.5,false",
        ] {
            let error = read("row", &format!("{HEADER}{row}\n")).unwrap_err();
            assert!(error.contains(":2: invalid row"), "{row}: {error}");
        }
        let error = read("short", &format!("{HEADER}a,0,1\n")).unwrap_err();
        assert!(error.contains(":2: is not a row"), "{error}");
    }
}
