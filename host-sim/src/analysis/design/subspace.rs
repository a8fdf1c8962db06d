//! Solves the inequality for large networks in small subspaces.
//!
//! `V^T M V >= I` follows from `M >= I`, so the solution in a subspace has the smaller cost: a lower
//! bound, which the dual problem confirms. Its multiple by `1 / lambda_min(M)` satisfies the whole
//! inequality: an upper bound, `1 / lambda_min` times the lower one. The eigenvectors of the smallest eigenvalues join the subspace
//! until both agree; near the solution the subspace then holds all eigenvectors that count, and the
//! gap closes faster than linearly. `V` starts with the consensus `x_1 = .. = x_N`, on which the
//! inequality already bounds every gain from below.
//!
//! Networks of up to [`WHOLE`] numbers use the whole space, and so do those of up to
//! [`WHOLE_AT_LAST`] whose subspace has grown to a quarter of it. Larger ones cost a few sparse
//! factorisations and a dense problem of order 20 to 150 in each of about 10 rounds.

use nalgebra::DMatrix;

use super::interior_point;
use super::pencil::Problem;
use super::{Report, norm};
use crate::analysis::block_cholesky::BlockCholesky;
use crate::analysis::block_matrix::{BlockMatrix, dot, normalise};
use crate::analysis::gain::half_products;
use crate::analysis::smallest::{Smallest, smallest_vectors};

/// Order up to which no subspace is needed.
const WHOLE: usize = 100;
/// Order up to which the whole space follows a subspace of a quarter of its order.
const WHOLE_AT_LAST: usize = 300;
/// Relative gap at which the search ends.
const TOLERANCE: f64 = 1e-8;
const ROUNDS_MAX: usize = 40;
/// Eigenvectors that join the subspace in each round.
const VECTORS: usize = 8;
/// Most vectors of the subspace; from then on the search ends with the gap it has.
const ORDER_MAX: usize = 400;

/// A gain with `M(K_1) >= eigenvalue_min I`.
pub(super) struct Found {
    pub(super) gain: DMatrix<f64>,
    pub(super) eigenvalue_min: f64,
    /// Relative gap between the upper and the lower bound on the cost.
    pub(super) gap: f64,
}

/// Solves the problem; `None` if rounding hides every solution.
pub(super) fn solve(problem: &Problem<'_>, report: Report<'_>) -> Option<Found> {
    let (n, dimension) = (problem.block(), problem.dimension());
    let mut basis: Vec<Vec<f64>> = Vec::new();
    let mut whole = dimension <= WHOLE;
    let unit = |k: usize| (0..dimension).map(|i| f64::from(u8::from(i == k))).collect();
    if whole {
        basis.extend((0..dimension).map(unit));
    } else {
        let size = (dimension as f64 / n as f64).sqrt().recip();
        let consensus =
            |a: usize| (0..dimension).map(|i| if i % n == a { size } else { 0.0 }).collect();
        basis.extend((0..n).map(consensus));
    }
    let mut best: Option<Found> = None;
    for round in 1..=ROUNDS_MAX {
        let columns = DMatrix::from_fn(dimension, basis.len(), |row, k| basis[k][row]);
        let gap = best.as_ref().map_or(1.0, |best| best.gap.min(1.0));
        // While the subspace is far too small, a rough solution will do.
        let tolerance = if whole { 1e-10 } else { (1e-3 * gap).clamp(1e-10, 1e-4) };
        let solution = interior_point::solve(&problem.project(&columns), tolerance)?;
        let gain = problem.gain(&solution.x);
        if !(norm(&gain) > 0.0 && solution.cost > 0.0) {
            return best;
        }
        let matrix = BlockMatrix {
            diagonal: problem.measured.iter().map(|block| half_products(&gain, block)).collect(),
            coupling: gain.clone(),
            graph: problem.graph,
        };
        let structure = BlockCholesky::new(&matrix);
        let smallest = Smallest::new(&matrix, &structure);
        if smallest.lower > 0.0 {
            let gap = (solution.cost / (smallest.lower * solution.bound) - 1.0).max(0.0);
            if best.as_ref().is_none_or(|best| gap < best.gap) {
                best = Some(Found { gain, eigenvalue_min: smallest.lower, gap });
            }
        }
        let gap = best.as_ref().map_or(1.0, |best| best.gap);
        report(round, gap);
        if whole || gap <= TOLERANCE || basis.len() >= ORDER_MAX {
            break;
        }
        let before = basis.len();
        for vector in smallest_vectors(&matrix, &structure, smallest, VECTORS) {
            join(&mut basis, vector);
        }
        if basis.len() == before {
            break;
        }
        if dimension <= WHOLE_AT_LAST && 4 * basis.len() > dimension {
            basis = (0..dimension).map(unit).collect();
            whole = true;
        }
    }
    best
}

/// Adds what is new in `vector`.
fn join(basis: &mut Vec<Vec<f64>>, mut vector: Vec<f64>) {
    let mut left = 1.0;
    for _ in 0..2 {
        for known in basis.iter() {
            let part = dot(&vector, known);
            vector.iter_mut().zip(known).for_each(|(x, v)| *x -= part * v);
        }
        left *= normalise(&mut vector);
    }
    if left > 1e-10 && left.is_finite() {
        basis.push(vector);
    }
}
