//! Real packages that a node accepts.

use agent_core::AgentId;
use agent_core::agent::exchange::ExchangeParams;
use agent_core::agent::region::StateBox;
use agent_core::math::activation::Activation;
use agent_core::math::symmetric::MatrixForm;
use agent_core::observer::field::disturbance::Model;
use agent_core::observer::field::{Coupling, Direction, HoldKind, Options};
use agent_core::observer::network::{Architecture, InnerNetwork, Layer, Scratch};
use agent_core::observer::outer_law::OuterLawParams;
use agent_core::observer::projection::ProjectionParams;
use agent_core::observer::trigger::TriggerParams;
use agent_core::package::{
    AgentConfig, Format, NeighbourIds, OnSwitch, Package, Provenance, TrainingErrors, TrialLimits,
};

/// The entries of a diagonally dominant matrix of shape `[size, size]` in this form.
fn entries(form: MatrixForm, size: usize) -> Vec<f32> {
    match form {
        MatrixForm::Scalar => vec![3.0],
        MatrixForm::Diagonal => (0..size).map(|row| 3.0 + row as f32).collect(),
        MatrixForm::Full => (0..form.count(size))
            .map(|index| if index % (size + 1) == 0 { 20.0 } else { 0.125 })
            .collect(),
    }
}

/// The properties in which real packages differ.
#[derive(Clone, Debug)]
pub struct SamplePackage {
    /// Its format.
    pub format: Format,
    /// Its version.
    pub version: u32,
    /// The agent.
    pub agent: AgentId,
    /// The inner layers.
    pub layers: Vec<(u8, Activation)>,
    /// Number of outputs.
    pub outputs: usize,
    /// The neighbours.
    pub neighbours: Vec<AgentId>,
    /// MatrixForm of `K_1`.
    pub gain: MatrixForm,
    /// MatrixForm of `Gamma`.
    pub outer_gain: MatrixForm,
    /// How many test vectors there are.
    pub test_vectors: usize,
    /// Name of the training recipe.
    pub recipe: &'static str,
    /// Whether it has the field observer; in format 2 only.
    pub has_field: bool,
}

impl SamplePackage {
    /// Returns the smallest package that a node accepts.
    #[must_use]
    pub fn smallest() -> Self {
        Self {
            format: Format::One,
            version: 1,
            agent: 0,
            layers: vec![(1, Activation::Tanh)],
            outputs: 1,
            neighbours: vec![],
            gain: MatrixForm::Scalar,
            outer_gain: MatrixForm::Scalar,
            test_vectors: 1,
            recipe: "",
            has_field: false,
        }
    }

    /// Encodes the unsigned package for state dimension `N`.
    ///
    /// # Panics
    /// If the properties do not describe a valid package.
    #[must_use]
    pub fn encode<const N: usize>(&self) -> Vec<u8> {
        let layers: Vec<Layer> =
            self.layers.iter().map(|&(width, activation)| Layer { width, activation }).collect();
        let architecture = Architecture::new(N, &layers).expect("the architecture is valid");
        let inner = numbers(architecture.parameter_count());
        let outer_weights = numbers(architecture.features() * N);
        let output_matrix = numbers(self.outputs * N);
        let gain = entries(self.gain, N);
        let outer_gain = entries(self.outer_gain, architecture.features());
        let is_first = self.format == Format::One;
        let field = if self.has_field { field::<N>(self.neighbours.len()) } else { vec![] };
        let node = AgentConfig {
            agent: self.agent,
            output_matrix: &output_matrix,
            gain: self.gain.matrix(&gain),
            neighbours: NeighbourIds::new(&self.neighbours),
            edge_weights: &vec![0.5; self.neighbours.len()],
            outer_law: OuterLawParams {
                gain: self.outer_gain.matrix(&outer_gain),
                projection: ProjectionParams {
                    radius: 19.0,
                    boundary_layer: 1.0,
                    smoothing: 0.125,
                    smoothness: 1,
                },
            },
            trigger: TriggerParams {
                hold_error_weight: 1e4,
                consensus_weight: 0.5,
                threshold: 10.0,
            },
            step_size: 1e-3,
            exchange: if is_first || self.version < 3 {
                ExchangeParams::PAPER
            } else {
                ExchangeParams { heartbeat: self.version, fade_to: 9, ..ExchangeParams::PAPER }
            },
            field: &field,
        };
        let package = Package {
            epoch: if is_first { 0 } else { self.version / 2 },
            version: self.version,
            replaces: (is_first && self.version > 1).then_some(self.version),
            known_inputs: 0,
            outer_weights_on_switch: match self.version % 2 {
                0 => OnSwitch::Keep,
                _ => OnSwitch::Replace,
            },
            network: InnerNetwork::new(architecture, &inner[..]).expect("the network is valid"),
            outer_weights: &outer_weights,
            node,
            broadcast_interval_min: 0.0,
            trained_box: StateBox { low: &[-1.0; N], high: &[1.0; N] },
            trial: (!is_first && self.version > 1).then_some(TrialLimits {
                seconds: Some(self.version),
                innovation_rms: Some(0.5),
                ..TrialLimits::NONE
            }),
            provenance: Provenance {
                scenario_hash: *b"scenario",
                recipe: self.recipe,
                seed: 42,
                samples: 300,
                errors: (!self.recipe.is_empty())
                    .then_some(TrainingErrors { training: 0.5, held_out: 0.75 }),
                tool_version: [0, 1, 0],
            },
            test_vectors: &[],
        };
        let mut scratch = Scratch::NEW;
        let inputs = numbers(self.test_vectors * N);
        let mut test_vectors = vec![];
        for input in inputs.chunks_exact(N) {
            let (features, output) =
                package.evaluate::<N>(input, &mut scratch).expect("the same dimension");
            test_vectors.extend_from_slice(input);
            test_vectors.extend_from_slice(features);
            test_vectors.extend_from_slice(output.as_slice());
        }
        let package = Package { test_vectors: &test_vectors, ..package };
        let mut buffer = vec![0; 1 << 20];
        let length = package.encode(self.format, &mut buffer).expect("the package fits");
        buffer.truncate(length);
        buffer
    }
}

/// Returns the words of a field observer in the state's own coordinates: the agent measures the first
/// direction, and follows its neighbours in turn in the others.
fn field<const N: usize>(neighbours: usize) -> Vec<f32> {
    let options = Options {
        digest: 0x1234,
        hold: HoldKind::Model,
        coupling: Coupling::Trees,
        uses_network: true,
        adapts: false,
        has_harmonics: true,
        is_half: true,
        timeout: 200,
        bias_kept: 0.999,
        relay_share: 0.9,
    };
    let identity = (0..N * N).map(|entry| if entry % (N + 1) == 0 { 1.0 } else { 0.0 });
    let mut words = options.words().to_vec();
    words.extend(identity.clone().chain(identity));
    words.extend([-2.0; N].into_iter().chain([2.0; N]));
    for c in 0..N {
        let place =
            |next: usize| (c > 0 && neighbours > 0).then(|| ((c + next) % neighbours) as u8);
        let direction = Direction {
            output: (c == 0).then_some(0),
            parent: place(0),
            spare: place(1),
            is_announced: c < 2,
            scale: 1.0,
            root_gain: 60.0,
            tree_gain: 120.0,
            radius: 0.0625,
            model: Model {
                bias_gain: 400.0,
                cosine_gain: 100.0,
                sine_gain: 200.0,
                rotation_cosine: 0.9375,
                rotation_sine: 0.347_985_27,
                clip: 8.0,
            },
        };
        words.extend(direction.words());
    }
    words
}

/// Returns pseudorandom numbers between -0.25 and 0.25.
fn numbers(count: usize) -> Vec<f32> {
    (0..count).map(|index| ((index * 37 + 11) % 101) as f32 / 202.0 - 0.25).collect()
}
