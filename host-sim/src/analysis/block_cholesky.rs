//! Decides whether `M - s I` is positive definite, by the Cholesky factorisation `M - s I = L L^T`
//! of a [`BlockMatrix`] with a rigorous error bound.
//!
//! Sparse graphs are factored block by block in the order of [`Elimination`]; the remaining dense
//! block goes to the trainer's kernel. A nearly complete graph, most of whose edges have the same
//! weight `w`, is represented by its missing edges: with the Laplacian `L_c` of weights `w - a_ij`,
//!
//! ```text
//! M = blockdiag(D_i + w N K) - L_c (x) K - U (N w K) U^T,   U = (1/sqrt(N)) [I .. I]^T
//! ```
//!
//! is the Schur complement of `N w K` in a matrix with one more block, a hub joined to every agent,
//! so that a complete graph costs as much as a star. The hub's matrix is positive definite if and
//! only if `M` is, because `K` is. Vectors `(v, U^T v)` are at most `sqrt(2)` times as long as `v`,
//! so errors count twice.
//!
//! Errors: if the factorisation completes, `L L^T = M - s I + E` with `|E| <= gamma |L| |L|^T`
//! entry by entry (Higham, *Accuracy and Stability of Numerical Algorithms*, theorem 10.3), so
//! `lambda_min(M) >= s - |E|`. The norm of `|L| |L|^T` is bounded by Collatz and Wielandt: for
//! every positive `y` it is at most the largest `(|L| |L|^T y)_i / y_i`.
//!
//! Cost: `n^3 (r^2 + r)` operations for each agent with `r` remaining neighbours, `d^3/6` for a
//! dense remainder of order `d`; memory proportional to the number of blocks of `L`.

use nalgebra::DMatrix;
use pulp::Arch;

use super::block_kernels::{
    Sum, divide_block, factor_block, subtract_product, subtract_product_transposed,
};
use super::block_matrix::{BlockMatrix, UNIT_ROUNDOFF};
use super::elimination::Elimination;
use crate::training::cholesky::Cholesky;

/// The structure shared by all factorisations of a matrix, independent of the shift.
#[derive(Debug)]
pub(super) struct BlockCholesky<'m> {
    matrix: &'m BlockMatrix<'m>,
    /// Multiple of `K` in the diagonal block of each vertex; the last vertex may be the hub.
    coefficients: Vec<f64>,
    /// Off-diagonal blocks, as multiples of `K`.
    pairs: Vec<(usize, usize, f64)>,
    hub: bool,
    elimination: Elimination,
    rank: Vec<usize>,
    /// The largest number of products in any entry of `L`.
    products_max: usize,
    /// Largest norm of the `D_i`, which bounds the rounding errors of computing them.
    block_norm: f64,
}

/// `L` for one shift.
#[derive(Debug)]
pub(super) struct Factor<'s, 'm> {
    structure: &'s BlockCholesky<'m>,
    /// For each eliminated vertex, its diagonal block and the blocks of its rows, each with `n * n`
    /// numbers in row-major order.
    columns: Vec<Vec<f64>>,
    dense: Cholesky,
    /// A lower bound of `lambda_min(M)`.
    pub(super) lower: f64,
    /// Distance of that bound from the shift: the bound on rounding errors.
    pub(super) error: f64,
}

impl<'m> BlockCholesky<'m> {
    pub(super) fn new(matrix: &'m BlockMatrix<'m>) -> Self {
        let graph = matrix.graph;
        let agents = graph.agents();
        let edges = graph.edges();
        let positive_coupling = super::jacobi::Eigen::new(&matrix.coupling).values[0] > 0.0;
        let usual = usual_weight(matrix);
        let complete = agents * (agents - 1) / 2;
        let differing = usual.map_or(complete, |(_, count)| complete - count);
        let hub = positive_coupling && agents > 2 && differing + agents < edges.len();
        let (mut coefficients, mut pairs);
        if let (true, Some((weight, _))) = (hub, usual) {
            pairs = Vec::with_capacity(differing + agents);
            let mut sums = vec![Sum::default(); agents];
            for first in 0..agents {
                let mut neighbours = graph.neighbours(first).iter().peekable();
                for second in 0..agents {
                    let found = neighbours.next_if(|neighbour| neighbour.agent == second);
                    let lacking = weight - found.map_or(0.0, |neighbour| neighbour.weight);
                    if second > first && lacking != 0.0 {
                        pairs.push((first, second, lacking));
                    }
                }
            }
            for &(first, second, lacking) in &pairs {
                sums[first].add(lacking);
                sums[second].add(lacking);
            }
            let all = weight * agents as f64;
            coefficients = sums.iter().map(|sum| all - sum.value()).collect::<Vec<_>>();
            // The hub.
            coefficients.push(all);
            let joint = -weight * (agents as f64).sqrt();
            pairs.extend((0..agents).map(|agent| (agent, agents, joint)));
        } else {
            pairs = edges.iter().map(|edge| (edge.first, edge.second, -edge.weight)).collect();
            let mut sums = vec![Sum::default(); agents];
            for edge in edges {
                sums[edge.first].add(edge.weight);
                sums[edge.second].add(edge.weight);
            }
            coefficients = sums.iter().map(Sum::value).collect();
        }
        let vertices = coefficients.len();
        let elimination = Elimination::new(vertices, pairs.iter().map(|&(a, b, _)| (a, b)));
        let mut rank = vec![0; vertices];
        for (position, &vertex) in elimination.order.iter().enumerate() {
            rank[vertex] = position;
        }
        let mut joined = vec![1; vertices];
        for row in elimination.rows.iter().flatten() {
            joined[*row] += 1;
        }
        let dense = vertices - elimination.eliminated();
        let most = |ranks: std::ops::Range<usize>| joined[ranks].iter().copied().max().unwrap_or(0);
        let eliminated = elimination.eliminated();
        let products_max = most(0..eliminated).max(most(eliminated..vertices) + dense);
        let block_norm = matrix.diagonal.iter().map(DMatrix::norm).fold(0.0, f64::max);
        Self {
            products_max: products_max * matrix.block(),
            matrix,
            coefficients,
            pairs,
            hub,
            elimination,
            rank,
            block_norm,
        }
    }

    /// Returns `L` of `M - shift I`, or `None` if that is not positive definite, or only within
    /// rounding.
    pub(super) fn factor(&self, shift: f64) -> Option<Factor<'_, 'm>> {
        let n = self.matrix.block();
        let eliminated = self.elimination.eliminated();
        let dense_order = (self.elimination.order.len() - eliminated) * n;
        let (mut columns, mut dense) = self.assemble(shift);
        let mut transposed = vec![0.0; n * n];
        for k in 0..eliminated {
            let rows = &self.elimination.rows[k];
            let (column, later) = columns[k..].split_at_mut(1);
            let (diagonal, below) = column[0].split_at_mut(n * n);
            if !factor_block(diagonal, n) {
                return None;
            }
            for block in below.chunks_exact_mut(n * n) {
                divide_block(block, diagonal, n);
            }
            let below = &*below;
            for (b, &rank_b) in rows.iter().enumerate() {
                let right = &below[b * n * n..][..n * n];
                for i in 0..n {
                    for j in 0..n {
                        transposed[j * n + i] = right[i * n + j];
                    }
                }
                if rank_b >= eliminated {
                    for (a, &rank_a) in rows.iter().enumerate().skip(b) {
                        // Only the upper triangle of the dense remainder is stored.
                        let left = &below[a * n * n..][..n * n];
                        let at =
                            (rank_b - eliminated) * n * dense_order + (rank_a - eliminated) * n;
                        subtract_product_transposed(&mut dense[at..], dense_order, left, right, n);
                    }
                    continue;
                }
                let target = &mut later[rank_b - k - 1];
                let target_rows = &self.elimination.rows[rank_b];
                subtract_product(
                    &mut target[..n * n],
                    &below[b * n * n..][..n * n],
                    &transposed,
                    n,
                );
                let mut from = 0;
                for (a, rank_a) in rows.iter().enumerate().skip(b + 1) {
                    let place = from + target_rows[from..].partition_point(|rank| rank < rank_a);
                    from = place + 1;
                    let left = &below[a * n * n..][..n * n];
                    subtract_product(&mut target[from * n * n..][..n * n], left, &transposed, n);
                }
            }
        }
        let mut tail = Cholesky::new(dense_order, Arch::new());
        if !tail.factor(&dense, 0.0, &|| false) {
            return None;
        }
        drop(dense);
        let mut factor = Factor { structure: self, columns, dense: tail, lower: shift, error: 0.0 };
        factor.error = self.error(shift, factor.magnitude());
        factor.lower = shift - factor.error;
        Some(factor)
    }

    /// Bounds the norm of all rounding errors, given that of `|L| |L|^T`.
    fn error(&self, shift: f64, magnitude: f64) -> f64 {
        let n = self.matrix.block();
        // Sums of products in L, a reciprocal and a square root, and the terms of an entry of M.
        let roundings = (self.products_max + 2 * n + 32) as f64;
        let scale = magnitude + shift.abs() + self.block_norm * n as f64;
        let counted = if self.hub { 2.0 } else { 1.0 };
        1.01 * counted * roundings * UNIT_ROUNDOFF * scale
    }

    /// Fills in the entries of `M - shift I` in the layout of the factor.
    fn assemble(&self, shift: f64) -> (Vec<Vec<f64>>, Vec<f64>) {
        let n = self.matrix.block();
        let coupling = &self.matrix.coupling;
        let eliminated = self.elimination.eliminated();
        let order = (self.elimination.order.len() - eliminated) * n;
        let rows = &self.elimination.rows;
        let mut columns: Vec<Vec<f64>> =
            rows.iter().map(|rows| vec![0.0; (1 + rows.len()) * n * n]).collect();
        let mut dense = vec![0.0; order * order];
        for (vertex, &coefficient) in self.coefficients.iter().enumerate() {
            let rank = self.rank[vertex];
            let own = self.matrix.diagonal.get(vertex);
            for i in 0..n {
                for j in 0..n {
                    let own =
                        own.map_or(0.0, |block| block[(i, j)] - if i == j { shift } else { 0.0 });
                    let entry = own + coefficient * coupling[(i, j)];
                    match rank.checked_sub(eliminated) {
                        None => columns[rank][i * n + j] = entry,
                        Some(place) => dense[(place * n + i) * order + place * n + j] = entry,
                    }
                }
            }
        }
        for &(a, b, coefficient) in &self.pairs {
            let (first, second) = (self.rank[a].min(self.rank[b]), self.rank[a].max(self.rank[b]));
            for i in 0..n {
                for j in 0..n {
                    let entry = coefficient * coupling[(i, j)];
                    match first.checked_sub(eliminated) {
                        None => {
                            let place = rows[first].partition_point(|&rank| rank < second);
                            columns[first][((1 + place) * n + i) * n + j] = entry;
                        }
                        Some(first) => {
                            let second = second - eliminated;
                            dense[(first * n + i) * order + second * n + j] = entry;
                        }
                    }
                }
            }
        }
        (columns, dense)
    }
}

impl Factor<'_, '_> {
    /// Solves `(M - s I) x = b` in place.
    pub(super) fn solve(&self, b: &mut [f64]) {
        let n = self.structure.matrix.block();
        let mut x = vec![0.0; self.structure.elimination.order.len() * n];
        for (vertex, block) in b.chunks_exact(n).enumerate() {
            x[self.structure.rank[vertex] * n..][..n].copy_from_slice(block);
        }
        self.forward(&mut x);
        self.backward(&mut x);
        for (vertex, block) in b.chunks_exact_mut(n).enumerate() {
            block.copy_from_slice(&x[self.structure.rank[vertex] * n..][..n]);
        }
    }

    fn forward(&self, x: &mut [f64]) {
        let n = self.structure.matrix.block();
        let rows = &self.structure.elimination.rows;
        for (k, column) in self.columns.iter().enumerate() {
            let (head, tail) = x.split_at_mut((k + 1) * n);
            let own = &mut head[k * n..];
            for i in 0..n {
                let sum = (0..i).fold(own[i], |sum, j| sum - column[i * n + j] * own[j]);
                own[i] = sum / column[i * n + i];
            }
            for (block, rank) in column[n * n..].chunks_exact(n * n).zip(&rows[k]) {
                let other = &mut tail[(rank - k - 1) * n..][..n];
                for i in 0..n {
                    for j in 0..n {
                        other[i] -= block[i * n + j] * own[j];
                    }
                }
            }
        }
        self.dense.forward(&mut x[self.columns.len() * n..]);
    }

    fn backward(&self, x: &mut [f64]) {
        let n = self.structure.matrix.block();
        let rows = &self.structure.elimination.rows;
        self.dense.backward(&mut x[self.columns.len() * n..]);
        for (k, column) in self.columns.iter().enumerate().rev() {
            let (head, tail) = x.split_at_mut((k + 1) * n);
            let own = &mut head[k * n..];
            for (block, rank) in column[n * n..].chunks_exact(n * n).zip(&rows[k]) {
                let other = &tail[(rank - k - 1) * n..][..n];
                for i in 0..n {
                    for j in 0..n {
                        own[j] -= block[i * n + j] * other[i];
                    }
                }
            }
            for i in (0..n).rev() {
                let sum = (i + 1..n).fold(own[i], |sum, j| sum - column[j * n + i] * own[j]);
                own[i] = sum / column[i * n + i];
            }
        }
    }

    /// Returns a bound on the norm of `|L| |L|^T`.
    fn magnitude(&self) -> f64 {
        let n = self.structure.matrix.block();
        let order = self.structure.elimination.order.len() * n;
        let mut y = vec![1.0; order];
        let mut least = f64::INFINITY;
        // A few power iterations move y close to the vector for which the bound equals the norm.
        for _ in 0..4 {
            let image = self.magnitudes_forward(&self.magnitudes_transposed(&y));
            let ratio = image.iter().zip(&y).fold(0.0, |most: f64, (a, b)| most.max(a / b));
            least = least.min(ratio);
            let scale = 1.0 / image.iter().fold(0.0, |most: f64, &a| most.max(a));
            // Bounded from below, so that the ratios remain meaningful.
            y.iter_mut().zip(&image).for_each(|(y, a)| *y = (a * scale).max(1e-6));
        }
        least
    }

    /// Computes `|L|^T y`.
    fn magnitudes_transposed(&self, y: &[f64]) -> Vec<f64> {
        let mut result = vec![0.0; y.len()];
        self.for_each_magnitude(y.len(), |row, column, entry| result[column] += entry * y[row]);
        result
    }

    /// Computes `|L| y`.
    fn magnitudes_forward(&self, y: &[f64]) -> Vec<f64> {
        let mut result = vec![0.0; y.len()];
        self.for_each_magnitude(y.len(), |row, column, entry| result[row] += entry * y[column]);
        result
    }

    /// Calls `visit` with row, column and value of every entry of `|L|`, which has `size` rows.
    fn for_each_magnitude(&self, size: usize, mut visit: impl FnMut(usize, usize, f64)) {
        let n = self.structure.matrix.block();
        let rows = &self.structure.elimination.rows;
        for (k, column) in self.columns.iter().enumerate() {
            let ranks = std::iter::once(&k).chain(&rows[k]);
            for ((block, rank), diagonal) in
                column.chunks_exact(n * n).zip(ranks).zip((0..).map(|place| place == 0))
            {
                for i in 0..n {
                    for j in 0..if diagonal { i + 1 } else { n } {
                        visit(rank * n + i, k * n + j, block[i * n + j].abs());
                    }
                }
            }
        }
        let start = self.columns.len() * n;
        for k in 0..size - start {
            for (row, entry) in (start + k..size).zip(self.dense.row(k)) {
                visit(row, start + k, entry.abs());
            }
        }
    }
}

/// Returns the most frequent edge weight and its number of edges.
fn usual_weight(matrix: &BlockMatrix<'_>) -> Option<(f64, usize)> {
    let mut weights: Vec<f64> = matrix.graph.edges().iter().map(|edge| edge.weight).collect();
    weights.sort_by(f64::total_cmp);
    let runs = weights.chunk_by(|a, b| a == b).map(|run| (run[0], run.len()));
    runs.max_by_key(|&(_, count)| count)
}
