//! Why no gain solves `BMI`: a direction `u` with `C_i u = 0` for every agent.
//!
//! The null space of the sum of all `C_i^T C_i`, in units in which every component has the same
//! weight, given in reduced echelon form so that its directions have few components.

use nalgebra::DMatrix;

use crate::analysis::gain::seen;
use crate::analysis::jacobi::Eigen;
use crate::number::significant;
use crate::scenario::Scenario;

/// Directions of the state that no agent measures.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "no gain is a solution: no agent measures {}; add a row to the output_matrix of an agent, or \
     another agent, that measures {}", directions.join(" or "), if directions.len() == 1 { "it" } else { "each of them" }
)]
pub struct Unseen {
    /// Combinations of state components, such as "x - 0.5 y".
    pub directions: Vec<String>,
}

impl Unseen {
    /// Returns the directions; `None` if the agents together measure the whole state.
    #[must_use]
    pub fn find(scenario: &Scenario) -> Option<Self> {
        let n = scenario.dimension();
        let seen = seen(scenario);
        let unit = |i: usize| if seen[(i, i)] > 0.0 { seen[(i, i)].sqrt() } else { 1.0 };
        let scaled = DMatrix::from_fn(n, n, |i, j| seen[(i, j)] / (unit(i) * unit(j)));
        let eigen = Eigen::new(&scaled);
        let count = eigen.values.iter().take_while(|value| **value <= 1e-12).count();
        if count == 0 {
            return None;
        }
        let rows = DMatrix::from_fn(count, n, |k, i| eigen.vectors[(i, k)] / unit(i));
        let names = scenario.plant.state_names();
        let rows = echelon(rows);
        let mut rows: Vec<Vec<f64>> =
            rows.row_iter().map(|row| row.iter().copied().collect()).collect();
        rows.sort_by_key(|row| row.iter().position(|x| x.abs() > 1e-6));
        let directions = rows.into_iter().map(|row| combination(row.into_iter(), &names)).collect();
        Some(Self { directions })
    }
}

/// Returns the combination of the state that the agents measure most weakly.
pub(super) fn weakest(scenario: &Scenario) -> String {
    let eigen = Eigen::new(&seen(scenario));
    combination(eigen.vectors.column(0).iter().copied(), &scenario.plant.state_names())
}

/// Brings rows to reduced echelon form with the largest entry of each row 1.
fn echelon(mut rows: DMatrix<f64>) -> DMatrix<f64> {
    let (count, n) = rows.shape();
    for k in 0..count {
        // The largest entry that is left is the pivot.
        let places = (k..count).flat_map(|row| (0..n).map(move |column| (row, column)));
        let pivot = places.max_by(|&a, &b| rows[a].abs().total_cmp(&rows[b].abs()));
        let Some((row, column)) = pivot else { break };
        rows.swap_rows(k, row);
        let value = rows[(k, column)];
        rows.row_mut(k).iter_mut().for_each(|x| *x /= value);
        for other in (0..count).filter(|&other| other != k) {
            let factor = rows[(other, column)];
            for j in 0..n {
                let part = factor * rows[(k, j)];
                rows[(other, j)] -= part;
            }
        }
    }
    rows
}

/// Formats a combination of state components; entries within rounding of zero are left out.
fn combination(entries: impl Iterator<Item = f64>, names: &[String]) -> String {
    let entries: Vec<f64> = entries.collect();
    let largest = entries.iter().fold(0.0f64, |max, x| max.max(x.abs()));
    let mut text = String::new();
    for (&entry, name) in entries.iter().zip(names) {
        if entry.abs() <= 1e-6 * largest {
            continue;
        }
        let sign = match (text.is_empty(), entry < 0.0) {
            (true, false) => "",
            (true, true) => "-",
            (false, false) => " + ",
            (false, true) => " - ",
        };
        let size = significant(entry.abs(), 4);
        let size = if size.contains('.') && !size.contains('e') {
            size.trim_end_matches('0').trim_end_matches('.').to_owned()
        } else {
            size
        };
        let factor = if size == "1" { String::new() } else { size + " " };
        text += &format!("{sign}{factor}{name}");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn directions_have_few_components() {
        let rows = echelon(DMatrix::from_row_slice(2, 3, &[0.6, 0.0, 0.8, 0.6, 0.0, -0.8]));
        let names = ["x", "y", "z"].map(str::to_owned);
        let words: Vec<_> =
            rows.row_iter().map(|row| combination(row.iter().copied(), &names)).collect();
        assert_eq!(words, ["z", "x"]);
        let words = combination([-0.5, 1.0, 1e-9].into_iter(), &names);
        assert_eq!(words, "-0.5 x + y");
    }
}
