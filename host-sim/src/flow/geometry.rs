//! The directions in which the state is observed: `n` independent rows among all agents' `C_i`,
//!
//! ```text
//! xi = T x,    xi_c = scale y_output at the roots of direction c
//! ```
//!
//! Rows are normalised and chosen by QR with pivoting: the next row is the one with the largest
//! part outside those already chosen, so that the directions are close to orthogonal; on a tie, that
//! of the lower agent and output. The directions are then sorted by their largest component, which
//! is positive: outputs that are multiples of the components give `T = I`, in any order.
//!
//! A row that is parallel to a direction makes its agent a root of it. Other rows are left over;
//! they gained nothing where they were used.
//!
//! Cost: `O(R n^2)` for R rows, plus a pass over the trajectory.

use nalgebra::DMatrix;

use super::dense::{dot, image, norm};
use super::trajectory::{Trajectory, units};
use crate::number::significant;

/// Sine of the angle below which two rows count as parallel, and a row as dependent on others:
/// outputs that close are the same for any sensor.
const PARALLEL: f64 = 1e-6;

/// Relative difference below which two sizes are a tie, so that rounding does not decide.
const TIE: f64 = 1e-9;

/// The directions of a network of observers, and who measures them.
#[derive(Clone, Debug, PartialEq)]
pub struct Geometry {
    /// `T`, shape `[n, n]`; row c is direction c.
    pub transform: DMatrix<f64>,
    /// `T^-1`, shape `[n, n]`.
    pub inverse: DMatrix<f64>,
    /// For each agent (outer) and direction, the output that measures it.
    pub roots: Vec<Vec<Option<Root>>>,
}

/// An output that measures a direction: `xi_c = scale y_output`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Root {
    /// Row of the agent's `C_i`.
    pub output: usize,
    /// `xi_c / y_output`.
    pub scale: f64,
}

/// Together, the agents do not measure the whole state.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error(
    "together the agents measure {covered} of {} independent directions of the state; no output \
     depends on {}: add an output that does", .unseen.len(), combination(.unseen)
)]
pub struct NotCovered {
    /// Number of independent directions among the outputs.
    pub covered: usize,
    /// Coefficients of a combination of the state's components that is outside all outputs; the
    /// largest is 1. Shape `[n]`.
    pub unseen: Vec<f64>,
}

impl Geometry {
    /// Takes directions in the state's units: the rows of `T` have unit norm.
    ///
    /// # Errors
    /// If the rows of all `C_i` do not span the state.
    ///
    /// # Panics
    /// If there are no matrices, or they differ in their number of columns.
    pub fn in_state_units(output_matrices: &[&DMatrix<f64>]) -> Result<Self, NotCovered> {
        let dimension = output_matrices.first().expect("a network has an agent").ncols();
        Self::new(output_matrices, &vec![1.0; dimension], |_| 1.0)
    }

    /// Takes directions in the units of the data: rows are compared in units of `x / std`, and every
    /// `xi_c` has unit standard deviation over `states`. A component or direction that does not move
    /// in `states` keeps its own unit.
    ///
    /// # Errors
    /// If the rows of all `C_i` do not span the state.
    ///
    /// # Panics
    /// If there are no matrices or no states, or they differ in dimension.
    pub fn scaled(
        output_matrices: &[&DMatrix<f64>],
        states: &Trajectory,
    ) -> Result<Self, NotCovered> {
        assert!(states.samples() > 0, "a trajectory has states");
        let (mean, unit) = (states.mean(), units(&states.deviation()));
        Self::new(output_matrices, &unit, |direction| {
            let squares = states.states.chunks_exact(states.dimension).fold(0.0, |sum, state| {
                let moved = (0..direction.len())
                    .fold(0.0, |moved, j| moved + direction[j] * ((state[j] - mean[j]) / unit[j]));
                sum + moved * moved
            });
            let deviation = (squares / states.samples() as f64).sqrt();
            // Below this, what moves is rounding.
            if deviation > TIE { deviation } else { 1.0 }
        })
    }

    /// Chooses directions in units of `x / unit`, then divides each by its `spread`.
    fn new(
        output_matrices: &[&DMatrix<f64>],
        unit: &[f64],
        spread: impl Fn(&[f64]) -> f64,
    ) -> Result<Self, NotCovered> {
        let n = unit.len();
        let mut rows = Vec::new();
        for (agent, matrix) in output_matrices.iter().enumerate() {
            assert_eq!(matrix.ncols(), n, "agent {agent} has a different number of states");
            for output in 0..matrix.nrows() {
                let row: Vec<f64> = (0..n).map(|j| matrix[(output, j)] * unit[j]).collect();
                let length = norm(&row);
                if length > 0.0 {
                    let direction = row.iter().map(|x| x / length).collect();
                    rows.push(Row { agent, output, length, direction });
                }
            }
        }
        let directions = choose(&rows, n).map_err(|(covered, unseen)| {
            let unseen: Vec<f64> = unseen.iter().zip(unit).map(|(x, unit)| x / unit).collect();
            let largest = unseen[leading(&unseen)];
            NotCovered { covered, unseen: unseen.iter().map(|x| x / largest).collect() }
        })?;
        let spreads: Vec<f64> = directions.iter().map(|direction| spread(direction)).collect();
        let transform = DMatrix::from_fn(n, n, |c, j| directions[c][j] / (spreads[c] * unit[j]));
        let unscaled = DMatrix::from_fn(n, n, |c, j| directions[c][j])
            .try_inverse()
            .expect("the chosen rows are independent");
        let inverse = DMatrix::from_fn(n, n, |j, c| unit[j] * unscaled[(j, c)] * spreads[c]);

        let mut roots = vec![vec![None; n]; output_matrices.len()];
        for row in &rows {
            let parallel = directions.iter().position(|direction| {
                let along = dot(direction, &row.direction);
                let outside = direction.iter().zip(&row.direction).map(|(d, r)| r - along * d);
                norm(&outside.collect::<Vec<_>>()) < PARALLEL
            });
            if let Some(c) = parallel {
                let along = dot(&directions[c], &row.direction);
                let scale = along / (row.length * spreads[c]);
                roots[row.agent][c].get_or_insert(Root { output: row.output, scale });
            }
        }
        Ok(Self { transform, inverse, roots })
    }

    /// Returns `n`, the number of directions.
    #[must_use]
    pub fn dimension(&self) -> usize {
        self.transform.nrows()
    }

    /// Returns `N`, the number of agents.
    #[must_use]
    pub fn agents(&self) -> usize {
        self.roots.len()
    }

    /// Whether `agent` measures `direction`.
    ///
    /// # Panics
    /// If there is no such agent or direction.
    #[must_use]
    pub fn is_root(&self, agent: usize, direction: usize) -> bool {
        self.roots[agent][direction].is_some()
    }

    /// Writes `xi = T x` to `xi`, both of shape `[n]`.
    ///
    /// # Panics
    /// If `x` or `xi` is longer than `n`.
    pub fn directions_of(&self, x: &[f64], xi: &mut [f64]) {
        image(&self.transform, x, xi);
    }
}

/// An output in chosen units.
struct Row {
    agent: usize,
    output: usize,
    length: f64,
    /// Of unit norm.
    direction: Vec<f64>,
}

/// Chooses `n` rows, sorted and with a positive largest component. If fewer than `n` rows are independent,
/// returns how many are, and a vector that is orthogonal to all rows.
fn choose(rows: &[Row], n: usize) -> Result<Vec<Vec<f64>>, (usize, Vec<f64>)> {
    let mut chosen = Vec::with_capacity(n);
    let mut basis: Vec<Vec<f64>> = Vec::with_capacity(n);
    let mut parts: Vec<Vec<f64>> = rows.iter().map(|row| row.direction.clone()).collect();
    while chosen.len() < n {
        let next = largest(&parts.iter().map(|part| norm(part)).collect::<Vec<_>>());
        let Some(next) = next.filter(|&next| norm(&parts[next]) > PARALLEL) else {
            return Err((chosen.len(), outside(&basis, n)));
        };
        chosen.push(next);
        // Twice, so that rounding leaves no part along the others.
        let direction = without(without(parts[next].clone(), &basis), &basis);
        let length = norm(&direction);
        basis.push(direction.iter().map(|x| x / length).collect());
        let newest = &basis[basis.len() - 1..];
        for part in &mut parts {
            *part = without(std::mem::take(part), newest);
        }
    }
    let mut directions: Vec<(usize, usize, Vec<f64>)> = chosen
        .into_iter()
        .map(|row| {
            let direction = &rows[row].direction;
            let first = leading(direction);
            let sign = direction[first].signum();
            // A signed zero would show in `T`.
            (first, row, direction.iter().map(|x| sign * x + 0.0).collect())
        })
        .collect();
    directions.sort_by_key(|&(first, row, _)| (first, row));
    Ok(directions.into_iter().map(|(_, _, direction)| direction).collect())
}

/// Returns a unit vector that is orthogonal to a basis of fewer than `n` vectors.
fn outside(basis: &[Vec<f64>], n: usize) -> Vec<f64> {
    let axis = |j: usize| (0..n).map(|k| f64::from(u8::from(k == j))).collect::<Vec<_>>();
    let parts: Vec<Vec<f64>> = (0..n).map(|j| without(without(axis(j), basis), basis)).collect();
    let longest = largest(&parts.iter().map(|part| norm(part)).collect::<Vec<_>>());
    parts.into_iter().nth(longest.expect("a state has components")).expect("it was found here")
}

/// Removes from `vector` its part along an orthonormal basis.
fn without(mut vector: Vec<f64>, basis: &[Vec<f64>]) -> Vec<f64> {
    for direction in basis {
        let along = dot(&vector, direction);
        for (x, direction) in vector.iter_mut().zip(direction) {
            *x -= along * direction;
        }
    }
    vector
}

/// Returns the first of the largest sizes.
fn largest(sizes: &[f64]) -> Option<usize> {
    let largest = sizes.iter().copied().fold(0.0, f64::max);
    sizes.iter().position(|&size| size >= largest * (1.0 - TIE))
}

/// Returns the first component with the largest magnitude.
fn leading(vector: &[f64]) -> usize {
    largest(&vector.iter().map(|x| x.abs()).collect::<Vec<_>>()).expect("a vector has components")
}

/// Words a combination of the state's components, `x1 - 0.5 x3`.
fn combination(coefficients: &[f64]) -> String {
    let mut text = String::new();
    for (j, &x) in coefficients.iter().enumerate().filter(|(_, x)| x.abs() > PARALLEL) {
        let sign = match (text.is_empty(), x < 0.0) {
            (true, false) => "",
            (true, true) => "-",
            (false, false) => " + ",
            (false, true) => " - ",
        };
        let size = significant(x.abs(), 3);
        let size = if size == "1.00" { String::new() } else { format!("{size} ") };
        text += &format!("{sign}{size}x{}", j + 1);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::dense::product;
    use crate::flow::testing::{close, random_outputs, random_walk, references};
    use nalgebra::dmatrix;
    use proptest::prelude::*;

    #[test]
    fn outputs_that_are_components_give_the_identity_in_any_order() {
        let outputs = [dmatrix![0.0, -2.0, 0.0], dmatrix![0.0, 0.0, 4.0; 0.0, 3.0, 0.0]];
        let (empty, first) = (DMatrix::zeros(0, 3), dmatrix![1.0, 0.0, 0.0]);
        let geometry =
            Geometry::in_state_units(&[&outputs[0], &empty, &outputs[1], &first]).unwrap();
        assert_eq!(geometry.transform, DMatrix::identity(3, 3));
        assert_eq!(geometry.inverse, DMatrix::identity(3, 3));
        let root = |output, scale| Some(Root { output, scale });
        assert_eq!(geometry.roots[0], [None, root(0, -0.5), None]);
        assert_eq!(geometry.roots[1], [None; 3]);
        assert_eq!(geometry.roots[2], [None, root(1, 1.0 / 3.0), root(0, 0.25)]);
        assert_eq!(geometry.roots[3], [root(0, 1.0), None, None]);
        assert!(geometry.is_root(3, 0) && !geometry.is_root(3, 1));
        assert_eq!((geometry.agents(), geometry.dimension()), (4, 3));
    }

    #[test]
    fn names_what_no_output_measures() {
        let outputs = dmatrix![1.0, 1.0, 0.0; 2.0, 2.0, 0.0; 0.0, 0.0, 1.0];
        let error = Geometry::in_state_units(&[&outputs]).unwrap_err();
        assert_eq!(error.covered, 2);
        close(&error.unseen, &[1.0, -1.0, 0.0], 1e-12);
        let text = error.to_string();
        assert_eq!(
            text,
            "together the agents measure 2 of 3 independent directions of the state; no output \
             depends on x1 - x2: add an output that does"
        );
        let nothing = Geometry::in_state_units(&[&DMatrix::zeros(1, 2)]).unwrap_err();
        assert_eq!(nothing, NotCovered { covered: 0, unseen: vec![1.0, 0.0] });
    }

    #[test]
    fn what_is_missing_completes_the_outputs_in_the_units_of_the_data() {
        let outputs = dmatrix![1.0, 100.0];
        let states = vec![1.0, 0.01, -1.0, 0.02, 3.0, -0.04];
        let states = Trajectory { dimension: 2, step: 1.0, states };
        let error = Geometry::scaled(&[&outputs], &states).unwrap_err();
        let added = DMatrix::from_row_slice(1, 2, &error.unseen);
        let geometry = Geometry::scaled(&[&outputs, &added], &states).unwrap();
        // Orthogonal in units of the standard deviations.
        let unit = states.deviation();
        let along: f64 =
            (0..2).map(|j| error.unseen[j] * outputs[(0, j)] * unit[j] * unit[j]).sum();
        assert!(along.abs() < 1e-12, "{along}");
        assert!(geometry.roots.iter().all(|roots| roots.iter().flatten().count() == 1));
    }

    #[test]
    fn a_component_that_never_moves_keeps_its_unit() {
        let states = Trajectory { dimension: 2, step: 1.0, states: vec![3.0, 7.0, 5.0, 7.0] };
        let geometry = Geometry::scaled(&[&DMatrix::identity(2, 2)], &states).unwrap();
        assert_eq!(geometry.transform, DMatrix::identity(2, 2));
    }

    proptest! {
        #[test]
        fn transforms_are_invertible_and_roots_measure_their_direction(seed in 0u64..400) {
            let (n, outputs) = random_outputs(seed);
            let states = random_walk(seed, n, 300);
            let scaled = Geometry::scaled(&references(&outputs), &states).unwrap();
            let plain = Geometry::in_state_units(&references(&outputs)).unwrap();
            for geometry in [&scaled, &plain] {
                let unit = product(&geometry.transform, &geometry.inverse);
                let off = (&unit - DMatrix::identity(n, n)).amax();
                prop_assert!(off < 1e-9 * geometry.inverse.amax().max(1.0), "{off}");
                let x: Vec<f64> = (0..n).map(|j| 0.3 + j as f64).collect();
                let (mut xi, mut back) = (vec![0.0; n], vec![0.0; n]);
                geometry.directions_of(&x, &mut xi);
                image(&geometry.inverse, &xi, &mut back);
                prop_assert!(x.iter().zip(&back).all(|(x, back)| (x - back).abs() < 1e-7));
                for c in 0..n {
                    prop_assert!((0..outputs.len()).any(|agent| geometry.is_root(agent, c)));
                }
                for (agent, roots) in geometry.roots.iter().enumerate() {
                    for (c, root) in roots.iter().enumerate() {
                        let Some(root) = root else { continue };
                        let row: Vec<f64> = outputs[agent].row(root.output).iter().copied().collect();
                        let measured = root.scale * dot(&row, &x);
                        prop_assert!((measured - xi[c]).abs() < 1e-4 * (1.0 + xi[c].abs()));
                    }
                }
            }
            for c in 0..n {
                let row: Vec<f64> = scaled.transform.row(c).iter().copied().collect();
                let along = (0..states.samples()).map(|k| dot(&row, states.state(k))).collect();
                let along = Trajectory { dimension: 1, step: 1.0, states: along };
                prop_assert!((along.deviation()[0] - 1.0).abs() < 1e-9);
            }
        }
    }
}
