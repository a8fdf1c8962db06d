//! Both ends of a symmetric operator's spectrum, by the Lanczos method with full
//! reorthogonalisation.
//!
//! The operator is given by its products with vectors, so networks of a thousand agents need no
//! matrix of that size. All sums have a fixed order and no library kernel is used: `phi_1` and
//! `phi_2` are computed here and enter the agents, and the same scenario must give the same bits on
//! every machine.
//!
//! Cost: one product and `2 k dim` operations in iteration `k`, at most [`ITERATIONS_MAX`]
//! iterations, fewer if both ends converge. Up to that dimension the result is exact to within
//! rounding error.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const ITERATIONS_MAX: usize = 400;
/// Both ends have converged when they change by less than this, relatively, in [`SETTLING`]
/// iterations.
const TOLERANCE: f64 = 1e-12;
const SETTLING: usize = 10;
/// Bisections of an interval with an eigenvalue: more than the digits of an `f64`.
const BISECTIONS: usize = 80;

/// The ends of a spectrum.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Spectrum {
    /// Smallest eigenvalue.
    pub(super) min: f64,
    /// Norm of the residual of its eigenvector: an eigenvalue is within this distance.
    pub(super) min_residual: f64,
    /// Largest eigenvalue.
    pub(super) max: f64,
}

/// Computes the ends of the spectrum of the symmetric operator `apply(v, result)` on `dimension`
/// numbers.
pub(super) fn spectrum(dimension: usize, mut apply: impl FnMut(&[f64], &mut [f64])) -> Spectrum {
    // The seed is arbitrary: a random start has a component along every eigenvector.
    let mut random = ChaCha8Rng::seed_from_u64(0);
    let mut basis: Vec<Vec<f64>> = Vec::new();
    let (mut diagonal, mut off_diagonal): (Vec<f64>, Vec<f64>) = (Vec::new(), Vec::new());
    let mut next = random_direction(&mut random, dimension, &basis);
    let mut image = vec![0.0; dimension];
    let mut settled = Spectrum { min: f64::NAN, min_residual: 0.0, max: f64::NAN };
    while let Some(vector) = next.take() {
        apply(&vector, &mut image);
        diagonal.push(dot(&vector, &image));
        basis.push(vector);
        let mut residual = image.clone();
        orthogonalise(&mut residual, &basis);
        let norm = dot(&residual, &residual).sqrt();
        let iterations = diagonal.len();
        let last = iterations == dimension.min(ITERATIONS_MAX);
        if last || iterations.is_multiple_of(SETTLING) {
            let now = ends(&diagonal, &off_diagonal, norm);
            let scale = TOLERANCE * now.max.abs().max(now.min.abs());
            let still =
                (now.min - settled.min).abs() <= scale && (now.max - settled.max).abs() <= scale;
            settled = now;
            if last || still {
                break;
            }
        }
        let scale = diagonal.iter().fold(0.0f64, |scale, d| scale.max(d.abs()));
        if norm > f64::EPSILON * scale * dimension as f64 {
            off_diagonal.push(norm);
            residual.iter_mut().for_each(|x| *x /= norm);
            next = Some(residual);
        } else {
            // The basis spans an invariant subspace: continue in its complement.
            off_diagonal.push(0.0);
            next = random_direction(&mut random, dimension, &basis);
        }
    }
    settled
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).fold(0.0, |sum, (a, b)| sum + a * b)
}

/// Removes the components along `basis` from `vector`; twice, because of rounding errors.
fn orthogonalise(vector: &mut [f64], basis: &[Vec<f64>]) {
    for _ in 0..2 {
        for direction in basis {
            let part = dot(vector, direction);
            vector.iter_mut().zip(direction).for_each(|(x, d)| *x -= part * d);
        }
    }
}

fn random_direction(
    random: &mut ChaCha8Rng,
    dimension: usize,
    basis: &[Vec<f64>],
) -> Option<Vec<f64>> {
    if basis.len() == dimension {
        return None;
    }
    let mut vector: Vec<f64> = (0..dimension).map(|_| random.random_range(-1.0..1.0)).collect();
    orthogonalise(&mut vector, basis);
    let norm = dot(&vector, &vector).sqrt();
    vector.iter_mut().for_each(|x| *x /= norm);
    Some(vector)
}

/// Computes the ends of the spectrum of a symmetric tridiagonal matrix, and the residual of the
/// smallest eigenvalue in the whole space, where the next off-diagonal entry is `beyond`.
fn ends(diagonal: &[f64], off_diagonal: &[f64], beyond: f64) -> Spectrum {
    let size = diagonal.len();
    let off = |k: usize| off_diagonal.get(k).copied().unwrap_or(0.0);
    // Gershgorin's discs contain all eigenvalues.
    let radius = |k: usize| off(k) + if k > 0 { off(k - 1) } else { 0.0 };
    let low = (0..size).fold(f64::INFINITY, |low, k| low.min(diagonal[k] - radius(k)));
    let high = (0..size).fold(f64::NEG_INFINITY, |high, k| high.max(diagonal[k] + radius(k)));
    let below = |x: f64| eigenvalues_below(diagonal, off_diagonal, x);
    let bisect = |wanted: usize| {
        let (mut low, mut high) = (low, high);
        for _ in 0..BISECTIONS {
            let middle = low + 0.5 * (high - low);
            if below(middle) >= wanted { high = middle } else { low = middle }
        }
        low + 0.5 * (high - low)
    };
    let min = bisect(1);
    let min_residual =
        if size == 0 { 0.0 } else { beyond * last_component(diagonal, off_diagonal, min) };
    Spectrum { min, min_residual, max: bisect(size) }
}

/// Returns the largest eigenvalue of a symmetric tridiagonal matrix.
pub(super) fn tridiagonal_max(diagonal: &[f64], off_diagonal: &[f64]) -> f64 {
    ends(diagonal, off_diagonal, 0.0).max
}

/// Counts the eigenvalues below `x`: the negative pivots of the matrix minus `x` (Sturm).
fn eigenvalues_below(diagonal: &[f64], off_diagonal: &[f64], x: f64) -> usize {
    let mut count = 0;
    let mut pivot = 1.0f64;
    for (k, d) in diagonal.iter().enumerate() {
        let off = if k > 0 { off_diagonal[k - 1] } else { 0.0 };
        pivot = d - x - if off == 0.0 { 0.0 } else { off * off / pivot };
        if pivot == 0.0 {
            pivot = f64::MIN_POSITIVE;
        }
        count += usize::from(pivot < 0.0);
    }
    count
}

/// Returns the magnitude of the last component of the unit eigenvector for `eigenvalue`, by the
/// three-term recurrence; an upper estimate if rounding dominates.
fn last_component(diagonal: &[f64], off_diagonal: &[f64], eigenvalue: f64) -> f64 {
    let (mut before, mut now, mut sum) = (0.0f64, 1.0f64, 1.0f64);
    for k in 0..diagonal.len() - 1 {
        let off = off_diagonal[k];
        if off == 0.0 {
            return 1.0;
        }
        let coupling = if k > 0 { off_diagonal[k - 1] * before } else { 0.0 };
        let after = ((eigenvalue - diagonal[k]) * now - coupling) / off;
        (before, now) = (now, after);
        sum += now * now;
        if sum > 1e200 {
            (before, now, sum) = (before * 1e-100, now * 1e-100, sum * 1e-200);
        }
    }
    now.abs() / sum.sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The Laplacian of a path of `size` nodes has the eigenvalues `2 - 2 cos(pi k / size)`.
    fn path(size: usize, shift: f64) -> Spectrum {
        spectrum(size, |v, result| {
            for i in 0..size {
                let before = if i > 0 { v[i] - v[i - 1] } else { 0.0 };
                let after = if i + 1 < size { v[i] - v[i + 1] } else { 0.0 };
                result[i] = before + after + shift * v[i];
            }
        })
    }

    #[test]
    fn finds_both_ends_of_a_known_spectrum() {
        for size in [1, 2, 3, 10, 60] {
            let found = path(size, 0.5);
            let largest =
                2.0 - 2.0 * libm::cos(std::f64::consts::PI * (size - 1) as f64 / size as f64);
            assert!((found.min - 0.5).abs() < 1e-12, "{size}: {found:?}");
            assert!((found.max - 0.5 - largest).abs() < 1e-12, "{size}: {found:?}");
            assert!(found.min_residual < 1e-10, "{size}: {found:?}");
        }
    }

    #[test]
    fn continues_after_repeated_eigenvalues() {
        let found = spectrum(6, |v, result| {
            for (i, result) in result.iter_mut().enumerate() {
                *result = [2.0, 2.0, 2.0, 2.0, 2.0, 7.0][i] * v[i];
            }
        });
        assert!((found.min - 2.0).abs() < 1e-12 && (found.max - 7.0).abs() < 1e-12, "{found:?}");
    }

    #[test]
    fn large_operator_converges_before_the_limit() {
        let found = path(3_000, 0.5);
        assert!((found.max - 4.5).abs() < 1e-4, "{found:?}");
        assert!(found.min >= 0.5 - 1e-12 && found.min < 0.51, "{found:?}");
    }
}
