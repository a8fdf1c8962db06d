//! The smallest eigenvalue of a symmetric matrix `S` whose entries outside the diagonal join each
//! node to at most one nearer the root. Elimination from the leaves has no fill-in, so
//!
//! ```text
//! p_i = S_ii - s - sum over children k of S_ik^2 / p_k,    S - s I > 0 if and only if all p_i > 0
//! ```
//!
//! and bisection on s finds the eigenvalue to within rounding error in about 60 passes of `O(N)`.

/// A symmetric matrix on a forest. Nodes are ordered so that every parent comes before its
/// children.
#[derive(Clone, Debug, Default)]
pub(super) struct Forest {
    nodes: Vec<Node>,
}

#[derive(Clone, Copy, Debug)]
struct Node {
    diagonal: f64,
    /// The parent's place and the entry that joins them.
    parent: Option<(usize, f64)>,
}

impl Forest {
    /// Adds a node and returns its place.
    ///
    /// # Panics
    /// If the parent was not added before.
    pub(super) fn add(&mut self, diagonal: f64, parent: Option<(usize, f64)>) -> usize {
        assert!(parent.is_none_or(|(place, _)| place < self.nodes.len()), "parents come first");
        self.nodes.push(Node { diagonal, parent });
        self.nodes.len() - 1
    }

    /// Returns the smallest eigenvalue, infinite for an empty forest. It is rounded down: `S - s I`
    /// is positive definite in floating point at the value returned.
    pub(super) fn eigenvalue_min(&self) -> f64 {
        // Gershgorin's discs below, the diagonal above.
        let mut radii = vec![0.0; self.nodes.len()];
        for (place, node) in self.nodes.iter().enumerate() {
            if let Some((parent, entry)) = node.parent {
                radii[place] += entry.abs();
                radii[parent] += entry.abs();
            }
        }
        let mut upper = f64::INFINITY;
        let mut lower = f64::INFINITY;
        let mut size = 0f64;
        for (node, radius) in self.nodes.iter().zip(radii) {
            upper = upper.min(node.diagonal);
            lower = lower.min(node.diagonal - radius);
            size = size.max(node.diagonal.abs() + radius);
        }
        if self.nodes.is_empty() {
            return upper;
        }
        // A disc can touch the eigenvalue.
        lower -= 4.0 * f64::EPSILON * size;
        let mut pivots = vec![0.0; self.nodes.len()];
        loop {
            let middle = 0.5 * (lower + upper);
            let resolved = upper - lower <= f64::EPSILON * size;
            if resolved || middle <= lower || middle >= upper {
                return lower;
            }
            if self.is_positive(middle, &mut pivots) {
                lower = middle;
            } else {
                upper = middle;
            }
        }
    }

    /// Whether `S - shift I` is positive definite.
    fn is_positive(&self, shift: f64, pivots: &mut [f64]) -> bool {
        for (pivot, node) in pivots.iter_mut().zip(&self.nodes) {
            *pivot = node.diagonal - shift;
        }
        for (place, node) in self.nodes.iter().enumerate().rev() {
            if pivots[place] <= 0.0 {
                return false;
            }
            if let Some((parent, entry)) = node.parent {
                pivots[parent] -= entry * entry / pivots[place];
            }
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::DMatrix;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn agrees_with_dense_algebra(
            nodes in prop::collection::vec((-5.0..5.0f64, -3.0..3.0f64, 0usize..100), 1..30)
        ) {
            let mut forest = Forest::default();
            let mut dense = DMatrix::zeros(nodes.len(), nodes.len());
            for (place, &(diagonal, entry, parent)) in nodes.iter().enumerate() {
                dense[(place, place)] = diagonal;
                let parent = parent % (place + 1);
                let joined = (parent != place).then_some((parent, entry));
                if joined.is_some() {
                    dense[(place, parent)] = entry;
                    dense[(parent, place)] = entry;
                }
                prop_assert_eq!(forest.add(diagonal, joined), place);
            }
            let expected = dense.symmetric_eigenvalues().min();
            let found = forest.eigenvalue_min();
            prop_assert!((found - expected).abs() < 1e-10, "{} {}", found, expected);
        }
    }

    #[test]
    fn an_empty_forest_restricts_nothing() {
        assert_eq!(Forest::default().eigenvalue_min(), f64::INFINITY);
    }

    #[test]
    fn a_zero_matrix_has_a_zero_eigenvalue() {
        let mut forest = Forest::default();
        forest.add(0.0, None);
        assert_eq!(forest.eigenvalue_min().abs(), 0.0);
    }
}
