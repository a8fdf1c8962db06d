//! Forward and backward pass of one batch of samples in f64.
//!
//! ```text
//! a_0 = x,   z_k = W_kᵀ a_(k−1) + b_k,   a_k = φ_k(z_k),   f̂ = Wᵀ a_ell
//! δ_ell^o = φ'(z_ell) ∘ W[:, o],   δ_k^o = φ'(z_k) ∘ (W_(k+1) δ_(k+1)^o)
//! ```
//!
//! `δ_k^o` is the derivative of output o with respect to `z_k`, so the derivative with respect to
//! weight (i, p) of layer k is `a_(k−1)[i] δ_k^o[p]`, with `a[−1] = 1` for biases.
//!
//! Cost per sample: one multiplication and one addition per parameter forward, `outputs` times that
//! backward.
//!
//! Invariants: quantity-major rows with one f64 for each of [`BATCH`] samples, so that a vector
//! holds neighbouring samples and each sample's sums run in the order above.

pub(super) use super::activation::BATCH;
use super::activation::{Activate, ApplySlopes};
use super::panel_product::{PanelProduct, Store, round_up};
use agent_core::math::activation::Activation;
use agent_core::observer::network::{Architecture, LAYER_WIDTH_MAX};
use pulp::Arch;

/// Row length of weights as the left factor of a product: the largest number of inputs of a node,
/// plus the bias, in whole cache lines.
const WEIGHT_ROW: usize = round_up(LAYER_WIDTH_MAX + 1);

/// Shape of a layer and position of its parameters.
#[derive(Clone, Copy, Debug)]
pub(super) struct LayerShape {
    /// Number of inputs, without the constant 1 of the bias.
    pub(super) inputs: usize,
    /// Number of nodes.
    pub(super) width: usize,
    /// Index of the layer's first parameter.
    pub(super) offset: usize,
    activation: Activation,
}

/// Returns the layers of an architecture with their offsets in the flat parameters.
pub(super) fn layer_shapes(architecture: &Architecture) -> Vec<LayerShape> {
    let mut offset = 0;
    let shape = |(inputs, layer): (usize, agent_core::observer::network::Layer)| {
        let width = usize::from(layer.width);
        let shape = LayerShape { inputs, width, offset, activation: layer.activation };
        offset += (inputs + 1) * width;
        shape
    };
    architecture.shapes().map(shape).collect()
}

/// One batch passing through the network.
#[derive(Clone, Debug)]
pub(super) struct Propagation {
    arch: Arch,
    layers: Vec<LayerShape>,
    outputs: usize,
    /// Outer weights, shape `[L][outputs]`.
    outer: Vec<f64>,
    /// Outer weights transposed, shape `[outputs][L]`.
    outer_by_output: Vec<[f64; WEIGHT_ROW]>,
    /// Incoming weights of each node of each layer, bias first: shape `[width][1 + inputs]`.
    entering: Vec<Vec<[f64; WEIGHT_ROW]>>,
    /// Outgoing weights of each input of each layer: shape `[inputs][width]`.
    leaving: Vec<Vec<[f64; WEIGHT_ROW]>>,
    /// Inputs of layer k with a leading row of ones, `[1 + inputs][BATCH]`; the last entry holds
    /// the features.
    inputs: Vec<Vec<f64>>,
    /// z_k, `[width][BATCH]`.
    pre_activations: Vec<Vec<f64>>,
    /// δ_k, `[width][outputs][BATCH]`.
    sensitivities: Vec<Vec<f64>>,
    /// f̂, `[outputs][BATCH]`.
    estimates: Vec<f64>,
}

impl Propagation {
    /// Creates the pass for outer weights of shape `[L][outputs]`, row-major.
    pub(super) fn new(architecture: &Architecture, outer: &[f64], arch: Arch) -> Self {
        let layers = layer_shapes(architecture);
        let features = architecture.features();
        let outputs = outer.len() / features;
        let mut inputs: Vec<Vec<f64>> =
            layers.iter().map(|layer| vec![1.0; (1 + layer.inputs) * BATCH]).collect();
        inputs.push(vec![1.0; (1 + features) * BATCH]);
        let rows =
            |count: usize| layers.iter().map(|layer| vec![0.0; layer.width * count]).collect();
        Self {
            arch,
            outputs,
            outer: outer.to_vec(),
            outer_by_output: padded_columns(outer, outputs),
            entering: vec![Vec::new(); layers.len()],
            leaving: vec![Vec::new(); layers.len()],
            inputs,
            pre_activations: rows(BATCH),
            sensitivities: rows(outputs * BATCH),
            estimates: vec![0.0; outputs * BATCH],
            layers,
        }
    }

    /// Sets the flat parameters.
    pub(super) fn set_parameters(&mut self, parameters: &[f64]) {
        for (k, layer) in self.layers.iter().enumerate() {
            let rows = &parameters[layer.offset..][..(1 + layer.inputs) * layer.width];
            let weights = &rows[layer.width..];
            self.entering[k] = padded_columns(rows, layer.width);
            self.leaving[k] = weights.chunks_exact(layer.width).map(padded).collect();
        }
    }

    /// Computes f̂, shape `[outputs][BATCH]`, of a batch of inputs, shape `[inputs][BATCH]`.
    pub(super) fn forward(&mut self, batch: &[f64]) -> &[f64] {
        self.inputs[0][BATCH..].copy_from_slice(batch);
        for (k, layer) in self.layers.iter().enumerate() {
            let (head, tail) = self.inputs.split_at_mut(k + 1);
            let pre_activation = &mut self.pre_activations[k][..];
            self.arch.dispatch(PanelProduct {
                left: &self.entering[k],
                terms: 1 + layer.inputs,
                panel: &head[k],
                panel_stride: BATCH,
                columns: BATCH,
                output: pre_activation,
                output_stride: BATCH,
                store: Store::Set,
            });
            let values = &mut tail[0][BATCH..];
            self.arch.dispatch(Activate { activation: layer.activation, pre_activation, values });
        }
        self.arch.dispatch(PanelProduct {
            left: &self.outer_by_output,
            terms: self.outer.len() / self.outputs,
            panel: &self.inputs[self.layers.len()][BATCH..],
            panel_stride: BATCH,
            columns: BATCH,
            output: &mut self.estimates,
            output_stride: BATCH,
            store: Store::Set,
        });
        &self.estimates
    }

    /// Computes the sensitivities for the batch of the last [`Self::forward`]; read them with
    /// [`Self::sensitivities`].
    pub(super) fn backward(&mut self) {
        for (k, layer) in self.layers.iter().enumerate().rev() {
            let (head, tail) = self.sensitivities.split_at_mut(k + 1);
            let target = &mut head[k];
            let columns = self.outputs * BATCH;
            if let Some(next) = self.layers.get(k + 1) {
                self.arch.dispatch(PanelProduct {
                    left: &self.leaving[k + 1],
                    terms: next.width,
                    panel: &tail[0],
                    panel_stride: columns,
                    columns,
                    output: target,
                    output_stride: columns,
                    store: Store::Set,
                });
            } else {
                for (rows, outer) in target.chunks_exact_mut(BATCH).zip(&self.outer) {
                    rows.fill(*outer);
                }
            }
            self.arch.dispatch(ApplySlopes {
                activation: layer.activation,
                pre_activation: &self.pre_activations[k],
                values: &self.inputs[k + 1][BATCH..],
                sensitivities: target,
                columns,
            });
        }
    }

    /// Returns the inputs of layer k with a leading row of ones, shape `[1 + inputs][BATCH]`.
    pub(super) fn inputs(&self, k: usize) -> &[f64] {
        &self.inputs[k]
    }

    /// Returns the sensitivities of layer k, shape `[width][outputs][BATCH]`.
    pub(super) fn sensitivities(&self, k: usize) -> &[f64] {
        &self.sensitivities[k]
    }
}

/// Pads a row of weights with zeros to the fixed length.
fn padded(row: &[f64]) -> [f64; WEIGHT_ROW] {
    core::array::from_fn(|i| row.get(i).copied().unwrap_or(0.0))
}

/// Returns the columns of a row-major matrix as padded rows.
fn padded_columns(matrix: &[f64], columns: usize) -> Vec<[f64; WEIGHT_ROW]> {
    let entry = |i: usize, c: usize| matrix.get(i * columns + c).copied().unwrap_or(0.0);
    (0..columns).map(|c| core::array::from_fn(|i| entry(i, c))).collect()
}
