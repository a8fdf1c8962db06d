//! The content of a package, and creating packages from it.
//!
//! The test vectors are computed here by the core's own code; every node must reproduce them bit
//! for bit. Their inputs are inside the trained box, where activations are not saturated more than
//! in operation.

use agent_core::agent::region::StateBox;
use agent_core::observer::network::{Architecture, InnerNetwork, NetworkError, Scratch};
use agent_core::package::{
    EncodeError, Format, OnSwitch, Package, PackageError, Provenance, Refusal, Requirements,
    TrainingErrors, TrialLimits,
};

use super::check::check;
use super::encode::encode;
use super::{OwnedAgentConfig, PackageBytes, with_dimension};

/// Number of test vectors, one per pattern of [`test_inputs`].
const TEST_VECTORS: usize = 4;

/// The content of a package, owned.
#[derive(Clone, Debug, PartialEq)]
pub struct Draft {
    /// See [`Package::epoch`].
    pub epoch: u32,
    /// See [`Package::version`].
    pub version: u32,
    /// See [`Package::outer_weights_on_switch`].
    pub on_switch: OnSwitch,
    /// See [`Package::known_inputs`].
    pub known_inputs: usize,
    /// Inner layers.
    pub architecture: Architecture,
    /// Their parameters, in the core's flat order.
    pub inner: Vec<f32>,
    /// Initial `W_hat`, row-major, shape `[L, n]`.
    pub outer_weights: Vec<f32>,
    /// The node's agent configuration.
    pub node: OwnedAgentConfig,
    /// See [`Package::broadcast_interval_min`]. \[s\]
    pub broadcast_interval_min: f32,
    /// Smallest training value of each input.
    pub low: Vec<f32>,
    /// Largest training value of each input.
    pub high: Vec<f32>,
    /// See [`Package::trial`].
    pub trial: Option<TrialLimits>,
    /// Hash of the scenario.
    pub scenario_hash: u64,
    /// Name of the training recipe.
    pub recipe: String,
    /// Seed of the training.
    pub seed: u64,
    /// Number of training samples.
    pub samples: u32,
    /// Errors after training.
    pub errors: Option<TrainingErrors>,
}

/// Why a draft cannot be packed.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum DraftError {
    /// The network is invalid.
    #[error("cannot pack the network: {0}")]
    Network(NetworkError),
    /// A number of the network is infinite or not a number.
    #[error(
        "{what} {} is not finite in single precision; train with less noise, for fewer training epochs or with \
         another seed, or correct the network", index + 1
    )]
    NotFinite {
        /// The kind of number.
        what: &'static str,
        /// Its index, from 0, in the core's order.
        index: usize,
    },
    /// An input or output of a test vector is not finite.
    #[error("the network's output overflows for inputs inside the trained box")]
    TestVector,
    /// The sizes do not match.
    #[error("cannot encode the package: {0}")]
    Encode(EncodeError),
    /// The package does not decode.
    #[error("invalid package: {0}")]
    Package(PackageError),
    /// A node would refuse the package.
    #[error("a node would refuse the package: {}", super::parameter::refusal(.0))]
    Refused(Refusal),
    /// A number of the node is too large for single precision.
    #[error("{what} is not finite in single precision")]
    NodeNotFinite {
        /// Its scenario key.
        what: &'static str,
    },
}

impl Draft {
    /// Copies the content of an existing package, without a permission to replace newer ones.
    #[must_use]
    pub fn copy(package: &Package<'_>) -> Self {
        let provenance = &package.provenance;
        Self {
            epoch: package.epoch,
            version: package.version,
            on_switch: package.outer_weights_on_switch,
            architecture: package.network.architecture().clone(),
            known_inputs: package.known_inputs,
            inner: package.network.parameters().to_vec(),
            outer_weights: package.outer_weights.to_vec(),
            node: OwnedAgentConfig::copy(&package.node),
            broadcast_interval_min: package.broadcast_interval_min,
            low: package.trained_box.low.to_vec(),
            high: package.trained_box.high.to_vec(),
            trial: package.trial,
            scenario_hash: u64::from_be_bytes(provenance.scenario_hash),
            recipe: provenance.recipe.to_owned(),
            seed: provenance.seed,
            samples: provenance.samples,
            errors: provenance.errors,
        }
    }

    /// Encodes the package in the newest format and runs the core's acceptance checks on it.
    ///
    /// # Errors
    /// See [`DraftError`].
    pub fn seal(&self) -> Result<PackageBytes, DraftError> {
        for (what, numbers) in [
            ("inner parameter", &self.inner),
            ("outer weight", &self.outer_weights),
            ("the smallest value of input", &self.low),
            ("the largest value of input", &self.high),
        ] {
            if let Some(index) = numbers.iter().position(|number| !number.is_finite()) {
                return Err(DraftError::NotFinite { what, index });
            }
        }
        if let Some(what) = self.node.not_finite() {
            return Err(DraftError::NodeNotFinite { what });
        }
        let network = InnerNetwork::new(self.architecture.clone(), &self.inner[..])
            .map_err(DraftError::Network)?;
        let mut package = Package {
            epoch: self.epoch,
            version: self.version,
            replaces: None,
            known_inputs: self.known_inputs,
            outer_weights_on_switch: self.on_switch,
            network,
            outer_weights: &self.outer_weights,
            node: self.node.node(),
            broadcast_interval_min: self.broadcast_interval_min,
            trained_box: StateBox { low: &self.low, high: &self.high },
            trial: self.trial,
            provenance: Provenance {
                scenario_hash: self.scenario_hash.to_be_bytes(),
                recipe: &self.recipe,
                seed: self.seed,
                samples: self.samples,
                errors: self.errors,
                tool_version: tool_version(),
            },
            test_vectors: &[],
        };
        let test_vectors = test_vectors(&package).ok_or(DraftError::TestVector)?;
        package.test_vectors = &test_vectors;
        let bytes = encode(Format::NEWEST, &package).map_err(DraftError::Encode)?;
        let bytes = PackageBytes::new(&bytes).map_err(DraftError::Package)?;
        check(&bytes, &Requirements::ANY).map_err(DraftError::Refused)?;
        Ok(bytes)
    }
}

/// Returns the major, minor and patch version of this program.
fn tool_version() -> [u8; 3] {
    let part = |text: &str| text.parse().unwrap_or(u8::MAX);
    [
        part(env!("CARGO_PKG_VERSION_MAJOR")),
        part(env!("CARGO_PKG_VERSION_MINOR")),
        part(env!("CARGO_PKG_VERSION_PATCH")),
    ]
}

fn test_vectors(package: &Package<'_>) -> Option<Vec<f32>> {
    let inputs = test_inputs(&package.trained_box);
    let mut numbers = Vec::new();
    for input in &inputs {
        let vector = with_dimension!(
            package.dimension(), test_vector(package, input), else None
        );
        numbers.extend(vector?);
    }
    numbers.iter().all(|number| number.is_finite()).then_some(numbers)
}

fn test_vector<const N: usize>(package: &Package<'_>, input: &[f32]) -> Option<Vec<f32>> {
    let mut scratch = Scratch::NEW;
    let (features, output) = package.evaluate::<N>(input, &mut scratch)?;
    Some([input, features, output.as_slice()].concat())
}

/// Returns the centre of the trained box and corners of the centred box of half its size, in
/// different patterns of low and high components. Unlimited components use [-1, 1].
fn test_inputs(trained: &StateBox<'_>) -> [Vec<f32>; TEST_VECTORS] {
    std::array::from_fn(|pattern| {
        let limits = trained.low.iter().zip(trained.high).enumerate();
        let component = limits.map(|(component, (&low, &high))| {
            let width = high - low;
            let (low, width) = if width.is_finite() { (low, width) } else { (-1.0, 2.0) };
            let share = match pattern {
                0 => 0.5,
                pattern if (component + pattern) % 3 == 0 => 0.25,
                _ => 0.75,
            };
            low + share * width
        });
        component.collect()
    })
}
