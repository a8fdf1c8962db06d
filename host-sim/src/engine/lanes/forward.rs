//! A network evaluated for [`LANES`] inputs at once, one in each lane of a vector.
//!
//! ```text
//! sum[p][lane]    = b[p][lane] + Σ_i w[i][p][lane] a[i][lane]      i ascending
//! output[p][lane] = φ(sum[p][lane])
//! ```
//!
//! Every lane does the operations of [`InnerNetwork::features`], in their order: the bias first, then the
//! inputs in ascending order, each with a rounded multiplication and then a rounded addition, then the same
//! activation function, whose branches become selections. No operation is fused, and none mixes lanes, so a
//! lane has the bits that the network gives on its own; only which NaN it is can differ.
//!
//! Cost: one multiplication and one addition of vectors for each parameter, in tiles whose sums stay in
//! registers. Parameters that all lanes share are broadcast from one copy; others are stored by parameter,
//! then by lane, in 64 bytes each.
//!
//! [`InnerNetwork::features`]: agent_core::observer::network::InnerNetwork::features

use agent_core::math::activation::{Activation, TANH_SMALL_BELOW, tanh_above, tanh_below};
use agent_core::observer::network::{Architecture, LAYER_WIDTH_MAX};
use pulp::{Arch, Scalar128b, Simd, WithSimd};

/// Inputs that are evaluated at once: the `f32` lanes of the longest vector.
pub(super) const LANES: usize = 16;

/// A number for each lane.
pub(super) type Row = [f32; LANES];

/// Working memory: the outputs of two layers.
#[derive(Clone, Debug)]
pub(super) struct LaneScratch {
    first: [Row; LAYER_WIDTH_MAX],
    second: [Row; LAYER_WIDTH_MAX],
}

impl Default for LaneScratch {
    fn default() -> Self {
        let rows = [[0.0; LANES]; LAYER_WIDTH_MAX];
        Self { first: rows, second: rows }
    }
}

/// A parameter of a network in every lane.
pub(super) trait Parameter: Copy {
    /// Returns the lanes of vector number `vector`.
    fn lanes<S: Simd>(&self, simd: S, vector: usize) -> S::f32s;
}

/// The same in all lanes.
impl Parameter for f32 {
    #[inline(always)]
    fn lanes<S: Simd>(&self, simd: S, _: usize) -> S::f32s {
        simd.splat_f32s(*self)
    }
}

impl Parameter for Row {
    #[inline(always)]
    fn lanes<S: Simd>(&self, _: S, vector: usize) -> S::f32s {
        S::as_simd_f32s(self).0[vector]
    }
}

/// One evaluation.
pub(super) struct Forward<'a, P> {
    pub(super) architecture: &'a Architecture,
    /// As many as the architecture requires, in its order.
    pub(super) parameters: &'a [P],
    /// One for each input of the network.
    pub(super) inputs: &'a [Row],
    /// Lanes in use, the first ones; the others can have any outputs.
    pub(super) count: usize,
    /// The features of one lane after the other, shape `[count][L]`.
    pub(super) features: &'a mut [f32],
    pub(super) scratch: &'a mut LaneScratch,
}

impl<P: Parameter> Forward<'_, P> {
    /// Evaluates the network with these instructions.
    pub(super) fn evaluate(self, arch: Arch) {
        match arch {
            // Vectors of four, which every processor with 64 bits has.
            Arch::Scalar => self.with_simd(Scalar128b),
            arch => arch.dispatch(self),
        }
    }
}

impl<P: Parameter> WithSimd for Forward<'_, P> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { architecture, mut parameters, inputs, count, features, scratch } = self;
        let vectors = count.min(LANES).div_ceil(S::F32_LANES);
        let LaneScratch { first, second } = scratch;
        let (mut source, mut target) = (first, second);
        let mut width_before = None;
        for layer in architecture.layers() {
            let width = usize::from(layer.width);
            let inputs = match width_before {
                None => inputs,
                Some(width) => &source[..width],
            };
            let (own, rest) = parameters.split_at(width * (inputs.len() + 1));
            let outputs = &mut target[..width];
            for vector in 0..vectors {
                affine(simd, own, inputs, outputs, vector);
            }
            activate(simd, layer.activation, outputs);
            parameters = rest;
            width_before = Some(width);
            core::mem::swap(&mut source, &mut target);
        }
        let width = width_before.unwrap_or_default();
        for (lane, features) in features.chunks_exact_mut(width).take(count).enumerate() {
            for (feature, outputs) in features.iter_mut().zip(&source[..width]) {
                *feature = outputs[lane];
            }
        }
    }
}

/// Applies the activation function to every element.
#[inline(always)]
fn activate<S: Simd>(simd: S, activation: Activation, rows: &mut [Row]) {
    // One mask then tells about all lanes.
    if S::F32_LANES == LANES && activation == Activation::Tanh {
        for row in rows {
            tanh(simd, row);
        }
    } else {
        activation.apply_inlined(rows.as_flattened_mut());
    }
}

/// Applies tanh. Agents of one plant have similar estimates, so most rows need only one of its forms.
#[inline(always)]
fn tanh<S: Simd>(simd: S, row: &mut Row) {
    let bits = simd.transmute_u32s_f32s(S::as_simd_f32s(row).0[0]);
    let magnitude = simd.and_u32s(bits, simd.splat_u32s(i32::MAX as u32));
    let is_small = simd.less_than_u32s(magnitude, simd.splat_u32s(TANH_SMALL_BELOW.to_bits()));
    if simd.first_true_m32s(is_small) >= LANES {
        for value in row {
            *value = tanh_above(*value);
        }
    } else if simd.first_true_m32s(simd.not_m32s(is_small)) >= LANES {
        for value in row {
            *value = tanh_below(*value);
        }
    } else {
        Activation::Tanh.apply_inlined(row);
    }
}

/// Computes vector number `vector` of `outputs = biases + weights^T inputs`.
#[inline(always)]
fn affine<S: Simd, P: Parameter>(
    simd: S,
    parameters: &[P],
    inputs: &[Row],
    outputs: &mut [Row],
    vector: usize,
) {
    let width = outputs.len();
    // Changes nothing, but shows the compiler that a row has this vector.
    let vector = vector % (LANES / S::F32_LANES);
    let mut first = 0;
    while first < width {
        let tile = Tile { parameters: &parameters[first..], width, inputs, vector };
        let outputs = &mut outputs[first..];
        // Twelve sums, an input and a parameter fit into 16 registers.
        first += match outputs.len() {
            12.. => tile.compute::<S, 12>(simd, outputs),
            5.. => tile.compute::<S, 5>(simd, outputs),
            2.. => tile.compute::<S, 2>(simd, outputs),
            _ => tile.compute::<S, 1>(simd, outputs),
        };
    }
}

/// Some nodes of a layer, in one vector.
struct Tile<'a, P> {
    /// From the bias of the first node on.
    parameters: &'a [P],
    /// Number of nodes in the layer.
    width: usize,
    inputs: &'a [Row],
    vector: usize,
}

impl<P: Parameter> Tile<'_, P> {
    /// Computes the first `NODES` outputs; returns `NODES`.
    #[inline(always)]
    #[allow(clippy::needless_range_loop, reason = "indices as in the formula; unrolled as meant")]
    fn compute<S: Simd, const NODES: usize>(self, simd: S, outputs: &mut [Row]) -> usize {
        let Self { mut parameters, width, inputs, vector } = self;
        let mut sums = [simd.splat_f32s(0.0); NODES];
        for node in 0..NODES {
            sums[node] = parameters[..NODES][node].lanes(simd, vector);
        }
        for input in inputs {
            parameters = &parameters[width..];
            let weights = &parameters[..NODES];
            let input = input.lanes(simd, vector);
            for node in 0..NODES {
                let product = simd.mul_f32s(weights[node].lanes(simd, vector), input);
                sums[node] = simd.add_f32s(sums[node], product);
            }
        }
        let outputs = &mut outputs[..NODES];
        for node in 0..NODES {
            S::as_mut_simd_f32s(&mut outputs[node]).0[vector] = sums[node];
        }
        NODES
    }
}
