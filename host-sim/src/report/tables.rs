//! Table 1: errors without a network, with an untrained one and with learning, next to the paper's.

use std::path::Path;

use super::columns::Table;
use super::paper::Published;
use crate::files::output::OutputError;
use crate::files::table::{Row, write_table};
use crate::number::significant;

/// Significant digits of errors and times in tables.
pub(crate) const DIGITS: usize = 4;

/// A run's results for one agent.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct AgentResult {
    /// Root mean square of `|e_1i|` over the evaluation window. \[state unit\]
    pub rmse: Option<f64>,
    /// Mean time between broadcasts. \[s\]
    pub mean_interval: Option<f64>,
}

/// The table. The slices are parallel; agents missing from a slice are left blank.
#[derive(Clone, Copy, Debug)]
pub struct ComparisonTable<'a> {
    /// The observer with feedback only.
    pub no_network: &'a [AgentResult],
    /// The run with an untrained network; the paper's "without learning".
    pub without: &'a [AgentResult],
    /// The run with learning.
    pub with: &'a [AgentResult],
    /// The paper's results, if the scenario is the paper's; otherwise empty.
    pub published: &'a [Published],
    /// Start and end of the evaluation window. \[s\]
    pub window: (f64, f64),
}

/// Results of one agent: without a network, untrained, learned.
struct Line {
    agent: usize,
    rmse: [Option<f64>; 3],
    /// Relative to no network, and relative to the untrained one.
    changes: [Option<f64>; 2],
    intervals: [Option<f64>; 3],
    published: Option<Published>,
}

impl ComparisonTable<'_> {
    fn lines(&self) -> impl Iterator<Item = Line> + '_ {
        let runs = [self.no_network, self.without, self.with];
        let agents = runs.iter().map(|run| run.len()).max().unwrap_or(0);
        (0..agents).map(move |index| {
            let results = runs.map(|run| run.get(index).copied().unwrap_or_default());
            let rmse = results.map(|result| result.rmse);
            Line {
                agent: index + 1,
                rmse,
                changes: [change_percent(rmse[0], rmse[2]), change_percent(rmse[1], rmse[2])],
                intervals: results.map(|result| result.mean_interval),
                published: self.published.get(index).copied(),
            }
        })
    }

    /// Returns the table as aligned text for a terminal.
    #[must_use]
    pub fn to_text(&self) -> String {
        format!(
            "Table 1: RMSE of |e_1i(t)| for t in [{}, {}] s [state unit]\n\n{}\n\
             Mean time between broadcasts [s]\n\n{}",
            self.window.0,
            self.window.1,
            self.errors().text(),
            self.intervals().text(),
        )
    }

    /// Returns the tables with their titles.
    #[must_use]
    pub fn tables(&self) -> [(String, Table); 2] {
        let (from, to) = self.window;
        [
            (format!("RMSE of |e_1i(t)| for t in [{from}, {to}] s [state unit]"), self.errors()),
            ("Mean time between broadcasts [s]".to_owned(), self.intervals()),
        ]
    }

    fn errors(&self) -> Table {
        let untrained = "change against untrained [%]";
        let columns = [
            (["", "agent"], true),
            (["", "no network"], true),
            (["untrained", "here"], true),
            (["untrained", "paper"], false),
            (["learned", "here"], true),
            (["learned", "paper"], false),
            (["change against", "no network [%]"], true),
            ([untrained, "here"], true),
            ([untrained, "paper"], false),
        ];
        self.table(&columns, |line| {
            let paper = line.published;
            vec![
                line.agent.to_string(),
                number(line.rmse[0]),
                number(line.rmse[1]),
                printed(paper.map(|paper| paper.rmse_without)),
                number(line.rmse[2]),
                printed(paper.map(|paper| paper.rmse_with)),
                percent(line.changes[0]),
                percent(line.changes[1]),
                percent(paper.map(|paper| paper.change_percent)),
            ]
        })
    }

    fn intervals(&self) -> Table {
        let columns = [
            (["", "agent"], true),
            (["", "no network"], true),
            (["", "untrained"], true),
            (["", "learned"], true),
            (["", "paper"], false),
        ];
        self.table(&columns, |line| {
            let [no_network, untrained, learned] = line.intervals.map(number);
            let paper = printed(line.published.map(|paper| paper.mean_interval));
            vec![line.agent.to_string(), no_network, untrained, learned, paper]
        })
    }

    /// Formats these columns; those marked `false` are shown only if there are published results.
    fn table(
        &self,
        columns: &[([&str; 2], bool)],
        entries: impl Fn(&Line) -> Vec<String>,
    ) -> Table {
        let shown = |always: bool| always || !self.published.is_empty();
        let headings: Vec<_> =
            columns.iter().filter(|(_, always)| shown(*always)).map(|(names, _)| *names).collect();
        let rows = self
            .lines()
            .map(|line| {
                let entries = entries(&line).into_iter().zip(columns);
                entries.filter(|(_, (_, always))| shown(*always)).map(|(entry, _)| entry).collect()
            })
            .collect();
        Table::new(&headings, rows)
    }

    /// Writes the table as CSV; missing numbers are empty fields.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn write_csv(&self, path: &Path) -> Result<(), OutputError> {
        let header = [
            "agent",
            "rmse_no_network [state unit]",
            "rmse_without [state unit]",
            "rmse_with [state unit]",
            "change_no_network [%]",
            "change [%]",
            "paper_rmse_without [state unit]",
            "paper_rmse_with [state unit]",
            "paper_change [%]",
            "mean_interval_no_network [s]",
            "mean_interval_without [s]",
            "mean_interval_with [s]",
            "paper_mean_interval [s]",
        ];
        write_table(path, &header, self.lines(), |row: &mut Row<'_>, line| {
            let paper = line.published;
            row.integer(line.agent as u64)?;
            line.rmse.into_iter().chain(line.changes).try_for_each(|value| row.optional(value))?;
            row.optional(paper.map(|paper| paper.rmse_without))?;
            row.optional(paper.map(|paper| paper.rmse_with))?;
            row.optional(paper.map(|paper| paper.change_percent))?;
            line.intervals.into_iter().try_for_each(|value| row.optional(value))?;
            row.optional(paper.map(|paper| paper.mean_interval))
        })
    }
}

/// Returns the change from `without` to `with`; `None` if one is missing. \[%\]
pub(crate) fn change_percent(without: Option<f64>, with: Option<f64>) -> Option<f64> {
    let (without, with) = (without.filter(|&rmse| rmse > 0.0)?, with?);
    Some(100.0 * (with - without) / without)
}

/// Formats a number for a table.
pub(crate) fn number(value: Option<f64>) -> String {
    value.map_or_else(|| "-".to_owned(), |value| significant(value, DIGITS))
}

/// Formats a change in percent for a table.
pub(crate) fn percent(value: Option<f64>) -> String {
    let text = value.map_or_else(|| "-".to_owned(), |value| format!("{value:+.1}"));
    if text == "-0.0" || text == "+0.0" { "0.0".to_owned() } else { text }
}

/// Formats a number with the decimals that the paper printed.
fn printed(value: Option<f64>) -> String {
    value.map_or_else(|| "-".to_owned(), |value| format!("{value:.4}"))
}

#[cfg(test)]
mod tests {
    use super::super::paper::PUBLISHED;
    use super::*;

    const fn result(rmse: f64, mean_interval: f64) -> AgentResult {
        AgentResult { rmse: Some(rmse), mean_interval: Some(mean_interval) }
    }

    const NO_NETWORK: [AgentResult; 3] =
        [result(0.1211, 0.0048), result(0.08, 0.009), result(1e-5, 0.0096)];
    const WITHOUT: [AgentResult; 3] =
        [result(0.14012, 0.0048), result(0.1173, 0.008_99), result(0.158, 0.009_57)];
    const WITH: [AgentResult; 3] = [
        result(0.0323, 0.0047),
        result(0.0287, 0.009),
        AgentResult { rmse: Some(0.0227), mean_interval: None },
    ];

    #[test]
    fn table_with_published_results() {
        let table = ComparisonTable {
            no_network: &NO_NETWORK,
            without: &WITHOUT,
            with: &WITH,
            published: &PUBLISHED,
            window: (20.0, 40.0),
        };
        let expected = "\
Table 1: RMSE of |e_1i(t)| for t in [20, 40] s [state unit]

                      untrained        learned      change against  change against untrained [%]
agent  no network    here   paper     here   paper  no network [%]           here          paper
------------------------------------------------------------------------------------------------
    1      0.1211  0.1401  0.1827  0.03230  0.0777           -73.3          -76.9          -57.5
    2     0.08000  0.1173  0.1775  0.02870  0.0634           -64.1          -75.5          -64.3
    3    1.000e-5  0.1580  0.2070  0.02270  0.0876       +226900.0          -85.6          -57.7

Mean time between broadcasts [s]

agent  no network  untrained   learned   paper
----------------------------------------------
    1    0.004800   0.004800  0.004700  0.0047
    2    0.009000   0.008990  0.009000  0.0089
    3    0.009600   0.009570         -  0.0095
";
        assert_eq!(table.to_text(), expected);
    }

    #[test]
    fn table_without_published_results() {
        let table = ComparisonTable {
            no_network: &[],
            without: &WITHOUT[..1],
            with: &[],
            published: &[],
            window: (0.5, 2.0),
        };
        let text = table.to_text();
        assert!(!text.contains("paper"), "{text}");
        let row = text.lines().find(|line| line.starts_with("    1")).unwrap();
        let entries: Vec<_> = row.split_whitespace().collect();
        assert_eq!(entries, ["1", "-", "0.1401", "-", "-", "-"]);
    }
}
