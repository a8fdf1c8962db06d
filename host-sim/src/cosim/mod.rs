//! Co-simulation: the simulator plays plant and links for nodes that are really there, emulated or on
//! a desk, and holds every bit that they compute against its own agents.
//!
//! ```text
//!                       y_i, frames of the neighbours' nodes
//!   engine ──> lockstep ─────────────────────────────────────> node
//!     │           │    <─────────────────────────────────────   (QEMU, a board)
//!     │           │     state, outer weights, derivative, frame
//!     └─────> compare: every step of every node, bit for bit
//! ```
//!
//! | module | purpose |
//! | --- | --- |
//! | [`endpoint`] | what nodes run on, as a command line names it |
//! | [`board`] | one node: the messages that are exchanged with it |
//! | [`qemu`], [`process`] | emulated nodes, and processes that end with their holder |
//! | [`firmware`] | where the firmware of emulated nodes comes from |
//! | `flash_copy` | what a node that is switched off has in its flash |
//! | [`compare`] | what a node did against what the simulated agent did |
//! | `loop_node` | a node of a run, and what is known of it |
//! | `lockstep` | the run observer that does all this |
//! | `relay`, `socket` | nodes of a running co-simulation, offered to others |
//! | [`fault`] | what can go wrong with a node |
//!
//! A node in the loop has no sensor and no clock: it gets measurements and time by message, and
//! takes its step between two of them. So the co-simulation is a pure function of scenario and seed,
//! as any run is, however fast or slow the nodes are.
//!
//! Nodes are watched ([`agent_core::health`]) with the recommended settings, so the simulated agents
//! are, too.

pub mod board;
pub mod compare;
pub mod endpoint;
pub mod fault;
pub mod firmware;
mod flash_copy;
mod lockstep;
mod loop_node;
pub mod process;
pub mod qemu;
mod relay;
mod socket;

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use agent_core::health::HealthSettings;
use serde::Serialize;

use crate::engine::{Progress, RunError, RunOptions, run_observed};
use crate::files::output::OutputError;
use crate::packages::PackageBytes;
use crate::scenario::{Record, Scenario, SimulationOnly};
use crate::signing::OperatorKey;
use crate::stop::Stop;
use board::Board;
use compare::Mismatch;
use fault::{Fault, NodeError};
use lockstep::Lockstep;
use relay::Relay;

/// Starts the node of an agent, from 0, whose flash is to hold this package.
pub type Start<'s> = dyn FnMut(usize, &PackageBytes) -> Result<Board, NodeError> + 's;

/// What a co-simulation needs beyond its scenario.
pub struct Setup<'s> {
    /// How nodes are started, and started again.
    pub start: &'s mut Start<'s>,
    /// How long a node may take for an answer.
    pub timeout: Duration,
    /// Signs every package that goes into a node, for firmware that asks for it.
    pub signer: Option<&'s OperatorKey>,
    /// Whether nodes start with erased flash and wait for packages.
    pub erased: bool,
    /// Called with what happens meanwhile.
    pub notice: Option<&'s mut dyn FnMut(&Notice<'_>)>,
    /// Ends the run in front of the next step, and every wait for a node.
    pub stop: Arc<Stop>,
}

impl<'s> Setup<'s> {
    /// Nodes that need no signatures, without notices.
    pub fn new(start: &'s mut Start<'s>, timeout: Duration, stop: &Arc<Stop>) -> Self {
        let stop = stop.clone();
        Self { start, timeout, signer: None, erased: false, notice: None, stop }
    }

    fn board(&mut self, index: usize, package: &PackageBytes) -> Result<Board, NodeError> {
        let mut board = (self.start)(index, package)?;
        board.set_timeout(self.timeout);
        board.set_grace(GRACE);
        Ok(board)
    }

    fn signed(&self, package: &PackageBytes) -> PackageBytes {
        self.signer.map_or_else(|| package.clone(), |key| package.signed(key))
    }

    fn tell(&mut self, notice: &Notice<'_>) {
        if let Some(listener) = &mut self.notice {
            listener(notice);
        }
    }
}

/// How long a step that is under way may go on after the stop is requested.
const GRACE: Duration = Duration::from_millis(400);

/// Something that happens while others can talk to the nodes.
#[derive(Debug)]
#[non_exhaustive]
pub enum Notice<'n> {
    /// All nodes have begun: they can be talked to.
    Reachable,
    /// A node takes no more steps; the others go on.
    Ended(&'n NodeError),
    /// A node that had ended has been started again.
    StartedAgain {
        /// The agent, from 1.
        agent: usize,
    },
    /// The run is slower than it was asked to be.
    Late {
        /// How much of the speed that was asked for is kept, below 1.
        share: f64,
    },
}

/// A co-simulation in real time, whose nodes others can talk to.
#[derive(Clone, Debug)]
pub struct Service {
    /// Where the sockets go, `agent-1.sock` and so on.
    pub folder: PathBuf,
    /// How much faster than real time it goes; above 0.
    pub speed: f64,
    /// Becomes true when the run is to end before the next step, without any wait being cut short.
    pub stop: Arc<AtomicBool>,
}

/// What a co-simulation returns.
#[derive(Clone, Debug, Serialize)]
pub struct CosimReport {
    /// Steps that every node took.
    pub steps: u64,
    /// How many nodes there are.
    pub nodes: usize,
    /// Steps of nodes, all nodes together, that differ in anything from the simulated ones.
    pub mismatches: u64,
    /// The first of them.
    pub first_mismatch: Option<Mismatch>,
    /// From the start of the first step to the end of the last, training included. \[s\]
    pub elapsed_s: f64,
    /// Steps per second; each of them is a round trip to every node. \[1/s\]
    pub steps_per_s: f64,
    /// Whether the stop was requested before the last step; not so for a run that is served,
    /// which ends like that.
    pub interrupted: bool,
    /// For a run that is served: how much of the speed that was asked for was kept, at most 1.
    pub real_time_kept: Option<f64>,
    /// The digest of the simulated run, in hexadecimal.
    pub digest: String,
    /// Of each node.
    pub boards: Vec<BoardReport>,
}

/// What became of one node.
#[derive(Clone, Debug, Serialize)]
pub struct BoardReport {
    /// The agent, from 1.
    pub agent: usize,
    /// What it ran on.
    pub board: String,
    /// Steps that were compared.
    pub compared: u64,
    /// How many of them differ.
    pub mismatches: u64,
    /// Frames that it broadcast.
    pub broadcasts: u64,
    /// Packages that were switched in between two steps.
    pub switches: u64,
    /// Since when it is not compared any more and why, if so.
    pub parted: Option<String>,
    /// When and why it took no more steps, if so and if it was not started again.
    pub ended: Option<String>,
    /// How often it was started again.
    pub restarts: u64,
    /// What it never used of its stack, if it can tell. \[byte\]
    pub stack_unused: Option<u32>,
}

impl BoardReport {
    fn new(agent: usize, board: &str) -> Self {
        let board = board.to_owned();
        Self {
            agent,
            board,
            compared: 0,
            mismatches: 0,
            broadcasts: 0,
            switches: 0,
            parted: None,
            ended: None,
            restarts: 0,
            stack_unused: None,
        }
    }
}

/// Why a co-simulation has no result.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CosimError {
    /// A node cannot go on.
    #[error(transparent)]
    Node(#[from] NodeError),
    /// The simulation cannot go on.
    #[error(transparent)]
    Run(RunError),
    /// Somebody asked for the end.
    #[error("interrupted; nothing is left running")]
    Interrupted,
    /// A node without a network has no package, and so does not know which agent it is.
    #[error("scenario {scenario} has no network; add [network] and [outer_law]")]
    NoNetwork {
        /// Its name.
        scenario: String,
    },
    /// Nodes are watched in another way than the scenario says.
    #[error(
        "scenario {scenario} has its own [health], and nodes in the loop are watched with the \
         recommended settings; remove [health], or write there plausible_margin = {margin:?}, \
         restart_after = {restart}, fall_back_after = 0",
        margin = HealthSettings::RECOMMENDED.plausible_margin,
        restart = HealthSettings::RECOMMENDED.restart_after.map_or(0, |steps| steps.get()),
    )]
    Health {
        /// Its name.
        scenario: String,
    },
    /// Nodes do not have the scenario's trigger.
    #[error(transparent)]
    Trigger(#[from] SimulationOnly),
    /// There is something else where a node's socket would be.
    #[error("{}: {what}; it is left as it is: name another folder with --serve", path.display())]
    Occupied {
        /// The socket.
        path: PathBuf,
        /// What is there.
        what: &'static str,
    },
    /// A file cannot be written.
    #[error(transparent)]
    Output(#[from] OutputError),
    /// Nodes cannot be offered to others.
    #[error("{}: {error}; name another folder with --serve, with a short path", path.display())]
    Serve {
        /// The folder or the socket.
        path: PathBuf,
        /// The system's error.
        #[source]
        error: std::io::Error,
    },
}

/// The scenario as its nodes live it: watched with the recommended settings; nothing is written down.
///
/// # Errors
/// [`CosimError::NoNetwork`], [`CosimError::Health`] or [`CosimError::Trigger`].
pub fn prepared(scenario: &Scenario) -> Result<Scenario, CosimError> {
    let name = || scenario.name.clone();
    if scenario.network.is_none() {
        return Err(CosimError::NoNetwork { scenario: name() });
    }
    scenario.trigger.check_for_nodes()?;
    // How often there are reports is of no consequence for the agent.
    let telemetry_interval = HealthSettings::RECOMMENDED.telemetry_interval;
    let differs = |own: HealthSettings| {
        HealthSettings { telemetry_interval, ..own } != HealthSettings::RECOMMENDED
    };
    if scenario.health.is_some_and(differs) {
        return Err(CosimError::Health { scenario: name() });
    }
    let mut scenario = scenario.clone();
    scenario.health = Some(HealthSettings::RECOMMENDED);
    scenario.record = Record { trace_stride: None, events: false, samples: false };
    Ok(scenario)
}

/// Runs a scenario together with its nodes; `service` offers them to others meanwhile.
///
/// # Errors
/// See [`CosimError`]. Whatever happens, no process, pipe or socket is left behind.
pub fn cosimulate(
    scenario: &Scenario,
    seed: u64,
    setup: Setup<'_>,
    service: Option<&Service>,
    progress: &dyn Progress,
) -> Result<CosimReport, CosimError> {
    let scenario = prepared(scenario)?;
    let relay = service.map(|service| Relay::new(service, &scenario, seed)).transpose()?;
    let mut lockstep = Lockstep::new(setup, relay);
    let options = RunOptions { seed, learning: true, bounds: false };
    let result =
        run_observed(&scenario, &mut lockstep, options, progress).map_err(|error| match error {
            RunError::RunObserver(error) => match error.downcast::<NodeError>() {
                Ok(error) if matches!(error.fault, Fault::Interrupted) => CosimError::Interrupted,
                Ok(error) => CosimError::Node(*error),
                Err(error) => error
                    .downcast::<CosimError>()
                    .map_or_else(|error| CosimError::Run(RunError::RunObserver(error)), |e| *e),
            },
            error => CosimError::Run(error),
        })?;
    let elapsed_s = lockstep.begun.map_or(0.0, |begun| (Instant::now() - begun).as_secs_f64());
    lockstep.ask_for_stacks()?;
    let boards: Vec<_> = lockstep.nodes.iter().map(|node| node.report.clone()).collect();
    let steps = lockstep.steps;
    Ok(CosimReport {
        steps,
        nodes: boards.len(),
        mismatches: boards.iter().map(|board| board.mismatches).sum(),
        first_mismatch: lockstep.first_mismatch.take(),
        elapsed_s,
        interrupted: lockstep.interrupted,
        real_time_kept: lockstep.relay.as_ref().map(Relay::real_time_kept),
        steps_per_s: if elapsed_s > 0.0 { steps as f64 / elapsed_s } else { 0.0 },
        digest: format!("{:#018x}", result.digest),
        boards,
    })
}
