//! The checks a package must pass before it can become active, identical on node and host.
//!
//! In this order: header and checksum, signature where the node has a public key, format of the
//! body, finiteness; then dimension, sizes, parameters and version; finally the test vectors, which
//! must match bit for bit. A package that passes computes on this processor exactly what it
//! computed where it was created.

use super::{Envelope, Package, PackageError};
use crate::AgentId;
use crate::StateVector;
use crate::math::numeric::{components_mut, zeros};
use crate::math::parameter::{ParameterError, finite, not_negative, positive};
use crate::observer::network::Scratch;
use crate::package::signature::{PublicKey, verify};

/// A node's requirements on packages.
#[derive(Clone, Copy, Debug)]
pub struct Requirements<'k> {
    /// If present, only packages signed with the matching private key are accepted.
    pub public_key: Option<&'k PublicKey>,
    /// The package in use, if any.
    pub in_use: Option<InUse>,
    /// Sizes of the node's buffers.
    pub capacity: Capacity,
}

/// Identity of the package in use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct InUse {
    /// Agent of the package.
    pub agent: AgentId,
    /// Its version.
    pub version: u32,
}

/// Sizes of a node's static buffers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Capacity {
    /// Largest number of features `L`.
    pub features: usize,
    /// Largest number of neighbours.
    pub neighbours: usize,
    /// Largest number of stored entries of `Gamma`.
    pub gain_entries: usize,
}

impl Capacity {
    /// Limited only by the format; for a host.
    pub const UNLIMITED: Self =
        Self { features: usize::MAX, neighbours: usize::MAX, gain_entries: usize::MAX };
}

/// Why a node refuses a package.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum Refusal {
    /// The bytes are not a package.
    Package(PackageError),
    /// The node has a public key and the package is not signed.
    Unsigned,
    /// The signature was made with another key or for another package.
    Signature,
    /// The package is for a state of another dimension.
    Dimension {
        /// Dimension of the node.
        expected: usize,
        /// Dimension of the package.
        found: usize,
    },
    /// The package exceeds a buffer of the node.
    Capacity {
        /// What exceeds its buffer.
        what: &'static str,
        /// Size of the buffer.
        capacity: usize,
        /// Size the package needs.
        found: usize,
    },
    /// A parameter is outside its range.
    Parameter(ParameterError),
    /// Neighbours are repeated or not in ascending order.
    NeighbourOrder {
        /// The first neighbour out of order.
        id: AgentId,
    },
    /// The box of trained inputs has a lower limit above the upper one.
    EmptyBox {
        /// Index of the component, from 0.
        component: usize,
    },
    /// The package is for another agent.
    Agent {
        /// The node's agent.
        expected: AgentId,
        /// The package's agent.
        found: AgentId,
    },
    /// The package is older than the one in use.
    Older {
        /// The version in use.
        in_use: u32,
        /// Version of the package.
        found: u32,
    },
    /// The package has no test vectors, so it cannot be checked.
    NoTestVectors,
    /// A test vector does not match.
    TestVector {
        /// Its index, from 0.
        index: usize,
    },
}

impl core::fmt::Display for Refusal {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match *self {
            Self::Package(error) => write!(f, "{error}"),
            Self::Unsigned => {
                write!(f, "the package is not signed, but this node requires a signature")
            }
            Self::Signature => write!(f, "the signature does not match the package and the key"),
            Self::Dimension { expected, found } => {
                write!(f, "the package is for {found} state components, the node has {expected}")
            }
            Self::Capacity { what, capacity, found } => {
                write!(f, "the package has {found} {what}, the node has room for {capacity}")
            }
            Self::Parameter(error) => write!(f, "{error}"),
            Self::NeighbourOrder { id } => {
                write!(f, "neighbour {id} is out of order, expected ascending numbers")
            }
            Self::EmptyBox { component } => {
                write!(f, "the box of trained inputs is empty in component {component}")
            }
            Self::Agent { expected, found } => {
                write!(f, "the package is for agent {found}, this node is agent {expected}")
            }
            Self::Older { in_use, found } => {
                write!(f, "the package has version {found}, but version {in_use} is in use")
            }
            Self::NoTestVectors => write!(f, "the package has no test vectors"),
            Self::TestVector { index } => {
                write!(f, "test vector {index} does not match bit for bit")
            }
        }
    }
}

impl core::error::Error for Refusal {}

impl From<PackageError> for Refusal {
    fn from(error: PackageError) -> Self {
        Self::Package(error)
    }
}

impl From<ParameterError> for Refusal {
    fn from(error: ParameterError) -> Self {
        Self::Parameter(error)
    }
}

/// Decodes the package in `bytes` and checks it for a node with state dimension `N`.
///
/// # Errors
/// The first check that fails; see [`Refusal`].
pub fn accept<'a, const N: usize>(
    bytes: &'a [u8],
    requirements: &Requirements<'_>,
    scratch: &mut Scratch,
) -> Result<Package<'a>, Refusal> {
    let envelope = Envelope::open(bytes)?;
    if let Some(key) = requirements.public_key {
        let signature = envelope.signature.ok_or(Refusal::Unsigned)?;
        verify(key, envelope.signed_part, signature).map_err(|_| Refusal::Signature)?;
    }
    let package = Package::from_envelope(&envelope)?;
    check_sizes::<N>(&package, &requirements.capacity)?;
    check_parameters::<N>(&package)?;
    check_identity(&package, requirements)?;
    check_test_vectors::<N>(&package, scratch)?;
    Ok(package)
}

fn check_sizes<const N: usize>(package: &Package<'_>, capacity: &Capacity) -> Result<(), Refusal> {
    if package.dimension() != N {
        return Err(Refusal::Dimension { expected: N, found: package.dimension() });
    }
    let needs = [
        ("features", capacity.features, package.features()),
        ("neighbours", capacity.neighbours, package.node.neighbours.len()),
        ("gain entries", capacity.gain_entries, package.node.outer_law.gain.entries().len()),
    ];
    for (what, capacity, found) in needs {
        if found > capacity {
            return Err(Refusal::Capacity { what, capacity, found });
        }
    }
    Ok(())
}

fn check_parameters<const N: usize>(package: &Package<'_>) -> Result<(), Refusal> {
    package.node.gain.validate("observer.gain", N)?;
    package.node.outer_law.validate_weights(package.outer_weights.as_chunks::<N>().0)?;
    package.node.trigger.validate()?;
    positive("step_size", package.node.step_size)?;
    not_negative("broadcast_interval_min", package.broadcast_interval_min)?;
    finite("output_matrix", package.node.output_matrix)?;
    let mut previous = None;
    for neighbour in package.node.neighbours() {
        let id = neighbour.id;
        if id == package.node.agent {
            return Err(ParameterError::OwnNeighbour { id }.into());
        }
        if previous.is_some_and(|previous| id <= previous) {
            return Err(Refusal::NeighbourOrder { id });
        }
        positive("observer.neighbours.weight", neighbour.weight)?;
        previous = Some(id);
    }
    let limits = package.trained_box.low.iter().zip(package.trained_box.high);
    match limits.map(|(low, high)| low <= high).position(|in_order| !in_order) {
        Some(component) => Err(Refusal::EmptyBox { component }),
        None => Ok(()),
    }
}

fn check_identity(package: &Package<'_>, requirements: &Requirements<'_>) -> Result<(), Refusal> {
    let Some(in_use) = requirements.in_use else { return Ok(()) };
    if package.node.agent != in_use.agent {
        return Err(Refusal::Agent { expected: in_use.agent, found: package.node.agent });
    }
    // An exception is honoured only if it is signed.
    let replaces = package.replaces.filter(|_| requirements.public_key.is_some());
    if package.version < in_use.version && replaces.is_none_or(|newest| newest < in_use.version) {
        return Err(Refusal::Older { in_use: in_use.version, found: package.version });
    }
    Ok(())
}

fn check_test_vectors<const N: usize>(
    package: &Package<'_>,
    scratch: &mut Scratch,
) -> Result<(), Refusal> {
    if package.test_vectors.is_empty() {
        return Err(Refusal::NoTestVectors);
    }
    for (index, vector) in package.test_vectors().enumerate() {
        let features = package.network.features(vector.input, scratch);
        let same = features.is_some_and(|features| {
            let output = combine::<N>(package.outer_weights, features);
            same_bits(features, vector.features) && same_bits(output.as_slice(), vector.output)
        });
        if !same {
            return Err(Refusal::TestVector { index });
        }
    }
    Ok(())
}

/// Computes `W_hat^T sigma` as [`crate::observer::outer_law::OuterWeights::combine`] does, from
/// weights in place.
fn combine<const N: usize>(outer_weights: &[f32], features: &[f32]) -> StateVector<N> {
    let mut output = zeros();
    for (row, &feature) in outer_weights.as_chunks::<N>().0.iter().zip(features) {
        for (sum, weight) in components_mut(&mut output).iter_mut().zip(row) {
            *sum += feature * weight;
        }
    }
    output
}

fn same_bits(found: &[f32], expected: &[f32]) -> bool {
    found.len() == expected.len()
        && found.iter().zip(expected).all(|(found, expected)| found.to_bits() == expected.to_bits())
}

impl Package<'_> {
    /// Computes the contents of a test vector with the package's own weights: `sigma(Phi_hat(x))`,
    /// shape `[L]`, and `W_hat^T sigma`, shape `[N]`. `None` if the network has a dimension other
    /// than `N`.
    pub fn evaluate<'s, const N: usize>(
        &self,
        input: &StateVector<N>,
        scratch: &'s mut Scratch,
    ) -> Option<(&'s [f32], StateVector<N>)> {
        let features = self.network.features(input.as_slice(), scratch)?;
        Some((features, combine(self.outer_weights, features)))
    }
}
