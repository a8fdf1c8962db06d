//! A primal-dual interior-point method for a linear matrix inequality in few unknowns.
//!
//! ```text
//! minimise c^T x   subject to   S = sum_k x_k A_k - C >= 0
//! maximise tr(C Z) subject to   tr(A_k Z) = c_k,   Z >= 0
//! ```
//!
//! `S Z = mu I` is linearised as `Z + dZ = mu S^-1 - sym(S^-1 dS Z)` (the direction of Helmberg,
//! Kojima and Monteiro), which leaves a linear system in `dx`,
//!
//! ```text
//! sum_l tr(A_k S^-1 A_l Z) dx_l = mu tr(A_k S^-1) - c_k
//! ```
//!
//! with Mehrotra's prediction of `mu` and correction of second order. `S` satisfies its equation in
//! every iteration; `Z` does once a full step was taken.
//!
//! Cost of an iteration for `p` unknowns of order `m`: `4 p m^2` times the entries in a row of
//! `A_k`, `2 p^2 m^2` for the system, and about `10 m^3` for the rest. 10 to 20 iterations.

use nalgebra::{Cholesky, DMatrix, DVector, Dyn};

use super::pencil::Pencil;
use crate::analysis::block_matrix::{dot, normalise, random_direction};
use crate::analysis::lanczos::tridiagonal_max;

const ITERATIONS_MAX: usize = 60;
/// Share of the way to the boundary that a step takes at most.
const SHARE: f64 = 0.95;
/// Doublings in search of a start.
const DOUBLINGS_MAX: usize = 200;
const LANCZOS_STEPS: usize = 30;

/// A solution.
pub(super) struct Solution {
    pub(super) x: Vec<f64>,
    /// `c^T x`.
    pub(super) cost: f64,
    /// `tr(C Z)`, below which no cost can be; 0 if `Z` was not found.
    pub(super) bound: f64,
}

/// Solves the problem to a relative gap of `tolerance`, or as far as rounding allows; `None` if
/// there is no start.
pub(super) fn solve(pencil: &Pencil, tolerance: f64) -> Option<Solution> {
    let costs = DVector::from_column_slice(&pencil.costs);
    let mut x = start(pencil)?;
    let mut s = Cholesky::new(slack(pencil, &x))?;
    let mut s_inverse = s.inverse();
    // The multiple of S^-1 that satisfies the equations best.
    let image = traces(pencil, &s_inverse);
    let mut z = &s_inverse * (costs.dot(&image) / image.norm_squared()).max(f64::MIN_POSITIVE);
    let order = z.nrows();
    for _ in 0..ITERATIONS_MAX {
        let slack_matrix = slack(pencil, &x);
        let mu = slack_matrix.dot(&z) / order as f64;
        let value = costs.dot(&x);
        let residual = (&costs - traces(pencil, &z)).amax() / costs.amax();
        if mu * order as f64 <= tolerance * value.abs() && residual <= tolerance.sqrt() {
            break;
        }
        let system = normal_matrix(pencil, &s_inverse, &z);
        let Some(system) = system.clone().cholesky().or_else(|| damped(system)) else { break };
        let centre = traces(pencil, &s_inverse);
        let Some(z_factor) = Cholesky::new(z.clone()) else { break };
        // Prediction: mu = 0.
        let dx = system.solve(&-&costs);
        let ds = combination(pencil, &dx);
        let dz = -&z - symmetric(&(&s_inverse * &ds * &z));
        let (step_s, step_z) = (longest(&s, &ds, 1.0), longest(&z_factor, &dz, 1.0));
        let predicted =
            (&slack_matrix + &ds * step_s).dot(&(&z + &dz * step_z)) / order as f64 / mu;
        let target = mu * predicted.clamp(0.0, 1.0).powi(3);
        // Correction.
        let second = symmetric(&(&s_inverse * &ds * &dz));
        let dx = system.solve(&(&centre * target - &costs - traces(pencil, &second)));
        let ds = combination(pencil, &dx);
        let dz = &s_inverse * target - &z - symmetric(&(&s_inverse * &ds * &z)) - second;
        let step_z = longest(&z_factor, &dz, SHARE);
        let mut step_s = longest(&s, &ds, SHARE);
        let moved = loop {
            let next = &x + &dx * step_s;
            if let Some(factor) = Cholesky::new(slack(pencil, &next)) {
                break Some((next, factor));
            }
            step_s *= 0.7;
            if step_s < 1e-8 {
                break None;
            }
        };
        let Some((next, factor)) = moved else { break };
        let mut step_z = step_z;
        let mut next_z = &z + &dz * step_z;
        while Cholesky::new(next_z.clone()).is_none() {
            step_z *= 0.7;
            if step_z < 1e-8 {
                next_z = z.clone();
                break;
            }
            next_z = &z + &dz * step_z;
        }
        x = next;
        s = factor;
        s_inverse = s.inverse();
        z = next_z;
        if step_s < 1e-6 && step_z < 1e-6 {
            break;
        }
    }
    let cost = costs.dot(&x);
    let residual = (&costs - traces(pencil, &z)).amax() / costs.amax();
    let dual = pencil.constant.iter().enumerate().fold(0.0, |sum, (i, c)| sum + c * z[(i, i)]);
    let bound = if residual < 1e-10 { dual } else { 0.0 };
    x.iter().all(|x| x.is_finite()).then(|| Solution { x: x.as_slice().to_vec(), cost, bound })
}

/// Returns a multiple of the pencil's ray well inside the inequality.
fn start(pencil: &Pencil) -> Option<DVector<f64>> {
    let mut x = DVector::from_column_slice(&pencil.ray);
    for _ in 0..DOUBLINGS_MAX {
        if Cholesky::new(slack(pencil, &x)).is_some() {
            return Some(x * 2.0);
        }
        x *= 2.0;
    }
    None
}

/// Returns `sum_k x_k A_k`.
fn combination(pencil: &Pencil, x: &DVector<f64>) -> DMatrix<f64> {
    let order = pencil.constant.len();
    let mut sum = DMatrix::zeros(order, order);
    for (coefficient, &x) in pencil.coefficients.iter().zip(x.iter()) {
        coefficient.add_to(&mut sum, x);
    }
    sum
}

/// Returns `S`.
fn slack(pencil: &Pencil, x: &DVector<f64>) -> DMatrix<f64> {
    let mut s = combination(pencil, x);
    for (index, constant) in pencil.constant.iter().enumerate() {
        s[(index, index)] -= constant;
    }
    s
}

/// Returns `tr(A_k X)` of every coefficient.
fn traces(pencil: &Pencil, x: &DMatrix<f64>) -> DVector<f64> {
    let traces = pencil.coefficients.iter().map(|coefficient| coefficient.trace_with(x));
    DVector::from_vec(traces.collect())
}

/// Returns `tr(A_k S^-1 A_l Z)`.
fn normal_matrix(pencil: &Pencil, s_inverse: &DMatrix<f64>, z: &DMatrix<f64>) -> DMatrix<f64> {
    let (unknowns, size) = (pencil.coefficients.len(), z.len());
    let mut left = DMatrix::zeros(unknowns, size);
    let mut right = DMatrix::zeros(size, unknowns);
    for (k, coefficient) in pencil.coefficients.iter().enumerate() {
        // tr(A_k S^-1 A_l Z) is the sum over (Z A_k)_ij (S^-1 A_l)_ji.
        let products = coefficient.right_of(z).transpose();
        left.row_mut(k).iter_mut().zip(products.iter()).for_each(|(to, from)| *to = *from);
        right.column_mut(k).copy_from_slice(coefficient.right_of(s_inverse).as_slice());
    }
    let matrix = left * right;
    symmetric(&matrix)
}

/// Factors a matrix that rounding has made singular, with a multiple of its diagonal added.
fn damped(mut matrix: DMatrix<f64>) -> Option<Cholesky<f64, Dyn>> {
    for index in 0..matrix.nrows() {
        matrix[(index, index)] *= 1.0 + 1e-12;
    }
    matrix.cholesky()
}

fn symmetric(matrix: &DMatrix<f64>) -> DMatrix<f64> {
    (matrix + matrix.transpose()) * 0.5
}

/// Returns `share` of the largest step, at most 1, for which `L L^T + step D` stays positive
/// definite: the Lanczos method on `-L^-1 D L^-T`.
fn longest(factor: &Cholesky<f64, Dyn>, direction: &DMatrix<f64>, share: f64) -> f64 {
    let order = direction.nrows();
    let l = factor.l_dirty();
    let mut basis = vec![random_direction(order)];
    let (mut diagonal, mut off_diagonal) = (Vec::new(), Vec::new());
    for k in 0..LANCZOS_STEPS.min(order) {
        let mut image = DVector::from_column_slice(&basis[k]);
        l.tr_solve_lower_triangular_mut(&mut image);
        image = direction * -image;
        l.solve_lower_triangular_mut(&mut image);
        let mut image = image.as_slice().to_vec();
        diagonal.push(dot(&basis[k], &image));
        for _ in 0..2 {
            for known in &basis {
                let part = dot(&image, known);
                image.iter_mut().zip(known).for_each(|(x, v)| *x -= part * v);
            }
        }
        let length = normalise(&mut image);
        if !length.is_finite() || length <= 1e-13 * diagonal[0].abs() || k + 1 == order {
            break;
        }
        off_diagonal.push(length);
        basis.push(image);
    }
    off_diagonal.truncate(diagonal.len() - 1);
    let largest = tridiagonal_max(&diagonal, &off_diagonal);
    if largest > 0.0 { (share / largest).min(1.0) } else { 1.0 }
}

#[cfg(test)]
mod tests {
    use super::super::pencil::{Coefficient, Pencil};
    use super::*;
    use nalgebra::dmatrix;

    #[test]
    fn smallest_sum_under_a_determinant() {
        // [x 1; 1 y] >= 0: x + y is smallest, 2, for x = y = 1.
        let pencil = Pencil {
            coefficients: vec![
                Coefficient::new(dmatrix![1.0, 0.0; 0.0, 0.0]),
                Coefficient::new(dmatrix![0.0, 0.0; 0.0, 1.0]),
                Coefficient::new(dmatrix![0.0, 1.0; 1.0, 0.0]),
            ],
            // The third unknown is kept at 1 by its cost alone: x + y - 2 w >= (sqrt x - sqrt y)^2.
            constant: vec![1.0, 1.0],
            costs: vec![1.0, 1.0, 0.5],
            ray: vec![1.0, 1.0, 0.0],
        };
        // min x + y + w/2 with (x - 1)(y - 1) >= w^2: by symmetry x = y, w = -(x - 1), so 2 x -
        // (x - 1)/2, smallest at x = 1.
        let found = solve(&pencil, 1e-10).unwrap();
        assert!((found.cost - 2.0).abs() < 1e-8, "{:?}", found.x);
    }
}
