//! What is wrong with a file of arrays, and how to hint it.

use std::fmt;
use std::io;
use std::path::{Path, PathBuf};

use agent_core::math::activation::Activation;
use agent_core::observer::network::{INNER_LAYERS_MAX, NetworkError};

use super::{FILE_BYTES_MAX, FileKind};
use crate::files::output::OutputError;

/// Why a network cannot be read from or written to a file: file, array, problem and hint, in
/// one line of text.
///
/// ``net.npz: array `layer2.weight` has shape [4, 2], expected [width 1 to 64, inputs 4];
/// transpose it, …``
#[derive(Debug, thiserror::Error)]
#[error("{}: {problem}", path.display())]
pub struct TensorError {
    /// The file, as it was named.
    pub path: PathBuf,
    /// What is wrong with it.
    #[source]
    pub problem: TensorProblem,
}

/// What can be wrong with a file of arrays. Indices count from 0, as in NumPy; layers from 1,
/// as in the names.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TensorProblem {
    /// The name promises no known format.
    #[error(
        "ends in neither .npz nor .safetensors; give the file the ending of the format that it has"
    )]
    Extension,
    /// The system cannot read the file.
    #[error("{0}; check the path and the permission to read it")]
    Read(#[source] io::Error),
    /// The system cannot write the file.
    #[error("{0}; make sure that the folder can be written to and the disk is not full")]
    Write(#[source] io::Error),
    /// Something else is there.
    #[error("is not replaced: {0}")]
    Refused(#[source] OutputError),
    /// The file is larger than any network.
    #[error(
        "is larger than {FILE_BYTES_MAX} bytes, more than any network takes; save only the inner layers and the outer weights"
    )]
    FileSize,
    /// The file as a whole does not have its format.
    #[error("is not a readable {kind} file: {reason}; write it with {}", kind.writer())]
    Format {
        /// The format that the name promises.
        kind: FileKind,
        /// What the reader stumbled over.
        reason: String,
    },
    /// An array does not have the `.npy` format.
    #[error("array `{array}` cannot be read: {reason}; save it again with numpy.savez")]
    Array {
        /// Its name.
        array: String,
        /// What the reader stumbled over.
        reason: String,
    },
    /// Two arrays have the same name.
    #[error("holds array `{array}` twice; keep one of them")]
    Twice {
        /// Their name.
        array: String,
    },
    /// A layer is given in both orientations.
    #[error("holds both `{weight}` and `{kernel}`; keep one of them")]
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
        /// Its name.
        array: String,
        /// What stands before the names of the other arrays.
        prefix: String,
    },
    /// A part of the network is not there.
    #[error("has no array `{array}`, it has {}; add the array, or give it this name", list(found))]
    Missing {
        /// The array's name.
        array: String,
        /// The names that there are.
        found: Vec<String>,
    },
    /// A layer has a number that no layer can have.
    #[error(
        "array `{array}` belongs to no layer from 1 to {INNER_LAYERS_MAX}; number the layers from 1 and leave out what is beyond {INNER_LAYERS_MAX}"
    )]
    LayerNumber {
        /// Its name.
        array: String,
    },
    /// An array has the wrong shape.
    #[error(
        "array `{array}` has shape {found:?}, expected {}; {}",
        shape(expected),
        shape_mend(found, expected)
    )]
    Shape {
        /// Its name.
        array: String,
        /// Its shape.
        found: Vec<usize>,
        /// What each dimension must be.
        expected: Vec<Extent>,
    },
    /// An array has elements of a type that is not read.
    #[error(
        "array `{array}` holds {found}, expected little-endian float32 or float64; convert it to float32"
    )]
    ElementType {
        /// Its name.
        array: String,
        /// The type, as the file calls it.
        found: String,
    },
    /// A value is infinite or not a number.
    #[error(
        "array `{array}` holds {value} at {index:?}, expected finite numbers; train the network again or repair the value"
    )]
    NotFinite {
        /// The array's name.
        array: String,
        /// Where in the array.
        index: Vec<usize>,
        /// The value.
        value: f64,
    },
    /// A float64 value is too large for float32.
    #[error(
        "array `{array}` holds {value:e} at {index:?}, beyond the largest float32, {:e}; scale the network so that its weights are smaller",
        f32::MAX
    )]
    OutOfRange {
        /// The array's name.
        array: String,
        /// Where in the array.
        index: Vec<usize>,
        /// The value.
        value: f64,
    },
    /// The file names an activation that the core does not have.
    #[error(
        "activation `{name}` is unknown, expected one of {}; train the network with one of these",
        known_activations()
    )]
    UnknownActivation {
        /// The name.
        name: String,
    },
    /// There are neither one activation nor as many as layers.
    #[error(
        "{found} activations for {layers} inner layers; give one for all layers or one for each"
    )]
    ActivationCount {
        /// How many were given.
        found: usize,
        /// How many layers there are.
        layers: usize,
    },
    /// The caller asks for other activations than the file states.
    #[error(
        "was written for the activations {stated}, asked for are {asked}; leave the choice to the file, or correct the file"
    )]
    ActivationsDiffer {
        /// What the file states, one a layer.
        stated: String,
        /// What the caller asks for, one a layer.
        asked: String,
    },
    /// The inner parameters to be written do not fit the architecture.
    #[error("{0}; write the parameters of this architecture")]
    Network(#[source] NetworkError),
    /// The outer weights to be written do not fit the architecture.
    #[error("{found} outer weights, the architecture has {expected}; write features times inputs")]
    OuterCount {
        /// The number given.
        found: usize,
        /// Features times inputs.
        expected: usize,
    },
    /// An outer weight to be written is infinite or not a number.
    #[error("outer weight {index} is not finite; write finite weights")]
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

/// What one dimension of an array must be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Extent {
    /// This many.
    Exactly(&'static str, usize),
    /// From one to this many.
    UpTo(&'static str, usize),
}

impl Extent {
    /// Whether a dimension of this size will do.
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

/// Whether an array of shape `found` is what `expected` asks for.
pub(super) fn fits(found: &[usize], expected: &[Extent]) -> bool {
    found.len() == expected.len()
        && found.iter().zip(expected).all(|(&found, expected)| expected.admits(found))
}

fn shape(expected: &[Extent]) -> String {
    let extents: Vec<String> = expected.iter().map(Extent::to_string).collect();
    format!("[{}]", extents.join(", "))
}

fn shape_mend(found: &[usize], expected: &[Extent]) -> &'static str {
    let transposed: Vec<usize> = found.iter().rev().copied().collect();
    if found.len() == 2 && fits(&transposed, expected) {
        "transpose it, or exchange .weight and .kernel in its name"
    } else {
        "save the array of a network with these sizes"
    }
}

/// The names of all activations.
fn known_activations() -> String {
    Activation::NAMES.map(|(name, _)| name).join(", ")
}

/// Names in a sentence, the first few of them.
fn list(names: &[String]) -> String {
    const SHOWN: usize = 20;
    let shown: Vec<String> = names.iter().take(SHOWN).map(|name| format!("`{name}`")).collect();
    match names.len() {
        0 => "none".to_owned(),
        all if all > SHOWN => format!("{} and {} more", shown.join(", "), all - SHOWN),
        _ => shown.join(", "),
    }
}
