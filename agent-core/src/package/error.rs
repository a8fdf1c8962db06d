//! Why bytes are no package.

use super::{FORMAT_VERSION, TEST_VECTORS_MAX};
use crate::observer::network::NetworkError;

/// Why bytes are no package.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum PackageError {
    /// There are more or fewer bytes than the header says, or fewer than a header has.
    Length {
        /// How many there should be, without a signature.
        expected: usize,
        /// How many there are.
        found: usize,
    },
    /// They do not start as a package does.
    Magic,
    /// The package has another format.
    FormatVersion {
        /// Version of its format.
        found: u8,
    },
    /// The checksum does not match: bytes were changed.
    Checksum,
    /// The signature's checksum does not match: bytes of the signature were changed.
    SignatureChecksum,
    /// The checksum matches and yet the body does not follow the format.
    Malformed,
    /// The bytes begin at an address that is not a multiple of four.
    Alignment,
    /// The number of outputs is not between 1 and the state's dimension.
    Outputs {
        /// The number given.
        found: usize,
    },
    /// There are more test vectors than [`TEST_VECTORS_MAX`].
    TestVectors {
        /// The number given.
        found: usize,
    },
    /// The metadata ask for another number of numbers.
    NumberCount {
        /// What they ask for.
        expected: usize,
        /// What there is.
        found: usize,
    },
    /// A number is infinite or not a number.
    NotFinite {
        /// Its index among all numbers of the body, from 0.
        index: usize,
    },
    /// A mean squared error of the training is infinite or not a number.
    TrainingErrorNotFinite,
    /// The network cannot be.
    Network(NetworkError),
}

impl core::fmt::Display for PackageError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match *self {
            Self::Length { expected, found } => {
                write!(f, "{found} bytes, but the package should have {expected}")
            }
            Self::Magic => write!(f, "the bytes do not start as a weight package does"),
            Self::FormatVersion { found } => {
                write!(f, "the package has format version {found}, expected {FORMAT_VERSION}")
            }
            Self::Checksum => write!(f, "the checksum does not match: the package is damaged"),
            Self::SignatureChecksum => {
                write!(f, "the signature's checksum does not match: the signature is damaged")
            }
            Self::Malformed => write!(f, "the package's body does not follow the format"),
            Self::Alignment => write!(f, "the package does not begin on a multiple of four"),
            Self::Outputs { found } => {
                write!(f, "{found} outputs, expected 1 to the number of state components")
            }
            Self::TestVectors { found } => {
                write!(f, "{found} test vectors, expected at most {TEST_VECTORS_MAX}")
            }
            Self::NumberCount { expected, found } => {
                write!(f, "the body has {found} numbers, its metadata ask for {expected}")
            }
            Self::NotFinite { index } => write!(f, "number {index} of the body is not finite"),
            Self::TrainingErrorNotFinite => write!(f, "a training error is not finite"),
            Self::Network(error) => write!(f, "{error}"),
        }
    }
}

impl core::error::Error for PackageError {}
