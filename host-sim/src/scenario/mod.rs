//! What is simulated: a checked description of plant, network of agents, gains, deep network
//! and learning, read from a TOML file.
//!
//! The types here hold what has already been checked as a whole (dimensions agree, the graph
//! is connected, every number is finite), so that the engine need not look again. All numbers
//! are in the units of the file: states as the user scales them, time in \[s\].

mod builtin;
mod error;
mod load;
mod reader;
mod sections;

pub use builtin::{BUILT_IN, PAPER, built_in};
pub use error::ScenarioError;
pub use sections::link::LinkModel;

use std::num::NonZeroU32;

use agent_core::health::HealthSettings;
use agent_core::observer::network::Architecture;
use nalgebra::DMatrix;

use crate::graph::Graph;
use crate::packages::PackageBytes;
use crate::plant::{Disturbance, Integrator, Plant};
use crate::training::{InitialParameters, TrainerSettings, TrainingSettings};

/// One experiment, complete but for the seed.
#[derive(Clone, Debug)]
pub struct Scenario {
    /// Its name, for reports and file names.
    pub name: String,
    /// Hash of the text that it was read from (FNV-1a, 64 bits), whatever its line ends.
    pub hash: u64,
    /// `f`, the drift that nobody knows.
    pub plant: Plant,
    /// `d`, what else acts on the plant.
    pub disturbance: Disturbance,
    /// `x_0(0)`, shape `[n]`.
    pub initial_state: Vec<f64>,
    /// How long, and in which steps.
    pub time: Time,
    /// Gains of the observer and constants of its analysis.
    pub design: Design,
    /// The deep network; without one the agents run on their feedback alone.
    pub network: Option<Network>,
    /// Who hears whom.
    pub graph: Graph,
    /// What happens to frames between agents.
    pub link: LinkModel,
    /// The agents; agent `i` of the paper is entry `i - 1`.
    pub agents: Vec<Agent>,
    /// Learning cycles, in the order of the file.
    pub learning: Vec<LearningCycle>,
    /// Ways of training that learning cycles name, in the order of the file.
    pub recipes: Vec<Recipe>,
    /// How agents are watched; without it they are not.
    pub health: Option<HealthSettings>,
    /// Over which time errors are evaluated.
    pub evaluation: Window,
    /// What is written down.
    pub record: Record,
}

impl Scenario {
    /// `n`, the dimension of the state.
    #[must_use]
    pub fn dimension(&self) -> usize {
        self.initial_state.len()
    }

    /// How many steps the run takes.
    #[must_use]
    pub fn steps(&self) -> u64 {
        self.time.tick(self.time.duration)
    }

    /// The recipe of that name.
    #[must_use]
    pub fn recipe(&self, name: &str) -> Option<&Recipe> {
        self.recipes.iter().find(|recipe| recipe.name == name)
    }
}

/// Duration and step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Time {
    /// Length of the run. \[s\]
    pub duration: f64,
    /// Step of plant and agents. \[s\]
    pub step_size: f64,
    /// How the plant is integrated; the agents always take Euler's steps.
    pub integrator: Integrator,
}

impl Time {
    /// The step that begins nearest to `time` \[s\].
    #[must_use]
    pub fn tick(&self, time: f64) -> u64 {
        (time / self.step_size).round() as u64
    }

    /// When step `tick` begins. \[s\]
    #[must_use]
    pub fn at(&self, tick: u64) -> f64 {
        tick as f64 * self.step_size
    }
}

/// Gain of the observer and the constants that its analysis ties to it.
#[derive(Clone, Debug, PartialEq)]
pub struct Design {
    /// `K_1`, symmetric, shape `[n, n]`. \[1/s\]
    pub gain: DMatrix<f64>,
    /// `k_2`. \[1/s\]
    pub k2: f64,
    /// `kappa`. \[s\]
    pub kappa: f64,
    /// `rho`, the assumed bound of the lumped uncertainty. \[state unit/s\]
    pub rho: f64,
    /// `delta` of `k_1 = k_2 + rho^2 / delta`. \[squared state unit/s\]
    pub delta: f64,
    /// `epsilon` of the trigger, for the whole network. \[squared state unit/s\]
    pub epsilon: f64,
}

/// The outer-weight law and its projection.
#[derive(Clone, Debug, PartialEq)]
pub struct OuterLaw {
    /// `Gamma`. \[1/s^2\]
    pub gain: OuterGain,
    /// `omega_bar`, the bound that the Frobenius norm of the outer weights never exceeds.
    pub bound: f64,
    /// `beta` of the projection; its inner radius is `bound - boundary_layer`.
    pub boundary_layer: f64,
    /// `delta` of the projection.
    pub smoothing: f64,
    /// `m` of the projection, 0 to 7.
    pub smoothness: u8,
}

/// `Gamma`, shape `[L, L]`, positive definite.
#[derive(Clone, Debug, PartialEq)]
pub enum OuterGain {
    /// A multiple of the identity.
    Scalar(f64),
    /// A diagonal.
    Diagonal(Vec<f64>),
    /// A full symmetric matrix.
    Full(DMatrix<f64>),
}

/// The deep network that every agent starts with.
#[derive(Clone, Debug, PartialEq)]
pub struct Network {
    /// Inner layers.
    pub architecture: Architecture,
    /// Weights and biases of the inner layers at the start.
    pub inner: InitialParameters,
    /// `W_hat(0)`, row by row, shape `[L, n]`.
    pub outer: Vec<f64>,
    /// The adaptation of the outer weights.
    pub outer_law: OuterLaw,
}

/// One agent.
#[derive(Clone, Debug, PartialEq)]
pub struct Agent {
    /// `C_i`, shape `[m, n]`.
    pub output_matrix: DMatrix<f64>,
    /// `x_hat_i(0)`, shape `[n]`.
    pub initial_estimate: Vec<f64>,
    /// The weight package to start with, in place of the scenario's own network.
    pub package: Option<PackageBytes>,
}

/// One cycle of collecting, training and switching in.
#[derive(Clone, Debug, PartialEq)]
pub struct LearningCycle {
    /// Which agents, as indices from 0.
    pub agents: Vec<usize>,
    /// When data are collected. \[s\]
    pub collect: Window,
    /// Every how many steps a sample is taken.
    pub stride: NonZeroU32,
    /// When the trained network is switched in. \[s\]
    pub apply_at: f64,
    /// Name of the recipe.
    pub recipe: String,
}

/// How collected samples become a network.
#[derive(Clone, Debug, PartialEq)]
pub struct Recipe {
    /// Its name.
    pub name: String,
    /// Length of the centred moving average that cleans inputs and targets of the high-gain
    /// chatter; 0 leaves them raw, `None` lets the samples' own spectrum decide. \[s\]
    pub smoothing_window: Option<f64>,
    /// Of the cleaned samples every how many-th is used; `None` follows from the window.
    pub decimation: Option<NonZeroU32>,
    /// Whether training takes place in units of the data.
    pub normalise: bool,
    /// Where training starts.
    pub initial: InitialParameters,
    /// Parts of the samples for training, validation and test; they add up to 1.
    pub split: [f64; 3],
    /// Penalty on the squared norm of the inner weights; 0 for none.
    pub weight_decay: f64,
    /// The trainer and its settings.
    pub trainer: TrainerSettings,
    /// When the trained network is used.
    pub switch_in: SwitchIn,
}

/// When a trained network is packed and switched in.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SwitchIn {
    /// If it explains a part of the variance of the smoothed targets at the end of the samples.
    #[default]
    Checked,
    /// Always.
    Always,
}

impl Recipe {
    /// Start, division of the samples, and solver.
    #[must_use]
    pub fn settings(&self) -> TrainingSettings {
        TrainingSettings {
            trainer: self.trainer.clone(),
            split: self.split,
            initial: self.initial.clone(),
            weight_decay: self.weight_decay,
            normalise: self.normalise,
        }
    }
}

/// An interval of time, `from <= t < to`. \[s\]
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Window {
    /// Where it begins.
    pub from: f64,
    /// Where it ends.
    pub to: f64,
}

impl Window {
    /// The steps that begin inside.
    #[must_use]
    pub fn ticks(&self, time: &Time) -> std::ops::Range<u64> {
        time.tick(self.from)..time.tick(self.to)
    }
}

/// What is written down during a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Record {
    /// Every how many steps a row of the traces is kept; `None` keeps no traces.
    pub trace_stride: Option<NonZeroU32>,
    /// Whether every agent's broadcast times are kept.
    pub events: bool,
    /// Whether the samples of learning cycles are kept.
    pub samples: bool,
}

#[cfg(test)]
mod tests;
