//! Observes a run step by step, with the inputs and results of every agent, and can switch
//! packages.
//!
//! Without an observer, the cost is one comparison per step.

use std::error::Error;
use std::ops::ControlFlow;

use agent_core::Tick;
use agent_core::service::Outcome;

use crate::packages::PackageBytes;

/// An observer's error, which ends the run.
pub type RunObserverError = Box<dyn Error + Send + Sync>;

/// Observes a run. Agents are numbered from 0.
pub trait RunObserver {
    /// Called at the start of the run, with one entry per agent.
    ///
    /// # Errors
    /// An error ends the run.
    fn begin(&mut self, agents: &[AgentStart<'_>]) -> Result<(), RunObserverError>;

    /// Called before the step at `tick`, with the `switches` that precede it; the observer may add
    /// more. `Break` ends the run before the step.
    ///
    /// # Errors
    /// An error ends the run.
    fn before_step(
        &mut self,
        tick: Tick,
        switches: &mut Vec<Switch>,
    ) -> Result<ControlFlow<()>, RunObserverError>;

    /// Called after the step at `tick`, with one entry per agent; `None` for an agent that did not
    /// step, because it is down or because its clock is behind.
    ///
    /// # Errors
    /// An error ends the run.
    fn after_step(
        &mut self,
        tick: Tick,
        agents: &[Option<AgentStep<'_>>],
    ) -> Result<(), RunObserverError>;
}

/// An agent at the start of a run.
#[derive(Clone, Debug)]
pub struct AgentStart<'r> {
    /// Its package; `None` without a network.
    pub package: Option<&'r PackageBytes>,
    /// `x_hat(0)`, shape `[n]`.
    pub estimate: &'r [f32],
    /// Its initial broadcast.
    pub announcement: Option<&'r [u8]>,
    /// Its neighbours, in ascending order.
    pub neighbours: Vec<usize>,
}

/// Inputs and results of an agent's step.
#[derive(Clone, Debug)]
pub struct AgentStep<'r> {
    /// The step's tick on the agent's own clock.
    pub tick: Tick,
    /// `y_i(t_k)`, shape `[m]`; `None` if the sensor had no value.
    pub measurement: Option<&'r [f32]>,
    /// Outcome of the step.
    pub outcome: Outcome,
    /// `x_hat(t_(k+1))`, shape `[n]`.
    pub estimate: &'r [f32],
    /// `d/dt x_hat(t_k)`, shape `[n]`; `None` if no step was taken. \[state unit/s\]
    pub derivative: Option<&'r [f32]>,
    /// `W_hat(t_(k+1))`, row-major, shape `[L, n]`.
    pub outer_weights: Vec<f32>,
    /// The frame of `t_(k+1)`, if the agent broadcast.
    pub broadcast: Option<&'r [u8]>,
}

/// A package that an agent switches to between two steps.
#[derive(Clone, Debug)]
pub struct Switch {
    /// The agent, from 0.
    pub agent: usize,
    /// The package.
    pub package: PackageBytes,
    /// Whether the agent reverts to it, so that it may be older than the one in use.
    pub back: bool,
}
