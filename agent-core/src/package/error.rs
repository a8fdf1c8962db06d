//! Errors in the bytes of a package.

use super::{FORMAT_VERSION, TEST_VECTORS_MAX};
use crate::observer::network::NetworkError;

/// Why bytes are not a package.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum PackageError {
    /// The length does not match the header, or is less than a header.
    Length {
        /// The expected length, without a signature.
        expected: usize,
        /// The length found.
        found: usize,
    },
    /// The bytes do not start with [`MAGIC`](super::MAGIC).
    Magic,
    /// The package has another format version.
    FormatVersion {
        /// The format version found.
        found: u8,
    },
    /// The checksum does not match: the package is damaged.
    Checksum,
    /// The signature's checksum does not match: the signature is damaged.
    SignatureChecksum,
    /// The checksum matches, but the body does not follow the format.
    Malformed,
    /// The bytes start at an address that is not a multiple of four.
    Alignment,
    /// The number of outputs is not between 1 and the state dimension.
    Outputs {
        /// The number given.
        found: usize,
    },
    /// There are more test vectors than [`TEST_VECTORS_MAX`].
    TestVectors {
        /// The number given.
        found: usize,
    },
    /// The count of numbers does not match the metadata.
    NumberCount {
        /// The count that the metadata requires.
        expected: usize,
        /// The count found.
        found: usize,
    },
    /// A number is infinite or not a number.
    NotFinite {
        /// Its index among all numbers of the body, from 0.
        index: usize,
    },
    /// A mean squared training error is infinite or NaN.
    TrainingErrorNotFinite,
    /// The network is invalid.
    Network(NetworkError),
}

impl core::fmt::Display for PackageError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match *self {
            Self::Length { expected, found } => {
                write!(f, "invalid package length: {found} bytes, expected {expected}")
            }
            Self::Magic => write!(f, "not a weight package"),
            Self::FormatVersion { found } => {
                write!(f, "the package has format version {found}, expected {FORMAT_VERSION}")
            }
            Self::Checksum => write!(f, "the checksum does not match: the package is damaged"),
            Self::SignatureChecksum => {
                write!(f, "the signature's checksum does not match: the signature is damaged")
            }
            Self::Malformed => write!(f, "the package's body does not follow the format"),
            Self::Alignment => write!(f, "the package does not start at a multiple of four bytes"),
            Self::Outputs { found } => {
                write!(f, "{found} outputs, expected 1 to the state dimension")
            }
            Self::TestVectors { found } => {
                write!(f, "{found} test vectors, expected at most {TEST_VECTORS_MAX}")
            }
            Self::NumberCount { expected, found } => {
                write!(f, "the body has {found} numbers, but its metadata requires {expected}")
            }
            Self::NotFinite { index } => write!(f, "number {index} of the body is not finite"),
            Self::TrainingErrorNotFinite => write!(f, "a training error is not finite"),
            Self::Network(error) => write!(f, "{error}"),
        }
    }
}

impl core::error::Error for PackageError {}
