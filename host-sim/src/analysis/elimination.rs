//! Elimination order of a graph's vertices that creates few new edges: the vertex of smallest
//! degree goes first (minimum-degree rule). A remainder with at least half the edges of a clique is
//! kept together and treated as dense.
//!
//! The elimination works on rows of bits: at most `N^3/64` operations, 16 million for a thousand
//! vertices.

/// The order, and the remaining neighbours at each elimination.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Elimination {
    /// The vertex of each rank: first those eliminated one by one, then the rest.
    pub(super) order: Vec<usize>,
    /// For each eliminated vertex, the ranks of its remaining neighbours, ascending.
    pub(super) rows: Vec<Vec<usize>>,
}

impl Elimination {
    /// Computes the order for a graph with these vertices and pairs of neighbours.
    pub(super) fn new(vertices: usize, pairs: impl Iterator<Item = (usize, usize)>) -> Self {
        let mut graph = Bits::new(vertices);
        for (a, b) in pairs {
            graph.join(a, b);
        }
        let mut left: Vec<usize> = (0..vertices).collect();
        let mut degrees: Vec<usize> = (0..vertices).map(|v| graph.degree(v)).collect();
        let (mut order, mut met) = (Vec::new(), Vec::new());
        while let Some(&vertex) = left.iter().min_by_key(|&&v| (degrees[v], v)) {
            if 2 * degrees[vertex] + 1 >= left.len() {
                break;
            }
            let neighbours = graph.neighbours(vertex);
            for &neighbour in &neighbours {
                graph.absorb(neighbour, vertex);
                degrees[neighbour] = graph.degree(neighbour);
            }
            left.retain(|&v| v != vertex);
            order.push(vertex);
            met.push(neighbours);
        }
        order.extend(left);
        let mut rank = vec![0; vertices];
        for (position, &vertex) in order.iter().enumerate() {
            rank[vertex] = position;
        }
        let ranked = |vertices: Vec<usize>| {
            let mut ranks: Vec<usize> = vertices.into_iter().map(|vertex| rank[vertex]).collect();
            ranks.sort_unstable();
            ranks
        };
        let rows = met.into_iter().map(ranked).collect();
        Self { order, rows }
    }

    /// Returns the number of vertices eliminated one by one.
    pub(super) fn eliminated(&self) -> usize {
        self.rows.len()
    }
}

/// An adjacency matrix of bits.
struct Bits {
    words: usize,
    bits: Vec<u64>,
}

impl Bits {
    fn new(vertices: usize) -> Self {
        let words = vertices.div_ceil(64);
        Self { words, bits: vec![0; words * vertices] }
    }

    fn row(&self, vertex: usize) -> &[u64] {
        &self.bits[vertex * self.words..][..self.words]
    }

    fn set(&mut self, a: usize, b: usize, joined: bool) {
        let word = &mut self.bits[a * self.words + b / 64];
        *word = *word & !(1 << (b % 64)) | u64::from(joined) << (b % 64);
    }

    fn join(&mut self, a: usize, b: usize) {
        self.set(a, b, true);
        self.set(b, a, true);
    }

    fn degree(&self, vertex: usize) -> usize {
        self.row(vertex).iter().map(|word| word.count_ones() as usize).sum()
    }

    fn neighbours(&self, vertex: usize) -> Vec<usize> {
        let is_set = |&other: &usize| self.row(vertex)[other / 64] >> (other % 64) & 1 == 1;
        (0..64 * self.words).filter(is_set).collect()
    }

    /// Joins `vertex` to the neighbours of `eliminated`, which is removed.
    fn absorb(&mut self, vertex: usize, eliminated: usize) {
        for word in 0..self.words {
            let more = self.bits[eliminated * self.words + word];
            self.bits[vertex * self.words + word] |= more;
        }
        self.set(vertex, vertex, false);
        self.set(vertex, eliminated, false);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn leaves_of_a_star_are_eliminated_first() {
        let found = Elimination::new(6, (1..6).map(|leaf| (0, leaf)));
        assert_eq!(found.order, [1, 2, 3, 0, 4, 5]);
        assert_eq!(found.rows, [vec![3], vec![3], vec![3]]);
    }

    #[test]
    fn elimination_joins_the_neighbours() {
        // A ring of seven: eliminating 0 joins 1 and 6.
        let found = Elimination::new(7, (0..7).map(|v| (v, (v + 1) % 7)));
        assert_eq!(found.order[0], 0);
        let met: Vec<_> = found.rows[0].iter().map(|&rank| found.order[rank]).collect();
        assert!(met.contains(&1) && met.contains(&6) && met.len() == 2, "{found:?}");
        assert!(found.rows.iter().all(|row| row.len() <= 2), "{found:?}");
    }

    #[test]
    fn a_clique_stays_together() {
        let pairs = (0..5).flat_map(|a| (0..a).map(move |b| (a, b)));
        let found = Elimination::new(5, pairs);
        assert_eq!(found.eliminated(), 0);
        assert_eq!(found.order, [0, 1, 2, 3, 4]);
    }
}
