//! Checks whether the step is short enough for the observer.
//!
//! If every agent broadcasts in every step, the held estimates equal the estimates, and the stacked
//! errors `e_1`, apart from plant and network, obey
//!
//! ```text
//! e_1(t + dt) = (I - dt G) e_1(t),   G = (I (x) K_1) (C^T C + L (x) I_n)
//! ```
//!
//! An error that grows makes agents broadcast in every step, so this matrix is decisive. `G` is the
//! product of a positive definite and a positive semidefinite matrix: its eigenvalues are real and
//! equal those of the symmetric `R (C^T C + L (x) I_n) R` with `R = I (x) K_1^(1/2)`. Euler's
//! method is stable if `dt lambda_max(G) < 2`, so the largest stable step is `2 / lambda_max(G)`.
//! Between broadcasts only an agent's own feedback `K_1 C_i^T C_i` acts, whose eigenvalues are no
//! larger.
//!
//! If a gain has an eigenvalue that is not positive, no step is stable; scenario files cannot
//! contain such a gain.
//!
//! `lambda_max` comes from the Lanczos method without reorthogonalisation, which the largest
//! eigenvalue does not need. It converges from below, to far more digits than are printed.

use nalgebra::DMatrix;

use super::block_matrix::{BlockMatrix, dot, normalise, random_direction};
use super::gain::gram;
use super::jacobi::Eigen;
use super::lanczos::tridiagonal_max;
use crate::number::significant;
use crate::scenario::Scenario;

const ITERATIONS_MAX: usize = 600;
/// Iterations between two convergence checks.
const SETTLING: usize = 20;
/// Relative change at which the eigenvalue has converged.
const TOLERANCE: f64 = 1e-9;

/// The step compared with the longest stable one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepCheck {
    /// `dt`. \[s\]
    pub step_size: f64,
    /// `lambda_max(G)`, the fastest rate of the observer's error dynamics. \[1/s\]
    pub eigenvalue_max: f64,
    /// The limit above which errors grow; `None` if they grow with any step. \[s\]
    pub largest_stable_step: Option<f64>,
    /// Whether agents use `design.gain` at all, in some part of the run.
    pub is_used: bool,
}

impl StepCheck {
    /// Checks the step of a scenario.
    #[must_use]
    pub fn new(scenario: &Scenario) -> Self {
        let gain = Eigen::new(&scenario.design.gain);
        let root = gain.square_root();
        let n = scenario.dimension();
        let blocks = scenario.agents.iter().map(|agent| {
            let measured = gram(&agent.output_matrix);
            let half = product(&measured, &root);
            let block = product(&root, &half);
            DMatrix::from_fn(n, n, |i, j| block[(i.max(j), i.min(j))])
        });
        let matrix = BlockMatrix {
            diagonal: blocks.collect(),
            coupling: scenario.design.gain.clone(),
            graph: &scenario.graph,
        };
        let eigenvalue_max = largest(&matrix);
        let stable = gain.values[0] > 0.0 && eigenvalue_max > 0.0;
        Self {
            step_size: scenario.time.step_size,
            eigenvalue_max,
            largest_stable_step: stable.then(|| 2.0 / eigenvalue_max),
            is_used: scenario.uses_design_gain(),
        }
    }

    /// Whether errors do not grow with this step, or `design.gain` has no part in them.
    #[must_use]
    pub fn is_stable(&self) -> bool {
        !self.is_used || self.largest_stable_step.is_some_and(|largest| self.step_size < largest)
    }

    /// Returns the growth of an error per step: the spectral radius of `I - dt G` if it is above 1,
    /// otherwise at most 1.
    #[must_use]
    pub fn growth(&self) -> f64 {
        (self.step_size * self.eigenvalue_max - 1.0).abs()
    }

    /// Describes the step relative to the largest stable one.
    #[must_use]
    pub fn describe(&self) -> String {
        let step = self.step_size;
        match self.largest_stable_step {
            _ if !self.is_used => {
                format!("time.step = {step} s; agents do not use design.gain, which would limit it")
            }
            None => "design.gain has an eigenvalue that is not above 0, so errors grow \
                     whatever time.step is; make design.gain positive definite"
                .to_owned(),
            Some(largest) if self.is_stable() => format!(
                "time.step = {step} s is below {} s, the stability limit of the observer",
                round_down(largest)
            ),
            Some(largest) => format!(
                "time.step = {step} s is too long: the observer's error grows by up to {} \
                 times per step; set time.step below {} s, or reduce design.gain or the \
                 weights of the graph",
                significant(self.growth(), 3),
                round_down(largest),
            ),
        }
    }
}

/// Rounds down to three digits, so that the step printed as stable is stable.
fn round_down(x: f64) -> String {
    let nearest = significant(x, 3);
    match nearest.parse::<f64>() {
        // A unit of the third digit is between a thousandth and a hundredth of the number.
        Ok(value) if value > x => {
            let unit = libm::pow(10.0, libm::floor(libm::log10(value)) - 2.0);
            significant(value - unit, 3)
        }
        _ => nearest,
    }
}

fn product(a: &DMatrix<f64>, b: &DMatrix<f64>) -> DMatrix<f64> {
    DMatrix::from_fn(a.nrows(), b.ncols(), |row, column| {
        (0..a.ncols()).fold(0.0, |sum, k| sum + a[(row, k)] * b[(k, column)])
    })
}

/// Returns `lambda_max(M)`.
fn largest(matrix: &BlockMatrix<'_>) -> f64 {
    let dimension = matrix.dimension();
    let (mut before, mut vector) = (vec![0.0; dimension], random_direction(dimension));
    let mut image = vec![0.0; dimension];
    let (mut diagonal, mut off_diagonal) = (Vec::new(), Vec::new());
    let (mut settled, mut scale) = (f64::NEG_INFINITY, 0.0f64);
    for iteration in 1..=ITERATIONS_MAX {
        matrix.apply(&vector, &mut image);
        let own = dot(&vector, &image);
        let last = off_diagonal.last().copied().unwrap_or(0.0);
        diagonal.push(own);
        for ((x, v), b) in image.iter_mut().zip(&vector).zip(&before) {
            *x -= own * v + last * b;
        }
        let length = normalise(&mut image);
        // The basis spans an invariant subspace.
        scale = scale.max(own.abs());
        let spans = !length.is_finite() || length <= 1e-13 * scale;
        if spans || iteration % SETTLING == 0 || iteration == ITERATIONS_MAX {
            let found = tridiagonal_max(&diagonal, &off_diagonal);
            let still = found - settled <= TOLERANCE * found.abs();
            settled = found;
            if spans || still {
                break;
            }
        }
        off_diagonal.push(length);
        std::mem::swap(&mut before, &mut vector);
        std::mem::swap(&mut vector, &mut image);
    }
    settled
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::PAPER;

    fn paper(change: impl FnOnce(&mut Scenario)) -> StepCheck {
        let mut scenario = Scenario::parse("paper.toml", PAPER).unwrap();
        change(&mut scenario);
        StepCheck::new(&scenario)
    }

    #[test]
    fn limit_of_the_paper_matches_dense_matrix() {
        let check = paper(|_| {});
        let dense = dense_eigenvalue_max(&Scenario::parse("paper.toml", PAPER).unwrap());
        assert!((check.eigenvalue_max - dense).abs() < 1e-9 * dense, "{check:?}, {dense}");
        assert!(check.is_stable());
        let limit = check.largest_stable_step.unwrap();
        assert!(paper(|scenario| scenario.time.step_size = 0.999 * limit).is_stable());
        let above = paper(|scenario| scenario.time.step_size = 1.001 * limit);
        assert!(!above.is_stable() && above.growth() > 1.0, "{above:?}");
        assert!(above.describe().contains("too long"), "{}", above.describe());
    }

    #[test]
    fn indefinite_gain_has_no_stable_step() {
        let check = paper(|scenario| scenario.design.gain[(1, 1)] = -1.0);
        assert_eq!((check.largest_stable_step, check.is_stable()), (None, false));
    }

    /// Computes `lambda_max(G)` of the full matrix by power iteration.
    fn dense_eigenvalue_max(scenario: &Scenario) -> f64 {
        let (n, agents) = (scenario.dimension(), scenario.agents.len());
        let laplacian = scenario.graph.laplacian();
        let g = DMatrix::from_fn(n * agents, n * agents, |row, column| {
            let (i, j) = (row / n, column / n);
            (0..n).fold(0.0, |sum, k| {
                let inner = if k == column % n { laplacian[(i, j)] } else { 0.0 }
                    + if i == j {
                        gram(&scenario.agents[i].output_matrix)[(k, column % n)]
                    } else {
                        0.0
                    };
                sum + scenario.design.gain[(row % n, k)] * inner
            })
        });
        let mut v = nalgebra::DVector::from_element(n * agents, 1.0);
        v[1] = 0.3;
        v[5] = -0.7;
        for _ in 0..20_000 {
            v = &g * v;
            v /= v.norm();
        }
        v.dot(&(&g * &v)) / v.dot(&v)
    }

    #[test]
    fn rounds_down_to_a_stable_step() {
        assert_eq!(round_down(0.033_39), "0.0333");
        assert_eq!(round_down(0.033_31), "0.0333");
        assert_eq!(round_down(2.0), "2.00");
    }
}
