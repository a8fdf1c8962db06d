//! The simulation engine: plant in double precision, agents in the core's single precision,
//! frames over a [`link::Link`].
//!
//! Step `k` runs from `t_k = k dt` to `t_(k+1)`:
//! 1. networks that are due are switched in,
//! 2. every agent that is up receives the frames of `t_k`, measures `x_0(t_k)`, and takes its step,
//! 3. samples, errors and traces of `t_k` are recorded,
//! 4. broadcasts of `t_(k+1)` are sent over the link, in ascending order of agents,
//! 5. the plant is integrated to `t_(k+1)`.
//!
//! A run is a pure function of scenario, seed and link. Agents only read frames that the link
//! has delivered before any of them steps, so they can be stepped in parallel, and the result is the same to the last bit
//! for any number of threads. The networks of many agents are evaluated at once, in the lanes of the processor's vectors ([`LaneMode`]),
//! which changes no bit either.

mod agents;
pub mod bounds;
mod clock;
mod failure;
mod kalman;
mod lanes;
mod learning;
pub mod link;
mod method;
mod networks;
mod norms;
mod run;
pub mod run_observer;
mod sensor;
mod sent;
mod simulated_plant;
mod state_size;
pub mod statistics;
mod stepping;
pub mod traces;
mod watch;

use agent_core::agent::StepError;
use agent_core::math::parameter::ParameterError;
use agent_core::package::Refusal;

use crate::analysis::StepCheck;
use crate::flow::PlanError;
use crate::learning::harmonic::Harmonic;
use crate::learning::quality::Quality;
use crate::learning::trained::TrainedError;
use crate::number::{seconds, significant};
use crate::packages::parameter::InScenario;
use crate::packages::{DraftError, PackageBytes, Recording};
use crate::plant::RateFault;
use crate::scenario::{ClockSettings, LearningCycle, Method, Scenario};
use crate::training::{EpochReport, TrainingError, TrainingReport};
use crate::warning::Warning;
use bounds::Bounds;
use failure::{norm_in_words, step_hint};
use link::LayerCount;
use statistics::AgentStatistics;
use traces::Traces;

pub use failure::remedy;
pub use lanes::LaneMode;
pub use run::{run, run_in_lanes, run_observed, run_over, start_package};
pub use run_observer::{RunObserver, RunObserverError};

/// Receives progress reports of a run; the methods do nothing by default.
pub trait Progress: Sync {
    /// Reports that the run has reached `tick` of `steps`.
    fn step(&self, tick: u64, steps: u64) {
        let _ = (tick, steps);
    }

    /// Reports that training of `agent` in `cycle`, both from 1, has finished an epoch.
    fn epoch(&self, agent: usize, cycle: usize, report: &EpochReport) {
        let _ = (agent, cycle, report);
    }

    /// Whether to stop the run, asked every so often. If so, the run fails with
    /// [`RunError::Interrupted`].
    fn is_stopped(&self) -> bool {
        false
    }
}

/// A [`Progress`] that ignores all reports.
#[derive(Clone, Copy, Debug)]
pub struct Silent;

impl Progress for Silent {}

/// Options of a run beyond its scenario.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RunOptions {
    /// Random seed.
    pub seed: u64,
    /// Whether learning cycles are carried out.
    pub learning: bool,
    /// Whether to measure the quantities that the theorems bound.
    pub bounds: bool,
}

/// Checks, without a run, that the method of a scenario supports the scenario. Only the Kalman filters have
/// conditions.
///
/// # Errors
/// The error that a run would end with at its start.
pub fn check_method(scenario: &Scenario) -> Result<(), RunError> {
    if scenario.method.is_kalman() { kalman::course(scenario).map(drop) } else { Ok(()) }
}

/// Checks that a method can deal with what is in a scenario, whatever the plant does.
///
/// # Errors
/// [`RunError::KalmanClock`].
pub fn check_support(scenario: &Scenario, method: Method) -> Result<(), RunError> {
    let has_clocks = scenario.agents.iter().any(|agent| agent.clock != ClockSettings::default());
    if method.is_kalman() && has_clocks { Err(RunError::KalmanClock) } else { Ok(()) }
}

/// The results of a run.
#[derive(Clone, Debug)]
pub struct RunResult {
    /// Statistics of each agent.
    pub agents: Vec<AgentStatistics>,
    /// The learning cycles: the scenario's, and those that started by themselves; empty without learning.
    pub cycles: Vec<LearningCycle>,
    /// All training runs, in the order of cycles and agents.
    pub trainings: Vec<TrainingRecord>,
    /// Rows of `x_0` and all `x_hat_i`; empty if the scenario records none.
    pub traces: Traces,
    /// What agents missed of learning cycles and switches while they were down, in words.
    pub missed: Vec<String>,
    /// What each layer of the link did, in their order; empty for a link without layers.
    pub layers: Vec<LayerCount>,
    /// Measurements for the theorems' bounds; `None` if not requested.
    pub bounds: Option<Bounds>,
    /// The largest `|x_0|`; 0 if it is not known. \[state unit\]
    pub largest_state: f64,
    /// The root mean square of the distance of `x_0` from its mean over the evaluation window, which is the error of
    /// an estimate that stays there; 0 if the state is not known. \[state unit\]
    pub state_deviation: f64,
    /// A hash of every broadcast and of the final state of every agent. Equal digests mean, except
    /// for hash collisions, that two runs behaved identically.
    pub digest: u64,
}

impl RunResult {
    /// Returns the agent, from 1, with the largest root mean square of the error in the evaluation window, and
    /// that error; `None` if errors are not known or one is not finite. \[state unit\]
    #[must_use]
    pub fn largest_rmse(&self) -> Option<(usize, f64)> {
        let errors: Option<Vec<f64>> =
            self.agents.iter().map(|agent| agent.rmse().filter(|rmse| rmse.is_finite())).collect();
        let errors = (1..).zip(errors?);
        errors.reduce(|worst, other| if other.1 > worst.1 { other } else { worst })
    }

    /// Returns [`Self::largest_rmse`] if the agent's estimate is of no use: its error is at least 90 % of
    /// [`Self::state_deviation`], that of an estimate that never moves. A plant that comes to rest is easily
    /// estimated like that, so an error counts only from 5 % of the largest state on.
    #[must_use]
    pub fn useless_estimate(&self) -> Option<(usize, f64)> {
        let least = (Self::USELESS * self.state_deviation).max(Self::SETTLED * self.largest_state);
        let is_known = self.state_deviation > 0.0;
        self.largest_rmse().filter(|&(_, rmse)| is_known && rmse >= least)
    }

    /// Share of the error of an estimate that never moves from which on an error is useless.
    const USELESS: f64 = 0.9;

    /// Share of the largest state below which no error is called useless.
    const SETTLED: f64 = 0.05;

    /// Returns the largest error in the evaluation window if it is excessive: not finite, or more than
    /// [`Growth::FAR`](bounds::Growth::FAR) times the largest state, which an observer that always estimates
    /// zero would not exceed. \[state unit\]
    #[must_use]
    pub fn excessive_error(&self) -> Option<f64> {
        let errors =
            self.agents.iter().filter_map(|agent| Some((agent.rmse()?, agent.max_error()?)));
        let largest = errors.map(|(rmse, largest)| if rmse.is_finite() { largest } else { rmse });
        let excessive =
            |&error: &f64| !error.is_finite() || error > bounds::Growth::FAR * self.largest_state;
        largest.filter(excessive).reduce(f64::max)
    }
}

/// One training.
#[derive(Clone, Debug)]
pub struct TrainingRecord {
    /// The agent, from 1.
    pub agent: usize,
    /// The learning cycle, from 1.
    pub cycle: usize,
    /// When the cycle started by itself; `None` for one of the scenario. \[s\]
    pub started_at: Option<f64>,
    /// Number of samples after cleaning and decimation.
    pub samples: usize,
    /// The course of the training.
    pub report: TrainingReport,
    /// The harmonic found in each direction, with the field observer.
    pub harmonics: Vec<Option<Harmonic>>,
    /// How well the trained network fits its samples.
    pub quality: Quality,
    /// Whether it was switched in; see [`Quality::explains`].
    pub switched_in: bool,
    /// Warnings about this training.
    pub warnings: Vec<Warning>,
    /// The trained network.
    pub package: PackageBytes,
    /// Its training samples, if the scenario records them.
    pub recording: Option<Recording>,
}

/// Why a run ended early.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RunError {
    /// The core refuses a parameter.
    #[error("agent {agent}: {}; change this key in the scenario", InScenario(*.error))]
    Parameter {
        /// The agent, from 1.
        agent: usize,
        /// The core's error.
        error: ParameterError,
    },
    /// The scenario's network cannot be packed.
    #[error("agent {agent}: {error}; change this in the scenario")]
    Package {
        /// The agent, from 1.
        agent: usize,
        /// The reason.
        error: DraftError,
    },
    /// The agent refuses a package, as a node would.
    #[error(
        "agent {agent} refuses its package: {refusal}; use a package for this scenario and agent, or train again"
    )]
    Refused {
        /// The agent, from 1.
        agent: usize,
        /// The refusal.
        refusal: Refusal,
    },
    /// A parameter in a package differs from the scenario.
    #[error(
        "the {parameter} in the package of agent {agent} differs from the scenario; train a package for \
         this scenario, or leave it out"
    )]
    PackageNode {
        /// The agent, from 1.
        agent: usize,
        /// The parameter.
        parameter: &'static str,
    },
    /// The layers of a package differ from the network to be trained.
    #[error(
        "the layers in the package of agent {agent} differ from [network], which the agent trains; \
         give [network] the same layers, or run without learning"
    )]
    PackageLayers {
        /// The agent, from 1.
        agent: usize,
    },
    /// A known input is too large for an agent.
    #[error(
        "agent {agent}: the known input {name} is {value:e} at t = {}, too large for single precision; scale \
         plant.inputs",
        seconds(*time)
    )]
    KnownInput {
        /// The agent, from 1.
        agent: usize,
        /// Name of the input.
        name: String,
        /// Its value.
        value: f64,
        /// The time of the agent's clock. \[s\]
        time: f64,
    },
    /// The network in a package takes other known inputs than the plant has.
    #[error(
        "the network in the package of agent {agent} takes {found} known inputs, but the plant has {expected}; \
         give a package of this scenario"
    )]
    PackageInputs {
        /// The agent, from 1.
        agent: usize,
        /// Known inputs of the network.
        found: usize,
        /// Known inputs of the plant.
        expected: usize,
    },
    /// An agent has a package, but the scenario has no network.
    #[error(
        "agent {agent} has a package, but the scenario has no network; add [network] and [outer_law]"
    )]
    PackageWithoutNetwork {
        /// The agent, from 1.
        agent: usize,
    },
    /// An agent could not take its step, and health monitoring is off or cannot recover it.
    #[error(
        "agent {agent} at t = {}: {error}{}; {}",
        seconds(*time),
        norm_in_words(*plant_norm),
        step_hint(*plant_norm, step, remedy)
    )]
    Step {
        /// The agent, from 1.
        agent: usize,
        /// Time of the step. \[s\]
        time: f64,
        /// `|x_0|` at that time. \[state unit\]
        plant_norm: f64,
        /// Whether the step is short enough for the observer itself.
        step: StepCheck,
        /// What to do if it is.
        remedy: &'static str,
        /// The core's error.
        error: StepError,
    },
    /// An expression of plant or disturbance has no finite value.
    #[error(transparent)]
    Expression(Box<RateFault>),
    /// The plant's state is no longer finite in single precision, in which agents measure it.
    #[error(
        "the plant diverged at t = {}; lower time.step or change the plant's parameters",
        seconds(*time)
    )]
    PlantDiverged {
        /// Time of the divergence. \[s\]
        time: f64,
    },
    /// The initial network cannot be created.
    #[error("cannot create the initial inner network: {0}")]
    InitialNetwork(TrainingError),
    /// A network could not be trained.
    #[error("training agent {agent} in learning cycle {cycle} failed: {error}")]
    Training {
        /// The agent, from 1.
        agent: usize,
        /// The learning cycle, from 1.
        cycle: usize,
        /// The trainer's error.
        error: TrainedError,
    },
    /// An agent's estimate had diverged while it collected samples.
    #[error(
        "agent {agent} cannot be trained in learning cycle {cycle}, because its estimates had diverged: samples \
         reach {}, where the plant's state stays within {}; {remedy}",
        significant(*largest, 2),
        significant(*state, 2)
    )]
    SamplesDiverged {
        /// The agent, from 1.
        agent: usize,
        /// The learning cycle, from 1.
        cycle: usize,
        /// The largest magnitude in the samples.
        largest: f64,
        /// The largest magnitude of a component of the plant's state.
        state: f64,
        /// What to do.
        remedy: &'static str,
    },
    /// A learning cycle names an unknown recipe.
    #[error(
        "learning cycle {cycle} names the unknown recipe {recipe:?}; add [recipes.{recipe}] to the scenario"
    )]
    Recipe {
        /// The learning cycle, from 1.
        cycle: usize,
        /// The name.
        recipe: String,
    },
    /// [`Progress::is_stopped`] ended the run.
    #[error("the run was interrupted")]
    Interrupted,
    /// The run observer ended the run.
    #[error(transparent)]
    RunObserver(RunObserverError),
    /// The estimate of a Kalman filter overflows.
    #[error(
        "the Kalman filter of agent {agent} diverged at t = {}; lower kalman.consensus_gain",
        seconds(*time)
    )]
    KalmanDiverged {
        /// The agent, from 1.
        agent: usize,
        /// Time of the divergence. \[s\]
        time: f64,
    },
    /// A Kalman filter in a scenario with clocks.
    #[error(
        "the Kalman filters have no clocks of their own; remove [clock] and the agents' clock, or choose \
         another method"
    )]
    KalmanClock,
    /// The settings of a Kalman filter cannot be derived.
    #[error("[kalman]: {0}")]
    KalmanSettings(PlanError),
    /// The field observer cannot be set up.
    #[error("[observer]: {0}")]
    Observer(PlanError),
    /// The field observer without a network.
    #[error(
        "[observer] needs [network], because a weight package carries its parameters; add [network], and \
         observer.network = false to leave the network out of the observer"
    )]
    ObserverWithoutNetwork,
    /// A learning cycle without a network.
    #[error("learning cycle {cycle} has no network to train; add [network] to the scenario")]
    NoNetwork {
        /// The learning cycle, from 1.
        cycle: usize,
    },
}
