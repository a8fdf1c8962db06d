//! `results.csv`: one row for each agent of each run.
//!
//! Rows are in the order of cells, seeds, initial states and agents, whatever the order in which runs
//! end: a run that ends early waits in memory for those before it. All rows of a run are written
//! at once, so the file is always a prefix of the complete one.
//!
//! Cells are written as in the scenario, seeds and counts as integers, and errors with the fewest
//! digits that read back to the same bits. A run without a result has `diverged = true` and empty
//! numbers. Studies of a recording have the column `innovation_rms` as well, because the recording may
//! have no reference to take errors against.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use super::cells::Cell;
use crate::engine::statistics::AgentStatistics;
use crate::files::output::{FileKind, OutputError};

/// Name of the file.
pub(super) const NAME: &str = "results.csv";

/// The columns after those of the varied keys, of a simulated plant.
pub(super) const COLUMNS: [&str; 8] =
    ["seed", "initial_state", "agent", "rmse", "broadcasts", "bytes", "max_error", "diverged"];

/// The same, of a recording.
pub(super) const RECORDED: [&str; 9] = [
    "seed",
    "initial_state",
    "agent",
    "rmse",
    "broadcasts",
    "bytes",
    "max_error",
    "innovation_rms",
    "diverged",
];

/// Returns the number of columns after `agent`.
pub(super) fn measured(is_recorded: bool) -> usize {
    let columns = if is_recorded { RECORDED.len() } else { COLUMNS.len() };
    columns - 3
}

/// Returns the number of varied keys in a header, and whether it is of a recording.
pub(super) fn keys_of(header: &[String]) -> Option<(usize, bool)> {
    let keys = |columns: &[&str]| {
        let keys = header.len().checked_sub(columns.len())?;
        (header[keys..] == *columns).then_some(keys)
    };
    let recorded = keys(&RECORDED).map(|keys| (keys, true));
    recorded.or_else(|| keys(&COLUMNS).map(|keys| (keys, false)))
}

/// The kind of this file.
pub(super) const KIND: FileKind = FileKind {
    name: "the results of a sweep",
    recognises: |bytes| {
        let line = bytes.split(|&byte| byte == b'\n').next().unwrap_or_default();
        line.ends_with(COLUMNS.join(",").as_bytes())
            || line.ends_with(RECORDED.join(",").as_bytes())
    },
};

/// Returns the first line of the file.
pub(super) fn header(keys: &[String], is_recorded: bool) -> String {
    let columns: &[&str] = if is_recorded { &RECORDED } else { &COLUMNS };
    let keys = keys.iter().map(String::as_str);
    line(&keys.chain(columns.iter().copied()).collect::<Vec<_>>())
}

/// Returns a line of CSV with its end.
pub(super) fn line(fields: &[&str]) -> String {
    let mut writer = csv::Writer::from_writer(Vec::new());
    // Writing into memory cannot fail.
    let _ = writer.write_record(fields);
    String::from_utf8(writer.into_inner().unwrap_or_default()).unwrap_or_default()
}

/// The rows of the runs of one cell.
#[derive(Clone, Debug)]
pub(super) struct CellRows {
    /// The values of the varied keys, with the comma after them.
    start: String,
    /// Number of agents.
    pub(super) agents: usize,
    /// Whether the study uses a recording.
    is_recorded: bool,
}

/// What a row says of one agent.
type Measured<'m> = Option<&'m AgentStatistics>;

impl CellRows {
    pub(super) fn new(cell: &Cell, is_recorded: bool) -> Self {
        let mut start = String::new();
        if !cell.values.is_empty() {
            let values: Vec<&str> = cell.values.iter().map(String::as_str).collect();
            start = line(&values);
            start.pop();
            start.push(',');
        }
        Self { start, agents: cell.scenario.agents.len(), is_recorded }
    }

    /// Returns the start of a row, up to the measured numbers. All numbers count from 1.
    pub(super) fn start_of_row(&self, seed: u64, initial_state: u64, agent: usize) -> String {
        format!("{}{seed},{initial_state},{agent},", self.start)
    }

    /// Returns all rows of a run; `None` for one without a result.
    pub(super) fn run(
        &self,
        seed: u64,
        initial_state: u64,
        agents: Option<&[AgentStatistics]>,
    ) -> String {
        let agents = agents.filter(|agents| agents.iter().all(is_finite));
        let row = |index: usize| {
            let start = self.start_of_row(seed, initial_state, index + 1);
            start + &measurements(agents.map(|agents| &agents[index]), self.is_recorded)
        };
        (0..self.agents).map(row).collect()
    }
}

/// Larger errors count as a divergence: agents calculate in single precision.
pub(super) const NUMBER_MAX: f64 = 1e50;

/// Whether an agent's errors are numbers of a possible size.
fn is_finite(agent: &AgentStatistics) -> bool {
    [agent.rmse(), agent.max_error(), agent.innovation_rms()]
        .into_iter()
        .flatten()
        .all(|error| error <= NUMBER_MAX)
}

fn measurements(agent: Measured<'_>, is_recorded: bool) -> String {
    let Some(agent) = agent else {
        return if is_recorded { ",,,,,true\n" } else { ",,,,true\n" }.to_owned();
    };
    let number = |value: Option<f64>| {
        value.map_or(String::new(), |value| ryu::Buffer::new().format(value).to_owned())
    };
    let innovation = if is_recorded { number(agent.innovation_rms()) + "," } else { String::new() };
    format!(
        "{},{},{},{},{innovation}false\n",
        number(agent.rmse()),
        agent.broadcasts_evaluated,
        agent.bytes_evaluated,
        number(agent.max_error())
    )
}

/// The file in progress.
pub(super) struct Results {
    path: PathBuf,
    file: File,
    /// Number of the next run to write.
    next: u64,
    waiting: BTreeMap<u64, String>,
}

impl Results {
    /// Continues a file that is open at its end, before run `next`.
    pub(super) fn new(path: &Path, file: File, next: u64) -> Self {
        Self { path: path.to_owned(), file, next, waiting: BTreeMap::new() }
    }

    /// Adds the rows of a run, and writes all that are next.
    pub(super) fn add(&mut self, run: u64, rows: String) -> Result<(), OutputError> {
        self.waiting.insert(run, rows);
        while let Some(rows) = self.waiting.remove(&self.next) {
            self.write(&rows)
                .map_err(|error| OutputError::Write { path: self.path.clone(), error })?;
            self.next += 1;
        }
        Ok(())
    }

    /// Returns the number of the first run that is not written.
    pub(super) fn next(&self) -> u64 {
        self.next
    }

    fn write(&mut self, rows: &str) -> io::Result<()> {
        self.file.write_all(rows.as_bytes())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::{PAPER, Scenario};

    fn rows(values: &[&str]) -> CellRows {
        let scenario = Scenario::parse("paper", PAPER).unwrap();
        let values = values.iter().map(|&value| value.to_owned()).collect();
        CellRows::new(&Cell { values, scenario }, false)
    }

    #[test]
    fn values_with_commas_are_quoted_and_errors_have_all_their_digits() {
        let keys = ["plant.initial_state".to_owned(), "k".to_owned()];
        assert_eq!(
            header(&keys, false),
            "plant.initial_state,k,seed,initial_state,agent,rmse,broadcasts,bytes,max_error,diverged\n"
        );
        assert!(
            (KIND.recognises)(header(&keys, false).as_bytes())
                && (KIND.recognises)(header(&[], true).as_bytes())
        );
        let rows = rows(&["[1, 2]", "paper"]);
        let mut agent = AgentStatistics::default();
        agent.broadcasts_evaluated = 7;
        agent.error(0.1 * 0.1);
        let written = rows.run(4, 2, Some(&[agent.clone(), agent.clone(), agent.clone()]));
        assert_eq!(
            written.lines().nth(1),
            Some("\"[1, 2]\",paper,4,2,2,0.1,7,0,0.1,false"),
            "{written}"
        );
        agent.error(f64::INFINITY);
        let diverged = rows.run(4, 2, Some(&[agent.clone(), agent.clone(), agent]));
        assert_eq!(diverged, rows.run(4, 2, None));
        assert!(diverged.starts_with("\"[1, 2]\",paper,4,2,1,,,,,true\n"), "{diverged}");
    }

    #[test]
    fn runs_are_written_in_order() {
        let file = tempfile();
        let mut results = Results::new(&file, File::create(&file).unwrap(), 3);
        for (run, written) in [(5, ""), (4, ""), (3, "345"), (7, "345"), (6, "34567")] {
            results.add(run, run.to_string()).unwrap();
            assert_eq!(std::fs::read_to_string(&file).unwrap(), written);
        }
        std::fs::remove_file(file).unwrap();
    }

    fn tempfile() -> PathBuf {
        std::env::temp_dir().join(format!("host-sim-results-{}", std::process::id()))
    }
}
