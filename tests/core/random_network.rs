//! Random networks of agents, generated from a seed, and a loop that steps them with lossless,
//! simultaneous frames.

use agent_core::agent::hold::Hold;
use agent_core::agent::inbox::Inbox;
use agent_core::agent::{AgentParams, AgentState, StepOutput};
use agent_core::math::activation::Activation;
use agent_core::math::symmetric::SymmetricMatrix;
use agent_core::observer::feedback::{Neighbour, ObserverParams, OutputMatrix};
use agent_core::observer::network::{Architecture, InnerNetwork, Layer};
use agent_core::observer::outer_law::OuterLawParams;
use agent_core::observer::projection::ProjectionParams;
use agent_core::observer::trigger::TriggerParams;
use agent_core::wire::frame::FrameBytes;
use agent_core::{AgentId, StateVector, Tick};
use nalgebra::{DMatrix, SMatrix};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::core::oracle::Trigger;

/// Capacity for features: the widest random layer.
pub(crate) const FEATURES: usize = 20;

/// The forms of `Gamma`.
#[derive(Clone, Debug)]
pub(crate) enum Gain {
    /// A multiple of the identity.
    Scalar(f32),
    /// The diagonal.
    Diagonal(Vec<f32>),
    /// All entries, row by row.
    Full(Vec<f32>),
}

impl Gain {
    /// Returns the gain in the core's form.
    fn borrowed(&self) -> SymmetricMatrix<'_> {
        match self {
            Self::Scalar(gain) => SymmetricMatrix::Scalar(*gain),
            Self::Diagonal(diagonal) => SymmetricMatrix::Diagonal(diagonal),
            Self::Full(entries) => SymmetricMatrix::Full(entries),
        }
    }
}

/// A random agent.
#[derive(Clone, Debug)]
pub(crate) struct DrawnAgent<const N: usize> {
    pub(crate) id: AgentId,
    pub(crate) neighbours: Vec<Neighbour>,
    pub(crate) output_rows: Vec<StateVector<N>>,
    pub(crate) layers: Vec<Layer>,
    /// Layer by layer, the biases and then the weights, one row per input.
    pub(crate) inner_parameters: Vec<f32>,
    pub(crate) outer_gain: Gain,
    pub(crate) projection: ProjectionParams,
    /// Row by row, shape `[L, N]`.
    pub(crate) outer_weights: Vec<f32>,
    pub(crate) estimate: StateVector<N>,
}

/// A random network.
#[derive(Clone, Debug)]
pub(crate) struct DrawnNetwork<const N: usize> {
    pub(crate) agents: Vec<DrawnAgent<N>>,
    /// `a_ij`, symmetric.
    pub(crate) adjacency: DMatrix<f32>,
    /// `K_1`, symmetric. \[1/s\]
    pub(crate) gain: SMatrix<f32, N, N>,
    /// `dt`. \[s\]
    pub(crate) step_size: f32,
    /// The trigger's constants, in double precision.
    pub(crate) trigger: Trigger,
    /// Magnitude of estimates and measurements.
    pub(crate) magnitude: f32,
}

/// A random number generator.
pub(crate) struct Draw(ChaCha8Rng);

impl Draw {
    /// Creates the generator for a seed.
    pub(crate) fn new(seed: u64) -> Self {
        Self(ChaCha8Rng::seed_from_u64(seed))
    }

    /// Returns a number in `[-size, size]`.
    pub(crate) fn signed(&mut self, size: f32) -> f32 {
        self.0.random_range(-size..=size)
    }

    /// Returns a number in `[low, high]` whose logarithm is uniform.
    pub(crate) fn positive(&mut self, low: f32, high: f32) -> f32 {
        low * (high / low).powf(self.0.random_range(0.0..=1.0))
    }

    /// Returns an integer in `low..=high`.
    pub(crate) fn whole(&mut self, low: usize, high: usize) -> usize {
        self.0.random_range(low..=high)
    }

    /// Returns `count` numbers in `[-size, size]`.
    pub(crate) fn signed_many(&mut self, count: usize, size: f32) -> Vec<f32> {
        (0..count).map(|_| self.signed(size)).collect()
    }

    /// Returns a vector with components in `[-size, size]`.
    pub(crate) fn vector<const N: usize>(&mut self, size: f32) -> StateVector<N> {
        StateVector::from_fn(|_, _| self.signed(size))
    }

    /// Returns a random order of `0..count`.
    pub(crate) fn order(&mut self, count: usize) -> Vec<usize> {
        let mut order: Vec<usize> = (0..count).collect();
        for last in (1..count).rev() {
            order.swap(last, self.whole(0, last));
        }
        order
    }

    /// Returns a symmetric, diagonally dominant matrix with its diagonal around `size`, row by row.
    fn symmetric(&mut self, rows: usize, size: f32) -> Vec<f32> {
        let mut entries = vec![0.0; rows * rows];
        for row in 0..rows {
            entries[row * rows + row] = size * self.positive(0.5, 2.0);
            for column in 0..row {
                let entry = self.signed(0.5 * size / rows as f32);
                entries[row * rows + column] = entry;
                entries[column * rows + row] = entry;
            }
        }
        entries
    }

    /// Returns a connected graph: a random tree and every other edge with probability 0.4.
    fn adjacency(&mut self, agents: usize) -> DMatrix<f32> {
        let mut adjacency = DMatrix::zeros(agents, agents);
        for agent in 1..agents {
            let parent = self.whole(0, agent - 1);
            for other in 0..agent {
                if other == parent || self.0.random_bool(0.4) {
                    let weight = self.positive(0.2, 5.0);
                    adjacency[(agent, other)] = weight;
                    adjacency[(other, agent)] = weight;
                }
            }
        }
        adjacency
    }

    /// Returns one to four layers of 1 to 20 nodes.
    fn layers(&mut self) -> Vec<Layer> {
        let count = self.whole(1, 4);
        (0..count)
            .map(|_| Layer {
                width: self.whole(1, FEATURES) as u8,
                activation: Activation::ALL[self.whole(0, Activation::ALL.len() - 1)],
            })
            .collect()
    }

    /// Returns the flat parameters for `layers` with `inputs` inputs of size `magnitude`, such that
    /// the sums before the activations are about 1.
    fn inner_parameters(&mut self, inputs: usize, layers: &[Layer], magnitude: f32) -> Vec<f32> {
        let (mut parameters, mut inputs, mut magnitude) = (Vec::new(), inputs, magnitude);
        for layer in layers {
            let width = usize::from(layer.width);
            parameters.extend(self.signed_many(width, 1.0));
            let size = 2.0 / (magnitude * (inputs as f32).sqrt());
            parameters.extend(self.signed_many(width * inputs, size));
            (inputs, magnitude) = (width, 1.0);
        }
        parameters
    }

    /// Returns constants for which weights of the norm `norm` are inside the ball, or in the layer
    /// around it.
    fn projection(&mut self, norm: f32, step_size: f32) -> ProjectionParams {
        let in_layer = self.0.random_bool(0.6);
        let radius =
            norm * if in_layer { self.positive(0.7, 0.99) } else { self.positive(1.1, 2.0) };
        let least = (norm - radius).max(0.05 * norm);
        ProjectionParams {
            radius,
            boundary_layer: least * self.positive(1.05, 2.0),
            // Euler's method shrinks the weights by about dt delta / (2 theta_0^2) per step.
            smoothing: self.positive(0.001, 0.1) * radius * radius / step_size,
            smoothness: self.whole(0, 7) as u8,
        }
    }

    fn agent<const N: usize>(
        &mut self,
        id: AgentId,
        magnitude: f32,
        step_size: f32,
    ) -> DrawnAgent<N> {
        let layers = self.layers();
        let features = usize::from(layers[layers.len() - 1].width);
        let outer_weights = self.signed_many(features * N, 5.0);
        let norm = outer_weights.iter().map(|weight| weight * weight).sum::<f32>().sqrt();
        let projection = self.projection(norm, step_size);
        let outputs = self.whole(1, N);
        // A step moves the weights by a small part of the boundary layer: otherwise Euler's method
        // could jump over the layer, and the operator's power of the depth would explode.
        let innovation = magnitude * (outputs * N) as f32;
        let size = self.positive(0.01, 0.3) * projection.boundary_layer
            / (step_size * innovation * (features as f32).sqrt());
        DrawnAgent {
            id,
            neighbours: Vec::new(),
            output_rows: (0..outputs).map(|_| self.vector(1.0)).collect(),
            inner_parameters: self.inner_parameters(N, &layers, magnitude),
            layers,
            outer_gain: match self.whole(0, 2) {
                0 => Gain::Scalar(size),
                1 => {
                    Gain::Diagonal((0..features).map(|_| size * self.positive(0.5, 2.0)).collect())
                }
                _ => Gain::Full(self.symmetric(features, size)),
            },
            projection,
            outer_weights,
            estimate: self.vector(magnitude),
        }
    }

    /// Returns a network of 2 to 6 agents.
    pub(crate) fn network<const N: usize>(&mut self) -> DrawnNetwork<N> {
        let count = self.whole(2, 6);
        let magnitude = self.positive(0.1, 10.0);
        let adjacency = self.adjacency(count);
        let size = self.positive(0.3, 300.0);
        let entries = self.symmetric(N, size);
        let gain = SMatrix::from_row_slice(&entries);
        // Euler's method is stable below about 2 / |L (x) K_1|, and the network's term, about 20
        // for 20 features and weights up to 5, must not carry an estimate away in one step.
        let degree = adjacency.row_iter().map(|row| row.sum()).fold(0.0, f32::max);
        let rate = size * (2.0 * degree + N as f32) + 20.0 / magnitude;
        let step_size = self.positive(0.01, 1.0) / rate;

        let (adjacency_64, gain_64) =
            (adjacency.map(f64::from), DMatrix::from_row_slice(N, N, &entries).map(f64::from));
        let (k_2, kappa) =
            (f64::from(self.positive(0.1, 100.0)), f64::from(self.positive(0.1, 10.0)));
        let phi_1 = Trigger::new(&adjacency_64, &gain_64, k_2, kappa, 1.0).phi_1;
        // The hold error at which the trigger fires for z = 0, in steps of change.
        let radius = f64::from(magnitude * self.positive(0.1, 100.0) * (step_size * size).min(1.0));
        let epsilon = count as f64 * phi_1 * radius.powi(2);

        let mut ids: Vec<AgentId> = Vec::new();
        while ids.len() < count {
            let id = self.0.random();
            if !ids.contains(&id) {
                ids.push(id);
            }
        }
        let mut agents: Vec<_> =
            ids.iter().map(|&id| self.agent(id, magnitude, step_size)).collect();
        for (index, agent) in agents.iter_mut().enumerate() {
            for other in self.order(count) {
                let weight = adjacency[(index, other)];
                if weight > 0.0 {
                    agent.neighbours.push(Neighbour { id: ids[other], weight });
                }
            }
        }
        DrawnNetwork {
            agents,
            trigger: Trigger::new(&adjacency_64, &gain_64, k_2, kappa, epsilon),
            adjacency,
            gain,
            step_size,
            magnitude,
        }
    }

    /// Returns a measurement for each agent.
    pub(crate) fn measurements<const N: usize>(
        &mut self,
        network: &DrawnNetwork<N>,
    ) -> Vec<Vec<f32>> {
        let outputs = network.agents.iter().map(|agent| agent.output_rows.len());
        outputs.map(|outputs| self.signed_many(outputs, network.magnitude)).collect()
    }
}

impl<const N: usize> DrawnAgent<N> {
    /// Returns `L`.
    pub(crate) fn features(&self) -> usize {
        self.outer_weights.len() / N
    }

    /// Returns the inner network with its parameters in a vector.
    pub(crate) fn inner_network(&self) -> InnerNetwork<Vec<f32>> {
        let architecture = Architecture::new(N, &self.layers).unwrap();
        InnerNetwork::new(architecture, self.inner_parameters.clone()).unwrap()
    }
}

/// Buffers for an agent's neighbours on the heap.
pub(crate) type ParamBuffers<const N: usize> = Vec<Option<Hold<N>>>;

/// One running agent.
#[derive(Clone, Debug)]
pub(crate) struct Member<'a, const N: usize> {
    pub(crate) params: AgentParams<'a, N>,
    pub(crate) inner_network: InnerNetwork<Vec<f32>>,
    pub(crate) state: AgentState<N, FEATURES, ParamBuffers<N>>,
    pub(crate) inbox: Inbox<N, ParamBuffers<N>>,
}

impl<const N: usize> DrawnNetwork<N> {
    /// Returns the parameters of one agent.
    pub(crate) fn params(&self, agent: usize) -> AgentParams<'_, N> {
        let drawn = &self.agents[agent];
        AgentParams::new(
            drawn.id,
            self.step_size,
            ObserverParams {
                output_matrix: OutputMatrix::new(&drawn.output_rows).unwrap(),
                gain: self.gain,
                neighbours: &drawn.neighbours,
            },
            OuterLawParams { gain: drawn.outer_gain.borrowed(), projection: drawn.projection },
            TriggerParams {
                hold_error_weight: self.trigger.phi_1 as f32,
                consensus_weight: self.trigger.phi_2 as f32,
                threshold: self.trigger.threshold as f32,
            },
        )
        .unwrap()
    }

    /// Returns all agents at tick 0, before any announcement.
    pub(crate) fn silent_members(&self) -> Vec<Member<'_, N>> {
        let members = self.agents.iter().enumerate().map(|(index, drawn)| {
            let params = self.params(index);
            let places = vec![None; drawn.neighbours.len()];
            let (estimate, weights) = (drawn.estimate, &drawn.outer_weights);
            Member {
                state: AgentState::new(&params, estimate, weights, places.clone()).unwrap(),
                params,
                inner_network: drawn.inner_network(),
                inbox: Inbox::new(places),
            }
        });
        members.collect()
    }

    /// Returns all agents at tick 0 with every announcement delivered.
    pub(crate) fn members(&self) -> Vec<Member<'_, N>> {
        let mut members = self.silent_members();
        let frames: Vec<_> = members
            .iter()
            .map(|m| (m.params.id(), m.state.announcement(&m.params).encode()))
            .collect();
        deliver(&mut members, &frames);
        members
    }
}

/// Puts every frame into the inbox of every neighbour of its sender.
pub(crate) fn deliver<const N: usize>(
    members: &mut [Member<'_, N>],
    frames: &[(AgentId, FrameBytes)],
) {
    for (sender, bytes) in frames {
        for member in members.iter_mut() {
            let neighbours = member.params.neighbours();
            if neighbours.iter().any(|neighbour| neighbour.id == *sender) {
                member.inbox.accept(neighbours, bytes).unwrap();
            }
        }
    }
}

impl<const N: usize> Member<'_, N> {
    /// Takes one step, which must succeed.
    pub(crate) fn step(&mut self, tick: Tick, measurement: &[f32]) -> StepOutput<N> {
        let network = Some(&self.inner_network);
        self.state.step(&self.params, network, tick, measurement, &mut self.inbox).unwrap()
    }
}

/// Takes one step of all agents in the given order and delivers their broadcasts; returns the
/// outputs by agent.
pub(crate) fn step_all<const N: usize>(
    members: &mut [Member<'_, N>],
    order: &[usize],
    tick: Tick,
    measurements: &[Vec<f32>],
) -> Vec<StepOutput<N>> {
    let mut outputs = vec![None; members.len()];
    for &agent in order {
        outputs[agent] = Some(members[agent].step(tick, &measurements[agent]));
    }
    let outputs: Vec<StepOutput<N>> = outputs.into_iter().map(Option::unwrap).collect();
    let frames = outputs.iter().filter_map(|output| output.broadcast);
    deliver(members, &frames.map(|frame| (frame.sender, frame.encode())).collect::<Vec<_>>());
    outputs
}
