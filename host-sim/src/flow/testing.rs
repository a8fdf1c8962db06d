//! Networks and trajectories for tests.

use nalgebra::DMatrix;

use super::trajectory::Trajectory;
use crate::graph::{Edge, Graph};

/// Random numbers for tests: Steele, Lea and Flood's SplitMix64.
pub(super) struct Draws(u64);

impl Draws {
    pub(super) fn new(seed: u64) -> Self {
        Self(seed)
    }

    fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Returns a number in `[0, 1)`.
    pub(super) fn uniform(&mut self) -> f64 {
        (self.bits() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Returns a number below `end`.
    pub(super) fn below(&mut self, end: usize) -> usize {
        (self.uniform() * end as f64) as usize
    }
}

/// Creates a graph whose edges have weight 1.
pub(super) fn graph(agents: usize, edges: &[(usize, usize)]) -> Graph {
    let edge = |&(first, second)| Edge { first, second, weight: 1.0 };
    Graph::new(agents, &edges.iter().map(edge).collect::<Vec<_>>()).unwrap()
}

/// Creates a random tree with more edges at this density.
pub(super) fn random_graph(seed: u64, agents: usize, density: f64) -> Graph {
    let mut draws = Draws::new(seed ^ 0x1234);
    let mut edges: Vec<(usize, usize)> = (1..agents).map(|k| (draws.below(k), k)).collect();
    for first in 0..agents {
        for second in first + 1..agents {
            if draws.uniform() < density && !edges.contains(&(first, second)) {
                edges.push((first, second));
            }
        }
    }
    graph(agents, &edges)
}

/// Creates outputs of which the first `measured` agents have one component each.
pub(super) fn unit_outputs(measured: usize, agents: usize) -> Vec<DMatrix<f64>> {
    let row = |i| DMatrix::from_fn(1, measured, |_, j| f64::from(u8::from(i == j)));
    let empty = || DMatrix::zeros(0, measured);
    (0..agents).map(|i| if i < measured { row(i) } else { empty() }).collect()
}

/// Creates a state's dimension, 3 to 6, and random outputs of 4 to 12 agents that span it; some
/// agents measure nothing, and some what another measures.
pub(super) fn random_outputs(seed: u64) -> (usize, Vec<DMatrix<f64>>) {
    let mut draws = Draws::new(seed);
    let (n, agents) = (3 + draws.below(4), 4 + draws.below(9));
    let mut pool: Vec<Vec<f64>> = Vec::new();
    let mut rows: Vec<Vec<Vec<f64>>> = vec![Vec::new(); agents];
    while pool.len() < n || rows.iter().all(Vec::is_empty) {
        for rows in &mut rows {
            rows.clear();
            if draws.uniform() < 0.25 {
                continue;
            }
            for _ in 0..1 + draws.below(2) {
                let scale = 0.3 + 2.7 * draws.uniform();
                if !pool.is_empty() && draws.uniform() < 0.3 {
                    let known = draws.below(pool.len());
                    rows.push(pool[known].iter().map(|x| -scale * x).collect());
                } else {
                    let row: Vec<f64> =
                        (0..n).map(|_| scale * (2.0 * draws.uniform() - 1.0)).collect();
                    pool.push(row.clone());
                    rows.push(row);
                }
            }
        }
        let distinct = rows.iter().flatten().map(|row| row[0] / row[1]).collect::<Vec<_>>();
        let mut sorted = distinct;
        sorted.sort_by(f64::total_cmp);
        sorted.dedup_by(|a, b| (*a - *b).abs() < 1e-9);
        if sorted.len() < n {
            pool.clear();
        }
    }
    let matrix = |rows: &Vec<Vec<f64>>| DMatrix::from_fn(rows.len(), n, |i, j| rows[i][j]);
    (n, rows.iter().map(matrix).collect())
}

/// Creates a random walk whose components differ in size.
pub(super) fn random_walk(seed: u64, n: usize, samples: usize) -> Trajectory {
    let mut draws = Draws::new(seed ^ 0x5678);
    let mut states = Vec::with_capacity(n * samples);
    let mut state = vec![0.0; n];
    for _ in 0..samples {
        for (j, x) in state.iter_mut().enumerate() {
            *x += libm::pow(3.0, j as f64 - 2.0) * (draws.uniform() - 0.5);
        }
        states.extend_from_slice(&state);
    }
    Trajectory { dimension: n, step: 1e-3, states }
}

/// Borrows the matrices of all agents.
pub(super) fn references(matrices: &[DMatrix<f64>]) -> Vec<&DMatrix<f64>> {
    matrices.iter().collect()
}

/// Compares numbers, with a tolerance relative to the larger of 1 and the expected one.
#[track_caller]
pub(super) fn close(found: &[f64], expected: &[f64], tolerance: f64) {
    assert_eq!(found.len(), expected.len(), "{found:?} {expected:?}");
    for (found, expected) in found.iter().zip(expected) {
        let off = (found - expected).abs();
        assert!(off <= tolerance * expected.abs().max(1.0), "{found}, expected {expected}");
    }
}
