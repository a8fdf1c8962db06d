//! Weight packages: everything that turns one firmware binary into a particular agent, as bytes
//! that can be stored, sent and flashed, and that are checked before use.
//!
//! | part | contents |
//! | --- | --- |
//! | [`Envelope`] | header, checksum, signature: whether the bytes arrived as they were made |
//! | [`Package`] | the content: network, outer weights, node parameters, provenance |
//! | [`accept`] | the checks before a package can become active |
//!
//! `docs/format.md` specifies every byte. In short, for format 2: a header of 128 bytes, which is
//! what gets signed, the signature, and typed sections of aligned little-endian words. The words are
//! used in place: a package in memory-mapped flash needs no RAM, either stored or in use. Format 1,
//! which is still read, and written for nodes with older firmware, has a short header, a body of
//! postcard-encoded metadata followed by all numbers, and the signature at the end.
//!
//! Cost: decoding is linear in the length, including the checksum; acceptance adds one evaluation
//! of the network for each of at most [`TEST_VECTORS_MAX`] test vectors, and the verification of a
//! signature.
//!
//! Invariants: any byte string decodes to a package or to an error; a decoded package contains only
//! finite numbers, as many as its metadata requires, and a network that matches its architecture.

mod accept;
mod decode;
mod encode;
mod encode_sections;
mod envelope;
mod error;
mod format;
mod header;
mod neighbours;
mod place;
mod replay;
pub mod sections;
mod serial;
pub mod signature;
mod switch;
mod trial_limits;
mod wire;

pub use accept::{
    Capacity, Refusal, Requirements, StepRange, accept, accept_header, check_digest,
    check_signature,
};
pub use encode::EncodeError;
pub use envelope::{Envelope, HEADER_LENGTH, signature_block};
pub use error::PackageError;
pub use format::{Format, MAGIC};
pub use header::{CHECKED_FIRST, DIGEST_LENGTH, HEADER2_LENGTH, Header, digest, set_serial};
pub use neighbours::NeighbourIds;
pub use place::{NetworkPlace, ParamsPlace};
pub use serial::Serial;
pub use signature::SIGNATURE_BLOCK_LENGTH;
pub use trial_limits::TrialLimits;

use serde::{Deserialize, Serialize};

use crate::AgentId;
use crate::StateVector;
use crate::agent::AgentParams;
use crate::agent::exchange::ExchangeParams;
use crate::agent::region::StateBox;
use crate::math::parameter::ParameterError;
use crate::math::symmetric::SymmetricMatrix;
use crate::observer::feedback::{Neighbour, ObserverParams, OutputMatrix};
use crate::observer::network::InnerNetwork;
use crate::observer::outer_law::OuterLawParams;
use crate::observer::trigger::TriggerParams;
use crate::wire::crc::crc32;

/// Largest number of test vectors in a package: enough to exercise every node of a layer, few
/// enough that a node can check them between two steps.
pub const TEST_VECTORS_MAX: usize = 8;

/// The contents of a package. All slices borrow the bytes it was decoded from.
///
/// ```
/// use agent_core::Package;
/// use agent_core::package::PackageError;
///
/// // Any bytes decode to a package or to an error.
/// let header = *b"OWP\x01\0\0\0\0\0\0\0\0";
/// assert_eq!(Package::decode(&header), Err(PackageError::Checksum));
/// assert_eq!(Package::decode(b"not a package"), Err(PackageError::Magic));
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct Package<'a> {
    /// Increased to go back to an older version; see [`Serial`]. 0 in packages of format 1.
    pub epoch: u32,
    /// Increases with every package for the same agent; older packages are refused.
    pub version: u32,
    /// If present, the package may replace any version up to this one even if its own version is
    /// lower, once and in epoch 0. Honoured only if the package is signed. Format 1 only.
    pub replaces: Option<u32>,
    /// Whether the adapted outer weights are kept when the package is activated.
    pub outer_weights_on_switch: OnSwitch,
    /// The inner network: its inputs are the state's `n` components and `p` known inputs of the plant.
    pub network: InnerNetwork<&'a [f32]>,
    /// `p`, the number of known inputs. Format 2 only, unless it is 0.
    pub known_inputs: usize,
    /// Initial `W_hat`, row by row, shape `[L, n]`.
    pub outer_weights: &'a [f32],
    /// The agent's parameters.
    pub node: AgentConfig<'a>,
    /// Minimum time between broadcasts that Theorem 2 guarantees on the training trajectories; 0 if
    /// unknown. \[s\]
    pub broadcast_interval_min: f32,
    /// The region of the training inputs, shape `[n + p]`.
    pub trained_box: StateBox<'a>,
    /// Limits within which the package has to stay while it is on trial. Format 2 only.
    pub trial: Option<TrialLimits>,
    /// Origin of the network.
    pub provenance: Provenance<'a>,
    /// Inputs with their exact outputs, concatenated: `n + p` numbers of input, `L` features, `n`
    /// numbers of `W_hat^T sigma`.
    pub test_vectors: &'a [f32],
}

/// The parameters of an agent without its network: all a node needs to run the observer on feedback
/// alone.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AgentConfig<'a> {
    /// The agent's number.
    pub agent: AgentId,
    /// `C_i`, row by row, shape `[m, n]`.
    pub output_matrix: &'a [f32],
    /// `K_1`, shape `[n, n]`. \[1/s\]
    pub gain: SymmetricMatrix<'a>,
    /// Numbers of the neighbours, in ascending order.
    pub neighbours: NeighbourIds<'a>,
    /// `a_ij`, one per neighbour.
    pub edge_weights: &'a [f32],
    /// `Gamma` and the projection.
    pub outer_law: OuterLawParams<'a>,
    /// `phi_1`, `phi_2`, `epsilon / N`.
    pub trigger: TriggerParams,
    /// `dt`. \[s\]
    pub step_size: f32,
    /// Exchange with the neighbours. Format 2 only, unless it is the paper's.
    pub exchange: ExchangeParams,
    /// Words of the field observer's parameters; empty for the paper's observer. Format 2 only.
    pub field: &'a [f32],
}

/// Whether an agent's adapted outer weights survive the switch to another package.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum OnSwitch {
    /// They are kept, as in the paper; the package's own are for a node that starts with it.
    Keep,
    /// They are replaced by the package's, because inner and outer layers were trained together.
    Replace,
}

/// Origin of a network, for documentation only.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Provenance<'a> {
    /// Hash of the training scenario; see the host's documentation.
    pub scenario_hash: [u8; 8],
    /// Description of the training.
    pub recipe: &'a str,
    /// Seed of the training.
    pub seed: u64,
    /// Number of training samples; 0 for an untrained network.
    pub samples: u32,
    /// Mean squared errors, if trained.
    pub errors: Option<TrainingErrors>,
    /// Major, minor and patch version of the tool that created the package.
    pub tool_version: [u8; 3],
}

impl Provenance<'_> {
    /// An unknown origin; in format 2, no section.
    pub const NONE: Self = Self {
        scenario_hash: [0; 8],
        recipe: "",
        seed: 0,
        samples: 0,
        errors: None,
        tool_version: [0; 3],
    };
}

/// Mean squared errors after training. \[squared state unit/s^2\]
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrainingErrors {
    /// On the training samples.
    pub training: f32,
    /// On samples held out from training.
    pub held_out: f32,
}

impl TrainingErrors {
    /// Returns whether both are finite.
    #[must_use]
    pub fn is_finite(&self) -> bool {
        self.training.is_finite() && self.held_out.is_finite()
    }
}

/// A test vector of a package.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TestVector<'a> {
    /// `x_hat` and the known inputs, shape `[n + p]`.
    pub input: &'a [f32],
    /// `sigma(Phi_hat(x_hat))`, shape `[L]`, exact bit for bit.
    pub features: &'a [f32],
    /// `W_hat^T sigma` with the package's outer weights, shape `[n]`, exact bit for bit.
    pub output: &'a [f32],
}

impl<'a> Package<'a> {
    /// Returns `n`, the state dimension.
    #[must_use]
    pub fn dimension(&self) -> usize {
        self.network.architecture().inputs().saturating_sub(self.known_inputs)
    }

    /// Returns the region of the training states, shape `[n]`.
    #[must_use]
    pub fn trained_states(&self) -> StateBox<'a> {
        let states = |limits: &'a [f32]| limits.get(..self.dimension()).unwrap_or(limits);
        StateBox { low: states(self.trained_box.low), high: states(self.trained_box.high) }
    }

    /// Returns `L`, the width of the last inner layer.
    #[must_use]
    pub fn features(&self) -> usize {
        self.network.architecture().features()
    }

    /// Returns the test vectors in order.
    pub fn test_vectors(&self) -> impl Iterator<Item = TestVector<'a>> + '_ {
        let (inputs, features) = (self.network.architecture().inputs(), self.features());
        self.test_vectors.chunks_exact(self.test_vector_length().max(1)).filter_map(
            move |numbers| {
                let (input, rest) = numbers.split_at_checked(inputs)?;
                let (features, output) = rest.split_at_checked(features)?;
                Some(TestVector { input, features, output })
            },
        )
    }

    /// Returns the numbers per test vector.
    fn test_vector_length(&self) -> usize {
        let inputs = self.network.architecture().inputs();
        test_vector_length(inputs, self.features(), self.dimension())
    }
}

impl AgentConfig<'_> {
    /// Returns the CRC-32 of `C_i`, to tell whether two packages measure the same.
    #[must_use]
    pub fn output_checksum(&self) -> u32 {
        crc32(&[bytemuck::try_cast_slice(self.output_matrix).unwrap_or_default()])
    }

    /// Returns `m`, the number of outputs the agent measures, for a state of `dimension`
    /// components.
    #[must_use]
    pub fn outputs(&self, dimension: usize) -> usize {
        self.output_matrix.len() / dimension.max(1)
    }

    /// Returns the neighbours with their edge weights.
    pub fn neighbours(&self) -> impl Iterator<Item = Neighbour> + '_ {
        let weights = self.edge_weights.iter();
        self.neighbours.iter().zip(weights).map(|(id, &weight)| Neighbour { id, weight })
    }

    /// Copies the agent's parameters into the caller's memory, so that they outlive the package.
    /// `neighbours` needs one entry per neighbour, `gain` one per stored entry of `Gamma`.
    ///
    /// # Errors
    /// Any error of [`AgentParams::new`], a matrix of the wrong shape, or a buffer that is too
    /// short.
    pub fn params<'b, const N: usize>(
        &self,
        neighbours: &'b mut [Neighbour],
        gain: &'b mut [f32],
    ) -> Result<AgentParams<'b, N>, ParameterError> {
        let length =
            |parameter, expected, found| ParameterError::Length { parameter, expected, found };
        let (capacity, found) = (neighbours.len(), self.neighbours.len());
        let neighbours =
            neighbours.get_mut(..found).ok_or(length("observer.neighbours", capacity, found))?;
        for (place, neighbour) in neighbours.iter_mut().zip(self.neighbours()) {
            *place = neighbour;
        }
        let entries = self.outer_law.gain.entries();
        let capacity = gain.len();
        let gain = gain.get_mut(..entries.len()).ok_or(length(
            "outer_law.gain",
            capacity,
            entries.len(),
        ))?;
        gain.copy_from_slice(entries);
        self.joined(neighbours, self.outer_law.gain.form().matrix(gain))
    }

    /// Creates the agent's parameters from neighbours and `Gamma` that are already stored.
    fn joined<'b, const N: usize>(
        &self,
        neighbours: &'b [Neighbour],
        gain: SymmetricMatrix<'b>,
    ) -> Result<AgentParams<'b, N>, ParameterError> {
        let length =
            |parameter, expected, found| ParameterError::Length { parameter, expected, found };
        let (expected, found) = (self.neighbours.len(), self.edge_weights.len());
        if expected != found {
            return Err(length("edge_weights", expected, found));
        }
        if !self.output_matrix.len().is_multiple_of(N) {
            return Err(length("output_matrix", self.outputs(N) * N, self.output_matrix.len()));
        }
        let mut rows = heapless::Vec::<StateVector<N>, N>::new();
        for row in self.output_matrix.as_chunks::<N>().0 {
            rows.push(StateVector::from(*row))
                .map_err(|_| length("output_matrix", N, self.outputs(N)))?;
        }
        self.gain.validate("observer.gain", N)?;
        let observer = ObserverParams {
            output_matrix: OutputMatrix::of(rows)?,
            gain: self.gain.unfold(),
            neighbours,
        };
        let outer_law = OuterLawParams { gain, projection: self.outer_law.projection };
        AgentParams::new(self.agent, self.step_size, observer, outer_law, self.trigger)?
            .with_exchange(self.exchange)
    }
}

/// Numbers per test vector.
const fn test_vector_length(inputs: usize, features: usize, dimension: usize) -> usize {
    inputs + features + dimension
}

#[cfg(test)]
mod bad_packages_tests;
#[cfg(test)]
mod format2_tests;
#[cfg(test)]
pub(crate) mod tests;
