//! Computes JᵀJ and Jᵀe of the inner parameters without forming J.
//!
//! With `a_k` the inputs of layer k (including a leading 1) and `δ_k^o` the sensitivities of output
//! o, the row of J for sample s and output o contains `a_k[i] δ_k^o[p]` at weight (i, p) of layer
//! k. Hence
//!
//! ```text
//! JᵀJ[(k, i, p), (l, j, q)] = Σ_s (a_k[i] a_l[j]) · (Σ_o δ_k^o[p] δ_l^o[q])
//! Jᵀe[(k, i, p)]            = Σ_s  a_k[i]         · (Σ_o δ_k^o[p] e^o)
//! ```
//!
//! The sum over outputs is taken before the products; for every pair of layers this leaves the
//! product of a panel `[(i, j)][s]` and a panel `[s][(p, q)]`, batch by batch. For k = l both
//! factors are symmetric, and only i ≤ j and p ≤ q are computed.
//!
//! Cost per sample: Σ_k m_k(m_k+1)/2 · w_k(w_k+1)/2 + Σ_(k<l) m_k m_l w_k w_l multiplications and
//! additions with m = inputs + 1: 79,053 for the paper's network, compared with 271,575 for the
//! rows of a dense J with three outputs. Memory: 8 bytes for each of these, once.
//!
//! Invariant: every entry is a sum over batches in ascending order of sums over samples in
//! ascending order.

use super::panel_product::{LANES, PanelProduct, Store, round_up, row_stride};
use super::propagation::{BATCH, LayerShape, Propagation};
use pulp::{Arch, Simd, WithSimd};

/// Accumulators of JᵀJ and Jᵀe.
#[derive(Clone, Debug)]
pub(super) struct NormalMatrix {
    arch: Arch,
    layers: Vec<LayerShape>,
    outputs: usize,
    pairs: Vec<Pair>,
    /// Sums of all pairs, panel by panel.
    sums: Vec<f64>,
    /// δ_k by sample, shape `[BATCH][outputs][node_stride(width)]`, zero-padded.
    by_sample: Vec<Vec<f64>>,
    /// The panel `[(i, j)][s]`.
    left: Vec<f64>,
    /// The panel `[s][(p, q)]`.
    right: Vec<f64>,
}

/// One panel of sums.
#[derive(Clone, Copy, Debug)]
struct Pair {
    first: usize,
    second: Second,
    /// Rows of the panel: pairs (i, j), or i alone.
    rows: usize,
    /// Columns of the panel: pairs (p, q), or p alone; a multiple of [`LANES`].
    columns: usize,
    /// Start of the panel in the sums.
    start: usize,
}

/// The factor that layer `first` is combined with.
#[derive(Clone, Copy, Debug)]
enum Second {
    /// A layer: a block of JᵀJ.
    Layer(usize),
    /// The residuals: a segment of Jᵀe.
    Residuals,
}

impl NormalMatrix {
    pub(super) fn new(layers: &[LayerShape], outputs: usize, arch: Arch) -> Self {
        let triangle = |n: usize| n * (n + 1) / 2;
        let mut pairs = Vec::new();
        let mut start = 0;
        for (k, a) in layers.iter().enumerate() {
            let mut push = |second, rows, columns| {
                let columns = round_up(columns);
                pairs.push(Pair { first: k, second, rows, columns, start });
                start += rows * columns;
            };
            push(Second::Residuals, a.inputs + 1, a.width);
            push(Second::Layer(k), triangle(a.inputs + 1), triangle(a.width));
            for (l, b) in layers.iter().enumerate().skip(k + 1) {
                let rows = (a.inputs + 1) * (b.inputs + 1);
                push(Second::Layer(l), rows, a.width * b.width);
            }
        }
        let rows = pairs.iter().map(|pair| pair.rows).max().unwrap_or(0);
        let columns = pairs.iter().map(|pair| panel_stride(pair.columns)).max().unwrap_or(0);
        let by_sample = |layer: &LayerShape| vec![0.0; BATCH * outputs * node_stride(layer.width)];
        Self {
            arch,
            layers: layers.to_vec(),
            outputs,
            sums: vec![0.0; start],
            pairs,
            by_sample: layers.iter().map(by_sample).collect(),
            left: vec![0.0; rows * BATCH],
            right: vec![0.0; columns * BATCH],
        }
    }

    /// Clears all sums.
    pub(super) fn clear(&mut self) {
        self.sums.fill(0.0);
    }

    /// Adds the first `samples` of a batch after its forward and backward pass; `residuals` has
    /// shape `[outputs][BATCH]`.
    pub(super) fn add(&mut self, batch: &Propagation, residuals: &[f64], samples: usize) {
        for (k, layer) in self.layers.iter().enumerate() {
            let target = &mut self.by_sample[k];
            sample_major(batch.sensitivities(k), self.outputs, layer.width, target);
        }
        for pair in &self.pairs {
            let k = pair.first;
            let stride = panel_stride(pair.columns);
            let (right, first) = (&mut self.right[..], &self.by_sample[k][..]);
            let width = self.layers[k].width;
            let left = match pair.second {
                Second::Residuals => {
                    self.arch.dispatch(WeightedSensitivities {
                        sensitivities: first,
                        residuals,
                        width,
                        right,
                        stride,
                    });
                    batch.inputs(k)
                }
                Second::Layer(l) => {
                    self.arch.dispatch(InputProducts {
                        first: batch.inputs(k),
                        second: batch.inputs(l),
                        symmetric: k == l,
                        left: &mut self.left,
                    });
                    self.arch.dispatch(SensitivityProducts {
                        factors: [first, &self.by_sample[l]],
                        widths: [width, self.layers[l].width],
                        symmetric: k == l,
                        outputs: self.outputs,
                        right,
                        stride,
                    });
                    &self.left
                }
            };
            self.arch.dispatch(PanelProduct {
                left: &left.as_chunks::<BATCH>().0[..pair.rows],
                terms: samples,
                panel: &self.right,
                panel_stride: stride,
                columns: pair.columns,
                output: &mut self.sums[pair.start..],
                output_stride: pair.columns,
                store: Store::Add,
            });
        }
    }

    /// Writes `scale · JᵀJ` (upper triangle, row-major, shape `[parameters][parameters]`) and
    /// `scale · Jᵀe` (shape `[parameters]`).
    pub(super) fn write(&self, scale: f64, hessian: &mut [f64], gradient: &mut [f64]) {
        let parameters = gradient.len();
        for pair in &self.pairs {
            let a = &self.layers[pair.first];
            let mut rows = self.sums[pair.start..].chunks_exact(pair.columns);
            let mut next_row = || rows.next().unwrap_or(&[]);
            match pair.second {
                Second::Residuals => {
                    for i in 0..=a.inputs {
                        let target = &mut gradient[a.offset + i * a.width..][..a.width];
                        for (target, sum) in target.iter_mut().zip(next_row()) {
                            *target = scale * sum;
                        }
                    }
                }
                Second::Layer(l) if l == pair.first => {
                    for i in 0..=a.inputs {
                        for j in i..=a.inputs {
                            let corner = [a.offset + i * a.width, a.offset + j * a.width];
                            let block = &mut hessian[corner[0] * parameters + corner[1]..];
                            write_symmetric(block, parameters, a.width, scale, next_row());
                        }
                    }
                }
                Second::Layer(l) => {
                    let b = &self.layers[l];
                    for i in 0..=a.inputs {
                        for j in 0..=b.inputs {
                            let row = next_row();
                            for p in 0..a.width {
                                let start = (a.offset + i * a.width + p) * parameters;
                                let start = start + b.offset + j * b.width;
                                let target = &mut hessian[start..][..b.width];
                                for (target, sum) in target.iter_mut().zip(&row[p * b.width..]) {
                                    *target = scale * sum;
                                }
                            }
                        }
                    }
                }
            }
        }
    }
}

/// Writes a symmetric block from its packed upper triangle. For a block on the diagonal of the
/// matrix, its lower triangle goes to a part that is never read.
fn write_symmetric(block: &mut [f64], stride: usize, width: usize, scale: f64, packed: &[f64]) {
    let mut packed = packed.iter();
    for p in 0..width {
        for (q, sum) in (p..width).zip(&mut packed) {
            block[p * stride + q] = scale * sum;
            block[q * stride + p] = scale * sum;
        }
    }
}

/// Row length of a panel `[s][(p, q)]`, with room for one more vector, because rows are written in
/// whole vectors.
const fn panel_stride(columns: usize) -> usize {
    row_stride(columns + LANES)
}

/// Row length of δ by sample, so that whole vectors can be read from any node on.
const fn node_stride(width: usize) -> usize {
    round_up(width) + LANES
}

/// Converts `[width][outputs][BATCH]` to `[BATCH][outputs][node_stride(width)]`.
fn sample_major(source: &[f64], outputs: usize, width: usize, target: &mut [f64]) {
    let stride = node_stride(width);
    let (rows, _) = source.as_chunks::<BATCH>();
    for (s, target) in target.chunks_exact_mut(outputs * stride).enumerate() {
        for (o, target) in target.chunks_exact_mut(stride).enumerate() {
            for (p, target) in target[..width].iter_mut().enumerate() {
                *target = rows[p * outputs + o][s];
            }
        }
    }
}

/// `left[(i, j)][s] = first[i][s] · second[j][s]`, for j ≥ i only if symmetric.
struct InputProducts<'a> {
    first: &'a [f64],
    second: &'a [f64],
    symmetric: bool,
    left: &'a mut [f64],
}

impl WithSimd for InputProducts<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let (first, _) = self.first.as_chunks::<BATCH>();
        let (second, _) = self.second.as_chunks::<BATCH>();
        let mut targets = self.left.as_chunks_mut::<BATCH>().0.iter_mut();
        for (i, a) in first.iter().enumerate() {
            let from = if self.symmetric { i } else { 0 };
            for (b, target) in second[from..].iter().zip(&mut targets) {
                for s in 0..BATCH {
                    target[s] = a[s] * b[s];
                }
            }
        }
    }
}

/// `right[s][(p, q)] = Σ_o first[s][o][p] · second[s][o][q]`, for q ≥ p only if symmetric.
///
/// Rows are written in whole vectors. Elements beyond the last q belong to the next p, which is
/// written later, or are padding.
struct SensitivityProducts<'a> {
    factors: [&'a [f64]; 2],
    widths: [usize; 2],
    symmetric: bool,
    outputs: usize,
    right: &'a mut [f64],
    stride: usize,
}

impl WithSimd for SensitivityProducts<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        // As a constant, the number of outputs keeps the rows of `second` in registers.
        match self.outputs {
            1 => self.all_samples::<S, 1>(simd),
            2 => self.all_samples::<S, 2>(simd),
            3 => self.all_samples::<S, 3>(simd),
            4 => self.all_samples::<S, 4>(simd),
            5 => self.all_samples::<S, 5>(simd),
            6 => self.all_samples::<S, 6>(simd),
            7 => self.all_samples::<S, 7>(simd),
            8 => self.all_samples::<S, 8>(simd),
            9 => self.all_samples::<S, 9>(simd),
            10 => self.all_samples::<S, 10>(simd),
            11 => self.all_samples::<S, 11>(simd),
            12 => self.all_samples::<S, 12>(simd),
            _ => self.many_outputs(simd),
        }
    }
}

impl SensitivityProducts<'_> {
    #[inline(always)]
    #[allow(clippy::needless_range_loop, reason = "indices as in the formula")]
    fn all_samples<S: Simd, const OUTPUTS: usize>(self, simd: S) {
        let strides = self.widths.map(node_stride);
        let samples = self.factors[0]
            .chunks_exact(OUTPUTS * strides[0])
            .zip(self.factors[1].chunks_exact(OUTPUTS * strides[1]))
            .zip(self.right.chunks_exact_mut(self.stride));
        for ((first, second), right) in samples {
            let first: [&[f64]; OUTPUTS] =
                core::array::from_fn(|o| &first[o * strides[0]..][..self.widths[0]]);
            let second: [&[f64]; OUTPUTS] =
                core::array::from_fn(|o| &second[o * strides[1]..][..strides[1]]);
            if self.symmetric {
                let mut start = 0;
                for p in 0..self.widths[0] {
                    let factors = core::array::from_fn(|o| simd.splat_f64s(first[o][p]));
                    let count = self.widths[1] - p;
                    for lane in (0..count).step_by(S::F64_LANES) {
                        let values = load(simd, second, p + lane);
                        store_dot(simd, factors, values, right, start + lane);
                    }
                    start += count;
                }
            } else {
                // From the last vector to the first, so that the next p is written later.
                let vectors = self.widths[1].div_ceil(S::F64_LANES);
                for lane in (0..vectors).rev().map(|v| v * S::F64_LANES) {
                    let values = load(simd, second, lane);
                    for p in 0..self.widths[0] {
                        let factors = core::array::from_fn(|o| simd.splat_f64s(first[o][p]));
                        store_dot(simd, factors, values, right, p * self.widths[1] + lane);
                    }
                }
            }
        }
    }
}

impl SensitivityProducts<'_> {
    /// As [`Self::all_samples`], with the same sums in the same order, for more outputs than registers hold.
    #[inline(always)]
    fn many_outputs<S: Simd>(self, simd: S) {
        let strides = self.widths.map(node_stride);
        let samples = self.factors[0]
            .chunks_exact(self.outputs * strides[0])
            .zip(self.factors[1].chunks_exact(self.outputs * strides[1]))
            .zip(self.right.chunks_exact_mut(self.stride));
        for ((first, second), right) in samples {
            let mut start = 0;
            for p in 0..self.widths[0] {
                let from = if self.symmetric { p } else { 0 };
                for q in (from..self.widths[1]).step_by(S::F64_LANES) {
                    let product = |o: usize| {
                        let values = &second[o * strides[1] + q..][..S::F64_LANES];
                        let factor = simd.splat_f64s(first[o * strides[0] + p]);
                        simd.mul_f64s(factor, S::as_simd_f64s(values).0[0])
                    };
                    let mut sum = product(0);
                    for o in 1..self.outputs {
                        sum = simd.add_f64s(sum, product(o));
                    }
                    let target = &mut right[start + q - from..][..S::F64_LANES];
                    S::as_mut_simd_f64s(target).0[0] = sum;
                }
                start += self.widths[1] - from;
            }
        }
    }
}

/// Loads one vector from each row.
#[inline(always)]
fn load<S: Simd, const OUTPUTS: usize>(
    _: S,
    rows: [&[f64]; OUTPUTS],
    start: usize,
) -> [S::f64s; OUTPUTS] {
    core::array::from_fn(|o| S::as_simd_f64s(&rows[o][start..][..S::F64_LANES]).0[0])
}

/// Computes `target[start..] = Σ_o factors[o] · values[o]` for one vector.
#[inline(always)]
fn store_dot<S: Simd, const OUTPUTS: usize>(
    simd: S,
    factors: [S::f64s; OUTPUTS],
    values: [S::f64s; OUTPUTS],
    target: &mut [f64],
    start: usize,
) {
    let mut sum = simd.mul_f64s(factors[0], values[0]);
    for o in 1..OUTPUTS {
        sum = simd.add_f64s(sum, simd.mul_f64s(factors[o], values[o]));
    }
    S::as_mut_simd_f64s(&mut target[start..][..S::F64_LANES]).0[0] = sum;
}

/// `right[s][p] = Σ_o sensitivities[s][o][p] · residuals[o][s]`.
struct WeightedSensitivities<'a> {
    sensitivities: &'a [f64],
    residuals: &'a [f64],
    width: usize,
    right: &'a mut [f64],
    stride: usize,
}

impl WithSimd for WeightedSensitivities<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let node_stride = node_stride(self.width);
        let (residuals, _) = self.residuals.as_chunks::<BATCH>();
        let samples = self.sensitivities.chunks_exact(residuals.len() * node_stride);
        let targets = self.right.chunks_exact_mut(self.stride);
        for (s, (sensitivities, target)) in samples.zip(targets).enumerate() {
            let target = &mut target[..round_up(self.width)];
            target.fill(0.0);
            for (row, residuals) in sensitivities.chunks_exact(node_stride).zip(residuals) {
                for (target, value) in target.iter_mut().zip(row) {
                    *target += residuals[s] * value;
                }
            }
        }
    }
}
