//! Errors of network files: what is wrong, and how to fix it.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

use agent_core::math::activation::Activation;
use agent_core::observer::network::{INNER_LAYERS_MAX, NetworkError};

use super::{FILE_BYTES_MAX, FileKind};
use crate::files::output::OutputError;

/// Why a network cannot be read from or written to a file. Formatted as one line: file, array,
/// problem and hint.
///
/// ``net.npz: array `layer2.weight` has shape [4, 2], expected [width 1 to 64, inputs 4];
/// transpose it, …``
#[derive(Debug, thiserror::Error)]
#[error("{}: {problem}", path.display())]
pub struct TensorError {
    /// The file, as the user named it.
    pub path: PathBuf,
    /// What is wrong.
    #[source]
    pub problem: TensorProblem,
}

/// What is wrong with a network file. Indices count from 0, as in NumPy; layers from 1, as in the
/// names.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TensorProblem {
    /// The file name has no known extension.
    #[error(
        "unknown file extension; use .npz or .safetensors, according to the format of the file"
    )]
    Extension,
    /// The file cannot be read.
    #[error("{0}; check the path and its read permission")]
    Read(#[source] io::Error),
    /// The file cannot be written.
    #[error("{0}; check that the folder is writable and the disk is not full")]
    Write(#[source] io::Error),
    /// A file of another kind exists at the path.
    #[error("not overwritten: {0}")]
    Refused(#[source] OutputError),
    /// The file is larger than any network.
    #[error(
        "larger than {FILE_BYTES_MAX} bytes, more than any network needs; save only the inner layers and the outer weights"
    )]
    FileSize,
    /// The file does not have the format of its extension.
    #[error("not a valid {kind} file: {reason}; write it with {}", kind.writer())]
    Format {
        /// The format of the extension.
        kind: FileKind,
        /// The reason.
        reason: String,
    },
    /// An array is not in `.npy` format.
    #[error("array `{array}` cannot be read: {reason}; save it again with numpy.savez")]
    Array {
        /// Name of the array.
        array: String,
        /// The reason.
        reason: String,
    },
    /// Two arrays have the same name.
    #[error("contains array `{array}` twice; keep one of them")]
    Twice {
        /// Name of the arrays.
        array: String,
    },
    /// A layer is given in both orientations.
    #[error("contains both `{weight}` and `{kernel}`; keep one of them")]
    BothOrientations {
        /// The array of shape `[outputs, inputs]`.
        weight: String,
        /// The array of shape `[inputs, outputs]`.
        kernel: String,
    },
    /// An array is not part of a network.
    #[error(
        "array `{array}` is not part of a network, expected `{prefix}layer1.weight`, `{prefix}layer1.bias` and so on up to `{prefix}outer.weight`; rename it or leave it out"
    )]
    Unexpected {
        /// Name of the array.
        array: String,
        /// Common prefix of the names.
        prefix: String,
    },
    /// A part of the network is missing.
    #[error("missing array `{array}` (found: {}); add or rename the array", list(found))]
    Missing {
        /// Name of the array.
        array: String,
        /// The names found.
        found: Vec<String>,
    },
    /// A layer number is out of range.
    #[error(
        "array `{array}` does not belong to a layer from 1 to {INNER_LAYERS_MAX}; number the layers from 1 and use at most {INNER_LAYERS_MAX}"
    )]
    LayerNumber {
        /// Name of the array.
        array: String,
    },
    /// An array has the wrong shape.
    #[error(
        "array `{array}` has shape {found:?}, expected {}; {}",
        shape(expected),
        shape_hint(found, expected)
    )]
    Shape {
        /// Name of the array.
        array: String,
        /// Its shape.
        found: Vec<usize>,
        /// The expected dimensions.
        expected: Vec<Extent>,
    },
    /// An array has an unsupported element type.
    #[error(
        "array `{array}` contains {found}, expected little-endian float32 or float64; convert it to float32"
    )]
    ElementType {
        /// Name of the array.
        array: String,
        /// The type, as named in the file.
        found: String,
    },
    /// A value is infinite or NaN.
    #[error(
        "array `{array}` contains {value} at {index:?}, expected finite numbers; train the network again or correct the value"
    )]
    NotFinite {
        /// Name of the array.
        array: String,
        /// Index in the array.
        index: Vec<usize>,
        /// The value.
        value: f64,
    },
    /// A float64 value is too large for float32.
    #[error(
        "array `{array}` contains {value:e} at {index:?}, beyond the largest float32, {:e}; scale the network so that its weights are smaller",
        f32::MAX
    )]
    OutOfRange {
        /// Name of the array.
        array: String,
        /// Index in the array.
        index: Vec<usize>,
        /// The value.
        value: f64,
    },
    /// The file names an unsupported activation.
    #[error(
        "unknown activation `{name}`, expected one of {}; train the network with one of these",
        known_activations()
    )]
    UnknownActivation {
        /// The name.
        name: String,
    },
    /// The number of activations is neither one nor the number of layers.
    #[error(
        "{found} activations for {layers} inner layers; pass one for all layers or one per layer"
    )]
    ActivationCount {
        /// Number of activations given.
        found: usize,
        /// Number of layers.
        layers: usize,
    },
    /// The caller requests activations other than those the file states.
    #[error(
        "the file states the activations {stated}, but {asked} were requested; use those of the file, or correct the file"
    )]
    ActivationsDiffer {
        /// The activations in the file, one per layer.
        stated: String,
        /// The activations requested, one per layer.
        asked: String,
    },
    /// The inner parameters to write do not match the architecture.
    #[error("{0}; pass the parameters of this architecture")]
    Network(#[source] NetworkError),
    /// The outer weights to write do not match the architecture.
    #[error(
        "{found} outer weights, but the architecture has {expected}; pass features times inputs"
    )]
    OuterCount {
        /// The number given.
        found: usize,
        /// Features times inputs.
        expected: usize,
    },
    /// An outer weight to write is infinite or NaN.
    #[error("outer weight {index} is not finite; pass finite weights")]
    OuterNotFinite {
        /// Index of the weight, row by row.
        index: usize,
    },
}

impl TensorProblem {
    pub(super) fn of(self, path: &Path) -> TensorError {
        TensorError { path: path.to_owned(), problem: self }
    }
}

/// The expected size of one dimension of an array.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Extent {
    /// This many.
    Exactly(&'static str, usize),
    /// From one to this many.
    UpTo(&'static str, usize),
}

impl Extent {
    /// Whether a dimension may have this size.
    #[must_use]
    pub fn admits(self, found: usize) -> bool {
        match self {
            Self::Exactly(_, expected) => found == expected,
            Self::UpTo(_, most) => (1..=most).contains(&found),
        }
    }
}

impl fmt::Display for Extent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Exactly(meaning, expected) => write!(f, "{meaning} {expected}"),
            Self::UpTo(meaning, most) => write!(f, "{meaning} 1 to {most}"),
        }
    }
}

/// Whether an array of shape `found` matches `expected`.
pub(super) fn fits(found: &[usize], expected: &[Extent]) -> bool {
    found.len() == expected.len()
        && found.iter().zip(expected).all(|(&found, expected)| expected.admits(found))
}

fn shape(expected: &[Extent]) -> String {
    let extents: Vec<String> = expected.iter().map(Extent::to_string).collect();
    format!("[{}]", extents.join(", "))
}

fn shape_hint(found: &[usize], expected: &[Extent]) -> &'static str {
    let transposed: Vec<usize> = found.iter().rev().copied().collect();
    if found.len() == 2 && fits(&transposed, expected) {
        "transpose it, or swap .weight and .kernel in its name"
    } else {
        "save a network with these sizes"
    }
}

/// The names of all activations.
fn known_activations() -> String {
    Activation::NAMES.map(|(name, _)| name).join(", ")
}

/// Lists the first few names.
fn list(names: &[String]) -> String {
    const SHOWN: usize = 20;
    let shown: Vec<String> = names.iter().take(SHOWN).map(|name| format!("`{name}`")).collect();
    match names.len() {
        0 => "none".to_owned(),
        all if all > SHOWN => format!("{} and {} more", shown.join(", "), all - SHOWN),
        _ => shown.join(", "),
    }
}
