//! Networks that PyTorch, JAX or NumPy trained come in, ours go out: `.npz` and `.safetensors`.
//!
//! `docs/tensors.md` lists the names and shapes of the arrays. A file holds the inner layers
//! (`W_q`, `b_q` of equation `Phi func`) and the outer weights `W_hat` in either orientation; in
//! memory both are as the core reads them, one row for each input.
//!
//! | module | what it knows |
//! | --- | --- |
//! | `names` | which array is which part of a network, and in which orientation |
//! | `activations` | the names of the activations, and whose word counts |
//! | `array` | one array: element type, order, rounding to float32 |
//! | `npz`, `npy`, `safetensors` | the formats |
//!
//! Cost: the file, at most [`FILE_BYTES_MAX`], and the network, once each in memory.
//!
//! Invariants: what [`read`] returns has the shapes of its architecture and no value that is
//! infinite or not a number; no bytes make it panic or allocate more than a small multiple of
//! [`FILE_BYTES_MAX`]. `read` returns the bits that [`write`](fn@write) was given.

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

/// Largest file that is read, in bytes. The largest network (8 layers of 64 nodes) takes
/// 0.28 MB in float64; the rest is room for headers and comments.
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

/// The formats that are read and written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FileKind {
    /// NumPy's archive of arrays, compressed or not.
    Npz,
    /// The format of the safetensors library.
    Safetensors,
}

/// What an import did besides copying.
#[derive(Clone, Debug, PartialEq)]
pub struct ImportReport {
    /// The file's format.
    pub kind: FileKind,
    /// What stood before every name (`model.`), often nothing.
    pub prefix: String,
    /// Who said which activations the layers have.
    pub activations: ActivationsSource,
    /// The value that rounding from float64 to float32 changed most; `None` if every value is
    /// as it was in the file.
    pub rounding: Option<Rounding>,
}

impl FileKind {
    /// The format that the name of a file promises.
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

    /// How the names of such files end, without the dot.
    #[must_use]
    pub fn extension(self) -> &'static str {
        match self {
            Self::Npz => "npz",
            Self::Safetensors => "safetensors",
        }
    }

    /// Files that a network may take the place of: other networks.
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

    /// The Python function that writes such files.
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

/// Reads a network. `activations` says which functions the layers apply, or leaves that to the
/// file.
///
/// # Errors
/// A [`TensorError`] that names the file, the array, what is wrong with it and the hint.
pub fn read(
    path: &Path,
    activations: Activations,
) -> Result<(NetworkArrays, ImportReport), TensorError> {
    let kind = FileKind::of(path)?;
    let bytes = read_bytes(path).map_err(|problem| problem.of(path))?;
    from_bytes(kind, &bytes, activations).map_err(|problem| problem.of(path))
}

/// Writes a network whole or not at all; `path` decides the format.
///
/// # Errors
/// A [`TensorError`] if the arrays do not fit their architecture, hold a value that is not
/// finite, or cannot be written.
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

/// What a file holds, whatever its format.
struct Contents<'f> {
    arrays: Vec<array::StoredArray<'f>>,
    /// Names of the activations, one a layer or one for all.
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
/// A [`TensorProblem`] that names the array, what is wrong with it and the hint.
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

/// The bytes of a file with this network: the same for the same network.
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
