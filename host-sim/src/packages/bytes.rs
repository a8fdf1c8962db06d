//! The bytes of a package: aligned to four bytes, as in a node's flash, and shared.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use agent_core::observer::network::Architecture;
use agent_core::package::signature::{PublicKey, verify};
use agent_core::package::{
    CHECKED_FIRST, EncodeError, Envelope, Format, HEADER2_LENGTH, Package, PackageError, Serial,
    check_digest, set_serial, signature_block,
};

use super::encode::encode;
use crate::files::input::{is_too_large, read_limited};
use crate::files::output::{FileKind, OutputError, write_whole};
use crate::signing::OperatorKey;

/// Maximum size of a package file: more than the largest network needs. \[bytes\]
const LENGTH_MAX: u64 = 1 << 20;

/// Bytes that decode as a package.
#[derive(Clone, PartialEq)]
pub struct PackageBytes {
    words: Arc<[u32]>,
    length: usize,
    architecture: Architecture,
}

/// Why a package file cannot be loaded.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PackageFileError {
    /// The file cannot be read.
    #[error("{}: cannot read: {error}; give the path of a weight package", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's error.
        error: std::io::Error,
    },
    /// The file is too long for any package.
    #[error(
        "{}: larger than {LENGTH_MAX} bytes, so not a weight package; give the path of a weight package",
        path.display()
    )]
    TooLong {
        /// The file.
        path: PathBuf,
    },
    /// The file is not a valid package.
    #[error("{}: {error}; copy it again, or train again", path.display())]
    Package {
        /// The file.
        path: PathBuf,
        /// The core's error.
        error: PackageError,
    },
}

/// Returns the content of a file that may be a package.
///
/// # Errors
/// If the file cannot be read or is longer than any package.
pub fn read_file(path: &Path) -> Result<Vec<u8>, PackageFileError> {
    let path = path.to_owned();
    read_limited(&path, LENGTH_MAX).map_err(|error| match is_too_large(&error) {
        true => PackageFileError::TooLong { path },
        false => PackageFileError::Read { path, error },
    })
}

impl PackageBytes {
    /// The file kind of packages.
    pub const KIND: FileKind =
        FileKind { name: "a weight package", recognises: |bytes| Self::new(bytes).is_ok() };

    /// Copies `bytes` if they are a valid package.
    ///
    /// # Errors
    /// Same as [`Package::decode`], except for the alignment, which the copy ensures.
    pub fn new(bytes: &[u8]) -> Result<Self, PackageError> {
        let mut words = vec![0u32; bytes.len().div_ceil(4)];
        bytemuck::cast_slice_mut(&mut words)[..bytes.len()].copy_from_slice(bytes);
        let length = bytes.len();
        let copy = &bytemuck::cast_slice(&words)[..length];
        let envelope = Envelope::open(copy)?;
        check_digest(&envelope)?;
        let package = Package::from_envelope(&envelope)?;
        let architecture = package.network.architecture().clone();
        Ok(Self { words: words.into(), length, architecture })
    }

    /// Reads a package file.
    ///
    /// # Errors
    /// See [`PackageFileError`].
    pub fn load(path: &Path) -> Result<Self, PackageFileError> {
        Self::new(&read_file(path)?)
            .map_err(|error| PackageFileError::Package { path: path.to_owned(), error })
    }

    /// Writes the file atomically. An existing package is replaced; a file of another kind is
    /// refused.
    ///
    /// # Errors
    /// See [`OutputError`].
    pub fn save(&self, path: &Path) -> Result<(), OutputError> {
        write_whole(path, Self::KIND, |file| file.write_all(self.as_bytes()))
    }

    /// Returns the bytes.
    #[must_use]
    pub fn as_bytes(&self) -> &[u8] {
        &bytemuck::cast_slice(&self.words)[..self.length]
    }

    /// Decodes the package.
    ///
    /// # Panics
    /// Never: the bytes were decoded on creation.
    #[must_use]
    pub fn package(&self) -> Package<'_> {
        Package::decode(self.as_bytes()).expect("bytes that decoded before")
    }

    /// Returns the format of the package.
    ///
    /// # Panics
    /// Never: the bytes were decoded on creation.
    #[must_use]
    pub fn format(&self) -> Format {
        Format::of(self.as_bytes()).expect("bytes that decoded before")
    }

    /// Returns the package with a signature by this key, replacing any other.
    ///
    /// # Panics
    /// Never: signing changes no byte of the package.
    #[must_use]
    pub fn signed(&self, key: &OperatorKey) -> Self {
        let envelope = Envelope::open(self.as_bytes()).expect("bytes that decoded before");
        let block = signature_block(&key.sign(envelope.signed_part));
        let bytes = match self.format() {
            Format::One => [envelope.signed_part, &block].concat(),
            Format::Two => {
                let mut bytes = self.as_bytes().to_vec();
                bytes[HEADER2_LENGTH..CHECKED_FIRST].copy_from_slice(&block);
                bytes
            }
        };
        Self::new(&bytes).expect("a package with a signature of the right length")
    }

    /// Returns the package with another version, without its signature and its permission to
    /// replace newer ones, which are valid for one version only.
    ///
    /// # Panics
    /// Never: the version fits into every package.
    #[must_use]
    pub fn renumbered(&self, version: u32) -> Self {
        let serial = Serial { version, ..self.package().serial() };
        self.with_serial(serial).expect("the epoch fits as before")
    }

    /// Returns the package with another epoch and version, in its own format, without its signature
    /// and its permission to replace newer ones.
    ///
    /// # Errors
    /// [`EncodeError::Epoch`] for a package of format 1.
    pub fn with_serial(&self, serial: Serial) -> Result<Self, EncodeError> {
        let mut bytes = self.as_bytes().to_vec();
        match self.format() {
            Format::One => {
                let Serial { epoch, version } = serial;
                let package = Package { epoch, version, replaces: None, ..self.package() };
                bytes = encode(Format::One, &package)?;
            }
            // In place, so that sections that only later versions know stay.
            Format::Two => set_serial(&mut bytes, serial).expect("bytes that decoded before"),
        }
        Ok(Self::new(&bytes).expect("a package that decoded with another version"))
    }

    /// Returns the package of format 1 with the permission to replace versions up to `newest`,
    /// without its signature.
    ///
    /// # Errors
    /// [`EncodeError::Replaces`] for a package of format 2.
    pub fn replacing(&self, newest: u32) -> Result<Self, EncodeError> {
        let package = Package { replaces: Some(newest), ..self.package() };
        let bytes = encode(self.format(), &package)?;
        Ok(Self::new(&bytes).expect("a package that decoded without a permission"))
    }

    /// Returns the package in another format: the same content, without its signature. Format 1
    /// loses the limits of the trial, format 2 a permission to replace newer versions.
    ///
    /// # Errors
    /// [`EncodeError`] if format 1 cannot hold the content.
    pub fn converted(&self, format: Format) -> Result<Self, EncodeError> {
        if format == self.format() {
            return Ok(self.clone());
        }
        let bytes = encode(format, &Package { replaces: None, ..self.package() })?;
        Ok(Self::new(&bytes).expect("a package that decoded in another format"))
    }

    /// Returns whether the package has a valid signature by the private half of `key`.
    #[must_use]
    pub fn is_signed_by(&self, key: &PublicKey) -> bool {
        Envelope::open(self.as_bytes()).is_ok_and(|envelope| {
            envelope
                .signature
                .is_some_and(|signature| verify(key, envelope.signed_part, signature).is_ok())
        })
    }

    /// Returns whether the package has a signature, valid or not.
    #[must_use]
    pub fn is_signed(&self) -> bool {
        Envelope::open(self.as_bytes()).is_ok_and(|envelope| envelope.signature.is_some())
    }

    /// Returns widths and activations of the layers.
    #[must_use]
    pub fn architecture(&self) -> &Architecture {
        &self.architecture
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
