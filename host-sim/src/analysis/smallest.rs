//! Rigorous bounds of `lambda_min(M)` for a [`BlockMatrix`].
//!
//! Upper bound: the smallest eigenvalue is not above any Rayleigh quotient. Lower bound: `M - s I`
//! has a Cholesky factor only if `s` is not above the eigenvalue (up to an error that
//! [`BlockCholesky`] bounds). The vector of the quotient comes from the Lanczos method on `(M - s
//! I)^-1`, with the factor of the lower bound; then `s` moves up to just below the quotient.
//! Repeated and clustered eigenvalues slow this down, but the bounds remain valid.
//!
//! Cost: usually two factorisations, a few more for clustered eigenvalues, with 24 solutions each.

use nalgebra::DMatrix;

use super::block_cholesky::{BlockCholesky, Factor};
use super::block_matrix::{BlockMatrix, dot, normalise, random_direction};
use super::jacobi::Eigen;

/// Lanczos steps between two factorisations.
const STEPS: usize = 24;
/// Limit that is never reached: each round reduces the gap by a factor.
const ROUNDS_MAX: usize = 40;
/// Relative gap between the bounds at which the search ends.
const TOLERANCE: f64 = 1e-12;

/// Bounds of `lambda_min(M)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Smallest {
    /// Lower bound.
    pub(super) lower: f64,
    /// A Rayleigh quotient.
    pub(super) estimate: f64,
    /// Upper bound.
    pub(super) upper: f64,
}

impl Smallest {
    /// Computes bounds as close as rounding or [`TOLERANCE`] allow.
    pub(super) fn new(matrix: &BlockMatrix<'_>, structure: &BlockCholesky<'_>) -> Self {
        let mut vector = random_direction(matrix.dimension());
        let (estimate, error) = matrix.rayleigh_quotient(&vector);
        let mut found = Self { lower: f64::NEG_INFINITY, estimate, upper: estimate + error };
        let Some((mut factor, mut shift)) = below_all(matrix, structure) else { return found };
        found.lower = factor.lower;
        for _ in 0..ROUNDS_MAX {
            let mut largest = largest_of_inverse(&factor, vector, 1);
            let Some(found_vector) = largest.pop() else { break };
            vector = found_vector;
            let (estimate, error) = matrix.rayleigh_quotient(&vector);
            let gained = found.upper - (estimate + error);
            if gained > 0.0 {
                found = Self { lower: found.lower, estimate, upper: estimate + error };
            }
            let near = (2.0 * (factor.error + error)).max(TOLERANCE * found.estimate.abs());
            if found.upper - found.lower <= 2.0 * near {
                break;
            }
            // Start at the distance that the residual suggests, then move down until there is a
            // factor.
            let mut distance = residual(matrix, &vector, estimate).max(0.5 * near);
            let nearer = loop {
                let next = found.estimate - distance;
                if next <= shift {
                    break None;
                }
                if let Some(factor) = structure.factor(next) {
                    break Some((factor, next));
                }
                distance = (4.0 * distance).max(0.25 * (found.estimate - shift));
            };
            match nearer {
                Some((nearer, next)) => {
                    found.lower = found.lower.max(nearer.lower);
                    (factor, shift) = (nearer, next);
                }
                None if gained <= near => break,
                None => {}
            }
        }
        found
    }
}

/// Returns a factor with a shift below every eigenvalue, and the shift.
fn below_all<'s, 'm>(
    matrix: &BlockMatrix<'_>,
    structure: &'s BlockCholesky<'m>,
) -> Option<(Factor<'s, 'm>, f64)> {
    let smallest_of = |block: &DMatrix<f64>| Eigen::new(block).values[0];
    // L (x) K is positive semidefinite if K is, and does not lower eigenvalues.
    let of_blocks = if smallest_of(&matrix.coupling) >= 0.0 {
        let mut blocks: Vec<&DMatrix<f64>> = matrix.diagonal.iter().collect();
        blocks.dedup();
        blocks.into_iter().map(smallest_of).fold(f64::INFINITY, f64::min)
    } else {
        f64::NEG_INFINITY
    };
    let start = of_blocks.max(matrix.eigenvalues_above());
    let scale = matrix.diagonal.iter().map(DMatrix::norm).fold(matrix.coupling.norm(), f64::max);
    let mut distance = 1e-9 * scale.max(start.abs()).max(f64::MIN_POSITIVE);
    for _ in 0..40 {
        if let Some(factor) = structure.factor(start - distance) {
            return Some((factor, start - distance));
        }
        distance *= 10.0;
    }
    None
}

/// Returns approximate eigenvectors of up to `count` of the smallest eigenvalues, unit vectors. The
/// shift keeps its distance from the smallest one, so that its neighbours converge, too.
pub(super) fn smallest_vectors(
    matrix: &BlockMatrix<'_>,
    structure: &BlockCholesky<'_>,
    bounds: Smallest,
    count: usize,
) -> Vec<Vec<f64>> {
    let distance = 1e-2 * bounds.estimate.abs() + (bounds.upper - bounds.lower);
    let factor = structure.factor(bounds.lower - distance);
    let factor = factor.or_else(|| Some(below_all(matrix, structure)?.0));
    let Some(factor) = factor else { return Vec::new() };
    largest_of_inverse(&factor, random_direction(matrix.dimension()), count)
}

/// Returns the Ritz vectors of the `count` largest eigenvalues of `(M - s I)^-1`, from a start near
/// the largest one, which comes last.
fn largest_of_inverse(factor: &Factor<'_, '_>, start: Vec<f64>, count: usize) -> Vec<Vec<f64>> {
    let dimension = start.len();
    let steps = STEPS.min(dimension);
    let (mut basis, mut projected) = (vec![start], DMatrix::zeros(steps, steps));
    for k in 0..steps {
        let mut image = basis[k].clone();
        factor.solve(&mut image);
        projected[(k, k)] = dot(&basis[k], &image);
        // Twice, because of rounding errors.
        for _ in 0..2 {
            for direction in &basis {
                let part = dot(&image, direction);
                image.iter_mut().zip(direction).for_each(|(x, d)| *x -= part * d);
            }
        }
        if k + 1 == steps {
            break;
        }
        let length = normalise(&mut image);
        if !length.is_finite() || length <= 1e-14 * projected[(0, 0)].abs() {
            // The basis spans the invariant subspace of the start.
            projected = projected.view((0, 0), (k + 1, k + 1)).into_owned();
            break;
        }
        projected[(k, k + 1)] = length;
        projected[(k + 1, k)] = length;
        basis.push(image);
    }
    let eigen = Eigen::new(&projected);
    let ritz = |index: usize| {
        let mut vector = vec![0.0; dimension];
        for (weight, direction) in eigen.vectors.column(index).iter().zip(&basis) {
            vector.iter_mut().zip(direction).for_each(|(x, d)| *x += weight * d);
        }
        normalise(&mut vector);
        vector
    };
    let found = eigen.values.len();
    (found.saturating_sub(count)..found).map(ritz).collect()
}

/// Returns `|M v - lambda v|` of a unit vector.
fn residual(matrix: &BlockMatrix<'_>, v: &[f64], eigenvalue: f64) -> f64 {
    let mut image = vec![0.0; v.len()];
    matrix.apply(v, &mut image);
    image.iter_mut().zip(v).for_each(|(x, v)| *x -= eigenvalue * v);
    dot(&image, &image).sqrt()
}
