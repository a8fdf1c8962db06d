//! Dense product of two small panels: the loop nest that dominates training.
//!
//! ```text
//! sum[r, c]    = Σ_t left[r, t] · panel[t, c]        t ascending
//! output[r, c] = sum, output + sum, or output − sum
//! ```
//!
//! Used by the forward pass, the backward pass, JᵀJ, the gradient and the Cholesky factorisation.
//!
//! Cost: `rows · terms · columns` multiplications and as many additions; the sums of a tile of
//! `left` rows times `panel` columns stay in registers.
//!
//! Invariants: every output element is one sum over `t` in ascending order, with a rounded
//! multiplication and then a rounded addition. No element depends on the vector width, on its tile
//! or on other elements, so the bits are the same on every machine.

use pulp::{Simd, WithSimd};

/// Columns come in multiples of this, the f64 lanes of the widest vector.
pub(super) const LANES: usize = 8;

/// Rounds `count` up to whole vectors of [`LANES`].
pub(super) const fn round_up(count: usize) -> usize {
    count.div_ceil(LANES) * LANES
}

/// Returns a row length of at least `count` that is an odd number of vectors, so that the rows of a
/// panel are spread over all cache sets.
pub(super) const fn row_stride(count: usize) -> usize {
    (count.div_ceil(LANES) | 1) * LANES
}

/// What to do with the sums.
#[derive(Clone, Copy, Debug)]
pub(super) enum Store {
    /// Replace the output.
    Set,
    /// Add to the output.
    Add,
    /// Subtract from the output.
    Subtract,
}

/// One product; see the module docs.
///
/// Rows of `left` have a length `STRIDE` known at compile time, so that a tile addresses all its
/// rows by one pointer and constant offsets.
pub(super) struct PanelProduct<'a, const STRIDE: usize> {
    /// Shape `[rows][terms]`, padded to `STRIDE`.
    pub(super) left: &'a [[f64; STRIDE]],
    /// Terms per sum, at most `STRIDE`.
    pub(super) terms: usize,
    /// Shape `[terms][columns]`, rows `panel_stride` apart.
    pub(super) panel: &'a [f64],
    /// Distance between rows of `panel`.
    pub(super) panel_stride: usize,
    /// Number of columns, a multiple of [`LANES`].
    pub(super) columns: usize,
    /// Shape `[rows][columns]`, rows `output_stride` apart.
    pub(super) output: &'a mut [f64],
    /// Distance between rows of the output.
    pub(super) output_stride: usize,
    /// What to do with the sums.
    pub(super) store: Store,
}

impl<const STRIDE: usize> WithSimd for PanelProduct<'_, STRIDE> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, simd: S) {
        debug_assert!(self.columns.is_multiple_of(LANES) && self.terms <= STRIDE);
        let mut column = 0;
        while self.columns - column >= 2 * S::F64_LANES {
            self.strip::<S, 2>(simd, column);
            column += 2 * S::F64_LANES;
        }
        if column < self.columns {
            self.strip::<S, 1>(simd, column);
        }
    }
}

impl<const STRIDE: usize> PanelProduct<'_, STRIDE> {
    /// Computes all rows of `VECTORS` vectors of columns, which stay in the first-level cache.
    #[inline(always)]
    fn strip<S: Simd, const VECTORS: usize>(&mut self, simd: S, column: usize) {
        let mut row = 0;
        // Eight rows by two vectors fill 16 of 32 registers, four by two 8 of 16. Both hide the
        // latency of an addition; larger tiles spilled and were slower.
        if S::REGISTER_COUNT >= 32 {
            while let Some(left) = self.left[row..].first_chunk() {
                self.tile::<S, 8, VECTORS>(simd, left, row, column);
                row += 8;
            }
        }
        while let Some(left) = self.left[row..].first_chunk() {
            self.tile::<S, 4, VECTORS>(simd, left, row, column);
            row += 4;
        }
        if let Some(left) = self.left[row..].first_chunk() {
            self.tile::<S, 2, VECTORS>(simd, left, row, column);
            row += 2;
        }
        if let Some(left) = self.left[row..].first_chunk() {
            self.tile::<S, 1, VECTORS>(simd, left, row, column);
        }
    }

    #[inline(always)]
    #[allow(clippy::needless_range_loop, reason = "indices as in the formula; unrolled as meant")]
    fn tile<S: Simd, const ROWS: usize, const VECTORS: usize>(
        &mut self,
        simd: S,
        left: &[[f64; STRIDE]; ROWS],
        row: usize,
        column: usize,
    ) {
        let width = VECTORS * S::F64_LANES;
        let mut sums = [[simd.splat_f64s(0.0); VECTORS]; ROWS];
        for t in 0..self.terms.min(STRIDE) {
            let panel = &self.panel[t * self.panel_stride + column..][..width];
            let panel = S::as_simd_f64s(panel).0;
            for r in 0..ROWS {
                let factor = simd.splat_f64s(left[r][t]);
                for v in 0..VECTORS {
                    sums[r][v] = simd.add_f64s(sums[r][v], simd.mul_f64s(factor, panel[v]));
                }
            }
        }
        for r in 0..ROWS {
            let output = &mut self.output[(row + r) * self.output_stride + column..][..width];
            let output = S::as_mut_simd_f64s(output).0;
            for v in 0..VECTORS {
                output[v] = match self.store {
                    Store::Set => sums[r][v],
                    Store::Add => simd.add_f64s(output[v], sums[r][v]),
                    Store::Subtract => simd.sub_f64s(output[v], sums[r][v]),
                };
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::training::testing::instruction_sets;

    /// The definition, element by element.
    fn naive(left: &[[f64; 16]], terms: usize, columns: usize, panel: &[f64]) -> Vec<f64> {
        let mut output = vec![1.0; left.len() * columns];
        for r in 0..left.len() {
            for c in 0..columns {
                let mut sum = 0.0;
                for t in 0..terms {
                    sum += left[r][t] * panel[t * columns + c];
                }
                output[r * columns + c] -= sum;
            }
        }
        output
    }

    #[test]
    fn every_vector_width_matches_the_plain_loop_bit_for_bit() {
        for rows in 0..20 {
            for columns in (8..=72).step_by(8) {
                let terms = (3 * rows + columns) % 11;
                let row = |r| core::array::from_fn(|t| 1.0 / (r * 16 + t + 3) as f64 - 0.2);
                let left: Vec<[f64; 16]> = (0..rows).map(row).collect();
                let panel: Vec<f64> =
                    (0..terms * columns).map(|i| 1.0 / (i as f64 + 7.0) - 0.1).collect();
                let expected = naive(&left, terms, columns, &panel);
                for arch in instruction_sets() {
                    let mut output = vec![1.0; rows * columns];
                    arch.dispatch(PanelProduct {
                        left: &left,
                        terms,
                        panel: &panel,
                        panel_stride: columns,
                        columns,
                        output: &mut output,
                        output_stride: columns,
                        store: Store::Subtract,
                    });
                    assert_eq!(output, expected, "{rows} x {terms} x {columns}");
                }
            }
        }
    }
}
