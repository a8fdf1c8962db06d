//! `BMI` as a linear matrix inequality in the entries of `K_1`.
//!
//! ```text
//! K_1 = sum_k x_k B_k,   B_k = e_a e_a^T  or  e_a e_b^T + e_b e_a^T
//! M(K_1) = sum_k x_k A_k,   A_k = (1/2) (I (x) B_k) C^T C + (1/2) C^T C (I (x) B_k) + L (x) B_k
//! V^T M V >= I,   t I - K_1 >= 0   (the second for the smallest norm only)
//! ```
//!
//! The columns of `V`, shape `[nN, r]`, are orthonormal. With the rows `V_a` that belong to
//! component `a` of all agents, `V^T A_k V` is `X_aa` or `X_ab + X_ba` of
//!
//! ```text
//! X_ab = V_a^T U_b + (1/2) (C^T C V)_a^T V_b,   U = (1/2) C^T C V + (L (x) I) V
//! ```
//!
//! so that all coefficients together cost `4 n^2 N r^2` operations.

use nalgebra::DMatrix;

use super::Shape;
use crate::analysis::gain::gram;
use crate::graph::Graph;
use crate::scenario::Scenario;

/// Weight of the trace relative to the norm: the norm alone leaves smaller eigenvalues undetermined.
const TRACE_WEIGHT: f64 = 1e-6;

/// The problem, independent of the subspace.
pub(super) struct Problem<'s> {
    pub(super) graph: &'s Graph,
    /// `C_i^T C_i` of every agent.
    pub(super) measured: Vec<DMatrix<f64>>,
    /// `(a, b)` of each `B_k`, `a <= b`.
    entries: Vec<(usize, usize)>,
    /// Whether the norm is minimised instead of the trace.
    norm: bool,
    n: usize,
}

/// The inequality in a subspace: `sum_k x_k A_k - C >= 0`.
pub(super) struct Pencil {
    /// `A_k`.
    pub(super) coefficients: Vec<Coefficient>,
    /// `C`, diagonal.
    pub(super) constant: Vec<f64>,
    /// `c` of the objective `c^T x`.
    pub(super) costs: Vec<f64>,
    /// Values of `x` that satisfy the inequality when multiplied by a large enough factor.
    pub(super) ray: Vec<f64>,
}

/// A symmetric matrix.
pub(super) struct Coefficient {
    pub(super) matrix: DMatrix<f64>,
    /// Its entries, if most are zero.
    entries: Option<Vec<(usize, usize, f64)>>,
}

impl<'s> Problem<'s> {
    pub(super) fn new(scenario: &'s Scenario, shape: Shape, norm: bool) -> Self {
        let n = scenario.dimension();
        let pairs = (0..n).flat_map(|a| (a..n).map(move |b| (a, b)));
        Self {
            graph: &scenario.graph,
            measured: scenario.agents.iter().map(|agent| gram(&agent.output_matrix)).collect(),
            entries: pairs.filter(|(a, b)| shape == Shape::Full || a == b).collect(),
            norm,
            n,
        }
    }

    /// Returns `nN`.
    pub(super) fn dimension(&self) -> usize {
        self.n * self.measured.len()
    }

    /// Returns `n`.
    pub(super) fn block(&self) -> usize {
        self.n
    }

    /// Returns `K_1` for these values.
    pub(super) fn gain(&self, x: &[f64]) -> DMatrix<f64> {
        let mut gain = DMatrix::zeros(self.n, self.n);
        for (&(a, b), &x) in self.entries.iter().zip(x) {
            gain[(a, b)] = x;
            gain[(b, a)] = x;
        }
        gain
    }

    /// Projects the inequality on the span of `basis`, shape `[nN, r]`.
    pub(super) fn project(&self, basis: &DMatrix<f64>) -> Pencil {
        let (n, r) = (self.n, basis.ncols());
        let mut seen = DMatrix::zeros(self.dimension(), r);
        let mut coupled = DMatrix::zeros(self.dimension(), r);
        for (i, measured) in self.measured.iter().enumerate() {
            let own = basis.rows(i * n, n);
            seen.rows_mut(i * n, n).copy_from(&(measured * own));
            let mut difference = own * self.graph.degree(i);
            for edge in self.graph.neighbours(i) {
                difference -= basis.rows(edge.agent * n, n) * edge.weight;
            }
            coupled.rows_mut(i * n, n).copy_from(&difference);
        }
        let half = seen * 0.5;
        let sum = &half + coupled;
        let component = |matrix: &DMatrix<f64>, a: usize| {
            DMatrix::from_fn(self.measured.len(), r, |i, column| matrix[(i * n + a, column)])
        };
        let parts =
            |matrix: &DMatrix<f64>| -> Vec<_> { (0..n).map(|a| component(matrix, a)).collect() };
        let (of_basis, of_half, of_sum) = (parts(basis), parts(&half), parts(&sum));
        let transposed =
            |parts: &[DMatrix<f64>]| -> Vec<_> { parts.iter().map(DMatrix::transpose).collect() };
        let (basis_rows, half_rows) = (transposed(&of_basis), transposed(&of_half));
        let product =
            |a: usize, b: usize| &basis_rows[a] * &of_sum[b] + &half_rows[a] * &of_basis[b];
        let order = r + if self.norm { n } else { 0 };
        let coefficient = |&(a, b): &(usize, usize)| {
            let inner = if a == b { product(a, a) } else { product(a, b) + product(b, a) };
            let mut matrix = DMatrix::zeros(order, order);
            for row in 0..r {
                for column in 0..r {
                    matrix[(row, column)] = 0.5 * (inner[(row, column)] + inner[(column, row)]);
                }
            }
            if self.norm {
                matrix[(r + a, r + b)] = -1.0;
                matrix[(r + b, r + a)] = -1.0;
            }
            Coefficient::new(matrix)
        };
        let mut coefficients: Vec<_> = self.entries.iter().map(coefficient).collect();
        let diagonal = |&(a, b): &(usize, usize)| f64::from(u8::from(a == b));
        let mut costs: Vec<_> = self.entries.iter().map(diagonal).collect();
        let mut ray = costs.clone();
        if self.norm {
            costs.iter_mut().for_each(|cost| *cost *= TRACE_WEIGHT);
            let bound = |row, column| f64::from(u8::from(row == column && row >= r));
            coefficients.push(Coefficient::new(DMatrix::from_fn(order, order, bound)));
            costs.push(1.0);
            ray.push(2.0);
        }
        let constant = (0..order).map(|row| f64::from(u8::from(row < r))).collect();
        Pencil { coefficients, constant, costs, ray }
    }
}

impl Coefficient {
    pub(super) fn new(matrix: DMatrix<f64>) -> Self {
        let count = matrix.iter().filter(|x| **x != 0.0).count();
        let entries = (8 * count < matrix.len()).then(|| {
            let places = (0..matrix.ncols())
                .flat_map(|column| (0..matrix.nrows()).map(move |row| (row, column)));
            let entries = places.map(|place| (place.0, place.1, matrix[place]));
            entries.filter(|entry| entry.2 != 0.0).collect()
        });
        Self { matrix, entries }
    }

    /// Returns `X A`.
    pub(super) fn right_of(&self, x: &DMatrix<f64>) -> DMatrix<f64> {
        let Some(entries) = &self.entries else { return x * &self.matrix };
        let order = x.nrows();
        let mut result = DMatrix::zeros(order, order);
        for &(row, column, value) in entries {
            let from = &x.as_slice()[row * order..][..order];
            let to = &mut result.as_mut_slice()[column * order..][..order];
            to.iter_mut().zip(from).for_each(|(to, from)| *to += value * from);
        }
        result
    }

    /// Returns `tr(A X)` for a symmetric `X`.
    pub(super) fn trace_with(&self, x: &DMatrix<f64>) -> f64 {
        match &self.entries {
            Some(entries) => entries
                .iter()
                .fold(0.0, |sum, &(row, column, value)| sum + value * x[(row, column)]),
            None => self.matrix.dot(x),
        }
    }

    /// Adds `factor A` to `sum`.
    pub(super) fn add_to(&self, sum: &mut DMatrix<f64>, factor: f64) {
        match &self.entries {
            Some(entries) => {
                entries.iter().for_each(|&(row, column, x)| sum[(row, column)] += factor * x);
            }
            None => sum.zip_apply(&self.matrix, |sum, x| *sum += factor * x),
        }
    }
}
