//! How fast the errors of all agents decay, for any gains. For each direction, `M` holds the gains
//! of `d/dt e = -M e + E e_hold`: `k_o` on the diagonal at roots; `K_c` there and `-K_c` in the
//! parent's column at other agents. With
//!
//! ```text
//! u_i = 1/k_o + h_i/K_c    v_i = s_i/K_i    P = diag(v_i / u_i)
//! ```
//!
//! where h is the depth, s the size of the subtree, and K_i the agent's own gain, `M u = 1` and `M^T
//! v = 1`. So `S = P M + M^T P` has `S u > 0` and no positive entries outside its diagonal, and
//!
//! ```text
//! lambda = lambda_min(P^(-1/2) (S/2) P^(-1/2)) >= 1/2 min_i (1/u_i + 1/v_i) > 0
//! ```
//!
//! (Collatz and Wielandt). Without the weights, the smallest eigenvalue of `(M + M^T)/2` is negative
//! for wide trees; the price of the weights is a factor `sqrt(cond(P))` in the bound of the error.
//!
//! Where relays announce their parent's announcement rather than their own estimate, every agent
//! listens to its root's estimate: in M, h <= 1 and s = 1 below the root, and the deviations of the
//! announcements along the path add up in `e_hold`: `1 + 0.9 (h - 1)` radii.
//!
//! Cost: `O(N log N)` per direction for everything, eigenvalues included, because M is a forest. A
//! thousand agents take about a millisecond per direction.

use nalgebra::DMatrix;

use super::forest::Forest;
use super::geometry::Geometry;
use super::trees::Trees;

/// Radius of relays that announce their parent's announcement, in radii of roots.
const RELAY_RADIUS: f64 = 0.9;

/// Decay rates of the error for given gains: the worst over all directions.
#[derive(Clone, Debug, PartialEq)]
pub struct Certificate {
    /// `lambda`, the decay rate in the weighted norm, rounded down; 0 if an agent has no path to a
    /// root. \[1/s\]
    pub eigenvalue_min: f64,
    /// `lambda_min((M + M^T)/2)`, the decay rate in the plain norm, rounded down; negative or 0 if
    /// there is none. \[1/s\]
    pub plain: f64,
    /// `1/2 min (1/u_i + 1/v_i)`, the lower bound on `eigenvalue_min` in closed form. \[1/s\]
    pub bound: f64,
    /// Largest over smallest weight of a direction.
    pub condition: f64,
    /// `|E|`. \[1/s\]
    pub coupling: f64,
    /// `|P^(1/2) E P^(-1/2)|`. \[1/s\]
    pub weighted_coupling: f64,
    /// `|e_hold|^2` in squared radii, for each direction.
    pub hold: Vec<f64>,
    /// `|P^(1/2) e_hold|^2` in squared radii, for each direction.
    pub weighted_hold: Vec<f64>,
    /// The diagonals of P, the largest of each direction 1; 0 for agents without a path to a root.
    /// Shape `[N, n]`.
    pub weights: DMatrix<f64>,
}

impl Certificate {
    /// Certifies the gains `k_o` of the roots and `K_c` of all others, both of shape `[n]`,
    /// \[1/s\]. Absent agents do not count.
    ///
    /// # Panics
    /// If a gain is not a finite number above 0, or the arguments are not of the same network.
    #[must_use]
    pub fn new(
        trees: &Trees,
        geometry: &Geometry,
        root_gains: &[f64],
        tree_gains: &[f64],
        relays_announce_parent: bool,
    ) -> Self {
        let (agents, n) = (geometry.agents(), geometry.dimension());
        assert_eq!((trees.agents(), trees.directions()), (agents, n), "trees of this geometry");
        assert_eq!((root_gains.len(), tree_gains.len()), (n, n), "a gain for every direction");
        let mut total = Self {
            eigenvalue_min: f64::INFINITY,
            plain: f64::INFINITY,
            bound: f64::INFINITY,
            condition: 1.0,
            coupling: 0.0,
            weighted_coupling: 0.0,
            hold: Vec::with_capacity(n),
            weighted_hold: Vec::with_capacity(n),
            weights: DMatrix::zeros(agents, n),
        };
        for c in 0..n {
            let gains = Gains { root: root_gains[c], tree: tree_gains[c] };
            total.add(c, &Direction::new(trees, c, gains, relays_announce_parent));
        }
        if trees.orphans().next().is_some() {
            // An orphan's row of M is zero: nothing corrects its error.
            (total.eigenvalue_min, total.bound) = (0.0, 0.0);
            total.plain = total.plain.min(0.0);
        }
        total
    }

    fn add(&mut self, c: usize, direction: &Direction) {
        let nodes = &direction.nodes;
        let bound = nodes.iter().map(|node| 0.5 * (1.0 / node.u + 1.0 / node.v));
        let bound = bound.fold(f64::INFINITY, f64::min);
        let weight = |node: &Node| node.v / node.u;
        let largest = nodes.iter().map(weight).fold(0.0, f64::max);
        let smallest = nodes.iter().map(weight).fold(f64::INFINITY, f64::min);
        let [mut plain, mut weighted] = [Forest::default(), Forest::default()];
        let mut hold = [0.0, 0.0];
        // Sums over the children of each node, of 1 and of the weights' ratios.
        let mut children = vec![[0.0, 0.0]; nodes.len()];
        for node in nodes {
            let weight = weight(node) / largest;
            self.weights[(node.agent, c)] = weight;
            let ratio = node.parent.map(|parent| nodes[parent].v / nodes[parent].u / largest);
            let ratio = ratio.map_or(1.0, |parent| weight / parent);
            let joined = |scale: f64| node.parent.map(|to| (to, -0.5 * node.gain * scale));
            plain.add(node.gain, joined(1.0));
            weighted.add(node.gain, joined(ratio.sqrt()));
            hold[0] += node.hold;
            hold[1] += node.hold * weight;
            if let Some(parent) = node.parent {
                children[parent][0] += 1.0;
                children[parent][1] += ratio;
            }
        }
        // Each row of E has one entry: in its parent's column, so that columns are orthogonal, or
        // on the diagonal.
        let widest = |k: usize| {
            let sum = children.iter().map(|sums| sums[k]).fold(0.0, f64::max);
            direction.tree_gain * if direction.shared { sum.sqrt() } else { sum.min(1.0).ceil() }
        };
        self.coupling = self.coupling.max(widest(0));
        self.weighted_coupling = self.weighted_coupling.max(widest(1));
        self.hold.push(hold[0]);
        self.weighted_hold.push(hold[1]);
        self.plain = self.plain.min(plain.eigenvalue_min());
        self.bound = self.bound.min(bound);
        // The eigenvalue is at least the bound; rounding must not hide it.
        self.eigenvalue_min = self.eigenvalue_min.min(weighted.eigenvalue_min().max(bound));
        if !nodes.is_empty() {
            self.condition = self.condition.max(largest / smallest);
        }
    }
}

#[derive(Clone, Copy)]
struct Gains {
    root: f64,
    tree: f64,
}

/// M of one direction, parents before children.
struct Direction {
    nodes: Vec<Node>,
    tree_gain: f64,
    /// Whether an announcement's deviation is the same for all who listen to it.
    shared: bool,
}

struct Node {
    agent: usize,
    /// `M_ii`.
    gain: f64,
    /// Place of the agent in whose column of M its gain stands, too.
    parent: Option<usize>,
    u: f64,
    v: f64,
    /// Its part of `|e_hold|^2`, in squared radii.
    hold: f64,
}

impl Direction {
    fn new(trees: &Trees, c: usize, gains: Gains, relays_announce_parent: bool) -> Self {
        let Gains { root, tree } = gains;
        for gain in [root, tree] {
            assert!(gain > 0.0 && gain.is_finite(), "gain {gain} of direction {c}");
        }
        let mut order: Vec<usize> =
            (0..trees.agents()).filter(|&agent| trees.reached(agent, c)).collect();
        order.sort_by_key(|&agent| trees.depth[agent][c]);
        let mut place = vec![0; trees.agents()];
        let mut nodes: Vec<Node> = Vec::with_capacity(order.len());
        for agent in order {
            place[agent] = nodes.len();
            let depth = trees.depth[agent][c];
            let near = trees.parent[agent][c].map(|parent| place[parent]);
            // With one level only, a node's parent stands for its root.
            let parent = match near {
                Some(near) if relays_announce_parent => Some(nodes[near].parent.unwrap_or(near)),
                near => near,
            };
            let gain = if parent.is_some() { tree } else { root };
            let (levels, listeners, hold);
            if relays_announce_parent {
                levels = depth.min(1);
                listeners = if depth == 0 { trees.subtree[agent][c] } else { 1 };
                let radii = if depth == 0 { 0.0 } else { 1.0 + RELAY_RADIUS * (depth - 1) as f64 };
                hold = radii * radii;
            } else {
                (levels, listeners) = (depth, trees.subtree[agent][c]);
                hold = f64::from(u8::from(trees.announces(agent, c)));
            }
            let u = 1.0 / root + levels as f64 / tree;
            nodes.push(Node { agent, gain, parent, u, v: listeners as f64 / gain, hold });
        }
        Self { nodes, tree_gain: tree, shared: !relays_announce_parent }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::testing::{graph, random_graph, random_outputs, references, unit_outputs};
    use crate::graph::Graph;
    use proptest::prelude::*;

    fn certify(graph: &Graph, measured: usize, k_o: f64, k_c: f64, relayed: bool) -> Certificate {
        let outputs = unit_outputs(measured, graph.agents());
        let geometry = Geometry::in_state_units(&references(&outputs)).unwrap();
        let trees = Trees::new(graph, &geometry);
        Certificate::new(&trees, &geometry, &vec![k_o; measured], &vec![k_c; measured], relayed)
    }

    /// `M` of one direction, dense.
    fn matrix(
        trees: &Trees,
        c: usize,
        root_gain: f64,
        tree_gain: f64,
        relayed: bool,
    ) -> DMatrix<f64> {
        let mut matrix = DMatrix::zeros(trees.agents(), trees.agents());
        for agent in 0..trees.agents() {
            let mut parent = trees.parent[agent][c];
            while let Some(farther) = parent.and_then(|p| trees.parent[p][c]).filter(|_| relayed) {
                parent = Some(farther);
            }
            matrix[(agent, agent)] = if parent.is_some() { tree_gain } else { root_gain };
            if let Some(parent) = parent {
                matrix[(agent, parent)] = -tree_gain;
            }
        }
        matrix
    }

    #[test]
    fn orphans_void_a_certificate_and_absent_agents_do_not() {
        let outputs = unit_outputs(1, 4);
        let geometry = Geometry::in_state_units(&references(&outputs)).unwrap();
        let path = graph(4, &[(0, 1), (1, 2), (2, 3)]);
        let certificate = |dead: &[usize]| {
            let trees = Trees::without(&path, &geometry, dead);
            Certificate::new(&trees, &geometry, &[50.0], &[100.0], false)
        };
        let shorter = certify(&graph(3, &[(0, 1), (1, 2)]), 1, 50.0, 100.0, false);
        let ended = certificate(&[3]);
        assert_eq!(ended.eigenvalue_min, shorter.eigenvalue_min);
        assert_eq!(ended.weights[(3, 0)], 0.0);
        let cut = certificate(&[1]);
        assert_eq!((cut.eigenvalue_min, cut.bound, cut.plain), (0.0, 0.0, 0.0));
    }

    #[test]
    fn large_networks_are_certified_in_full() {
        let edges: Vec<(usize, usize)> = (1..20_000).map(|k| ((k - 1) / 3, k)).collect();
        let tree = graph(20_000, &edges);
        for relayed in [false, true] {
            let found = certify(&tree, 1, 113.0, 100.0, relayed);
            assert!(found.eigenvalue_min >= found.bound && found.bound > 1.0, "{}", found.bound);
        }
    }

    proptest! {
        #[test]
        fn any_positive_gains_are_certified(
            seed in 0u64..400,
            gains in prop::collection::vec((0.01..1e4f64, 0.01..1e4f64), 8),
            relayed: bool,
        ) {
            let (n, outputs) = random_outputs(seed);
            let network = random_graph(seed, outputs.len(), 0.15);
            let geometry = Geometry::in_state_units(&references(&outputs)).unwrap();
            let trees = Trees::new(&network, &geometry);
            let (k_o, k_c): (Vec<f64>, Vec<f64>) = gains[..n].iter().copied().unzip();
            let found = Certificate::new(&trees, &geometry, &k_o, &k_c, relayed);
            prop_assert!(found.bound > 0.0 && found.eigenvalue_min >= found.bound);
            let mut expected = [f64::INFINITY; 3];
            let mut coupling = [0f64; 2];
            for c in 0..n {
                let m = matrix(&trees, c, k_o[c], k_c[c], relayed);
                // The definition of the weights, by solving.
                let ones = DMatrix::from_element(outputs.len(), 1, 1.0);
                let u = m.clone().lu().solve(&ones).unwrap();
                let v = m.transpose().lu().solve(&ones).unwrap();
                let weights = v.component_div(&u);
                let largest = weights.max();
                for agent in 0..outputs.len() {
                    let weight = weights[agent] / largest;
                    prop_assert!((found.weights[(agent, c)] / weight - 1.0).abs() < 1e-6);
                    let bound = 0.5 * (1.0 / u[agent] + 1.0 / v[agent]);
                    expected[2] = expected[2].min(bound);
                }
                let root = |agent: usize| weights[agent].sqrt();
                let weighted =
                    DMatrix::from_fn(m.nrows(), m.ncols(), |i, j| root(i) * m[(i, j)] / root(j));
                for (k, m) in [m, weighted].into_iter().enumerate() {
                    let symmetric = (&m + m.transpose()) * 0.5;
                    expected[k] = expected[k].min(symmetric.symmetric_eigenvalues().min());
                    let mut e = -m.clone();
                    e.fill_diagonal(0.0);
                    let norm = if relayed {
                        if e.amax() > 0.0 { k_c[c] } else { 0.0 }
                    } else {
                        e.singular_values().max()
                    };
                    coupling[k] = coupling[k].max(norm);
                }
            }
            let size = gains.iter().fold(0f64, |size, gain| size.max(gain.0).max(gain.1));
            let tolerance = 1e-8 * size * found.condition.sqrt();
            for (found, expected) in
                [found.plain, found.eigenvalue_min, found.bound].into_iter().zip(expected)
            {
                prop_assert!((found - expected).abs() < tolerance, "{} {}", found, expected);
            }
            prop_assert!((found.coupling - coupling[0]).abs() < tolerance);
            prop_assert!((found.weighted_coupling - coupling[1]).abs() < tolerance);
        }
    }
}
