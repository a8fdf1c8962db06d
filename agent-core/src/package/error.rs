//! Errors in the bytes of a package.

use super::{Format, TEST_VECTORS_MAX};
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
    /// The package has a different format version.
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
    /// The network has fewer inputs than the state has components.
    Inputs {
        /// Inputs of the network.
        inputs: usize,
        /// Components of the state.
        dimension: usize,
    },
    /// A required section is of a kind that this crate does not know.
    UnknownSection {
        /// The kind.
        kind: u16,
    },
    /// A section does not have as many words as the header requires, or is missing.
    SectionLength {
        /// The kind of the section.
        kind: u16,
        /// The count that the header requires.
        expected: usize,
        /// The count found; 0 if the section is missing.
        found: usize,
    },
    /// A number of a section is infinite or not a number.
    SectionNotFinite {
        /// The kind of the section.
        kind: u16,
        /// The number's index in the section, from 0; in the agent's section, after its first word.
        index: usize,
    },
    /// A limit of the trial is infinite or not a number.
    TrialLimitNotFinite,
    /// The digest of the sections does not match: they are not those that the header was made for.
    Digest,
}

impl core::fmt::Display for PackageError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match *self {
            Self::Length { found: 0, .. } => write!(f, "the package is empty"),
            Self::Length { expected, found } => {
                write!(f, "invalid package length: {found} bytes, expected {expected}")
            }
            Self::Magic => write!(f, "not a weight package"),
            Self::FormatVersion { found } => {
                write!(
                    f,
                    "the package has format version {found}, expected 1 to {}",
                    Format::NEWEST.number()
                )
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
            Self::Inputs { inputs, dimension } => {
                write!(
                    f,
                    "the network has fewer inputs ({inputs}) than the state has components ({dimension})"
                )
            }
            Self::UnknownSection { kind } => {
                write!(f, "section {} is required, but unknown to this version", number(kind))
            }
            Self::SectionLength { kind, found: 0, .. } => {
                write!(f, "section {} is missing", number(kind))
            }
            Self::SectionLength { kind, expected, found } => {
                write!(f, "section {} has {found} numbers, expected {expected}", number(kind))
            }
            Self::SectionNotFinite { kind, index } => {
                write!(f, "number {index} of section {} is not finite", number(kind))
            }
            Self::TrialLimitNotFinite => write!(f, "a limit of the trial is not finite"),
            Self::Digest => {
                write!(f, "the digest does not match: the content is not the signed one")
            }
        }
    }
}

impl core::error::Error for PackageError {}

/// Returns the number of a kind of section, without the bit that makes it required.
const fn number(kind: u16) -> u16 {
    kind & !super::wire::REQUIRED
}
