//! Who hears whom: the weighted undirected graph of the sensor network.
//!
//! With the adjacency matrix `A`, `a_ij = a_ji > 0` where agents i and j hear each other and 0
//! elsewhere, the Laplacian is `L = Delta - A`, `Delta` diagonal with `Delta_ii = sum_j a_ij`.
//!
//! Agents are numbered from 0 here and from 1 in files and messages. Cost: construction
//! `O(E log E)`, neighbours `O(1)`. Memory: 24 bytes an edge and 16 an end of an edge.
//!
//! Invariants: at least one agent; every edge joins two different agents, once, with a finite
//! weight above 0; edges and neighbours are in ascending order; every agent is reached from
//! every other.

use nalgebra::DMatrix;

/// Two agents that hear each other.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Edge {
    /// The agent with the smaller number, from 0.
    pub first: usize,
    /// The agent with the larger number, from 0.
    pub second: usize,
    /// `a_ij`, above 0.
    pub weight: f64,
}

/// One end of an edge, seen from the other.
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
    /// Agent i has the neighbours `starts[i]..starts[i + 1]`.
    starts: Vec<usize>,
}

/// Why there is no such graph. Agents are numbered from 0 in the fields, from 1 in the message.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum GraphError {
    /// No agent at all.
    #[error("a graph needs at least one agent")]
    Empty,
    /// The adjacency matrix is not square.
    #[error("the adjacency matrix has {rows} rows and {columns} columns, expected as many")]
    NotSquare {
        /// Its rows.
        rows: usize,
        /// Its columns.
        columns: usize,
    },
    /// The adjacency matrix is not symmetric.
    #[error(
        "row {}, column {} is not equal to row {}, column {}", .row + 1, .column + 1, .column + 1, .row + 1
    )]
    NotSymmetric {
        /// Row of one of the two entries.
        row: usize,
        /// Column of that entry.
        column: usize,
    },
    /// An edge names an agent that does not exist.
    #[error("agent {} does not exist, there are {agents}", .agent + 1)]
    UnknownAgent {
        /// The agent named.
        agent: usize,
        /// How many there are.
        agents: usize,
    },
    /// An agent is joined to itself.
    #[error("agent {} is joined to itself", .agent + 1)]
    SelfLoop {
        /// The agent.
        agent: usize,
    },
    /// A weight is not a finite number above 0.
    #[error("the weight between agents {} and {} is {weight}, expected a finite number above 0", .first + 1, .second + 1)]
    Weight {
        /// One agent.
        first: usize,
        /// The other.
        second: usize,
        /// The weight given.
        weight: f64,
    },
    /// Two agents are joined twice.
    #[error("agents {} and {} are joined twice", .first + 1, .second + 1)]
    Repeated {
        /// One agent.
        first: usize,
        /// The other.
        second: usize,
    },
    /// The graph falls apart.
    #[error("agent {} cannot be reached from agent 1", .agent + 1)]
    Disconnected {
        /// The first agent that cannot be reached from agent 0.
        agent: usize,
    },
}

impl Graph {
    /// The graph with `agents` vertices and these edges, in any order and direction.
    ///
    /// # Errors
    /// The first edge that breaks an invariant, or the first agent out of reach.
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

    /// The graph with this adjacency matrix, shape `[N, N]`.
    ///
    /// # Errors
    /// A matrix that is not square, symmetric, zero on its diagonal and elsewhere 0 or a finite
    /// number above 0; a graph that is not connected.
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
                // Written so that NaN, which no weight may be, counts as a weight.
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

    /// Counts, then fills: no agent has a list of its own on the heap. The edges are sorted,
    /// so every agent meets its smaller neighbours before its larger ones.
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

    /// `N`, the number of agents.
    #[must_use]
    pub fn agents(&self) -> usize {
        self.starts.len() - 1
    }

    /// The edges, by their first, then by their second agent.
    #[must_use]
    pub fn edges(&self) -> &[Edge] {
        &self.edges
    }

    /// The neighbours of `agent`, in ascending order.
    ///
    /// # Panics
    /// If there is no such agent.
    #[must_use]
    pub fn neighbours(&self, agent: usize) -> &[Neighbour] {
        &self.neighbours[self.starts[agent]..self.starts[agent + 1]]
    }

    /// `Delta_ii`, the sum of the weights of `agent`'s edges.
    ///
    /// # Panics
    /// If there is no such agent.
    #[must_use]
    pub fn degree(&self, agent: usize) -> f64 {
        self.neighbours(agent).iter().fold(0.0, |sum, neighbour| sum + neighbour.weight)
    }

    /// `A`, shape `[N, N]`.
    #[must_use]
    pub fn adjacency(&self) -> DMatrix<f64> {
        let mut adjacency = DMatrix::zeros(self.agents(), self.agents());
        for &Edge { first, second, weight } in &self.edges {
            adjacency[(first, second)] = weight;
            adjacency[(second, first)] = weight;
        }
        adjacency
    }

    /// `L = Delta - A`, shape `[N, N]`.
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
    fn the_laplacian_of_the_papers_network() {
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
    fn refuses_what_is_no_graph() {
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
    fn refuses_a_matrix_that_is_no_adjacency() {
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
