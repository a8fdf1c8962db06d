//! Weight packages: everything that makes one firmware binary a certain agent, as bytes that
//! can be stored, sent and flashed, and that prove themselves before they are used.
//!
//! | part | what it is |
//! | --- | --- |
//! | [`Envelope`] | header, checksum, signature: whether the bytes arrived as they were made |
//! | [`Package`] | the content: network, outer weights, node parameters, provenance |
//! | [`accept`] | what a node checks before a package may become active |
//!
//! `docs/format.md` specifies every byte. In short: twelve bytes of header, a body of
//! postcard-encoded metadata followed by all numbers as aligned little-endian words, and
//! possibly a signature. The words are used where they lie: a package in memory-mapped flash
//! costs no RAM, neither stored nor in use.
//!
//! Cost: decoding is linear in the length of the bytes, checksum included; acceptance adds one
//! evaluation of the network for each of at most [`TEST_VECTORS_MAX`] test vectors, and a
//! signature's verification.
//!
//! Invariants: any byte string decodes to a package or to an error; a decoded package holds
//! finite numbers only, as many as its metadata ask for, and a network that fits its
//! architecture.

mod accept;
mod decode;
mod encode;
mod envelope;
mod error;
mod place;
pub mod signature;
mod switch;
mod wire;

pub use accept::{Capacity, InUse, Refusal, Requirements, accept};
pub use encode::EncodeError;
pub use envelope::{Envelope, HEADER_LENGTH, MAGIC, SIGNATURE_BLOCK_LENGTH, signature_block};
pub use error::PackageError;
pub use place::{NetworkPlace, ParamsPlace};

use serde::{Deserialize, Serialize};

use crate::AgentId;
use crate::StateVector;
use crate::agent::AgentParams;
use crate::agent::region::StateBox;
use crate::math::parameter::ParameterError;
use crate::math::symmetric::SymmetricMatrix;
use crate::observer::feedback::{Neighbour, ObserverParams, OutputMatrix};
use crate::observer::network::InnerNetwork;
use crate::observer::outer_law::OuterLawParams;
use crate::observer::trigger::TriggerParams;

/// Version of the format that this crate writes and reads.
pub const FORMAT_VERSION: u8 = 1;

/// Most test vectors that a package can carry: enough to light up every node of a layer, few
/// enough that a node checks them between two steps.
pub const TEST_VECTORS_MAX: usize = 8;

/// The content of a package. All slices lie in the bytes that it was decoded from.
#[derive(Clone, Debug, PartialEq)]
pub struct Package<'a> {
    /// Rises with every package for the same agent; an older one is refused.
    pub version: u32,
    /// If there is one, the package may take the place of any version up to this one although
    /// it is itself older. Counts only if the package is signed.
    pub replaces: Option<u32>,
    /// What becomes of the adapted outer weights when the package is switched in.
    pub outer_weights_on_switch: OnSwitch,
    /// The inner network.
    pub network: InnerNetwork<&'a [f32]>,
    /// `W_hat` to start from, row by row, shape `[L, n]`.
    pub outer_weights: &'a [f32],
    /// What makes the node this agent.
    pub node: AgentConfig<'a>,
    /// Time between broadcasts that Theorem 2 guarantees on the trajectories that the network
    /// was trained on; 0 where none is known. \[s\]
    pub broadcast_interval_min: f32,
    /// The inputs that the network was trained on.
    pub trained_box: StateBox<'a>,
    /// Where the network comes from.
    pub provenance: Provenance<'a>,
    /// Inputs with the exact outputs for them, one after another: `n` numbers of input, `L`
    /// features, `n` numbers of `W_hat^T sigma`.
    pub test_vectors: &'a [f32],
}

/// Everything about an agent but its network: what a node needs to run the observer on its
/// feedback alone.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AgentConfig<'a> {
    /// The agent's number.
    pub agent: AgentId,
    /// `C_i`, row by row, shape `[m, n]`.
    pub output_matrix: &'a [f32],
    /// `K_1`, shape `[n, n]`. \[1/s\]
    pub gain: SymmetricMatrix<'a>,
    /// Numbers of the neighbours, ascending.
    pub neighbours: NeighbourIds<'a>,
    /// `a_ij`, one for each neighbour.
    pub edge_weights: &'a [f32],
    /// `Gamma` and the projection.
    pub outer_law: OuterLawParams<'a>,
    /// `phi_1`, `phi_2`, `epsilon / N`.
    pub trigger: TriggerParams,
    /// `dt`. \[s\]
    pub step_size: f32,
}

/// What becomes of the outer weights that an agent has adapted when another package takes over.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum OnSwitch {
    /// They go on, as in the paper; the package's own are for a node that starts with it.
    Keep,
    /// They are replaced by the package's, because inner and outer layers were trained together.
    Replace,
}

/// Agent numbers in place, two little-endian bytes each.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NeighbourIds<'a>(&'a [[u8; 2]]);

impl<'a> NeighbourIds<'a> {
    /// The numbers in `bytes`; `None` if their count is odd.
    #[must_use]
    pub fn new(bytes: &'a [u8]) -> Option<Self> {
        match bytes.as_chunks() {
            (pairs, []) => Some(Self(pairs)),
            _ => None,
        }
    }

    /// How many there are.
    #[must_use]
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// Whether there is none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// One after another.
    pub fn iter(&self) -> impl Iterator<Item = AgentId> + Clone + 'a {
        self.0.iter().map(|&pair| AgentId::from_le_bytes(pair))
    }

    fn bytes(&self) -> &'a [u8] {
        self.0.as_flattened()
    }
}

/// Where a network comes from. Nothing depends on it but people.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Provenance<'a> {
    /// Hash of the scenario that it was trained for; see the host's documentation.
    pub scenario_hash: [u8; 8],
    /// How it was trained.
    pub recipe: &'a str,
    /// Seed of the training.
    pub seed: u64,
    /// Samples that it was trained on; 0 for a network that is not trained.
    pub samples: u32,
    /// Mean squared errors, if it was trained.
    pub errors: Option<TrainingErrors>,
    /// Major, minor and patch version of the tool that made the package.
    pub tool_version: [u8; 3],
}

/// Mean squared errors after training. \[squared state unit/s^2\]
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrainingErrors {
    /// Over the samples that the network was trained on.
    pub training: f32,
    /// Over samples that were held back from training.
    pub held_out: f32,
}

impl TrainingErrors {
    /// Whether both are numbers.
    #[must_use]
    pub fn is_finite(&self) -> bool {
        self.training.is_finite() && self.held_out.is_finite()
    }
}

/// One test vector of a package.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TestVector<'a> {
    /// `x_hat`, shape `[n]`.
    pub input: &'a [f32],
    /// `sigma(Phi_hat(x_hat))`, shape `[L]`, to the bit.
    pub features: &'a [f32],
    /// `W_hat^T sigma` with the package's outer weights, shape `[n]`, to the bit.
    pub output: &'a [f32],
}

impl<'a> Package<'a> {
    /// `n`, components of the state.
    #[must_use]
    pub fn dimension(&self) -> usize {
        self.network.architecture().inputs()
    }

    /// `L`, width of the last inner layer.
    #[must_use]
    pub fn features(&self) -> usize {
        self.network.architecture().features()
    }

    /// The test vectors, one after another.
    pub fn test_vectors(&self) -> impl Iterator<Item = TestVector<'a>> + '_ {
        let (n, features) = (self.dimension(), self.features());
        let length = test_vector_length(n, features).max(1);
        self.test_vectors.chunks_exact(length).filter_map(move |numbers| {
            let (input, rest) = numbers.split_at_checked(n)?;
            let (features, output) = rest.split_at_checked(features)?;
            Some(TestVector { input, features, output })
        })
    }
}

impl AgentConfig<'_> {
    /// `m`, how many outputs the agent of a state with `dimension` components measures.
    #[must_use]
    pub fn outputs(&self, dimension: usize) -> usize {
        self.output_matrix.len() / dimension.max(1)
    }

    /// The neighbours with the weights of their edges.
    pub fn neighbours(&self) -> impl Iterator<Item = Neighbour> + '_ {
        let weights = self.edge_weights.iter();
        self.neighbours.iter().zip(weights).map(|(id, &weight)| Neighbour { id, weight })
    }

    /// The agent's parameters, copied into memory of the caller: they outlive what is borrowed here.
    /// `neighbours` needs a place for each neighbour, `gain` one for each entry of `Gamma`.
    ///
    /// # Errors
    /// What [`AgentParams::new`] refuses, matrices of another shape, or too few places.
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

    /// The agent's parameters with neighbours and `Gamma` that have been put somewhere.
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
        AgentParams::new(self.agent, self.step_size, observer, outer_law, self.trigger)
    }
}

/// Numbers in one test vector.
const fn test_vector_length(dimension: usize, features: usize) -> usize {
    2 * dimension + features
}

#[cfg(test)]
pub(crate) mod tests;
