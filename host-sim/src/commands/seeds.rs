//! Runs with several seeds: median and range for each agent.
//!
//! The step in which a trigger fires is sensitive to rounding, so broadcast counts vary by a few
//! percent between equivalent runs. Medians and ranges over seeds separate this variation from real
//! effects.

use std::path::Path;

use rayon::prelude::*;
use serde::Serialize;

use super::CommandError;
use crate::engine::statistics::AgentStatistics;
use crate::engine::{Progress, RunOptions, run};
use crate::files::output::OutputError;
use crate::files::table::write_table;
use crate::number::counted;
use crate::report::columns::Table;
use crate::report::tables::{change_percent, number, percent};
use crate::scenario::{Record, Scenario, Time};

/// Results of one agent with one seed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Measured {
    rmse: Option<f64>,
    broadcasts: u64,
    mean_interval: Option<f64>,
}

/// Results of all agents with one seed.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct SeedRun {
    seed: u64,
    agents: Vec<Measured>,
}

impl SeedRun {
    pub(super) fn new(seed: u64, agents: &[AgentStatistics], time: &Time) -> Self {
        let measured = |agent: &AgentStatistics| Measured {
            rmse: agent.rmse(),
            broadcasts: agent.broadcasts(),
            mean_interval: agent.mean_interval(time),
        };
        Self { seed, agents: agents.iter().map(measured).collect() }
    }
}

/// Runs `scenario` with learning for each seed, in parallel and without recording. `progress` is
/// called once per run. The result does not depend on the number of threads.
///
/// # Errors
/// Returns the error of the first seed whose run fails.
pub(super) fn run_all<P: Progress>(
    scenario: &Scenario,
    seeds: std::ops::Range<u64>,
    progress: impl Fn() -> P + Sync,
) -> Result<Vec<SeedRun>, CommandError> {
    let scenario = Scenario { record: Record::NOTHING, ..scenario.clone() };
    let one = |seed| {
        let options = RunOptions { seed, learning: true, bounds: false };
        let result = run(&scenario, options, &progress());
        let result =
            result.map_err(|error| CommandError::from(error).within(&format!("seed {seed}")))?;
        Ok(SeedRun::new(seed, &result.agents, &scenario.time))
    };
    let runs: Vec<_> = seeds.into_par_iter().map(one).collect();
    runs.into_iter().collect()
}

/// Median and range of a set of values.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub(super) struct Spread {
    pub(super) median: f64,
    pub(super) min: f64,
    pub(super) max: f64,
}

impl Spread {
    /// Returns the median and range, or `None` without values. The median of an even number of
    /// values is the mean of the middle two.
    pub(super) fn of(values: impl Iterator<Item = f64>) -> Option<Self> {
        let mut values: Vec<f64> = values.collect();
        values.sort_by(f64::total_cmp);
        let (&min, &max) = (values.first()?, values.last()?);
        let (low, high) = ((values.len() - 1) / 2, values.len() / 2);
        Some(Self { median: 0.5 * (values[low] + values[high]), min, max })
    }
}

/// Spreads over the learning runs of all seeds.
#[derive(Debug, Serialize)]
pub(super) struct Report {
    first: u64,
    count: usize,
    agents: Vec<AgentSpreads>,
}

#[derive(Debug, Serialize)]
struct AgentSpreads {
    agent: usize,
    rmse: Option<Spread>,
    change_percent_no_network: Option<Spread>,
    /// Relative to the untrained network.
    change_percent: Option<Spread>,
    broadcasts: Option<Spread>,
    mean_interval: Option<Spread>,
}

impl Report {
    /// Summarises runs in the order of their seeds. `no_network` and `untrained` are the baselines,
    /// which are the same for every seed.
    pub(super) fn new(
        runs: &[SeedRun],
        no_network: &[AgentStatistics],
        untrained: &[AgentStatistics],
    ) -> Self {
        let agents = runs.first().map_or(0, |run| run.agents.len());
        let spreads = |index: usize| {
            let measured = || runs.iter().map(move |run| run.agents[index]);
            let changes = |against: &[AgentStatistics]| {
                let before = against.get(index).and_then(AgentStatistics::rmse);
                Spread::of(measured().filter_map(|agent| change_percent(before, agent.rmse)))
            };
            AgentSpreads {
                agent: index + 1,
                rmse: Spread::of(measured().filter_map(|agent| agent.rmse)),
                change_percent_no_network: changes(no_network),
                change_percent: changes(untrained),
                broadcasts: Spread::of(measured().map(|agent| agent.broadcasts as f64)),
                mean_interval: Spread::of(measured().filter_map(|agent| agent.mean_interval)),
            }
        };
        Self {
            first: runs.first().map_or(0, |run| run.seed),
            count: runs.len(),
            agents: (0..agents).map(spreads).collect(),
        }
    }

    /// Returns errors and broadcasts, each with its title.
    pub(super) fn tables(&self) -> [(String, Table); 2] {
        let levels = |group: &'static str| ["median", "min", "max"].map(|level| [group, level]);
        let change = "change relative to no network [%]";
        let errors = self.table(&[levels("RMSE, learned"), levels(change)].concat(), |agent| {
            [entries(agent.rmse, number), entries(agent.change_percent_no_network, percent)]
                .concat()
        });
        let groups = [levels("broadcasts, learned"), levels("mean interval, learned [s]")];
        let broadcasts = self.table(&groups.concat(), |agent| {
            [entries(agent.broadcasts, whole), entries(agent.mean_interval, number)].concat()
        });
        let title = |of: &str| format!("{of}, {}", self.in_words());
        [(title("Errors"), errors), (title("Broadcasts"), broadcasts)]
    }

    fn in_words(&self) -> String {
        let last = self.first + (self.count as u64).saturating_sub(1);
        format!(
            "seeds {} to {last}; the runs without learning do not depend on the seed",
            self.first
        )
    }

    /// Formats both tables for the terminal.
    pub(super) fn text(&self) -> String {
        let [(_, errors), (_, broadcasts)] = self.tables();
        let runs = counted(self.count as u64, "run", "runs");
        format!("{runs}, {}\n\n{}\n{}\n", self.in_words(), errors.text(), broadcasts.text())
    }

    fn table(&self, headings: &[[&str; 2]], row: impl Fn(&AgentSpreads) -> Vec<String>) -> Table {
        let headings = [&[["", "agent"]], headings].concat();
        let row = |agent: &AgentSpreads| [vec![agent.agent.to_string()], row(agent)].concat();
        Table::new(&headings, self.agents.iter().map(row).collect())
    }
}

fn entries(spread: Option<Spread>, entry: impl Fn(Option<f64>) -> String) -> Vec<String> {
    let levels = spread.map(|spread| [spread.median, spread.min, spread.max]);
    (0..3).map(|index| entry(levels.map(|levels| levels[index]))).collect()
}

/// Formats a count, which may be a half after taking the median.
fn whole(value: Option<f64>) -> String {
    value.map_or_else(|| "-".to_owned(), |value| value.to_string())
}

/// Writes the results of each agent with each seed.
pub(super) fn write_csv(path: &Path, runs: &[SeedRun]) -> Result<(), OutputError> {
    let header = ["seed", "agent", "rmse [state unit]", "broadcasts", "mean_interval [s]"];
    let rows = runs.iter().flat_map(|run| {
        run.agents.iter().enumerate().map(move |(index, agent)| (run.seed, index + 1, agent))
    });
    write_table(path, &header, rows, |row, (seed, agent, measured)| {
        row.integer(seed)?;
        row.integer(agent as u64)?;
        row.optional(measured.rmse)?;
        row.integer(measured.broadcasts)?;
        row.optional(measured.mean_interval)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_spread_is_the_median_and_the_range() {
        let of = |values: &[f64]| Spread::of(values.iter().copied());
        assert_eq!(of(&[]), None);
        assert_eq!(of(&[3.0, 1.0, 2.0]), Some(Spread { median: 2.0, min: 1.0, max: 3.0 }));
        assert_eq!(of(&[4.0, 1.0, 2.0, 9.0]), Some(Spread { median: 3.0, min: 1.0, max: 9.0 }));
    }

    #[test]
    fn the_tables_have_one_line_per_agent() {
        let run = |seed, rmse, broadcasts| SeedRun {
            seed,
            agents: vec![Measured { rmse: Some(rmse), broadcasts, mean_interval: Some(0.005) }],
        };
        let mut before = AgentStatistics::default();
        before.error(0.04);
        let runs = [run(3, 0.1, 100), run(4, 0.3, 105)];
        let text = Report::new(&runs, &[before], &[]).text();
        let expected = "\
2 runs, seeds 3 to 4; the runs without learning do not depend on the seed

            RMSE, learned      change relative to no network [%]
agent  median     min     max      median        min         max
----------------------------------------------------------------
    1  0.2000  0.1000  0.3000         0.0      -50.0       +50.0

       broadcasts, learned   mean interval, learned [s]
agent   median   min   max    median       min       max
--------------------------------------------------------
    1    102.5   100   105  0.005000  0.005000  0.005000

";
        assert_eq!(text, expected);
    }
}
