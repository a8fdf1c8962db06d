//! The lines of `tradeoff.svg`: cells that differ in one key only.
//!
//! A line goes along the key with the most values among those whose values are all numbers, if every
//! cell has a neighbour along it. Otherwise each cell has its own colour, or, if there are more cells
//! than colours, all have the same.

use super::summary::{CellSummary, Summary};
use crate::figures::{INNOVATION_LABEL, RMSE_LABEL, TradeoffFigure, TradeoffLine, TradeoffPoint};
use crate::number::significant;

/// Up to this many cells have their own colours.
const COLOURS: usize = 8;

/// The values of the other keys, and the cells by the value of the key that the line goes along.
type Group = (Vec<String>, Vec<(f64, TradeoffPoint)>);

/// Describes the picture of a study; `None` if no cell has a result.
pub(super) fn tradeoff(title: String, summary: &Summary) -> Option<TradeoffFigure> {
    let cells: Vec<(&CellSummary, TradeoffPoint)> =
        summary.cells.iter().filter_map(|cell| Some((cell, point(summary, cell)?))).collect();
    if cells.is_empty() {
        return None;
    }
    let error_label = if summary.has_errors() { RMSE_LABEL } else { INNOVATION_LABEL };
    let Some(along) = key_of_lines(summary, &cells) else {
        return Some(TradeoffFigure {
            title,
            label: String::new(),
            error_label,
            lines: single(summary, cells),
        });
    };
    let mut groups: Vec<Group> = Vec::new();
    for (cell, mut point) in cells {
        let value: f64 = cell.values[along].parse().unwrap_or(0.0);
        point.label = significant(value, 3);
        let others = others(&cell.values, along);
        match groups.iter_mut().find(|(values, _)| *values == others) {
            Some((_, points)) => points.push((value, point)),
            None => groups.push((others, vec![(value, point)])),
        }
    }
    let keys = others(&summary.keys, along);
    let line = |(values, mut points): Group| {
        points.sort_by(|(a, _), (b, _)| a.total_cmp(b));
        TradeoffLine {
            name: in_words(&keys, &values),
            points: points.into_iter().map(|(_, point)| point).collect(),
            is_joined: true,
        }
    };
    let lines = groups.into_iter().map(line).collect();
    Some(TradeoffFigure { title, label: summary.keys[along].clone(), error_label, lines })
}

/// Returns the key that lines go along.
fn key_of_lines(summary: &Summary, cells: &[(&CellSummary, TradeoffPoint)]) -> Option<usize> {
    let distinct = |key: usize| {
        let mut values: Vec<&str> =
            cells.iter().map(|(cell, _)| cell.values[key].as_str()).collect();
        values.sort_unstable();
        values.dedup();
        values
    };
    let is_number = |value: &&str| value.parse::<f64>().is_ok_and(f64::is_finite);
    let has_neighbour = |key: usize| {
        let all: Vec<Vec<String>> =
            cells.iter().map(|(cell, _)| others(&cell.values, key)).collect();
        let mut sorted = all.clone();
        sorted.sort_unstable();
        let count = |values: &Vec<String>| {
            sorted.partition_point(|other| other <= values)
                - sorted.partition_point(|other| other < values)
        };
        all.iter().all(|values| count(values) > 1)
    };
    (0..summary.keys.len())
        .map(|key| (key, distinct(key)))
        .filter(|(key, values)| {
            values.len() > 1 && values.iter().all(is_number) && has_neighbour(*key)
        })
        // The first of those with the most values.
        .max_by_key(|(key, values)| (values.len(), std::cmp::Reverse(*key)))
        .map(|(key, _)| key)
}

/// Returns lines of one cell each, or one of all without joining them.
fn single(summary: &Summary, cells: Vec<(&CellSummary, TradeoffPoint)>) -> Vec<TradeoffLine> {
    if cells.len() > COLOURS {
        let points = cells.into_iter().map(|(_, point)| point).collect();
        return vec![TradeoffLine { name: String::new(), points, is_joined: false }];
    }
    let line = |(cell, point): (&CellSummary, TradeoffPoint)| TradeoffLine {
        name: in_words(&summary.keys, &cell.values),
        points: vec![point],
        is_joined: false,
    };
    cells.into_iter().map(line).collect()
}

fn point(summary: &Summary, cell: &CellSummary) -> Option<TradeoffPoint> {
    let (broadcasts, error) = (cell.all.broadcasts?, summary.error_of(cell)?);
    Some(TradeoffPoint {
        label: String::new(),
        broadcasts: [broadcasts.low, broadcasts.median, broadcasts.high],
        error: [error.low, error.median, error.high],
    })
}

fn others(values: &[String], key: usize) -> Vec<String> {
    let values = values.iter().enumerate();
    values.filter(|(index, _)| *index != key).map(|(_, value)| value.clone()).collect()
}

fn in_words(keys: &[String], values: &[String]) -> String {
    let pairs = keys.iter().zip(values);
    pairs.map(|(key, value)| format!("{key} = {value}")).collect::<Vec<_>>().join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::commands::sweep::summary::{Interval, Measures};

    fn summary(keys: &[&str], rows: &[&[&str]]) -> Summary {
        let interval = Some(Interval { mean: 2.0, median: 2.0, low: 1.0, high: 3.0 });
        let all = Measures {
            rmse: interval,
            broadcasts: interval,
            bytes: None,
            max_error: None,
            innovation_rms: None,
        };
        let cell = |row: &&[&str]| CellSummary {
            values: row.iter().map(|&value| value.to_owned()).collect(),
            runs: 1,
            diverged: 0,
            all,
            agents: Vec::new(),
        };
        let keys = keys.iter().map(|&key| key.to_owned()).collect();
        let cells = rows.iter().map(cell).collect();
        Summary { keys, is_recorded: false, cells, digest: String::new() }
    }

    fn lines(summary: &Summary) -> Vec<(String, Vec<String>)> {
        let figure = tradeoff(String::new(), summary).unwrap();
        let labels =
            |line: &TradeoffLine| line.points.iter().map(|point| point.label.clone()).collect();
        figure.lines.iter().map(|line| (line.name.clone(), labels(line))).collect()
    }

    #[test]
    fn lines_go_along_the_key_with_the_most_numbers() {
        let grid = summary(
            &["e", "preset"],
            &[&["10", "a"], &["10", "b"], &["2", "a"], &["2", "b"], &["30", "a"], &["30", "b"]],
        );
        let labels: Vec<String> = ["2.00", "10.0", "30.0"].map(str::to_owned).into();
        assert_eq!(
            lines(&grid),
            [("preset = a".to_owned(), labels.clone()), ("preset = b".to_owned(), labels)]
        );
    }

    #[test]
    fn cells_that_are_no_neighbours_are_not_joined() {
        let few = summary(&["a", "b"], &[&["1", "5"], &["2", "7"]]);
        assert_eq!(lines(&few)[1], ("a = 2, b = 7".to_owned(), vec![String::new()]));
        let values: Vec<[String; 2]> =
            (0..9).map(|k| [k.to_string(), (k * k).to_string()]).collect();
        let rows: Vec<Vec<&str>> =
            values.iter().map(|row| row.iter().map(String::as_str).collect()).collect();
        let rows: Vec<&[&str]> = rows.iter().map(Vec::as_slice).collect();
        let many = lines(&summary(&["a", "b"], &rows));
        assert_eq!((many.len(), many[0].1.len()), (1, 9));
        let none = summary(&[], &[&[]]);
        assert_eq!(lines(&none), [(String::new(), vec![String::new()])]);
    }
}
