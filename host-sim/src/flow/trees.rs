//! Who listens to whom: for each direction, the breadth-first trees from its roots,
//!
//! ```text
//! depth_ic = 0 at a root, else 1 + min over neighbours j of depth_jc
//! parent_ic = the lowest-numbered neighbour at depth_ic - 1
//! ```
//!
//! Agents that measure nothing are leaves or relays like others; several roots grow as many trees.
//!
//! Cost: `O(n (N + E))` operations, 33 bytes per agent and direction. The weights of the graph's
//! edges do not matter.

use super::geometry::Geometry;
use crate::graph::Graph;

/// The trees of all directions. Lists are indexed by agent, then direction.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Trees {
    /// The agent to whom an agent listens; `None` for roots, absent agents and orphans.
    pub parent: Vec<Vec<Option<usize>>>,
    /// Edges to the nearest root; 0 where there is no path to one.
    pub depth: Vec<Vec<usize>>,
    /// Number of agents that get the direction through this one, itself included; 0 where there is
    /// no path to a root.
    pub subtree: Vec<Vec<usize>>,
    /// Agents that are gone.
    pub absent: Vec<bool>,
}

impl Trees {
    /// Grows the trees over the whole graph. There are no orphans, because the graph is connected
    /// and every direction has a root.
    ///
    /// # Panics
    /// If the graph and the geometry differ in their number of agents.
    #[must_use]
    pub fn new(graph: &Graph, geometry: &Geometry) -> Self {
        Self::without(graph, geometry, &[])
    }

    /// Grows the trees over the graph without the agents in `dead`: an agent's parent is then a
    /// neighbour whose own path to a root avoids them. An agent that no such path reaches is an
    /// [orphan](Self::orphans) of the direction.
    ///
    /// # Panics
    /// If the graph and the geometry differ in their number of agents, or a dead agent does not
    /// exist.
    #[must_use]
    pub fn without(graph: &Graph, geometry: &Geometry, dead: &[usize]) -> Self {
        let (agents, n) = (graph.agents(), geometry.dimension());
        assert_eq!(agents, geometry.agents(), "graph and geometry must belong to the same network");
        let mut absent = vec![false; agents];
        for &agent in dead {
            absent[agent] = true;
        }
        let mut parent = vec![vec![None; n]; agents];
        let mut depth = vec![vec![0; n]; agents];
        let mut subtree = vec![vec![0; n]; agents];
        let mut order = Vec::with_capacity(agents);
        for c in 0..n {
            order.clear();
            order.extend((0..agents).filter(|&i| !absent[i] && geometry.is_root(i, c)));
            for &root in &order {
                subtree[root][c] = 1;
            }
            let mut next = 0;
            while let Some(&nearer) = order.get(next) {
                next += 1;
                for edge in graph.neighbours(nearer) {
                    let i = edge.agent;
                    if subtree[i][c] == 0 && !absent[i] {
                        (subtree[i][c], depth[i][c]) = (1, depth[nearer][c] + 1);
                        order.push(i);
                    }
                }
            }
            for &i in order.iter().filter(|&&i| depth[i][c] > 0) {
                let nearer = graph.neighbours(i).iter().map(|edge| edge.agent);
                parent[i][c] =
                    nearer.filter(|&j| subtree[j][c] > 0).find(|&j| depth[j][c] + 1 == depth[i][c]);
            }
            // Farthest first, so that every count is complete before it is added.
            for &i in order.iter().rev() {
                if let Some(j) = parent[i][c] {
                    subtree[j][c] += subtree[i][c];
                }
            }
        }
        Self { parent, depth, subtree, absent }
    }

    /// Whether `direction` is in `S_i`: some neighbour has `agent` as its parent for it.
    ///
    /// # Panics
    /// If there is no such agent or direction.
    #[must_use]
    pub fn announces(&self, agent: usize, direction: usize) -> bool {
        self.subtree[agent][direction] > 1
    }

    /// Whether `agent` measures `direction` or has a path to an agent that does.
    ///
    /// # Panics
    /// If there is no such agent or direction.
    #[must_use]
    pub fn reached(&self, agent: usize, direction: usize) -> bool {
        self.subtree[agent][direction] > 0
    }

    /// Returns the agents and directions without a path to a root, except for absent agents.
    pub fn orphans(&self) -> impl Iterator<Item = (usize, usize)> {
        let pairs = (0..self.agents()).flat_map(|i| (0..self.directions()).map(move |c| (i, c)));
        pairs.filter(|&(i, c)| !self.absent[i] && !self.reached(i, c))
    }

    /// Returns `N`, the number of agents, including absent ones.
    #[must_use]
    pub fn agents(&self) -> usize {
        self.parent.len()
    }

    /// Returns `n`, the number of directions.
    #[must_use]
    pub fn directions(&self) -> usize {
        self.parent.first().map_or(0, Vec::len)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flow::testing::{graph, random_graph, random_outputs, references, unit_outputs};
    use proptest::prelude::*;

    #[test]
    fn trees_of_the_papers_star() {
        let outputs = unit_outputs(3, 3);
        let geometry = Geometry::in_state_units(&references(&outputs)).unwrap();
        let trees = Trees::new(&graph(3, &[(0, 1), (0, 2)]), &geometry);
        assert_eq!(trees.parent[0], [None, Some(1), Some(2)]);
        assert_eq!(trees.parent[1], [Some(0), None, Some(0)]);
        assert_eq!(trees.parent[2], [Some(0), Some(0), None]);
        assert_eq!(trees.depth, [[0, 1, 1], [1, 0, 2], [1, 2, 0]]);
        assert_eq!(trees.subtree, [[3, 2, 2], [1, 3, 1], [1, 1, 3]]);
        let announced = |agent| (0..3).filter(|&c| trees.announces(agent, c)).collect::<Vec<_>>();
        assert_eq!([announced(0), announced(1), announced(2)], [vec![0, 1, 2], vec![1], vec![2]]);
    }

    #[test]
    fn a_ring_closes_around_a_dead_relay() {
        // 0-1-2-3-4-0; only agent 0 measures anything.
        let outputs: Vec<_> = (0..5).map(|i| unit_outputs(1, 5)[i].clone()).collect();
        let geometry = Geometry::in_state_units(&references(&outputs)).unwrap();
        let ring = graph(5, &[(0, 1), (1, 2), (2, 3), (3, 4), (4, 0)]);
        let whole = Trees::new(&ring, &geometry);
        let column = |trees: &Trees| trees.parent.iter().map(|row| row[0]).collect::<Vec<_>>();
        assert_eq!(column(&whole), [None, Some(0), Some(1), Some(4), Some(0)]);
        let rebuilt = Trees::without(&ring, &geometry, &[1]);
        assert_eq!(column(&rebuilt), [None, None, Some(3), Some(4), Some(0)]);
        assert_eq!((rebuilt.depth[2][0], rebuilt.orphans().count()), (3, 0));
        let cut = Trees::without(&ring, &geometry, &[1, 4]);
        assert_eq!(cut.orphans().collect::<Vec<_>>(), [(2, 0), (3, 0)]);
        assert!(!cut.reached(2, 0) && cut.subtree[0][0] == 1);
        let headless = Trees::without(&ring, &geometry, &[0]);
        assert_eq!(headless.orphans().count(), 4);
    }

    proptest! {
        #[test]
        fn every_agent_has_a_path_for_every_direction(seed in 0u64..400, dead in 0usize..12) {
            let (n, outputs) = random_outputs(seed);
            let graph = random_graph(seed, outputs.len(), 0.15);
            let geometry = Geometry::in_state_units(&references(&outputs)).unwrap();
            prop_assert_eq!(Trees::new(&graph, &geometry).orphans().count(), 0);
            let dead = dead % outputs.len();
            let trees = Trees::without(&graph, &geometry, &[dead]);
            prop_assert!(trees.absent[dead] && trees.parent[dead].iter().all(Option::is_none));
            for c in 0..n {
                let mut covered = 0;
                for start in (0..outputs.len()).filter(|&i| trees.reached(i, c)) {
                    let mut agent = start;
                    for depth in (0..trees.depth[start][c]).rev() {
                        let parent = trees.parent[agent][c].unwrap();
                        prop_assert!(graph.neighbours(agent).iter().any(|j| j.agent == parent));
                        prop_assert!(parent != dead && trees.announces(parent, c));
                        prop_assert_eq!(trees.depth[parent][c], depth);
                        agent = parent;
                    }
                    prop_assert!(geometry.is_root(agent, c));
                    covered += usize::from(geometry.is_root(start, c)) * trees.subtree[start][c];
                }
                let reached = (0..outputs.len()).filter(|&i| trees.reached(i, c)).count();
                prop_assert_eq!(covered, reached);
            }
        }
    }
}
