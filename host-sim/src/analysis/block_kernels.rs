//! Operations of [`super::block_cholesky`] on single blocks of `n * n` numbers in row-major order,
//! and a compensated sum.

/// A compensated sum (Kahan and Neumaier).
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Sum {
    sum: f64,
    lost: f64,
}

impl Sum {
    pub(super) fn add(&mut self, term: f64) {
        let sum = self.sum + term;
        let (large, small) =
            if self.sum.abs() >= term.abs() { (self.sum, term) } else { (term, self.sum) };
        self.lost += (large - sum) + small;
        self.sum = sum;
    }

    pub(super) fn value(&self) -> f64 {
        self.sum + self.lost
    }
}

/// Factors a block in place, lower triangle; returns `false` if it is not positive definite.
pub(super) fn factor_block(a: &mut [f64], n: usize) -> bool {
    for j in 0..n {
        let pivot = (0..j).fold(a[j * n + j], |sum, k| sum - a[j * n + k] * a[j * n + k]);
        // Also false for a NaN pivot.
        if !(pivot > 0.0 && pivot.is_finite()) {
            return false;
        }
        let root = pivot.sqrt();
        a[j * n + j] = root;
        for i in j + 1..n {
            let sum = (0..j).fold(a[i * n + j], |sum, k| sum - a[i * n + k] * a[j * n + k]);
            a[i * n + j] = sum / root;
        }
    }
    true
}

/// Replaces `X` with `X L^-T`.
pub(super) fn divide_block(x: &mut [f64], l: &[f64], n: usize) {
    for row in x.chunks_exact_mut(n) {
        for j in 0..n {
            let sum = (0..j).fold(row[j], |sum, k| sum - row[k] * l[j * n + k]);
            row[j] = sum / l[j * n + j];
        }
    }
}

/// Computes `target -= left right^T`, given `right^T`.
pub(super) fn subtract_product(
    target: &mut [f64],
    left: &[f64],
    right_transposed: &[f64],
    n: usize,
) {
    for (target, left) in target.chunks_exact_mut(n).zip(left.chunks_exact(n)) {
        for (&factor, right) in left.iter().zip(right_transposed.chunks_exact(n)) {
            for (target, right) in target.iter_mut().zip(right) {
                *target -= factor * right;
            }
        }
    }
}

/// Computes `target -= right left^T`, with rows `stride` apart.
pub(super) fn subtract_product_transposed(
    target: &mut [f64],
    stride: usize,
    left: &[f64],
    right: &[f64],
    n: usize,
) {
    for (i, right) in right.chunks_exact(n).enumerate() {
        for (j, left) in left.chunks_exact(n).enumerate() {
            target[i * stride + j] =
                left.iter().zip(right).fold(target[i * stride + j], |sum, (l, r)| sum - l * r);
        }
    }
}
