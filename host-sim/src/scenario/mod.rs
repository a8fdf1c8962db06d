//! Scenarios: checked descriptions of the plant, the network of agents, the gains, the deep network
//! and the learning cycles, read from a TOML file.
//!
//! Values of these types have been checked as a whole (dimensions agree, the graph is connected,
//! every number is finite), so the engine does not check them again. All numbers are in the units
//! of the file: states as the user scales them, time in \[s\].

mod builtin;
mod changes;
mod copies;
mod error;
mod initial_state;
mod load;
mod reader;
mod sections;
mod source;

pub use builtin::{BUILT_IN, PAPER, built_in};
pub use changes::{Change, ChangeError};
pub use copies::{copied, without_files};
pub use error::ScenarioError;
pub use initial_state::drawn_state;
pub use sections::clock::ClockSettings;
pub use sections::life::Downtime;
pub use sections::link::{Burst, EdgeRule, EdgeSettings, LinkSettings, MediumSettings, Partition};
pub use sections::method::{KalmanSettings, Method};
pub use sections::observer::{DisturbanceModel, ObserverSettings};
pub use sections::sensor::{Outliers, SensorSettings};
pub use sections::trigger::TriggerModel;
pub use source::ScenarioSource;

use std::borrow::Cow;
use std::num::NonZeroU32;

use agent_core::agent::exchange::ExchangeParams;
use agent_core::health::HealthSettings;
use agent_core::observer::network::Architecture;
use nalgebra::DMatrix;

use crate::graph::Graph;
use crate::packages::PackageBytes;
use crate::plant::{Disturbance, Integrator, Plant};
use crate::training::{InitialParameters, TrainerSettings, TrainingSettings};

/// One experiment, complete except for the seed.
#[derive(Clone, Debug)]
pub struct Scenario {
    /// Its name, used in reports and file names.
    pub name: String,
    /// Hash of the scenario's text (FNV-1a, 64 bits), independent of line endings.
    pub hash: u64,
    /// `f`, the drift, unknown to the agents.
    pub plant: Plant,
    /// `d`, the disturbance of the plant; a random one has no path until [`Self::drawn`].
    pub disturbance: Disturbance,
    /// `x_0(0)`, shape `[n]`; with [`Self::initial_spread`] the one of seed 0, until
    /// [`Self::drawn`].
    pub initial_state: Vec<f64>,
    /// Half widths of the uniform distribution that the run's seed draws `x_0(0)` from, shape `[n]`;
    /// `None` if it is given.
    pub initial_spread: Option<Vec<f64>>,
    /// Intensity of the white noise that drives the plant, shape `[n]`; empty without noise.
    /// \[state unit/sqrt(s)\]
    pub process_noise: Vec<f64>,
    /// Duration, step and plant integrator.
    pub time: Time,
    /// Gains of the observer and constants of its analysis.
    pub design: Design,
    /// The deep network; `None` if the agents use feedback alone.
    pub network: Option<Network>,
    /// The communication graph.
    pub graph: Graph,
    /// What happens to frames between agents.
    pub link: LinkSettings,
    /// When agents are down.
    pub life: Vec<Downtime>,
    /// When agents broadcast.
    pub trigger: TriggerModel,
    /// How agents estimate: the observer, or a baseline.
    pub method: Method,
    /// Settings of the Kalman filters.
    pub kalman: KalmanSettings,
    /// When agents broadcast other than at their events, and how they treat late and old samples.
    pub exchange: ExchangeParams,
    /// The field observer; `None` for the paper's.
    pub observer: Option<ObserverSettings>,
    /// The agents; agent `i` of the paper is entry `i - 1`.
    pub agents: Vec<Agent>,
    /// Learning cycles, in file order.
    pub learning: Vec<LearningCycle>,
    /// Cycles that follow the last of these by themselves; none without them.
    pub relearning: Option<Relearning>,
    /// Training recipes that learning cycles refer to, in file order.
    pub recipes: Vec<Recipe>,
    /// Health monitoring of the agents; `None` if they are not monitored.
    pub health: Option<HealthSettings>,
    /// The window over which errors are evaluated.
    pub evaluation: Window,
    /// What is recorded.
    pub record: Record,
    /// Steps to run in place of the whole duration. What is derived from the plant's motion, such as the field
    /// observer's settings, is derived from the whole duration in any case.
    pub run_steps: Option<u64>,
}

impl Scenario {
    /// Returns `n`, the dimension of the state.
    #[must_use]
    pub fn dimension(&self) -> usize {
        self.initial_state.len()
    }

    /// Returns the scenario with the initial state and the disturbance of a run with this seed: itself, unless one
    /// of them is drawn.
    #[must_use]
    pub fn drawn(&self, seed: u64) -> Cow<'_, Self> {
        let initial_state = self.initial_spread.as_ref().map(|spread| drawn_state(spread, seed, 0));
        let mut drawn = Cow::Borrowed(self);
        if let Some(initial_state) = initial_state {
            drawn.to_mut().initial_state = initial_state;
        }
        let steps = self.steps().max(self.time.steps());
        if let Some(disturbance) = self.disturbance.drawn(seed, self.time.step_size, steps) {
            drawn.to_mut().disturbance = disturbance;
        }
        drawn
    }

    /// Returns the number of steps in the run.
    #[must_use]
    pub fn steps(&self) -> u64 {
        self.run_steps.unwrap_or(self.time.steps())
    }

    /// Returns what the paper's theorems do not allow for, apart from the trigger: one clause for each, such
    /// as "links are not ideal (\[link\])".
    #[must_use]
    pub fn departures(&self) -> Vec<&'static str> {
        let clock = ClockSettings::default();
        [
            (!self.link.is_ideal(), "links are not ideal ([link])"),
            (
                !self.agents.iter().all(|a| a.sensor.is_ideal()),
                "measurements are not exact ([sensor])",
            ),
            (
                self.exchange != ExchangeParams::PAPER,
                "agents broadcast and use samples differently from the paper ([exchange])",
            ),
            (self.plant.recording().is_some(), "the plant is a recording (plant.model)"),
            (!self.process_noise.is_empty(), "noise drives the plant (plant.noise)"),
            (self.agents.iter().any(|a| a.clock != clock), "clocks differ ([clock])"),
            (!self.life.is_empty(), "agents are down at times ([[life]])"),
            (self.runs_field_observer(), "agents run the field observer ([observer])"),
            (self.method != Method::Observer, "agents run another method (method)"),
        ]
        .into_iter()
        .filter_map(|(departs, clause)| departs.then_some(clause))
        .collect()
    }

    /// Whether agents run the field observer at some time.
    #[must_use]
    pub fn runs_field_observer(&self) -> bool {
        self.observer.is_some() && !self.method.is_kalman()
    }

    /// Whether agents use `design.gain` at some time: until the field observer is in use, and not with a Kalman filter.
    #[must_use]
    pub fn uses_design_gain(&self) -> bool {
        let until = self.observer.as_ref().map_or(f64::INFINITY, |observer| observer.from);
        !self.method.is_kalman() && until > 0.0
    }

    /// Checks that nodes can run what the scenario describes.
    ///
    /// # Errors
    /// If it is for simulation only.
    pub fn check_for_nodes(&self) -> Result<(), SimulationOnly> {
        if self.method != Method::Observer {
            return Err(SimulationOnly::Method { method: self.method.name() });
        }
        if self.network.is_some() && !self.plant.input_names().is_empty() {
            return Err(SimulationOnly::KnownInputs);
        }
        self.trigger.departure().map_or(Ok(()), |model| Err(SimulationOnly::Trigger { model }))
    }

    /// Returns `p`, the number of known inputs that a network takes in addition to the state.
    #[must_use]
    pub fn known_inputs_of(&self, network: &Network) -> usize {
        network.architecture.inputs().saturating_sub(self.dimension())
    }

    /// Returns whether every broadcast reaches all neighbours at once and unharmed.
    #[must_use]
    pub fn delivers_all(&self) -> bool {
        self.link.is_ideal() && self.life.is_empty()
    }

    /// Returns when a cycle that starts by itself is applied at the earliest \[s\]; `None` if none does.
    #[must_use]
    pub fn relearning_end(&self) -> Option<f64> {
        let (relearning, last) = (self.relearning.as_ref()?, self.learning.last()?);
        let windows = 1 + Relearning::REFERENCES + Relearning::ABOVE;
        let from = self.observer.as_ref().map_or(0.0, |observer| observer.from);
        let watched_from = self.learning.iter().map(|cycle| cycle.apply_at).fold(from, f64::max);
        let length = last.apply_at - last.collect.from;
        // Windows are whole steps.
        let window = self.time.tick(relearning.window).max(1) as f64 * self.time.step_size;
        Some(watched_from + f64::from(windows) * window + length)
    }

    /// Returns how many cycles can start by themselves at most.
    #[must_use]
    pub fn relearnings_max(&self) -> usize {
        let (Some(relearning), Some(last)) = (&self.relearning, self.learning.last()) else {
            return 0;
        };
        let length = last.apply_at - last.collect.from;
        let windows = |count: u32| f64::from(count) * relearning.window;
        let Some(rest) = self.relearning_end().map(|end| self.time.at(self.steps()) - end) else {
            return 0;
        };
        if rest < 0.0 {
            return 0;
        }
        // After a network that is not used the next cycle waits for fewer windows.
        let between = relearning.pause.max(length + windows(Relearning::ABOVE));
        1 + (rest / between) as usize
    }

    /// Returns the recipe with this name.
    #[must_use]
    pub fn recipe(&self, name: &str) -> Option<&Recipe> {
        self.recipes.iter().find(|recipe| recipe.name == name)
    }
}

/// Why nodes cannot run a scenario.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SimulationOnly {
    /// Weight packages cannot carry the trigger.
    #[error(
        "trigger.kind: broadcasting {model} is for simulation only, because weight packages carry the \
         event trigger; remove [trigger], or write kind = \"event\""
    )]
    Trigger {
        /// When agents broadcast.
        model: String,
    },
    /// Nodes do not know the plant's inputs.
    #[error(
        "plant.inputs: a network with known inputs is for simulation only, because nodes do not receive them; \
         remove plant.inputs, or [network]"
    )]
    KnownInputs,
    /// Nodes run the observer only.
    #[error(
        "method = {method:?} is for simulation only, because nodes run the observer; remove it, or write \
         method = \"observer\""
    )]
    Method {
        /// The method.
        method: &'static str,
    },
}

/// Duration and step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Time {
    /// Length of the scenario. \[s\]
    pub duration: f64,
    /// Step of plant and agents. \[s\]
    pub step_size: f64,
    /// How the plant is integrated; the agents always use Euler's method.
    pub integrator: Integrator,
}

impl Time {
    /// Returns the number of steps in the duration.
    #[must_use]
    pub fn steps(&self) -> u64 {
        self.tick(self.duration)
    }

    /// Returns the step whose start is nearest to `time` \[s\].
    #[must_use]
    pub fn tick(&self, time: f64) -> u64 {
        (time / self.step_size).round() as u64
    }

    /// Returns the start of step `tick`. \[s\]
    #[must_use]
    pub fn at(&self, tick: u64) -> f64 {
        tick as f64 * self.step_size
    }
}

/// Gain of the observer and the constants of its analysis.
#[derive(Clone, Debug, PartialEq)]
pub struct Design {
    /// `K_1`, symmetric, shape `[n, n]`. \[1/s\]
    pub gain: DMatrix<f64>,
    /// `k_2`. \[1/s\]
    pub k2: f64,
    /// `kappa`. \[s\]
    pub kappa: f64,
    /// `rho`, the assumed bound on the lumped uncertainty. \[state unit/s\]
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
    /// Initial weights and biases of the inner layers.
    pub inner: InitialParameters,
    /// `W_hat(0)`, row by row, shape `[L, n]`.
    pub outer: Vec<f64>,
    /// The adaptation law of the outer weights.
    pub outer_law: OuterLaw,
}

/// One agent.
#[derive(Clone, Debug, PartialEq)]
pub struct Agent {
    /// `C_i`, shape `[m, n]`.
    pub output_matrix: DMatrix<f64>,
    /// Columns of the plant's recording that the agent measures, one for each output; empty for `C_i x_0`.
    pub measured: Vec<usize>,
    /// `x_hat_i(0)`, shape `[n]`.
    pub initial_estimate: Vec<f64>,
    /// The weight package to start with, instead of the scenario's own network.
    pub package: Option<PackageBytes>,
    /// How the agent measures.
    pub sensor: SensorSettings,
    /// The agent's clock.
    pub clock: ClockSettings,
}

/// One cycle of collecting samples, training, and switching the network in.
#[derive(Clone, Debug, PartialEq)]
pub struct LearningCycle {
    /// The agents that learn, as indices from 0.
    pub agents: Vec<usize>,
    /// When samples are collected. \[s\]
    pub collect: Window,
    /// Steps between samples.
    pub stride: NonZeroU32,
    /// When the trained network is switched in. \[s\]
    pub apply_at: f64,
    /// Name of the recipe.
    pub recipe: String,
    /// Whether all agents get one network, trained on the samples of all.
    pub is_shared: bool,
}

/// When further cycles, like the last of the scenario, start by themselves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Relearning {
    /// Number of broadcasts of all agents in a window, as a multiple of their mean in the three windows
    /// after the first one after the last switch.
    pub rate: f64,
    /// Length of a window. \[s\]
    pub window: f64,
    /// Least time between the starts of two cycles that started by themselves. \[s\]
    pub pause: f64,
}

impl Relearning {
    /// Windows that say how often agents broadcast with a network, after the one in which the observer settles.
    pub const REFERENCES: u32 = 3;

    /// Number of consecutive windows above the rate before a cycle starts.
    pub const ABOVE: u32 = 2;
}

/// How collected samples become a trained network.
#[derive(Clone, Debug, PartialEq)]
pub struct Recipe {
    /// Its name.
    pub name: String,
    /// Length of the centred moving average that removes high-gain chatter from inputs and targets;
    /// 0 leaves them unfiltered, `None` derives it from the samples' spectrum. \[s\]
    pub smoothing_window: Option<f64>,
    /// Keep one cleaned sample out of this many; `None` derives it from the window.
    pub decimation: Option<NonZeroU32>,
    /// Whether inputs and targets are normalised for training.
    pub normalise: bool,
    /// Initial parameters of the training.
    pub initial: InitialParameters,
    /// Fractions of the samples for training, validation and test; they add up to 1.
    pub split: [f64; 3],
    /// Penalty on the squared norm of the inner weights; 0 disables it.
    pub weight_decay: f64,
    /// The trainer and its settings.
    pub trainer: TrainerSettings,
    /// When the trained network is switched in.
    pub switch_in: SwitchIn,
}

/// When a trained network is packaged and switched in.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum SwitchIn {
    /// If it explains part of the variance of the smoothed targets at the end of the samples.
    #[default]
    Checked,
    /// Always.
    Always,
}

impl Recipe {
    /// Returns the initial parameters, the data split and the solver settings.
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

/// A half-open interval of time, `from <= t < to`. \[s\]
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Window {
    /// Start of the interval.
    pub from: f64,
    /// End of the interval.
    pub to: f64,
}

impl Window {
    /// Returns the steps that start inside the window.
    #[must_use]
    pub fn ticks(&self, time: &Time) -> std::ops::Range<u64> {
        time.tick(self.from)..time.tick(self.to)
    }
}

/// What is recorded during a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Record {
    /// Steps between rows of the traces; `None` records no traces.
    pub trace_stride: Option<NonZeroU32>,
    /// Whether the broadcast times of every agent are recorded.
    pub events: bool,
    /// Whether the samples of learning cycles are recorded.
    pub samples: bool,
}

impl Record {
    /// Nothing: for a run made for comparison only.
    pub const NOTHING: Self = Self { trace_stride: None, events: false, samples: false };
}

#[cfg(test)]
mod tests;
