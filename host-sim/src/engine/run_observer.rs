//! What goes along with a run: somebody who hears what every agent takes and gives, step by step,
//! and who can have packages switched in.
//!
//! A run without a run_observer pays one comparison a step for the possibility.

use std::error::Error;
use std::ops::ControlFlow;

use agent_core::Tick;
use agent_core::service::Outcome;

use crate::packages::PackageBytes;

/// Why a run_observer ends a run: an error of its own.
pub type RunObserverError = Box<dyn Error + Send + Sync>;

/// Goes along with a run. Agents are counted from 0.
pub trait RunObserver {
    /// The run begins: an entry for each agent.
    ///
    /// # Errors
    /// Any error ends the run.
    fn begin(&mut self, agents: &[AgentStart<'_>]) -> Result<(), RunObserverError>;

    /// The step at `tick` comes next, after `switches`, to which the run_observer may add its own.
    /// A `Break` ends the run in front of it.
    ///
    /// # Errors
    /// Any error ends the run.
    fn before_step(
        &mut self,
        tick: Tick,
        switches: &mut Vec<Switch>,
    ) -> Result<ControlFlow<()>, RunObserverError>;

    /// All agents have done the step at `tick`: an entry for each.
    ///
    /// # Errors
    /// Any error ends the run.
    fn after_step(&mut self, tick: Tick, agents: &[AgentStep<'_>]) -> Result<(), RunObserverError>;
}

/// An agent at the beginning of a run.
#[derive(Clone, Debug)]
pub struct AgentStart<'r> {
    /// What it starts with; `None` for one without a network.
    pub package: Option<&'r PackageBytes>,
    /// `x_hat(0)`, shape `[n]`.
    pub estimate: &'r [f32],
    /// The frame that announces it to its neighbours.
    pub announcement: Option<&'r [u8]>,
    /// Its neighbours, in ascending order.
    pub neighbours: Vec<usize>,
}

/// What an agent took and did in a step.
#[derive(Clone, Debug)]
pub struct AgentStep<'r> {
    /// `y_i(t_k)`, shape `[m]`.
    pub measurement: &'r [f32],
    /// What came of it.
    pub outcome: Outcome,
    /// `x_hat(t_(k+1))`, shape `[n]`.
    pub estimate: &'r [f32],
    /// `d/dt x_hat(t_k)`, shape `[n]`; `None` if no step was taken. \[state unit/s\]
    pub derivative: Option<&'r [f32]>,
    /// `W_hat(t_(k+1))`, row by row, shape `[L, n]`.
    pub outer_weights: Vec<f32>,
    /// The frame of `t_(k+1)`, if the agent broadcast.
    pub broadcast: Option<&'r [u8]>,
}

/// A package that an agent takes into use between two steps.
#[derive(Clone, Debug)]
pub struct Switch {
    /// The agent, from 0.
    pub agent: usize,
    /// The package.
    pub package: PackageBytes,
    /// Whether it may be older than the one in use: the agent goes back to it.
    pub back: bool,
}
