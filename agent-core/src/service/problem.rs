//! Errors that a node reports for requests.

use serde::{Deserialize, Serialize};

use crate::package::{PackageError, Refusal};
use crate::store::{CheckedError, StoreError};

/// Why a node refuses a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Problem {
    /// The request is not known to the node.
    Unknown,
    /// The request is for a node in the loop, but this one has its own sensor and clock.
    NotInTheLoop,
    /// No package is in use.
    NoPackage,
    /// The estimate is not finite or has the wrong number of components.
    Estimate,
    /// The store refused the request.
    Store(StoreError),
    /// The package was refused.
    Package(RefusalReport),
    /// The node has a port key, and this request must be sealed with it.
    NotSealed,
    /// The seal does not match: a different key, an earlier request, or an epoch that is over.
    Seal,
    /// The node has no port key, so that nothing can be sealed for it, or the request needs one.
    NotProvisioned,
    /// The node accepts its first keys only from its operator, and the signature does not match.
    NotSigned,
}

impl core::fmt::Display for Problem {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Unknown => write!(f, "unknown request"),
            Self::NotInTheLoop => {
                write!(f, "the node is not in the loop: it has its own sensor and clock")
            }
            Self::NoPackage => write!(f, "the node has no package in use"),
            Self::Estimate => {
                write!(f, "the estimate is not finite or does not have the node's state dimension")
            }
            Self::Store(error) => write!(f, "{error}"),
            Self::Package(report) => write!(f, "package refused: {report}"),
            Self::NotSealed => write!(f, "the node is provisioned and needs this request sealed"),
            Self::Seal => {
                write!(f, "the seal does not match the node's port key, boot epoch and counter")
            }
            Self::NotProvisioned => write!(f, "the node is not provisioned"),
            Self::NotSigned => {
                write!(
                    f,
                    "the node's first keys must be signed with the operator key built into its firmware"
                )
            }
        }
    }
}

impl core::error::Error for Problem {}

impl From<StoreError> for Problem {
    fn from(error: StoreError) -> Self {
        Self::Store(error)
    }
}

impl From<CheckedError<Refusal>> for Problem {
    fn from(error: CheckedError<Refusal>) -> Self {
        match error {
            CheckedError::Store(error) => Self::Store(error),
            CheckedError::Refused(refusal) => Self::Package(RefusalReport::from(&refusal)),
        }
    }
}

/// A [`Refusal`] in the form of a message: the check that failed, and its numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RefusalReport {
    /// The check that failed.
    pub kind: RefusalKind,
    /// The expected number; 0 if there is none.
    pub expected: u32,
    /// The number found, or the index of the invalid item; 0 if there is none.
    pub found: u32,
}

/// The check that failed: the variants of [`Refusal`] and [`PackageError`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[expect(missing_docs, reason = "they are those of the other enumerations")]
pub enum RefusalKind {
    Length,
    Magic,
    FormatVersion,
    Checksum,
    SignatureChecksum,
    Malformed,
    Alignment,
    Outputs,
    TestVectorCount,
    NumberCount,
    NotFinite,
    TrainingErrorNotFinite,
    Network,
    Unsigned,
    Signature,
    Dimension,
    Capacity,
    Parameter,
    NeighbourOrder,
    EmptyBox,
    Agent,
    Older,
    NoTestVectors,
    TestVector,
    /// The slot's bytes differ from the recorded ones.
    Slot,
    /// A check that is unknown to this version.
    Other,
    Epoch,
    Repeated,
    /// The numbers are those of a binary32.
    Step,
    Inputs,
    UnknownSection,
    /// A section is missing or has the wrong length.
    Section,
    Digest,
}

impl RefusalReport {
    const fn new(kind: RefusalKind, expected: u32, found: u32) -> Self {
        Self { kind, expected, found }
    }

    /// A slot whose bytes differ from the recorded ones.
    pub const SLOT: Self = Self::new(RefusalKind::Slot, 0, 0);
}

impl From<&Refusal> for RefusalReport {
    fn from(refusal: &Refusal) -> Self {
        use RefusalKind as Kind;
        let (kind, expected, found) = match *refusal {
            Refusal::Package(error) => return Self::from(&error),
            Refusal::Unsigned => (Kind::Unsigned, 0, 0),
            Refusal::Signature => (Kind::Signature, 0, 0),
            Refusal::Dimension { expected, found } => {
                (Kind::Dimension, count(expected), count(found))
            }
            Refusal::Capacity { capacity, found, .. } => {
                (Kind::Capacity, count(capacity), count(found))
            }
            Refusal::Parameter(_) => (Kind::Parameter, 0, 0),
            Refusal::NeighbourOrder { id } => (Kind::NeighbourOrder, 0, id),
            Refusal::EmptyBox { component } => (Kind::EmptyBox, 0, count(component)),
            Refusal::Agent { expected, found } => (Kind::Agent, expected, found),
            Refusal::Older { highest, found } if highest.epoch != found.epoch => {
                (Kind::Epoch, highest.epoch, found.epoch)
            }
            Refusal::Older { highest, found } => (Kind::Older, highest.version, found.version),
            Refusal::Repeated { serial } => (Kind::Repeated, serial.epoch, serial.version),
            Refusal::Step { range, found } if found < range.min => {
                (Kind::Step, range.min.to_bits(), found.to_bits())
            }
            Refusal::Step { range, found } => (Kind::Step, range.max.to_bits(), found.to_bits()),
            Refusal::NoTestVectors => (Kind::NoTestVectors, 0, 0),
            Refusal::TestVector { index } => (Kind::TestVector, 0, count(index)),
        };
        Self::new(kind, expected, found)
    }
}

impl From<&PackageError> for RefusalReport {
    fn from(error: &PackageError) -> Self {
        use RefusalKind as Kind;
        let (kind, expected, found) = match *error {
            PackageError::Length { expected, found } => {
                (Kind::Length, count(expected), count(found))
            }
            PackageError::Magic => (Kind::Magic, 0, 0),
            PackageError::FormatVersion { found } => (Kind::FormatVersion, 0, found.into()),
            PackageError::Checksum => (Kind::Checksum, 0, 0),
            PackageError::SignatureChecksum => (Kind::SignatureChecksum, 0, 0),
            PackageError::Malformed => (Kind::Malformed, 0, 0),
            PackageError::Alignment => (Kind::Alignment, 0, 0),
            PackageError::Outputs { found } => (Kind::Outputs, 0, count(found)),
            PackageError::TestVectors { found } => (Kind::TestVectorCount, 0, count(found)),
            PackageError::NumberCount { expected, found } => {
                (Kind::NumberCount, count(expected), count(found))
            }
            PackageError::NotFinite { index } => (Kind::NotFinite, 0, count(index)),
            PackageError::TrainingErrorNotFinite => (Kind::TrainingErrorNotFinite, 0, 0),
            PackageError::Network(_) => (Kind::Network, 0, 0),
            PackageError::Inputs { inputs, dimension } => {
                (Kind::Inputs, count(dimension), count(inputs))
            }
            PackageError::UnknownSection { kind } => (Kind::UnknownSection, 0, kind.into()),
            PackageError::SectionLength { expected, found, .. } => {
                (Kind::Section, count(expected), count(found))
            }
            PackageError::SectionNotFinite { index, .. } => (Kind::NotFinite, 0, count(index)),
            PackageError::TrialLimitNotFinite => (Kind::Parameter, 0, 0),
            PackageError::Digest => (Kind::Digest, 0, 0),
        };
        Self::new(kind, expected, found)
    }
}

fn count(number: usize) -> u32 {
    u32::try_from(number).unwrap_or(u32::MAX)
}

impl core::fmt::Display for RefusalReport {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        use RefusalKind as Kind;
        let Self { kind, expected, found } = *self;
        match kind {
            Kind::Length => write!(f, "its length is {found} bytes, expected {expected}"),
            Kind::Magic => write!(f, "not a weight package"),
            Kind::FormatVersion => write!(f, "its format version is {found}"),
            Kind::Checksum => write!(f, "its checksum does not match"),
            Kind::SignatureChecksum => write!(f, "its signature's checksum does not match"),
            Kind::Malformed => write!(f, "its body does not follow the format"),
            Kind::Alignment => write!(f, "it does not start at a multiple of four bytes"),
            Kind::Outputs => write!(f, "it has {found} outputs, expected 1 to the state dimension"),
            Kind::TestVectorCount => write!(f, "it has too many test vectors: {found}"),
            Kind::NumberCount => write!(f, "it has {found} numbers, expected {expected}"),
            Kind::NotFinite => write!(f, "number {found} is not finite"),
            Kind::TrainingErrorNotFinite => write!(f, "a training error is not finite"),
            Kind::Network => write!(f, "its network is invalid"),
            Kind::Unsigned => write!(f, "it is not signed, but this node requires a signature"),
            Kind::Signature => write!(f, "its signature does not match the node's key"),
            Kind::Dimension => {
                write!(f, "it is for {found} state components, but the node has {expected}")
            }
            Kind::Capacity => {
                write!(f, "it needs {found} entries, but the node has room for {expected}")
            }
            Kind::Parameter => {
                write!(f, "a parameter is out of range (run `weights verify` to see which)")
            }
            Kind::NeighbourOrder => write!(f, "neighbour {found} is out of order"),
            Kind::EmptyBox => write!(f, "the trained box is empty in component {found}"),
            Kind::Agent => write!(f, "it is for agent {found}, but this node is agent {expected}"),
            Kind::Older => {
                write!(f, "it has version {found}, but version {expected} has already been used")
            }
            Kind::Epoch => write!(
                f,
                "it is of package epoch {found}, but the node is in package epoch {expected}"
            ),
            Kind::Repeated => {
                write!(f, "version {found} of package epoch {expected} has already been used")
            }
            Kind::Step => write!(
                f,
                "its step is {:e} s, beyond the {:e} s that this board can keep",
                f32::from_bits(found),
                f32::from_bits(expected)
            ),
            Kind::Inputs => {
                write!(f, "its network has {found} inputs for a state of {expected} components")
            }
            Kind::UnknownSection => {
                write!(f, "a required section, kind {found}, is unknown to this firmware")
            }
            Kind::Section => {
                write!(f, "a section has {found} numbers, expected {expected}")
            }
            Kind::Digest => write!(f, "its content is not the one that was signed"),
            Kind::NoTestVectors => write!(f, "it has no test vectors"),
            Kind::TestVector => write!(f, "test vector {found} does not match bit for bit"),
            Kind::Slot => write!(f, "the bytes in its slot differ from the recorded ones"),
            Kind::Other => write!(f, "it failed a check that is unknown to this version"),
        }
    }
}
