//! Solves the damped normal equations by Cholesky factorisation.
//!
//! ```text
//! (A + μ I) x = b,   A + μ I = Uᵀ U,   Uᵀ y = b,   U x = y
//! ```
//!
//! Cost for n unknowns: n³/6 multiplications and additions, n² of memory. Rows are factored in
//! blocks; the contribution of a block to the rows below it is one panel product.
//!
//! Invariants: the bits do not depend on the machine (no fused multiply-add; square root and
//! division are correctly rounded by IEEE 754). A matrix that is not positive definite to within
//! rounding error is an outcome, `false`, not an error.

use super::panel_product::{LANES, PanelProduct, Store, round_up, row_stride};
use pulp::{Arch, Simd, WithSimd};

/// Number of rows factored before the rest of the matrix is updated.
const BLOCK: usize = 32;

/// The factor and its work space.
#[derive(Clone, Debug)]
pub(crate) struct Cholesky {
    arch: Arch,
    order: usize,
    stride: usize,
    /// Upper triangle of U, row-major, rows `stride` apart.
    factor: Vec<f64>,
    /// The columns of the current block, stored as rows.
    columns: Vec<[f64; BLOCK]>,
}

impl Cholesky {
    /// Allocates the work space for matrices of the given order.
    pub(crate) fn new(order: usize, arch: Arch) -> Self {
        let stride = row_stride(order);
        Self {
            arch,
            order,
            stride,
            factor: vec![0.0; order * stride],
            columns: vec![[0.0; BLOCK]; order],
        }
    }

    /// Solves `(A + damping I) x = b` in place of `b`. `matrix` is A, row-major, shape
    /// `[order][order]`; only its upper triangle is read.
    ///
    /// Returns whether the matrix was positive definite; if not, the content of `b` is unspecified.
    /// Also returns `false` once `stopped` is true, which is checked every few million
    /// multiplications.
    ///
    /// # Panics
    /// If `matrix` or `b` is too short for the order.
    pub(crate) fn solve(
        &mut self,
        matrix: &[f64],
        damping: f64,
        b: &mut [f64],
        stopped: &dyn Fn() -> bool,
    ) -> bool {
        let positive = self.factor(matrix, damping, stopped);
        if positive {
            self.forward(b);
            self.backward(b);
        }
        positive
    }

    /// Factors `A + damping I`, with `matrix` as in [`Self::solve`]; returns whether it was
    /// positive definite and `stopped` stayed false.
    ///
    /// # Panics
    /// If `matrix` is too short for the order.
    pub(crate) fn factor(
        &mut self,
        matrix: &[f64],
        damping: f64,
        stopped: &dyn Fn() -> bool,
    ) -> bool {
        for row in 0..self.order {
            let source = &matrix[row * self.order..][row..self.order];
            let target = &mut self.factor[row * self.stride..][row..self.order];
            target.copy_from_slice(source);
            target[0] += damping;
        }
        self.factorise(stopped)
    }

    /// Returns row `k` of U from the diagonal onward.
    pub(crate) fn row(&self, k: usize) -> &[f64] {
        &self.factor[k * self.stride..][k..self.order]
    }

    fn factorise(&mut self, stopped: &dyn Fn() -> bool) -> bool {
        let (order, stride) = (self.order, self.stride);
        for first in (0..order).step_by(BLOCK) {
            let rows = BLOCK.min(order - first);
            let next = first + rows;
            let (head, below) = self.factor.split_at_mut(next * stride);
            let block = &mut head[first * stride..];
            if !self.arch.dispatch(BlockRows { block, stride, first, rows, order }) {
                return false;
            }
            for column in next..order {
                for r in 0..rows {
                    self.columns[column][r] = block[r * stride + column];
                }
            }
            for start in (next..order).step_by(BLOCK) {
                if stopped() {
                    return false;
                }
                let column = start / LANES * LANES;
                self.arch.dispatch(PanelProduct {
                    left: &self.columns[start..order.min(start + BLOCK)],
                    terms: rows,
                    panel: &block[column..],
                    panel_stride: stride,
                    columns: round_up(order) - column,
                    output: &mut below[(start - next) * stride + column..],
                    output_stride: stride,
                    store: Store::Subtract,
                });
            }
        }
        true
    }

    /// Solves `Uᵀ y = b` in place.
    ///
    /// # Panics
    /// If `b` is too short for the order.
    pub(crate) fn forward(&self, b: &mut [f64]) {
        let b = &mut b[..self.order];
        for k in 0..self.order {
            let row = self.row(k);
            let (head, tail) = b[k..].split_at_mut(1);
            head[0] /= row[0];
            for (b, u) in tail.iter_mut().zip(&row[1..]) {
                *b -= u * head[0];
            }
        }
    }

    /// Solves `U x = y` in place.
    ///
    /// # Panics
    /// If `b` is too short for the order.
    pub(crate) fn backward(&self, b: &mut [f64]) {
        let b = &mut b[..self.order];
        for k in (0..self.order).rev() {
            let row = self.row(k);
            let (head, tail) = b[k..].split_at_mut(1);
            head[0] = (head[0] - dot(&row[1..], tail)) / row[0];
        }
    }
}

/// Computes an inner product in four interleaved sums, added pairwise at the end.
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let mut sums = [0.0; 4];
    let (a_chunks, a_rest) = a.as_chunks::<4>();
    let (b_chunks, b_rest) = b.as_chunks::<4>();
    for (a, b) in a_chunks.iter().zip(b_chunks) {
        for i in 0..4 {
            sums[i] += a[i] * b[i];
        }
    }
    let mut rest = 0.0;
    for (a, b) in a_rest.iter().zip(b_rest) {
        rest += a * b;
    }
    ((sums[0] + sums[1]) + (sums[2] + sums[3])) + rest
}

/// Factors the rows of one block, from its diagonal to the last column.
struct BlockRows<'a> {
    block: &'a mut [f64],
    stride: usize,
    first: usize,
    rows: usize,
    order: usize,
}

impl WithSimd for BlockRows<'_> {
    type Output = bool;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> bool {
        for k in 0..self.rows {
            let diagonal = self.first + k;
            let (above, row) = self.block.split_at_mut(k * self.stride);
            let row = &mut row[diagonal..self.order];
            for above in above.chunks_exact(self.stride) {
                let above = &above[diagonal..self.order];
                let factor = above[0];
                for (value, u) in row.iter_mut().zip(above) {
                    *value -= factor * u;
                }
            }
            let pivot = row[0];
            // Also false for a NaN pivot.
            if !(pivot > 0.0 && pivot.is_finite()) {
                return false;
            }
            let inverse = 1.0 / pivot.sqrt();
            for value in row {
                *value *= inverse;
            }
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::training::testing::{assert_close, instruction_sets, random_values};

    /// Returns BᵀB/n + identity/4, row-major.
    fn positive_definite(order: usize) -> Vec<f64> {
        let b = random_values(order * order, 7);
        let mut a = vec![0.0; order * order];
        for i in 0..order {
            for j in 0..order {
                let sum: f64 = (0..order).map(|k| b[k * order + i] * b[k * order + j]).sum();
                a[i * order + j] = sum / order as f64 + if i == j { 0.25 } else { 0.0 };
            }
        }
        a
    }

    #[test]
    fn solution_is_correct_and_independent_of_vector_width() {
        for order in [1, 2, 7, 31, 32, 33, 64, 65, 100, 137] {
            let matrix = positive_definite(order);
            let b = random_values(order, 8);
            let mut results = Vec::new();
            for arch in instruction_sets() {
                let mut x = b.clone();
                assert!(Cholesky::new(order, arch).solve(&matrix, 0.5, &mut x, &|| false));
                results.push(x);
            }
            assert!(results.iter().all(|x| *x == results[0]), "bits");
            let x = &results[0];
            let product: Vec<f64> = (0..order)
                .map(|i| 0.5 * x[i] + (0..order).map(|j| matrix[i * order + j] * x[j]).sum::<f64>())
                .collect();
            assert_close(&product, &b, 1e-12, 1e-12);
        }
    }

    #[test]
    fn detects_a_matrix_that_is_not_positive_definite() {
        let order = 40;
        let mut matrix = positive_definite(order);
        let mut cholesky = Cholesky::new(order, Arch::new());
        assert!(cholesky.solve(&matrix, 0.0, &mut vec![1.0; order], &|| false));
        assert!(!cholesky.solve(&matrix, 0.0, &mut vec![1.0; order], &|| true), "stopped");
        matrix[35 * order + 35] = -1.0;
        assert!(!cholesky.solve(&matrix, 0.0, &mut vec![1.0; order], &|| false));
        assert!(
            cholesky.solve(&matrix, 10.0, &mut vec![1.0; order], &|| false),
            "positive definite with enough damping"
        );
        matrix[3] = f64::NAN;
        assert!(!cholesky.solve(&matrix, 10.0, &mut vec![1.0; order], &|| false));
    }
}
