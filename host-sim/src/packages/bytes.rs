//! A package's bytes: they begin on a multiple of four, as in a node's flash, and can be shared.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use agent_core::observer::network::{Architecture, InnerNetwork};
use agent_core::package::signature::{PublicKey, verify};
use agent_core::package::{Envelope, NetworkPlace, Package, PackageError, signature_block};

use crate::files::input::{is_too_large, read_limited};
use crate::files::output::{FileKind, OutputError, write_whole};
use crate::signing::OperatorKey;

/// Longest file that is read as a package: beyond the largest network of all. \[bytes\]
const LENGTH_MAX: u64 = 1 << 20;

/// Bytes that decode as a package.
#[derive(Clone, PartialEq)]
pub struct PackageBytes {
    words: Arc<[u32]>,
    length: usize,
    place: NetworkPlace,
}

/// Why a package file cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PackageFileError {
    /// The file cannot be read.
    #[error("{}: cannot be read: {error}; give the path of a weight package", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's error.
        error: std::io::Error,
    },
    /// The file is too long for any package.
    #[error(
        "{}: has more than {LENGTH_MAX} bytes, which no package has; give the path of a weight package",
        path.display()
    )]
    TooLong {
        /// The file.
        path: PathBuf,
    },
    /// It is no package.
    #[error("{}: {error}; copy it again, or train again", path.display())]
    Package {
        /// The file.
        path: PathBuf,
        /// What the core says.
        error: PackageError,
    },
}

/// The content of a file that may be a package.
///
/// # Errors
/// A file that cannot be read, or that is longer than any package.
pub fn read_file(path: &Path) -> Result<Vec<u8>, PackageFileError> {
    let path = path.to_owned();
    read_limited(&path, LENGTH_MAX).map_err(|error| match is_too_large(&error) {
        true => PackageFileError::TooLong { path },
        false => PackageFileError::Read { path, error },
    })
}

impl PackageBytes {
    /// The kind of its files.
    pub const KIND: FileKind =
        FileKind { name: "a weight package", recognises: |bytes| Self::new(bytes).is_ok() };

    /// Takes a copy of `bytes` if they decode as a package.
    ///
    /// # Errors
    /// What [`Package::decode`] refuses, but for the alignment, which the copy has.
    pub fn new(bytes: &[u8]) -> Result<Self, PackageError> {
        let mut words = vec![0u32; bytes.len().div_ceil(4)];
        bytemuck::cast_slice_mut(&mut words)[..bytes.len()].copy_from_slice(bytes);
        let length = bytes.len();
        let copy = &bytemuck::cast_slice(&words)[..length];
        let package = Package::decode(copy)?;
        let place = NetworkPlace::new(&package, copy).ok_or(PackageError::Malformed)?;
        Ok(Self { words: words.into(), length, place })
    }

    /// Reads a file.
    ///
    /// # Errors
    /// See [`PackageFileError`].
    pub fn load(path: &Path) -> Result<Self, PackageFileError> {
        Self::new(&read_file(path)?)
            .map_err(|error| PackageFileError::Package { path: path.to_owned(), error })
    }

    /// Writes the file whole, or leaves what was there; another package is replaced, anything else
    /// is not.
    ///
    /// # Errors
    /// See [`OutputError`].
    pub fn save(&self, path: &Path) -> Result<(), OutputError> {
        write_whole(path, Self::KIND, |file| file.write_all(self.as_bytes()))
    }

    /// The bytes.
    #[must_use]
    pub fn as_bytes(&self) -> &[u8] {
        &bytemuck::cast_slice(&self.words)[..self.length]
    }

    /// The package that they hold.
    ///
    /// # Panics
    /// Never: they were decoded when this was made.
    #[must_use]
    pub fn package(&self) -> Package<'_> {
        Package::decode(self.as_bytes()).expect("bytes that decoded before")
    }

    /// The inner network with its parameters in place.
    ///
    /// # Panics
    /// Never: the place was found when this was made.
    #[must_use]
    pub fn network(&self) -> InnerNetwork<PackageParameters> {
        let parameters = PackageParameters(self.clone());
        InnerNetwork::new(self.architecture().clone(), parameters).expect("a decoded network")
    }

    /// The same package with a signature by this key, in place of any other.
    ///
    /// # Panics
    /// Never: signing changes no byte of the package.
    #[must_use]
    pub fn signed(&self, key: &OperatorKey) -> Self {
        let envelope = Envelope::open(self.as_bytes()).expect("bytes that decoded before");
        let signature = key.sign(envelope.signed_part);
        let bytes = [envelope.signed_part, &signature_block(&signature)].concat();
        Self::new(&bytes).expect("a package with a signature of the right length")
    }

    /// The same package under another version, without its signature and its permission to replace
    /// newer ones, both of which hold for one version only.
    ///
    /// # Panics
    /// Never: every version has the same length.
    #[must_use]
    pub fn renumbered(&self, version: u32) -> Self {
        let package = Package { version, replaces: None, ..self.package() };
        // Without a signature it is not longer; a number may take a few bytes more.
        let mut buffer = vec![0; self.length + 64];
        let length = package.encode(&mut buffer).expect("a package that was encoded before");
        Self::new(&buffer[..length]).expect("a package that decoded under another version")
    }

    /// Whether there is a signature by the private half of `key`.
    #[must_use]
    pub fn is_signed_by(&self, key: &PublicKey) -> bool {
        Envelope::open(self.as_bytes()).is_ok_and(|envelope| {
            envelope
                .signature
                .is_some_and(|signature| verify(key, envelope.signed_part, signature).is_ok())
        })
    }

    /// Whether there is a signature, by whomever.
    #[must_use]
    pub fn is_signed(&self) -> bool {
        Envelope::open(self.as_bytes()).is_ok_and(|envelope| envelope.signature.is_some())
    }

    /// Widths and activations.
    #[must_use]
    pub fn architecture(&self) -> &Architecture {
        self.place.architecture()
    }
}

impl std::fmt::Debug for PackageBytes {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let package = self.package();
        write!(
            f,
            "PackageBytes({} bytes: agent {}, version {})",
            self.length, package.node.agent, package.version
        )
    }
}

/// The inner parameters in a package, kept alive by whoever works with them.
#[derive(Clone, Debug, PartialEq)]
pub struct PackageParameters(PackageBytes);

impl AsRef<[f32]> for PackageParameters {
    #[inline]
    fn as_ref(&self) -> &[f32] {
        self.0.place.parameters(self.0.as_bytes()).unwrap_or(&[])
    }
}
