//! Table 1: errors without and with learning, beside the paper's.

use std::fmt::Write;
use std::path::Path;

use super::csv::{Row, write_table};
use super::paper::Published;
use crate::output_file::OutputError;

/// What a run measured of one agent.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct AgentResult {
    /// Root mean square of `|e_1i|` over the evaluation window. \[state unit\]
    pub rmse: Option<f64>,
    /// Mean time between broadcasts. \[s\]
    pub mean_interval: Option<f64>,
}

/// The table. The three slices are parallel; agents that a slice does not have are left blank.
#[derive(Clone, Copy, Debug)]
pub struct ComparisonTable<'a> {
    /// Of the run without learning.
    pub without: &'a [AgentResult],
    /// Of the run with learning.
    pub with: &'a [AgentResult],
    /// The paper's, if the scenario is the paper's; empty otherwise.
    pub published: &'a [Published],
    /// Begin and end of the evaluation window. \[s\]
    pub window: (f64, f64),
}

/// One agent's numbers, in the order of the columns.
struct Line {
    agent: usize,
    rmse: [Option<f64>; 2],
    change: Option<f64>,
    intervals: [Option<f64>; 2],
    published: Option<Published>,
}

impl ComparisonTable<'_> {
    fn lines(&self) -> impl Iterator<Item = Line> + '_ {
        (0..self.without.len().max(self.with.len())).map(|index| {
            let without = self.without.get(index).copied().unwrap_or_default();
            let with = self.with.get(index).copied().unwrap_or_default();
            Line {
                agent: index + 1,
                rmse: [without.rmse, with.rmse],
                change: change_percent(without.rmse, with.rmse),
                intervals: [without.mean_interval, with.mean_interval],
                published: self.published.get(index).copied(),
            }
        })
    }

    /// The table as aligned text for a terminal.
    #[must_use]
    pub fn to_text(&self) -> String {
        let compared = !self.published.is_empty();
        let mut text = format!(
            "Table 1: RMSE of |e_1i(t)| for t in [{}, {}] s [state unit], and mean time between broadcasts [s]\n\n",
            self.window.0, self.window.1
        );
        let (groups, names, rule) = heading(compared);
        // Writing into a string cannot fail.
        let _ = writeln!(text, "{groups}\n{names}\n{rule}");
        for line in self.lines() {
            let here =
                [line.rmse[0], line.rmse[1], line.change, line.intervals[0], line.intervals[1]];
            let paper = line.published.map(|published| {
                [
                    published.rmse_without,
                    published.rmse_with,
                    published.change_percent,
                    published.mean_interval,
                ]
            });
            let _ = writeln!(text, "{}", text_row(line.agent, here, compared, paper));
        }
        text
    }

    /// Writes the table as CSV; a number that there is not is an empty field.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn write_csv(&self, path: &Path) -> Result<(), OutputError> {
        let header = [
            "agent",
            "rmse_without [state unit]",
            "rmse_with [state unit]",
            "change [%]",
            "paper_rmse_without [state unit]",
            "paper_rmse_with [state unit]",
            "paper_change [%]",
            "mean_interval_without [s]",
            "mean_interval_with [s]",
            "paper_mean_interval [s]",
        ];
        write_table(path, &header, self.lines(), |row: &mut Row<'_>, line| {
            let paper = line.published;
            row.integer(line.agent as u64)?;
            row.optional(line.rmse[0])?;
            row.optional(line.rmse[1])?;
            row.optional(line.change)?;
            row.optional(paper.map(|paper| paper.rmse_without))?;
            row.optional(paper.map(|paper| paper.rmse_with))?;
            row.optional(paper.map(|paper| paper.change_percent))?;
            row.optional(line.intervals[0])?;
            row.optional(line.intervals[1])?;
            row.optional(paper.map(|paper| paper.mean_interval))
        })
    }
}

/// By how much `with` differs from `without`; `None` without anything to compare. \[%\]
pub(crate) fn change_percent(without: Option<f64>, with: Option<f64>) -> Option<f64> {
    let (without, with) = (without.filter(|&rmse| rmse > 0.0)?, with?);
    Some(100.0 * (with - without) / without)
}

/// Two lines of headings and a rule.
fn heading(compared: bool) -> (String, String, String) {
    let (groups, names) = if compared {
        (
            "        without learning     with learning        change [%]       mean time between broadcasts [s]",
            "agent      here    paper      here    paper      here    paper      without       with      paper",
        )
    } else {
        (
            "         RMSE      RMSE                  mean time between broadcasts [s]",
            "agent  without      with   change [%]      without       with",
        )
    };
    (groups.to_owned(), names.to_owned(), "-".repeat(groups.len().max(names.len())))
}

fn text_row(
    agent: usize,
    here: [Option<f64>; 5],
    compared: bool,
    paper: Option<[f64; 4]>,
) -> String {
    let number = |value: Option<f64>, width: usize, decimals: usize| match value {
        Some(value) => format!("{value:>width$.decimals$}"),
        None => format!("{:>width$}", "-"),
    };
    let [without, with, change, interval_without, interval_with] = here;
    if !compared {
        return [
            format!("{agent:>5}"),
            number(without, 9, 4),
            number(with, 10, 4),
            number(change, 13, 2),
            number(interval_without, 13, 5),
            number(interval_with, 11, 5),
        ]
        .concat();
    }
    let paper = |index: usize| paper.map(|paper| paper[index]);
    [
        format!("{agent:>5}"),
        number(without, 10, 4),
        number(paper(0), 9, 4),
        number(with, 10, 4),
        number(paper(1), 9, 4),
        number(change, 10, 2),
        number(paper(2), 9, 2),
        number(interval_without, 13, 5),
        number(interval_with, 11, 5),
        number(paper(3), 11, 4),
    ]
    .concat()
}

#[cfg(test)]
mod tests {
    use super::super::paper::PUBLISHED;
    use super::*;

    const fn result(rmse: f64, mean_interval: f64) -> AgentResult {
        AgentResult { rmse: Some(rmse), mean_interval: Some(mean_interval) }
    }

    const WITHOUT: [AgentResult; 3] =
        [result(0.14012, 0.0048), result(0.1173, 0.008_99), result(0.158, 0.009_57)];
    const WITH: [AgentResult; 3] = [
        result(0.0323, 0.0047),
        result(0.0287, 0.009),
        AgentResult { rmse: Some(0.0227), mean_interval: None },
    ];

    #[test]
    fn beside_the_paper() {
        let table = ComparisonTable {
            without: &WITHOUT,
            with: &WITH,
            published: &PUBLISHED,
            window: (20.0, 40.0),
        };
        let expected = "\
Table 1: RMSE of |e_1i(t)| for t in [20, 40] s [state unit], and mean time between broadcasts [s]

        without learning     with learning        change [%]       mean time between broadcasts [s]
agent      here    paper      here    paper      here    paper      without       with      paper
---------------------------------------------------------------------------------------------------
    1    0.1401   0.1827    0.0323   0.0777    -76.95   -57.47      0.00480    0.00470     0.0047
    2    0.1173   0.1775    0.0287   0.0634    -75.53   -64.28      0.00899    0.00900     0.0089
    3    0.1580   0.2070    0.0227   0.0876    -85.63   -57.68      0.00957          -     0.0095
";
        assert_eq!(table.to_text(), expected);
    }

    #[test]
    fn of_a_scenario_of_ones_own() {
        let table = ComparisonTable {
            without: &WITHOUT[..1],
            with: &[],
            published: &[],
            window: (0.5, 2.0),
        };
        let expected = "\
Table 1: RMSE of |e_1i(t)| for t in [0.5, 2] s [state unit], and mean time between broadcasts [s]

         RMSE      RMSE                  mean time between broadcasts [s]
agent  without      with   change [%]      without       with
-------------------------------------------------------------------------
    1   0.1401         -            -      0.00480          -
";
        assert_eq!(table.to_text(), expected);
    }
}
