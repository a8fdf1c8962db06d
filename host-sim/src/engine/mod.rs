//! The simulation engine: plant in double precision, agents in the core's single precision,
//! frames over a [`link::Link`].
//!
//! Step `k` runs from `t_k = k dt` to `t_(k+1)`:
//! 1. networks whose time has come are switched in,
//! 2. every agent takes the frames of `t_k`, measures `x_0(t_k)`, and takes its step,
//! 3. samples, errors and traces of `t_k` are noted,
//! 4. broadcasts of `t_(k+1)` go to the link, agents in ascending order,
//! 5. the plant is integrated to `t_(k+1)`.
//!
//! A run is a pure function of scenario, seed and link: agents only read what the link holds
//! from the tick before, so they can be stepped in parallel and in any order, and the bits are
//! the same whatever the number of threads.

mod agents;
pub mod bounds;
mod failure;
mod learning;
pub mod link;
mod run;
pub mod run_observer;
pub mod statistics;
pub mod traces;
mod watch;

use agent_core::agent::StepError;
use agent_core::math::parameter::ParameterError;
use agent_core::package::Refusal;

use crate::analysis::StepCheck;
use crate::learning::quality::Quality;
use crate::learning::trained::TrainedError;
use crate::packages::parameter::InScenario;
use crate::packages::{DraftError, PackageBytes, Recording};
use crate::plant::RateFault;
use crate::training::{EpochReport, TrainingError, TrainingReport};
use crate::warning::Warning;
use bounds::Bounds;
use failure::step_hint;
use statistics::AgentStatistics;
use traces::Traces;

pub use run::{run, run_accompanied, run_over};
pub use run_observer::{RunObserver, RunObserverError};

/// Hears how a run goes on; every method does nothing by default.
pub trait Progress: Sync {
    /// Reports that the run has reached `tick` of `steps`.
    fn stepped(&self, tick: u64, steps: u64) {
        let _ = (tick, steps);
    }

    /// Training of `agent` in `cycle` (both from 1) has finished an epoch.
    fn epoch(&self, agent: usize, cycle: usize, report: &EpochReport) {
        let _ = (agent, cycle, report);
    }
}

/// A [`Progress`] that says nothing.
#[derive(Clone, Copy, Debug)]
pub struct Silent;

impl Progress for Silent {}

/// What a run is asked for beyond its scenario.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RunOptions {
    /// Seed of all that is random.
    pub seed: u64,
    /// Whether learning cycles are carried out.
    pub learning: bool,
    /// Whether the quantities that the theorems bound are measured.
    pub bounds: bool,
}

/// What a run returns.
#[derive(Clone, Debug)]
pub struct RunResult {
    /// Of each agent.
    pub agents: Vec<AgentStatistics>,
    /// Of each training, in the order of cycles and agents.
    pub trainings: Vec<TrainingRecord>,
    /// Rows of `x_0` and all `x_hat_i`; empty if the scenario records none.
    pub traces: Traces,
    /// What the theorems bound; `None` if it was not asked for.
    pub bounds: Option<Bounds>,
    /// A hash of every broadcast and of the final state of every agent: two runs did the same
    /// if and only if (but for chance) these agree.
    pub digest: u64,
}

/// One training.
#[derive(Clone, Debug)]
pub struct TrainingRecord {
    /// The agent, from 1.
    pub agent: usize,
    /// The learning cycle, from 1.
    pub cycle: usize,
    /// Samples that were left after cleaning and decimation.
    pub samples: usize,
    /// How it went.
    pub report: TrainingReport,
    /// How well the trained network fits its samples.
    pub quality: Quality,
    /// Whether it was switched in; see [`Quality::explains`].
    pub switched_in: bool,
    /// Warnings about this training.
    pub warnings: Vec<Warning>,
    /// The trained network.
    pub package: PackageBytes,
    /// What it was trained on, if the scenario records samples.
    pub recording: Option<Recording>,
}

/// Why a run ended early.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RunError {
    /// A parameter that the core refuses.
    #[error("agent {agent}: {}; change this key in the scenario", InScenario(*.error))]
    Parameter {
        /// The agent, from 1.
        agent: usize,
        /// What the core says.
        error: ParameterError,
    },
    /// The scenario's network does not become a package.
    #[error("agent {agent}: {error}; change this in the scenario")]
    Package {
        /// The agent, from 1.
        agent: usize,
        /// Why.
        error: DraftError,
    },
    /// The agent refuses a package as a node would.
    #[error(
        "agent {agent} refuses its package: {refusal}; give it the package of this scenario and agent, or train again"
    )]
    Refused {
        /// The agent, from 1.
        agent: usize,
        /// What it says.
        refusal: Refusal,
    },
    /// A package was made for a node with another parameter.
    #[error(
        "the package of agent {agent} has another {parameter} than the scenario; train it for \
         this scenario, or leave it out"
    )]
    PackageNode {
        /// The agent, from 1.
        agent: usize,
        /// The parameter.
        parameter: &'static str,
    },
    /// A package has other layers than the network that the agent is to learn.
    #[error(
        "the package of agent {agent} has other layers than [network], which the agent is to \
         learn; give [network] the same layers, or run without learning"
    )]
    PackageLayers {
        /// The agent, from 1.
        agent: usize,
    },
    /// A package for an agent of a scenario without a network.
    #[error(
        "agent {agent} has a package, but the scenario no network; add [network] and [outer_law]"
    )]
    PackageWithoutNetwork {
        /// The agent, from 1.
        agent: usize,
    },
    /// An agent that is not watched, or could not go on if it were, did not take its step.
    #[error(
        "agent {agent} at t = {time}: {error}, |x_0| is {plant_norm:.3e} by then; {}",
        step_hint(*plant_norm, step)
    )]
    Step {
        /// The agent, from 1.
        agent: usize,
        /// When. \[s\]
        time: f64,
        /// `|x_0|` at that time. \[state unit\]
        plant_norm: f64,
        /// Whether the step is short enough for the observer itself.
        step: StepCheck,
        /// What the core says.
        error: StepError,
    },
    /// An expression of plant or disturbance has no finite value.
    #[error(transparent)]
    Expression(Box<RateFault>),
    /// The plant's state is not finite any more in single precision, in which agents measure it.
    #[error("the plant diverged at t = {time}; lower time.step or change the plant's parameters")]
    PlantDiverged {
        /// When. \[s\]
        time: f64,
    },
    /// There is no initial network.
    #[error("the initial inner network: {0}")]
    InitialNetwork(TrainingError),
    /// A network could not be trained.
    #[error("training of agent {agent} in learning cycle {cycle}: {error}")]
    Training {
        /// The agent, from 1.
        agent: usize,
        /// The learning cycle, from 1.
        cycle: usize,
        /// What the trainer says.
        error: TrainedError,
    },
    /// A learning cycle names a recipe that there is not.
    #[error(
        "learning cycle {cycle} names the recipe {recipe:?}; add [recipes.{recipe}] to the scenario"
    )]
    Recipe {
        /// The learning cycle, from 1.
        cycle: usize,
        /// The name.
        recipe: String,
    },
    /// Who went along with the run ended it.
    #[error(transparent)]
    RunObserver(RunObserverError),
    /// A learning cycle without a network.
    #[error("learning cycle {cycle} has no network to train; add [network] to the scenario")]
    NoNetwork {
        /// The learning cycle, from 1.
        cycle: usize,
    },
}
