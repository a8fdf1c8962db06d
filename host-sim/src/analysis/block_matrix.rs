//! Symmetric matrices of the analysis: `M = blockdiag(D_1, .., D_N) + L (x) K`, of shape `[nN,
//! nN]`, with symmetric `D_i` and `K` of shape `[n, n]` and the graph's Laplacian `L`.
//!
//! A product with a vector costs `2 n^2 N` operations plus `3 n` per end of an edge.

use nalgebra::DMatrix;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::graph::Graph;

/// `M`.
#[derive(Clone, Debug)]
pub(super) struct BlockMatrix<'g> {
    /// `D_i`, one per agent.
    pub(super) diagonal: Vec<DMatrix<f64>>,
    /// `K`.
    pub(super) coupling: DMatrix<f64>,
    /// The graph of the Laplacian `L`.
    pub(super) graph: &'g Graph,
}

impl BlockMatrix<'_> {
    /// Returns `n`.
    pub(super) fn block(&self) -> usize {
        self.coupling.nrows()
    }

    /// Returns `nN`.
    pub(super) fn dimension(&self) -> usize {
        self.block() * self.graph.agents()
    }

    /// Writes `M v` to `result`.
    pub(super) fn apply(&self, v: &[f64], result: &mut [f64]) {
        self.product(v, result, |x| x, -1.0);
    }

    /// Writes `|M| v`, with absolute values entry by entry, or a slightly larger value to `result`.
    pub(super) fn apply_magnitudes(&self, v: &[f64], result: &mut [f64]) {
        self.product(v, result, f64::abs, 1.0);
    }

    fn product(&self, v: &[f64], result: &mut [f64], entry: impl Fn(f64) -> f64, sign: f64) {
        let n = self.block();
        let mut difference = vec![0.0; n];
        for (i, block) in self.diagonal.iter().enumerate() {
            let own = &v[i * n..][..n];
            difference.fill(0.0);
            for edge in self.graph.neighbours(i) {
                let other = &v[edge.agent * n..][..n];
                for (sum, (x, y)) in difference.iter_mut().zip(own.iter().zip(other)) {
                    *sum += edge.weight * (x + sign * y);
                }
            }
            for row in 0..n {
                result[i * n + row] = (0..n).fold(0.0, |sum, column| {
                    sum + entry(block[(row, column)]) * own[column]
                        + entry(self.coupling[(row, column)]) * difference[column]
                });
            }
        }
    }

    /// Returns `v^T M v / v^T v`, an upper bound of `lambda_min`, and a bound on its rounding
    /// error.
    pub(super) fn rayleigh_quotient(&self, v: &[f64]) -> (f64, f64) {
        let n = self.block();
        let mut image = vec![0.0; v.len()];
        self.apply(v, &mut image);
        let (product, square) = (self.dot(v, &image), self.dot(v, v));
        let magnitudes: Vec<f64> = v.iter().map(|x| x.abs()).collect();
        self.apply_magnitudes(&magnitudes, &mut image);
        let magnitude = self.dot(&magnitudes, &image) / square;
        let degree_max =
            (0..self.graph.agents()).map(|i| self.graph.neighbours(i).len()).max().unwrap_or(0);
        // Number of roundings per value: the sums over neighbours, over a block and over the
        // agents, of both the product and the square, and a margin.
        let roundings = 2 * (degree_max + 4 * n + 2 * self.graph.agents()) + 16;
        (product / square, roundings as f64 * UNIT_ROUNDOFF * magnitude)
    }

    /// Sums over each agent first, which reduces the number of roundings.
    fn dot(&self, a: &[f64], b: &[f64]) -> f64 {
        let n = self.block();
        a.chunks(n).zip(b.chunks(n)).fold(0.0, |sum, (a, b)| sum + dot(a, b))
    }

    /// Returns a lower bound on all eigenvalues, by Gershgorin's discs.
    pub(super) fn eigenvalues_above(&self) -> f64 {
        let n = self.block();
        let mut lowest = f64::INFINITY;
        for (i, block) in self.diagonal.iter().enumerate() {
            let degree = self.graph.degree(i);
            for row in 0..n {
                let mut low = 0.0;
                for column in 0..n {
                    let coupling = self.coupling[(row, column)];
                    let own = block[(row, column)] + degree * coupling;
                    low += if column == row { own } else { -own.abs() };
                    low -= degree * coupling.abs();
                }
                lowest = lowest.min(low);
            }
        }
        lowest
    }
}

/// Half the distance from 1 to the next larger number.
pub(super) const UNIT_ROUNDOFF: f64 = 0.5 * f64::EPSILON;

pub(super) fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).fold(0.0, |sum, (a, b)| sum + a * b)
}

/// Scales `v` to length 1; returns its previous length.
pub(super) fn normalise(v: &mut [f64]) -> f64 {
    let length = dot(v, v).sqrt();
    v.iter_mut().for_each(|x| *x /= length);
    length
}

/// Returns a unit vector. The seed is arbitrary, because a random vector has a component along
/// every eigenvector.
pub(super) fn random_direction(dimension: usize) -> Vec<f64> {
    let mut random = ChaCha8Rng::seed_from_u64(0);
    let mut v: Vec<f64> = (0..dimension).map(|_| random.random_range(-1.0..1.0)).collect();
    normalise(&mut v);
    v
}
