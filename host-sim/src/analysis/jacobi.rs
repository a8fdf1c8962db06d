//! All eigenvalues of a small symmetric matrix, by Jacobi rotations.
//!
//! Cost: about 10 sweeps of `6 n^3` operations, in a fixed order, so that the bits are the same on
//! every machine. Small eigenvalues of a positive definite matrix have nearly full precision.

use nalgebra::DMatrix;

/// Limit that is never reached, because convergence is quadratic.
const SWEEPS_MAX: usize = 60;

/// Eigenvalues, ascending, and their unit eigenvectors as columns.
#[derive(Clone, Debug)]
pub(super) struct Eigen {
    pub(super) values: Vec<f64>,
    pub(super) vectors: DMatrix<f64>,
}

impl Eigen {
    /// Decomposes a symmetric matrix, shape `[n, n]`.
    pub(super) fn new(matrix: &DMatrix<f64>) -> Self {
        let n = matrix.nrows();
        let mut a = matrix.clone();
        let mut vectors = DMatrix::identity(n, n);
        for _ in 0..SWEEPS_MAX {
            let mut rotated = false;
            for p in 0..n {
                for q in p + 1..n {
                    rotated |= rotate(&mut a, &mut vectors, p, q);
                }
            }
            if !rotated {
                break;
            }
        }
        let mut order: Vec<usize> = (0..n).collect();
        order.sort_by(|&i, &j| a[(i, i)].total_cmp(&a[(j, j)]));
        Self {
            values: order.iter().map(|&i| a[(i, i)]).collect(),
            vectors: DMatrix::from_fn(n, n, |row, column| vectors[(row, order[column])]),
        }
    }

    /// Returns the matrix with the same eigenvectors and the square roots of the eigenvalues;
    /// negative ones count as zero.
    pub(super) fn square_root(&self) -> DMatrix<f64> {
        let n = self.values.len();
        DMatrix::from_fn(n, n, |row, column| {
            (0..n).fold(0.0, |sum, k| {
                let root = self.values[k].max(0.0).sqrt();
                sum + self.vectors[(row, k)] * root * self.vectors[(column, k)]
            })
        })
    }
}

/// Zeroes entry `(p, q)`; returns whether it was above rounding.
fn rotate(a: &mut DMatrix<f64>, vectors: &mut DMatrix<f64>, p: usize, q: usize) -> bool {
    let off = a[(p, q)];
    // Relative to both diagonal entries, so that small eigenvalues keep their digits.
    let small = f64::EPSILON * 0.5 * (a[(p, p)].abs() * a[(q, q)].abs()).sqrt();
    if off == 0.0 || off.abs() <= small || !off.is_finite() {
        return false;
    }
    let ratio = 0.5 * (a[(q, q)] - a[(p, p)]) / off;
    let tangent = if ratio == 0.0 {
        1.0
    } else {
        ratio.signum() / (ratio.abs() + (1.0 + ratio * ratio).sqrt())
    };
    let cosine = 1.0 / (1.0 + tangent * tangent).sqrt();
    let sine = tangent * cosine;
    let n = a.nrows();
    for k in 0..n {
        let (left, right) = (a[(k, p)], a[(k, q)]);
        a[(k, p)] = cosine * left - sine * right;
        a[(k, q)] = sine * left + cosine * right;
    }
    for k in 0..n {
        let (left, right) = (a[(p, k)], a[(q, k)]);
        a[(p, k)] = cosine * left - sine * right;
        a[(q, k)] = sine * left + cosine * right;
        let (left, right) = (vectors[(k, p)], vectors[(k, q)]);
        vectors[(k, p)] = cosine * left - sine * right;
        vectors[(k, q)] = sine * left + cosine * right;
    }
    a[(p, q)] = 0.0;
    a[(q, p)] = 0.0;
    true
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::dmatrix;

    #[test]
    fn eigenvalues_match_hand_calculation() {
        // The Laplacian of a path of three nodes: 0, 1, 3.
        let eigen = Eigen::new(&dmatrix![1.0, -1.0, 0.0; -1.0, 2.0, -1.0; 0.0, -1.0, 1.0]);
        for (found, expected) in eigen.values.iter().zip([0.0, 1.0, 3.0]) {
            assert!((found - expected).abs() < 1e-15, "{eigen:?}");
        }
        assert_eq!(Eigen::new(&dmatrix![3.0]).values, [3.0]);
    }

    #[test]
    fn square_of_the_root_is_the_matrix() {
        let matrix = dmatrix![4.0, 1.0, 0.5; 1.0, 3.0, -0.25; 0.5, -0.25, 1e-3 + 0.2];
        let root = Eigen::new(&matrix).square_root();
        for row in 0..3 {
            for column in 0..3 {
                let product = (0..3).fold(0.0, |sum, k| sum + root[(row, k)] * root[(k, column)]);
                assert!((product - matrix[(row, column)]).abs() < 1e-14, "{row}, {column}");
            }
        }
    }
}
