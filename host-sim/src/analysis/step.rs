//! Is the step short enough for the observer itself?
//!
//! Where every agent broadcasts in every step, the held estimates are the estimates, and the
//! errors `e_1`, all stacked, obey, with the plant and the network apart,
//!
//! ```text
//! e_1(t + dt) = (I - dt G) e_1(t),   G = (I (x) K_1) (C^T C + L (x) I_n)
//! ```
//!
//! An error that grows makes agents broadcast in every step, so this matrix decides. `G` is a
//! product of a positive definite and a positive semidefinite matrix: its eigenvalues are real and
//! those of the symmetric `R (C^T C + L (x) I_n) R` with `R = I (x) K_1^(1/2)`. Euler's method is
//! stable if `dt lambda_max(G) < 2`, so the largest stable step is `2 / lambda_max(G)`. Between
//! broadcasts an agent's own feedback `K_1 C_i^T C_i` alone acts, whose eigenvalues are no larger.
//!
//! A gain with an eigenvalue that is not above zero makes no step stable; a scenario file cannot
//! have one.
//!
//! `lambda_max` comes from Lanczos' method without reorthogonalisation, which the largest
//! eigenvalue does not need; it is approached from below, to far more digits than are printed.

use nalgebra::DMatrix;

use super::block_matrix::{BlockMatrix, dot, normalise, random_direction};
use super::gain::gram;
use super::jacobi::Eigen;
use super::lanczos::tridiagonal_max;
use crate::number::significant;
use crate::scenario::Scenario;

const ITERATIONS_MAX: usize = 600;
/// Iterations between two looks at the eigenvalue.
const SETTLING: usize = 20;
/// It counts as settled when it moved by less than this, relatively.
const TOLERANCE: f64 = 1e-9;

/// The step against the longest that is stable.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepCheck {
    /// `dt`. \[s\]
    pub step_size: f64,
    /// `lambda_max(G)`, the fastest rate of the observer's own error dynamics. \[1/s\]
    pub eigenvalue_max: f64,
    /// From this step on errors grow; `None` where they do at any step. \[s\]
    pub largest_stable_step: Option<f64>,
}

impl StepCheck {
    /// Examines this scenario's step.
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
        }
    }

    /// Whether errors do not grow at this step.
    #[must_use]
    pub fn is_stable(&self) -> bool {
        self.largest_stable_step.is_some_and(|largest| self.step_size < largest)
    }

    /// The spectral radius of `I - dt G` where that is above 1, else at most 1: by how much an
    /// error grows in a step.
    #[must_use]
    pub fn growth(&self) -> f64 {
        (self.step_size * self.eigenvalue_max - 1.0).abs()
    }

    /// The step against the largest stable one, in words.
    #[must_use]
    pub fn describe(&self) -> String {
        let step = self.step_size;
        match self.largest_stable_step {
            None => "design.gain has an eigenvalue that is not above 0, so errors grow at any \
                     step; make design.gain positive definite"
                .to_owned(),
            Some(largest) if self.is_stable() => format!(
                "time.step = {step} s is below {} s, from which the observer itself is unstable",
                round_down(largest)
            ),
            Some(largest) => format!(
                "time.step = {step} s is too long for the observer, whose error grows up to {} \
                 times in every step; write time.step below {} s, or lower design.gain or the \
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
        // The last of three digits is worth between a thousandth and a hundredth of the number.
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

/// `lambda_max(M)`.
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
        // Nothing is left: the basis spans an invariant subspace.
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
    fn of_the_papers_network_as_a_dense_matrix_has_it() {
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
    fn a_gain_that_is_not_positive_definite_is_stable_at_no_step() {
        let check = paper(|scenario| scenario.design.gain[(1, 1)] = -1.0);
        assert_eq!((check.largest_stable_step, check.is_stable()), (None, false));
    }

    /// `lambda_max(G)` of the matrix written out, by powers of it.
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
    fn rounds_towards_what_is_stable() {
        assert_eq!(round_down(0.033_39), "0.0333");
        assert_eq!(round_down(0.033_31), "0.0333");
        assert_eq!(round_down(2.0), "2.00");
    }
}
