//! The inner deep network: `sigma(Phi_hat(x_hat))` of `Observer i`.
//!
//! `a_0 = x_hat`, `a_q = phi_q(W_q^T a_(q-1) + b_q)` for the inner layers
//! `q = 1..=ell` (equation `Phi func`, with the activation after the affine map); the
//! outputs of the last inner layer are the features `sigma` that the outer weights combine.
//!
//! Cost: one multiplication and one addition per weight, one activation per node. Memory: the
//! parameters, wherever they are stored, and [`Scratch`].
//!
//! Invariants: an [`InnerNetwork`] always has exactly the parameters its [`Architecture`] requires,
//! all finite. Every sum starts with the bias and adds the inputs in ascending order, whatever the
//! width, so the bits depend on neither padding nor vector length.
//!
//! The parameters are one flat sequence, layer by layer: first the `width` biases, then the weights
//! in row-major order, one row of `width` weights per input of the layer (`W_q` of the paper).

use serde::{Deserialize, Serialize};

use crate::INPUTS_MAX;
use crate::activation::Activation;

/// Largest number of inner layers.
pub const INNER_LAYERS_MAX: usize = 8;
/// Largest number of nodes in an inner layer.
pub const LAYER_WIDTH_MAX: usize = 64;

/// One inner layer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Layer {
    /// Nodes, 1 to [`LAYER_WIDTH_MAX`].
    pub width: u8,
    /// Activation applied to every node's weighted sum.
    pub activation: Activation,
}

impl Layer {
    /// Fills the unused entries of [`Architecture`].
    const NONE: Self = Self { width: 0, activation: Activation::Tanh };
}

/// Input dimension and inner layers of a network.
///
/// 18 bytes, copied without a loop, because a node builds a network from it in every step.
///
/// ```
/// use inner_network::activation::Activation;
/// use inner_network::network::{Architecture, Layer};
///
/// let layer = |width| Layer { width, activation: Activation::Tanh };
/// let architecture = Architecture::new(3, &[layer(10), layer(5)])?;
/// assert_eq!(architecture.features(), 5);
/// assert_eq!(architecture.parameter_count(), (3 + 1) * 10 + (10 + 1) * 5);
/// # Ok::<(), inner_network::network::NetworkError>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Architecture {
    inputs: u8,
    count: u8,
    /// The first `count` entries are the layers; the rest are [`Layer::NONE`].
    layers: [Layer; INNER_LAYERS_MAX],
}

/// Why a network is invalid.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum NetworkError {
    /// The input dimension is not in 1..=[`INPUTS_MAX`].
    Inputs {
        /// The dimension given.
        found: usize,
    },
    /// The number of inner layers is not in 1..=[`INNER_LAYERS_MAX`].
    LayerCount {
        /// The number given.
        found: usize,
    },
    /// A layer's width is not in 1..=[`LAYER_WIDTH_MAX`].
    Width {
        /// Index of the layer, from 0.
        layer: usize,
        /// The width given.
        found: usize,
    },
    /// The number of parameters does not match the architecture.
    ParameterCount {
        /// The number the architecture requires.
        expected: usize,
        /// The number given.
        found: usize,
    },
    /// A parameter is infinite or not a number.
    NotFinite {
        /// Index of the parameter, from 0.
        index: usize,
    },
}

impl core::fmt::Display for NetworkError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match *self {
            Self::Inputs { found } => {
                write!(f, "{found} network inputs, expected 1 to {INPUTS_MAX}")
            }
            Self::LayerCount { found } => {
                write!(f, "{found} inner layers, expected 1 to {INNER_LAYERS_MAX}")
            }
            Self::Width { layer, found } => {
                write!(f, "inner layer {layer} has {found} nodes, expected 1 to {LAYER_WIDTH_MAX}")
            }
            Self::ParameterCount { expected, found } => {
                write!(f, "{found} inner parameters, expected {expected}")
            }
            Self::NotFinite { index } => write!(f, "inner parameter {index} is not finite"),
        }
    }
}

impl core::error::Error for NetworkError {}

impl Architecture {
    /// Creates an architecture with `inputs` state components and the inner `layers`.
    ///
    /// # Errors
    /// [`NetworkError::Inputs`], [`NetworkError::LayerCount`] or [`NetworkError::Width`].
    pub fn new(inputs: usize, layers: &[Layer]) -> Result<Self, NetworkError> {
        let inputs_checked = u8::try_from(inputs)
            .ok()
            .filter(|&i| (1..=INPUTS_MAX).contains(&usize::from(i)))
            .ok_or(NetworkError::Inputs { found: inputs })?;
        let count = NetworkError::LayerCount { found: layers.len() };
        if layers.is_empty() {
            return Err(count);
        }
        for (layer, &Layer { width, .. }) in layers.iter().enumerate() {
            let found = usize::from(width);
            if !(1..=LAYER_WIDTH_MAX).contains(&found) {
                return Err(NetworkError::Width { layer, found });
            }
        }
        let mut places = [Layer::NONE; INNER_LAYERS_MAX];
        places.get_mut(..layers.len()).ok_or(count)?.copy_from_slice(layers);
        Ok(Self { inputs: inputs_checked, count: layers.len() as u8, layers: places })
    }

    /// Returns the number of inputs, which is the state dimension.
    #[must_use]
    pub fn inputs(&self) -> usize {
        usize::from(self.inputs)
    }

    /// Returns the inner layers, first to last.
    #[must_use]
    pub fn layers(&self) -> &[Layer] {
        self.layers.get(..usize::from(self.count)).unwrap_or_default()
    }

    /// Returns the width of the last inner layer: the paper's L, the rows of the outer weights.
    #[must_use]
    pub fn features(&self) -> usize {
        self.layers().last().map_or(0, |layer| usize::from(layer.width))
    }

    /// Returns the length of the flat parameter sequence.
    #[must_use]
    pub fn parameter_count(&self) -> usize {
        self.shapes().map(|(inputs, layer)| (inputs + 1) * usize::from(layer.width)).sum()
    }

    /// Returns `(inputs, layer)` for each layer, first to last.
    pub fn shapes(&self) -> impl Iterator<Item = (usize, Layer)> + '_ {
        self.layers().iter().scan(self.inputs(), |inputs, &layer| {
            let shape = (*inputs, layer);
            *inputs = usize::from(layer.width);
            Some(shape)
        })
    }
}

/// The inner network with its parameters stored in `S`: a flash slice, a static buffer, or a heap
/// vector on the host.
///
/// ```
/// use inner_network::network::Scratch;
/// use inner_network::activation::Activation;
/// use inner_network::network::{Architecture, InnerNetwork, Layer};
///
/// let layers = [Layer { width: 1, activation: Activation::Tanh }];
/// let architecture = Architecture::new(2, &layers)?;
/// // One bias, then one weight per input.
/// let network = InnerNetwork::new(architecture, [0.0, 1.0, -1.0])?;
///
/// let mut scratch = Scratch::NEW;
/// assert_eq!(network.features(&[4.0, 4.0], &mut scratch), Some(&[0.0][..]));
/// assert_eq!(network.features(&[4.0], &mut scratch), None); // the wrong length
/// # Ok::<(), inner_network::network::NetworkError>(())
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct InnerNetwork<S> {
    architecture: Architecture,
    parameters: S,
}

impl<S: AsRef<[f32]>> InnerNetwork<S> {
    /// Creates a network from an architecture and its parameters.
    ///
    /// # Errors
    /// [`NetworkError::ParameterCount`] or [`NetworkError::NotFinite`].
    pub fn new(architecture: Architecture, parameters: S) -> Result<Self, NetworkError> {
        let values = parameters.as_ref();
        let expected = architecture.parameter_count();
        if values.len() != expected {
            return Err(NetworkError::ParameterCount { expected, found: values.len() });
        }
        match values.iter().position(|value| !value.is_finite()) {
            Some(index) => Err(NetworkError::NotFinite { index }),
            None => Ok(Self { architecture, parameters }),
        }
    }

    /// Creates a network from parameters whose count and finiteness have already been checked.
    pub fn verified(architecture: Architecture, parameters: S) -> Self {
        Self { architecture, parameters }
    }

    /// Returns the widths and activations.
    #[must_use]
    pub fn architecture(&self) -> &Architecture {
        &self.architecture
    }

    /// Returns the flat parameter sequence.
    #[must_use]
    pub fn parameters(&self) -> &[f32] {
        self.parameters.as_ref()
    }

    /// Computes `sigma(Phi_hat(x))`, shape `[L]`, in `scratch`.
    ///
    /// Returns `None` if `x` does not have the length the architecture requires.
    pub fn features<'s>(&self, x: &[f32], scratch: &'s mut Scratch) -> Option<&'s [f32]> {
        features(&self.architecture, self.parameters.as_ref(), x, scratch)
    }
}

/// Evaluates a network. Not generic, so that it is compiled in this crate and at its optimisation
/// level, whatever the level of the firmware that calls it.
#[inline(never)]
fn features<'s>(
    architecture: &Architecture,
    mut parameters: &[f32],
    x: &[f32],
    scratch: &'s mut Scratch,
) -> Option<&'s [f32]> {
    if x.len() != architecture.inputs() {
        return None;
    }
    let (mut source, mut target) = (&mut scratch.first, &mut scratch.second);
    // The outputs of the layer before in `source`; the first layer reads `x` itself.
    let mut width_before = None;
    for layer in architecture.layers() {
        let width = usize::from(layer.width);
        let inputs = match width_before {
            None => x,
            Some(width) => source.get(..width)?,
        };
        let (own, rest) = parameters.split_at_checked(width * (inputs.len() + 1))?;
        // Present: `Architecture` bounds the width.
        let outputs = target.get_mut(..width)?;
        affine(own, inputs, outputs)?;
        layer.activation.apply(outputs);
        parameters = rest;
        width_before = Some(width);
        core::mem::swap(&mut source, &mut target);
    }
    source.get(..width_before?)
}

/// Working memory for the outputs of two layers during evaluation.
#[derive(Clone, Debug)]
pub struct Scratch {
    first: [f32; LAYER_WIDTH_MAX],
    second: [f32; LAYER_WIDTH_MAX],
}

impl Scratch {
    /// Empty scratch memory, for a `static`.
    pub const NEW: Self = Self { first: [0.0; LAYER_WIDTH_MAX], second: [0.0; LAYER_WIDTH_MAX] };

    /// Returns room for the features of a basis other than a network.
    pub fn outputs(&mut self) -> &mut [f32; LAYER_WIDTH_MAX] {
        &mut self.first
    }
}

/// Computes `outputs = biases + weights^T inputs` for the first layer in `parameters`; `None` if
/// there are too few.
///
/// Up to twelve sums at a time stay in registers and give a vector unit independent lanes; each
/// adds in the same order as a plain loop. The paper's widths each have their own function, in
/// which rows are contiguous; all other widths share [`wide`].
#[inline(always)]
fn affine(parameters: &[f32], inputs: &[f32], outputs: &mut [f32]) -> Option<()> {
    match outputs.len() {
        12 => narrow::<12>(parameters, inputs, outputs.first_chunk_mut()?),
        5 => narrow::<5>(parameters, inputs, outputs.first_chunk_mut()?),
        _ => wide(parameters, inputs, outputs)?,
    }
    Some(())
}

/// A layer of `WIDTH` nodes, in one block. Not inlined: inlined side by side, the widths would
/// compete for registers.
#[inline(never)]
fn narrow<const WIDTH: usize>(parameters: &[f32], inputs: &[f32], outputs: &mut [f32; WIDTH]) {
    let Some((biases, rows)) = parameters.split_first_chunk::<WIDTH>() else { return };
    let mut sums = *biases;
    let (rows, _) = rows.as_chunks::<WIDTH>();
    for (row, &input) in rows.iter().zip(inputs) {
        add_row(&mut sums, row, input);
    }
    *outputs = sums;
}

/// A layer of any width, in blocks.
#[inline(never)]
fn wide(parameters: &[f32], inputs: &[f32], outputs: &mut [f32]) -> Option<()> {
    let width = outputs.len();
    let mut first = 0;
    while first < width {
        let (parameters, outputs) = (parameters.get(first..)?, outputs.get_mut(first..)?);
        first += match outputs.len() {
            12.. => block::<12>(parameters, width, inputs, outputs)?,
            4.. => block::<4>(parameters, width, inputs, outputs)?,
            _ => block::<1>(parameters, width, inputs, outputs)?,
        };
    }
    Some(())
}

/// Computes the first `LANES` of `outputs` in a layer whose rows have `width` weights; returns
/// `LANES`.
#[inline(always)]
fn block<const LANES: usize>(
    parameters: &[f32],
    width: usize,
    inputs: &[f32],
    outputs: &mut [f32],
) -> Option<usize> {
    let mut rows = parameters;
    let mut sums = *rows.first_chunk::<LANES>()?;
    for &input in inputs {
        rows = rows.get(width..)?;
        add_row(&mut sums, rows.first_chunk()?, input);
    }
    *outputs.first_chunk_mut()? = sums;
    Some(LANES)
}

/// Adds `row * input` to `sums`.
#[inline(always)]
fn add_row<const LANES: usize>(sums: &mut [f32; LANES], row: &[f32; LANES], input: f32) {
    for lane in 0..LANES {
        sums[lane] += row[lane] * input;
    }
}
