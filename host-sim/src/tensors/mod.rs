//! Imports and exports networks of PyTorch, JAX and NumPy as `.npz` and `.safetensors`.
//!
//! `docs/tensors.md` lists the names and shapes of the arrays. A file contains the inner layers
//! (`W_q`, `b_q` of equation `Phi func`) and the outer weights `W_hat` in either orientation; in
//! memory both have the core's orientation, one row per input.
//!
//! | module | purpose |
//! | --- | --- |
//! | `names` | array names: their part of the network and orientation |
//! | `activations` | activation names, and the precedence of file and caller |
//! | `array` | one array: element type, order, rounding to float32 |
//! | `npz`, `npy`, `safetensors` | the formats |
//!
//! Cost: one copy each of the file, at most [`FILE_BYTES_MAX`], and the network in memory.
//!
//! Invariants: the arrays that [`read`] returns match their architecture and contain only finite
//! values; no input makes it panic or allocate more than a small multiple of [`FILE_BYTES_MAX`].
//! `read` returns the bits that [`write`](fn@write) was given.

mod activations;
mod array;
mod error;
mod names;
mod npy;
mod npz;
mod safetensors;

use std::fmt;
use std::io;
use std::path::Path;

use agent_core::observer::network::{Architecture, InnerNetwork};

pub use activations::{Activations, ActivationsSource};
pub use array::Rounding;
pub use error::{Extent, TensorError, TensorProblem};

use crate::files::input::{is_too_large, read_limited};
use crate::files::output::{FileKind as OutputKind, OutputError, write_whole};

/// Size limit of a file, in bytes. The largest network (8 layers of 64 nodes) takes 0.28 MB in
/// float64; the rest is room for headers and comments.
pub const FILE_BYTES_MAX: u64 = 4 << 20;

/// An inner network with its outer weights, as arrays.
#[derive(Clone, Debug, PartialEq)]
pub struct NetworkArrays {
    /// Inputs, widths and activations.
    pub architecture: Architecture,
    /// The inner parameters in the core's order ([`agent_core::observer::network`]), shape
    /// `[parameter_count]`.
    pub inner: Vec<f32>,
    /// `W_hat` row by row, shape `[features][inputs]`: the state has as many components as the
    /// network has inputs.
    pub outer: Vec<f32>,
}

/// Supported file formats.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FileKind {
    /// NumPy's archive of arrays, compressed or not.
    Npz,
    /// The format of the safetensors library.
    Safetensors,
}

/// Details of an import.
#[derive(Clone, Debug, PartialEq)]
pub struct ImportReport {
    /// Format of the file.
    pub kind: FileKind,
    /// Common prefix of the names (`model.`), usually empty.
    pub prefix: String,
    /// Source of the activations.
    pub activations: ActivationsSource,
    /// The value with the largest rounding error from float64 to float32; `None` if all values are
    /// unchanged.
    pub rounding: Option<Rounding>,
}

impl FileKind {
    /// Returns the format for the extension of a file name.
    ///
    /// # Errors
    /// [`TensorProblem::Extension`].
    pub fn of(path: &Path) -> Result<Self, TensorError> {
        let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
        [Self::Npz, Self::Safetensors]
            .into_iter()
            .find(|kind| extension.eq_ignore_ascii_case(kind.extension()))
            .ok_or_else(|| TensorProblem::Extension.of(path))
    }

    /// Returns the file extension, without the dot.
    #[must_use]
    pub fn extension(self) -> &'static str {
        match self {
            Self::Npz => "npz",
            Self::Safetensors => "safetensors",
        }
    }

    /// Returns the kind of file that a network may replace: another network.
    #[must_use]
    pub fn output_kind(self) -> OutputKind {
        match self {
            Self::Npz => OutputKind {
                name: "a network (.npz)",
                recognises: |bytes| from_bytes(Self::Npz, bytes, Activations::FromFile).is_ok(),
            },
            Self::Safetensors => OutputKind {
                name: "a network (.safetensors)",
                recognises: |bytes| {
                    from_bytes(Self::Safetensors, bytes, Activations::FromFile).is_ok()
                },
            },
        }
    }

    /// Returns the Python function that writes such files.
    fn writer(self) -> &'static str {
        match self {
            Self::Npz => "numpy.savez",
            Self::Safetensors => "safetensors.numpy.save_file",
        }
    }
}

impl fmt::Display for FileKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, ".{}", self.extension())
    }
}

/// Reads a network. `activations` selects the activations of the layers, or leaves the choice to
/// the file.
///
/// # Errors
/// A [`TensorError`] with the file, the array, the problem and the hint.
pub fn read(
    path: &Path,
    activations: Activations,
) -> Result<(NetworkArrays, ImportReport), TensorError> {
    let kind = FileKind::of(path)?;
    let bytes = read_bytes(path).map_err(|problem| problem.of(path))?;
    from_bytes(kind, &bytes, activations).map_err(|problem| problem.of(path))
}

/// Writes a network atomically; the extension of `path` selects the format.
///
/// # Errors
/// If the arrays do not match their architecture, contain a value that is not finite, or cannot be
/// written.
pub fn write(path: &Path, arrays: &NetworkArrays) -> Result<(), TensorError> {
    let kind = FileKind::of(path)?;
    let bytes = to_bytes(kind, arrays).map_err(|problem| problem.of(path))?;
    write_whole(path, kind.output_kind(), |file| file.write_all(&bytes)).map_err(|failed| {
        match failed {
            OutputError::Write { error, .. } => TensorProblem::Write(error),
            refused => TensorProblem::Refused(refused),
        }
        .of(path)
    })
}

/// The contents of a file, independent of its format.
struct Contents<'f> {
    arrays: Vec<array::StoredArray<'f>>,
    /// Names of the activations, one per layer or one for all.
    activations: Option<Vec<String>>,
}

fn read_bytes(path: &Path) -> Result<Vec<u8>, TensorProblem> {
    read_limited(path, FILE_BYTES_MAX).map_err(|error| match is_too_large(&error) {
        true => TensorProblem::FileSize,
        false => TensorProblem::Read(error),
    })
}

/// Reads a network from the bytes of a file.
///
/// # Errors
/// A [`TensorProblem`] with the array, the problem and the hint.
pub fn from_bytes(
    kind: FileKind,
    bytes: &[u8],
    activations: Activations,
) -> Result<(NetworkArrays, ImportReport), TensorProblem> {
    let contents = match kind {
        FileKind::Npz => npz::read(bytes),
        FileKind::Safetensors => safetensors::read(bytes),
    }?;
    let parts = names::assemble(contents.arrays)?;
    let stated = contents.activations.as_deref();
    let (functions, source) = activations.resolve(stated, parts.widths.len())?;
    let architecture = parts.architecture(&functions)?;
    let report =
        ImportReport { kind, prefix: parts.prefix, activations: source, rounding: parts.rounding };
    Ok((NetworkArrays { architecture, inner: parts.inner, outer: parts.outer }, report))
}

/// Returns the bytes of a file with this network; they depend on the network only.
///
/// # Errors
/// [`TensorProblem::Network`], [`TensorProblem::OuterCount`] or
/// [`TensorProblem::OuterNotFinite`].
pub fn to_bytes(kind: FileKind, arrays: &NetworkArrays) -> Result<Vec<u8>, TensorProblem> {
    let NetworkArrays { architecture, inner, outer } = arrays;
    InnerNetwork::new(architecture.clone(), inner).map_err(TensorProblem::Network)?;
    let expected = architecture.features() * architecture.inputs();
    if outer.len() != expected {
        return Err(TensorProblem::OuterCount { found: outer.len(), expected });
    }
    if let Some(index) = outer.iter().position(|value| !value.is_finite()) {
        return Err(TensorProblem::OuterNotFinite { index });
    }
    let named = names::disassemble(arrays);
    let functions = activations::names_of(architecture);
    match kind {
        FileKind::Npz => npz::write(&named, &functions),
        FileKind::Safetensors => safetensors::write(&named, &functions),
    }
    .map_err(|reason| TensorProblem::Write(io::Error::other(reason)))
}

#[cfg(test)]
mod tests;
