//! Products of small dense matrices, with a fixed order of operations: nalgebra's own products of
//! more than five rows depend on the processor's vector instructions.

use nalgebra::DMatrix;

/// Returns `A B`.
pub(super) fn product(a: &DMatrix<f64>, b: &DMatrix<f64>) -> DMatrix<f64> {
    DMatrix::from_fn(a.nrows(), b.ncols(), |row, column| {
        (0..a.ncols()).fold(0.0, |sum, k| sum + a[(row, k)] * b[(k, column)])
    })
}

/// Writes `A x` to `result`.
pub(super) fn image(a: &DMatrix<f64>, x: &[f64], result: &mut [f64]) {
    for (row, result) in result.iter_mut().enumerate() {
        *result = x.iter().enumerate().fold(0.0, |sum, (k, x)| sum + a[(row, k)] * x);
    }
}

/// Returns `a . b`.
pub(super) fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).fold(0.0, |sum, (a, b)| sum + a * b)
}

/// Returns `|a|`.
pub(super) fn norm(a: &[f64]) -> f64 {
    dot(a, a).sqrt()
}
