//! The checks a package must pass before it can become active, identical on node and host.
//!
//! In this order: header and checksum, signature and digest where the node has a public key, format
//! of the body, finiteness; then dimension, sizes, parameters, step, agent, epoch and version;
//! finally the test vectors, which must match bit for bit. A package that passes computes on this processor exactly what it
//! computed where it was created.

use super::header::{Header, digest};
use super::{Envelope, Format, Package, PackageError, Serial, TrialLimits};
use crate::AgentId;
use crate::StateVector;
use crate::math::numeric::{components_mut, zeros};
use crate::math::parameter::{ParameterError, finite, not_negative, positive};
#[cfg(feature = "field")]
use crate::observer::field::{FieldParams, FieldWords};
use crate::observer::network::Scratch;
use crate::package::signature::{PublicKey, verify};

/// A node's requirements on packages.
#[derive(Clone, Copy, Debug)]
pub struct Requirements<'k> {
    /// If there are any, only packages signed with the private key of one of them are accepted.
    pub public_keys: &'k [PublicKey],
    /// The node's agent, if a package has named it.
    pub agent: Option<AgentId>,
    /// Epoch and version of the newest package that was ever activated, if any: also of one whose
    /// trial failed. Only newer packages are accepted.
    pub highest: Option<Serial>,
    /// The steps `dt` that the board can keep.
    pub step_range: StepRange,
    /// Sizes of the node's buffers.
    pub capacity: Capacity,
}

impl Requirements<'static> {
    /// What the format alone requires; for a host.
    pub const ANY: Self = Self {
        public_keys: &[],
        agent: None,
        highest: None,
        step_range: StepRange::ANY,
        capacity: Capacity::UNLIMITED,
    };
}

impl Requirements<'_> {
    /// Whether packages must be signed. Without the `signature` feature there are no keys.
    pub(super) fn is_signed_only(&self) -> bool {
        cfg!(feature = "signature") && !self.public_keys.is_empty()
    }
}

/// The range of steps that a board can keep. \[s\]
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepRange {
    /// The shortest.
    pub min: f32,
    /// The longest.
    pub max: f32,
}

impl StepRange {
    /// For a board that gives no range of its own: no processor of this kind computes a step in a
    /// microsecond, and a timer of 32 bits that counts nanoseconds ends after four seconds.
    pub const DEFAULT: Self = Self { min: 1e-6, max: 10.0 };
    /// Every positive step; for a host.
    pub const ANY: Self = Self { min: 0.0, max: f32::MAX };

    /// Checks a step.
    ///
    /// # Errors
    /// [`Refusal::Parameter`] for a step that is not positive, [`Refusal::Step`] for one outside the
    /// range.
    pub fn check(&self, step_size: f32) -> Result<(), Refusal> {
        positive("step_size", step_size)?;
        match self.min <= step_size && step_size <= self.max {
            true => Ok(()),
            false => Err(Refusal::Step { range: *self, found: step_size }),
        }
    }
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
    /// Number of the plant's inputs that the node knows in every step.
    pub known_inputs: usize,
}

impl Capacity {
    /// No limits beyond those of the format; for hosts.
    pub const UNLIMITED: Self = Self {
        features: usize::MAX,
        neighbours: usize::MAX,
        gain_entries: usize::MAX,
        known_inputs: usize::MAX,
    };
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
    /// The package is for a state of a different dimension.
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
    /// The package is older than the newest one that was ever activated.
    Older {
        /// Epoch and version of the newest one.
        highest: Serial,
        /// Those of the package.
        found: Serial,
    },
    /// The package has the epoch and version of the newest one that was ever activated, whether its
    /// content is the same or not.
    Repeated {
        /// The epoch and version that the two packages share.
        serial: Serial,
    },
    /// The board cannot keep the package's step.
    Step {
        /// The board's range. \[s\]
        range: StepRange,
        /// The package's step. \[s\]
        found: f32,
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
                write!(
                    f,
                    "the package is for {found} state components, but the node has {expected}"
                )
            }
            Self::Capacity { what, capacity, found } => {
                write!(f, "the package has {found} {what}, but the node has room for {capacity}")
            }
            Self::Parameter(error) => write!(f, "{error}"),
            Self::NeighbourOrder { id } => {
                write!(f, "neighbour {id} is out of order, expected ascending numbers")
            }
            Self::EmptyBox { component } => {
                write!(f, "the box of trained inputs is empty in component {component}")
            }
            Self::Agent { expected, found } => {
                write!(f, "the package is for agent {found}, but this node is agent {expected}")
            }
            Self::Older { highest, found } if highest.epoch == 0 && found.epoch == 0 => write!(
                f,
                "the package has version {}, but version {} has already been used",
                found.version, highest.version
            ),
            Self::Older { highest, found } => {
                write!(f, "the package is {found}, but {highest} has already been used")
            }
            Self::Repeated { serial } => {
                write!(f, "a package with {serial} has already been used")
            }
            Self::Step { range, found } => write!(
                f,
                "the package's step is {found:e} s, but the board's range is {:e} to {:e} s",
                range.min, range.max
            ),
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

/// Decodes the package in `bytes` and checks it for a node with state dimension `N`. Its origin is not
/// decoded: it is [`Provenance::NONE`](super::Provenance::NONE).
///
/// # Errors
/// The first check that fails; see [`Refusal`].
pub fn accept<'a, const N: usize>(
    bytes: &'a [u8],
    requirements: &Requirements<'_>,
    scratch: &mut Scratch,
) -> Result<Package<'a>, Refusal> {
    let envelope = Envelope::open(bytes)?;
    if requirements.is_signed_only() {
        check_signature(&envelope, requirements.public_keys)?;
        check_digest(&envelope)?;
    }
    let package = Package::without_origin(&envelope)?;
    check_dimension::<N>(package.dimension())?;
    let sizes = Capacity {
        features: package.features(),
        neighbours: package.node.neighbours.len(),
        gain_entries: package.node.outer_law.gain.entries().len(),
        known_inputs: package.known_inputs,
    };
    check_sizes(&sizes, &requirements.capacity)?;
    check_parameters::<N>(&package)?;
    requirements.step_range.check(package.node.step_size)?;
    check_agent(package.node.agent, requirements)?;
    requirements.check_serial(package.serial(), package.replaces)?;
    check_test_vectors::<N>(&package, scratch)?;
    Ok(package)
}

/// Checks the beginning of a package, of which `bytes` are the first, before a node makes room for
/// the rest: its header's checksum, its signature if the node has a public key, dimension, sizes,
/// step, agent, epoch and version. Needs [`CHECKED_FIRST`](super::CHECKED_FIRST) bytes.
///
/// [`accept`] repeats all of this on the complete package. A package of format 1 reveals nothing
/// this early; for one, this is `None`.
///
/// # Errors
/// The first check that fails; see [`Refusal`].
pub fn accept_header<const N: usize>(
    bytes: &[u8],
    requirements: &Requirements<'_>,
) -> Result<Option<Header>, Refusal> {
    if Format::of(bytes)? == Format::One {
        return Ok(None);
    }
    let (envelope, _) = Envelope::split_start(bytes, true)?;
    if requirements.is_signed_only() {
        check_signature(&envelope, requirements.public_keys)?;
    }
    let header = envelope.header.ok_or(PackageError::Malformed)?;
    check_dimension::<N>(header.dimension)?;
    let (features, neighbours) = (header.architecture.features(), header.neighbours);
    let known_inputs = header.known_inputs();
    let sizes = Capacity { features, neighbours, gain_entries: 0, known_inputs };
    check_sizes(&sizes, &requirements.capacity)?;
    requirements.step_range.check(header.step_size)?;
    check_agent(header.agent, requirements)?;
    requirements.check_serial(header.serial, None)?;
    Ok(Some(header))
}

/// Checks that a package is signed with the private key of one of `keys`. [`accept`] does so if the node
/// has any.
///
/// # Errors
/// [`Refusal::Unsigned`] or [`Refusal::Signature`].
pub fn check_signature(envelope: &Envelope<'_>, keys: &[PublicKey]) -> Result<(), Refusal> {
    let signature = envelope.signature.ok_or(Refusal::Unsigned)?;
    let matches = |key| verify(key, envelope.signed_part, signature).is_ok();
    if keys.iter().any(matches) { Ok(()) } else { Err(Refusal::Signature) }
}

/// Checks that the sections of a package of format 2 are those that its header was made, and perhaps
/// signed, for. [`accept`] does so if the node has a public key.
///
/// # Errors
/// [`PackageError::Digest`].
pub fn check_digest(envelope: &Envelope<'_>) -> Result<(), PackageError> {
    match envelope.digest {
        Some(expected) if digest(envelope.body) != *expected => Err(PackageError::Digest),
        _ => Ok(()),
    }
}

fn check_dimension<const N: usize>(found: usize) -> Result<(), Refusal> {
    if found == N { Ok(()) } else { Err(Refusal::Dimension { expected: N, found }) }
}

fn check_sizes(found: &Capacity, capacity: &Capacity) -> Result<(), Refusal> {
    let needs = [
        ("features", capacity.features, found.features),
        ("neighbours", capacity.neighbours, found.neighbours),
        ("gain entries", capacity.gain_entries, found.gain_entries),
        ("known inputs", capacity.known_inputs, found.known_inputs),
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
    package.node.gain.validate_diagonal("observer.gain", N)?;
    package.node.outer_law.validate_weights(package.outer_weights.as_chunks::<N>().0)?;
    package.node.trigger.validate()?;
    package.node.exchange.validate()?;
    #[cfg(feature = "field")]
    if !package.node.field.is_empty() {
        let field = FieldParams::<N>::from_words(FieldWords(package.node.field))?;
        let (outputs, neighbours) = (package.node.outputs(N), package.node.neighbours.len());
        field.validate(outputs, neighbours, package.node.step_size)?;
    }
    positive("step_size", package.node.step_size)?;
    not_negative("broadcast_interval_min", package.broadcast_interval_min)?;
    finite("output_matrix", package.node.output_matrix)?;
    // An output that does not depend on the state measures nothing.
    for row in package.node.output_matrix.as_chunks::<N>().0 {
        if row.iter().all(|&entry| entry == 0.0) {
            let (parameter, value) = ("output_matrix", 0.0);
            let expected = "an entry other than 0 in every row";
            return Err(ParameterError::OutOfRange { parameter, value, expected }.into());
        }
    }
    package.trial.as_ref().map_or(Ok(()), TrialLimits::validate)?;
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

fn check_agent(found: AgentId, requirements: &Requirements<'_>) -> Result<(), Refusal> {
    match requirements.agent {
        Some(expected) if found != expected => Err(Refusal::Agent { expected, found }),
        _ => Ok(()),
    }
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
    /// than `N`, or `input` a length other than the number of the network's inputs.
    pub fn evaluate<'s, const N: usize>(
        &self,
        input: &[f32],
        scratch: &'s mut Scratch,
    ) -> Option<(&'s [f32], StateVector<N>)> {
        let features = self.network.features(input, scratch).filter(|_| self.dimension() == N)?;
        Some((features, combine(self.outer_weights, features)))
    }
}
