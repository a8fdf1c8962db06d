//! The weighted undirected communication graph of the sensor network.
//!
//! With the adjacency matrix `A`, where `a_ij = a_ji > 0` if agents i and j communicate and 0
//! otherwise, the Laplacian is `L = Delta - A`, `Delta` diagonal with `Delta_ii = sum_j a_ij`.
//!
//! Agents are numbered from 0 here and from 1 in files and messages. Cost: construction `O(E log
//! E)`, neighbours `O(1)`. Memory: 24 bytes per edge plus 16 per end of an edge.
//!
//! Invariants: at least one agent; every edge joins two different agents, appears once, and has a
//! finite weight above 0; edges and neighbours are in ascending order; the graph is connected.

use nalgebra::DMatrix;

/// Two agents that communicate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Edge {
    /// The agent with the smaller number, from 0.
    pub first: usize,
    /// The agent with the larger number, from 0.
    pub second: usize,
    /// `a_ij`, above 0.
    pub weight: f64,
}

/// A neighbour of an agent, with the weight of their edge.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Neighbour {
    /// The neighbour, from 0.
    pub agent: usize,
    /// `a_ij`, above 0.
    pub weight: f64,
}

/// A connected weighted undirected graph.
#[derive(Clone, Debug, PartialEq)]
pub struct Graph {
    edges: Vec<Edge>,
    neighbours: Vec<Neighbour>,
    /// The neighbours of agent i are `starts[i]..starts[i + 1]`.
    starts: Vec<usize>,
}

/// Why a graph is invalid. Agents are numbered from 0 in the fields, from 1 in the message.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum GraphError {
    /// No agents.
    #[error("a graph needs at least one agent")]
    Empty,
    /// The adjacency matrix is not square.
    #[error("the adjacency matrix has {rows} rows and {columns} columns, expected a square matrix")]
    NotSquare {
        /// Number of rows.
        rows: usize,
        /// Number of columns.
        columns: usize,
    },
    /// The adjacency matrix is not symmetric.
    #[error(
        "entries ({}, {}) and ({}, {}) differ", .row + 1, .column + 1, .column + 1, .row + 1
    )]
    NotSymmetric {
        /// Row of one of the two entries.
        row: usize,
        /// Column of that entry.
        column: usize,
    },
    /// An edge names an agent that does not exist.
    #[error("agent {} does not exist; the number of agents is {agents}", .agent + 1)]
    UnknownAgent {
        /// The unknown agent.
        agent: usize,
        /// The number of agents.
        agents: usize,
    },
    /// An edge from an agent to itself.
    #[error("agent {} has an edge to itself", .agent + 1)]
    SelfLoop {
        /// The agent.
        agent: usize,
    },
    /// A weight is not a finite number above 0.
    #[error("the weight between agents {} and {} is {weight}, expected a finite number above 0", .first + 1, .second + 1)]
    Weight {
        /// One agent.
        first: usize,
        /// The other agent.
        second: usize,
        /// The weight.
        weight: f64,
    },
    /// Two edges between the same agents.
    #[error("agents {} and {} have two edges", .first + 1, .second + 1)]
    Repeated {
        /// One agent.
        first: usize,
        /// The other agent.
        second: usize,
    },
    /// The graph is not connected.
    #[error("agent {} cannot be reached from agent 1", .agent + 1)]
    Disconnected {
        /// The first agent that cannot be reached from agent 0.
        agent: usize,
    },
}

impl Graph {
    /// Creates the graph of `agents` vertices with these edges, in any order and direction.
    ///
    /// # Errors
    /// Returns the first edge that breaks an invariant, or the first unreachable agent.
    pub fn new(agents: usize, edges: &[Edge]) -> Result<Self, GraphError> {
        if agents == 0 {
            return Err(GraphError::Empty);
        }
        let mut sorted = Vec::with_capacity(edges.len());
        for &Edge { first, second, weight } in edges {
            let (first, second) = (first.min(second), first.max(second));
            if second >= agents {
                return Err(GraphError::UnknownAgent { agent: second, agents });
            }
            if first == second {
                return Err(GraphError::SelfLoop { agent: first });
            }
            if !(weight > 0.0 && weight.is_finite()) {
                return Err(GraphError::Weight { first, second, weight });
            }
            sorted.push(Edge { first, second, weight });
        }
        sorted.sort_by_key(|edge| (edge.first, edge.second));
        for pair in sorted.windows(2) {
            let Edge { first, second, .. } = pair[1];
            if (pair[0].first, pair[0].second) == (first, second) {
                return Err(GraphError::Repeated { first, second });
            }
        }
        let graph = Self::from_sorted(agents, sorted);
        match graph.first_unreachable() {
            Some(agent) => Err(GraphError::Disconnected { agent }),
            None => Ok(graph),
        }
    }

    /// Creates the graph with this adjacency matrix, shape `[N, N]`.
    ///
    /// # Errors
    /// If the matrix is not square, not symmetric, not zero on its diagonal, or has an off-diagonal
    /// entry that is neither 0 nor a finite number above 0; if the graph is not connected.
    pub fn from_adjacency(adjacency: &DMatrix<f64>) -> Result<Self, GraphError> {
        let (rows, columns) = adjacency.shape();
        if rows != columns {
            return Err(GraphError::NotSquare { rows, columns });
        }
        let mut edges = Vec::new();
        for row in 0..rows {
            if adjacency[(row, row)] != 0.0 {
                return Err(GraphError::SelfLoop { agent: row });
            }
            for column in row + 1..columns {
                let (above, below) = (adjacency[(row, column)], adjacency[(column, row)]);
                // The comparison treats NaN as a weight, so that `Graph::new` rejects it.
                if above == 0.0 && below == 0.0 {
                    continue;
                }
                if above != below && !(above.is_nan() && below.is_nan()) {
                    return Err(GraphError::NotSymmetric { row, column });
                }
                edges.push(Edge { first: row, second: column, weight: above });
            }
        }
        Self::new(rows, &edges)
    }

    /// Counts the neighbours, then fills one shared list: no allocation per agent. The edges are
    /// sorted, so every agent gets its smaller neighbours before its larger ones.
    fn from_sorted(agents: usize, edges: Vec<Edge>) -> Self {
        let mut starts = vec![0; agents + 1];
        for edge in &edges {
            starts[edge.first + 1] += 1;
            starts[edge.second + 1] += 1;
        }
        for agent in 0..agents {
            starts[agent + 1] += starts[agent];
        }
        let mut next = starts.clone();
        let mut neighbours = vec![Neighbour { agent: 0, weight: 0.0 }; 2 * edges.len()];
        for &Edge { first, second, weight } in &edges {
            neighbours[next[second]] = Neighbour { agent: first, weight };
            next[second] += 1;
        }
        for &Edge { first, second, weight } in &edges {
            neighbours[next[first]] = Neighbour { agent: second, weight };
            next[first] += 1;
        }
        Self { edges, neighbours, starts }
    }

    fn first_unreachable(&self) -> Option<usize> {
        let mut reached = vec![false; self.agents()];
        let mut open = vec![0];
        reached[0] = true;
        while let Some(agent) = open.pop() {
            for neighbour in self.neighbours(agent) {
                if !std::mem::replace(&mut reached[neighbour.agent], true) {
                    open.push(neighbour.agent);
                }
            }
        }
        reached.iter().position(|&reached| !reached)
    }

    /// Returns `N`, the number of agents.
    #[must_use]
    pub fn agents(&self) -> usize {
        self.starts.len() - 1
    }

    /// Returns the edges, sorted by first, then by second agent.
    #[must_use]
    pub fn edges(&self) -> &[Edge] {
        &self.edges
    }

    /// Returns the neighbours of `agent` in ascending order.
    ///
    /// # Panics
    /// If the agent does not exist.
    #[must_use]
    pub fn neighbours(&self, agent: usize) -> &[Neighbour] {
        &self.neighbours[self.starts[agent]..self.starts[agent + 1]]
    }

    /// Returns `Delta_ii`, the sum of the weights of `agent`'s edges.
    ///
    /// # Panics
    /// If the agent does not exist.
    #[must_use]
    pub fn degree(&self, agent: usize) -> f64 {
        self.neighbours(agent).iter().fold(0.0, |sum, neighbour| sum + neighbour.weight)
    }

    /// Returns `A`, shape `[N, N]`.
    #[must_use]
    pub fn adjacency(&self) -> DMatrix<f64> {
        let mut adjacency = DMatrix::zeros(self.agents(), self.agents());
        for &Edge { first, second, weight } in &self.edges {
            adjacency[(first, second)] = weight;
            adjacency[(second, first)] = weight;
        }
        adjacency
    }

    /// Returns `L = Delta - A`, shape `[N, N]`.
    #[must_use]
    pub fn laplacian(&self) -> DMatrix<f64> {
        let mut laplacian = -self.adjacency();
        for agent in 0..self.agents() {
            laplacian[(agent, agent)] = self.degree(agent);
        }
        laplacian
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::dmatrix;

    fn edge(first: usize, second: usize, weight: f64) -> Edge {
        Edge { first, second, weight }
    }

    #[test]
    fn sorts_edges_and_neighbours() {
        let edges = [edge(3, 1, 2.0), edge(2, 0, 0.5), edge(1, 0, 1.0), edge(3, 0, 4.0)];
        let graph = Graph::new(4, &edges).unwrap();
        let sorted = [edge(0, 1, 1.0), edge(0, 2, 0.5), edge(0, 3, 4.0), edge(1, 3, 2.0)];
        assert_eq!(graph.edges(), sorted);
        let of = |agent| graph.neighbours(agent).iter().map(|n| n.agent).collect::<Vec<_>>();
        assert_eq!([of(0), of(1), of(2), of(3)], [vec![1, 2, 3], vec![0, 3], vec![0], vec![0, 1]]);
        assert_eq!(graph.neighbours(3)[1], Neighbour { agent: 1, weight: 2.0 });
        assert_eq!(graph.degree(0), 5.5);
    }

    #[test]
    fn laplacian_of_the_papers_network() {
        let adjacency = dmatrix![0.0, 1.0, 1.0; 1.0, 0.0, 0.0; 1.0, 0.0, 0.0];
        let graph = Graph::from_adjacency(&adjacency).unwrap();
        assert_eq!(graph.adjacency(), adjacency);
        let laplacian = dmatrix![2.0, -1.0, -1.0; -1.0, 1.0, 0.0; -1.0, 0.0, 1.0];
        assert_eq!(graph.laplacian(), laplacian);
    }

    #[test]
    fn one_agent_needs_no_edge() {
        let graph = Graph::new(1, &[]).unwrap();
        assert_eq!((graph.agents(), graph.neighbours(0).len()), (1, 0));
        assert_eq!(graph.laplacian(), dmatrix![0.0]);
    }

    #[test]
    fn rejects_invalid_graphs() {
        let refused = |agents, edges: &[Edge]| Graph::new(agents, edges).unwrap_err();
        assert_eq!(refused(0, &[]), GraphError::Empty);
        assert_eq!(
            refused(2, &[edge(0, 2, 1.0)]),
            GraphError::UnknownAgent { agent: 2, agents: 2 }
        );
        assert_eq!(refused(2, &[edge(1, 1, 1.0)]), GraphError::SelfLoop { agent: 1 });
        for weight in [0.0, -1.0, f64::INFINITY] {
            let error = GraphError::Weight { first: 0, second: 1, weight };
            assert_eq!(refused(2, &[edge(1, 0, weight)]), error);
        }
        assert!(matches!(refused(2, &[edge(0, 1, f64::NAN)]), GraphError::Weight { .. }));
        let twice = [edge(0, 1, 1.0), edge(1, 0, 2.0)];
        assert_eq!(refused(2, &twice), GraphError::Repeated { first: 0, second: 1 });
        let apart = [edge(0, 2, 1.0), edge(1, 3, 1.0)];
        assert_eq!(refused(4, &apart), GraphError::Disconnected { agent: 1 });
    }

    #[test]
    fn rejects_invalid_adjacency_matrices() {
        let refused = |matrix: DMatrix<f64>| Graph::from_adjacency(&matrix).unwrap_err();
        assert_eq!(refused(dmatrix![0.0, 1.0]), GraphError::NotSquare { rows: 1, columns: 2 });
        let lopsided = dmatrix![0.0, 1.0; 2.0, 0.0];
        assert_eq!(refused(lopsided), GraphError::NotSymmetric { row: 0, column: 1 });
        assert_eq!(refused(dmatrix![0.0, 1.0; 1.0, 3.0]), GraphError::SelfLoop { agent: 1 });
        let nan = dmatrix![0.0, f64::NAN; f64::NAN, 0.0];
        assert!(matches!(refused(nan), GraphError::Weight { .. }));
        assert_eq!(refused(DMatrix::zeros(0, 0)), GraphError::Empty);
    }
}
