//! Co-simulation: simulates plant and links for emulated or real nodes, and compares every bit they
//! compute with the simulated agents.
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
//! | [`endpoint`] | what nodes run on, as given on the command line |
//! | [`board`] | a node: the messages exchanged with it |
//! | [`qemu`], [`process`] | emulated nodes, and child processes that never outlive this one |
//! | [`firmware`] | finds or builds the firmware of emulated nodes |
//! | `authentic` | authentic frames: what is compared, and the answer to the first hello |
//! | [`compare`] | compares a node's steps with the simulated ones |
//! | `loop_node` | a node with its state in the co-simulation |
//! | `lockstep` | the run observer that steps the nodes |
//! | `relay`, `socket` | serve nodes to clients during a run |
//! | `stopped_node` | reads the flash of a node that is not running |
//! | [`fault`] | failures of a node |
//!
//! A node in the loop gets measurements and time by message instead of from a sensor and a clock.
//! So a co-simulation, like any run, is a pure function of scenario and seed, regardless of the
//! nodes' speed.
//!
//! Health monitoring ([`agent_core::health`]) uses the recommended settings on nodes, and therefore
//! also on the simulated agents.

mod authentic;
pub mod board;
pub mod compare;
pub mod endpoint;
pub mod fault;
pub mod firmware;
mod lockstep;
mod loop_node;
pub mod process;
pub mod qemu;
mod relay;
mod socket;
mod stopped_node;

use std::io;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use agent_core::health::HealthSettings;
use serde::Serialize;

use crate::engine::{Progress, RunError, RunOptions, run_observed};
use crate::files::output::OutputError;
use crate::keys::FleetKeys;
use crate::packages::PackageBytes;
use crate::scenario::{Record, Scenario, SimulationOnly};
use crate::signing::OperatorKey;
use crate::stop::Stop;
use board::Board;
use compare::Mismatch;
use fault::{Fault, NodeError};
use lockstep::Lockstep;
use relay::Relay;

/// Starts the node of an agent, from 0, with this package in its flash.
pub type Start<'s> = dyn FnMut(usize, &PackageBytes) -> Result<Board, NodeError> + 's;

/// Settings of a co-simulation beyond its scenario.
pub struct Setup<'s> {
    /// Starts or restarts a node.
    pub start: &'s mut Start<'s>,
    /// Timeout for replies of nodes.
    pub timeout: Duration,
    /// Signs every package for a node, if its firmware requires signatures.
    pub signer: Option<&'s OperatorKey>,
    /// Gives every node keys: its own port key, and the network keys of all. Nodes then broadcast
    /// authentic frames, and accept only sealed requests.
    pub keys: Option<&'s FleetKeys>,
    /// Whether nodes start with erased flash and wait for packages.
    pub erased: bool,
    /// Removes the flash of an agent's node, from 0, so that its next start is that of a new one. Without it,
    /// nodes cannot be replaced.
    pub remove_flash: Option<&'s dyn Fn(usize) -> io::Result<()>>,
    /// Called with notices during the run.
    pub notice: Option<&'s mut dyn FnMut(&Notice<'_>)>,
    /// Ends the run before the next step, and ends every wait for a node.
    pub stop: Arc<Stop>,
}

impl<'s> Setup<'s> {
    /// Creates settings without signatures or notices.
    pub fn new(start: &'s mut Start<'s>, timeout: Duration, stop: &Arc<Stop>) -> Self {
        Self {
            start,
            timeout,
            signer: None,
            keys: None,
            erased: false,
            remove_flash: None,
            notice: None,
            stop: stop.clone(),
        }
    }

    fn board(&mut self, index: usize, package: &PackageBytes) -> Result<Board, NodeError> {
        let mut board = (self.start)(index, package)?;
        board.set_timeout(self.timeout);
        board.set_grace(GRACE);
        if let Some(keys) = self.keys {
            board.set_keys(keys.port_keys());
        }
        Ok(board)
    }

    fn signed(&self, package: &PackageBytes) -> PackageBytes {
        self.signer.map_or_else(|| package.clone(), |key| package.signed(key))
    }

    fn notify(&mut self, notice: &Notice<'_>) {
        if let Some(listener) = &mut self.notice {
            listener(notice);
        }
    }
}

/// How long a step in progress may continue after a stop is requested.
const GRACE: Duration = Duration::from_millis(400);

/// An event of a run that serves clients.
#[derive(Debug)]
#[non_exhaustive]
pub enum Notice<'n> {
    /// All nodes have started and accept clients.
    Reachable,
    /// A node has stopped; the others continue.
    Ended(&'n NodeError),
    /// A stopped node was restarted.
    Restarted {
        /// The agent, from 1.
        agent: usize,
    },
    /// The run is slower than requested.
    Late {
        /// Achieved fraction of the requested speed, below 1.
        share: f64,
    },
}

/// Settings of a run in real time that serves clients.
#[derive(Clone, Debug)]
pub struct Service {
    /// Folder of the sockets, `agent-1.sock` and so on.
    pub folder: PathBuf,
    /// Speed relative to real time, above 0.
    pub speed: f64,
    /// Ends the run before the next step once set, without interrupting a wait.
    pub stop: Arc<AtomicBool>,
}

/// Results of a co-simulation.
#[derive(Clone, Debug, Serialize)]
pub struct CosimReport {
    /// Number of steps of each node.
    pub steps: u64,
    /// Number of nodes.
    pub nodes: usize,
    /// Number of steps, over all nodes, that differ from the simulation.
    pub mismatches: u64,
    /// The first difference.
    pub first_mismatch: Option<Mismatch>,
    /// Time from the start of the first step to the end of the last, including training. \[s\]
    pub elapsed_s: f64,
    /// Steps per second, each with a round trip to every node. \[1/s\]
    pub steps_per_s: f64,
    /// Whether a stop was requested before the last step; `false` for a run that serves clients,
    /// where this is the normal end.
    pub interrupted: bool,
    /// For a run that serves clients: achieved fraction of the requested speed, at most 1.
    pub real_time_kept: Option<f64>,
    /// The digest of the simulated run, in hexadecimal.
    pub digest: String,
    /// Results of each node.
    pub boards: Vec<BoardReport>,
}

/// Results of one node.
#[derive(Clone, Debug, Serialize)]
pub struct BoardReport {
    /// The agent, from 1.
    pub agent: usize,
    /// What the node ran on.
    pub board: String,
    /// Number of compared steps.
    pub compared: u64,
    /// Number of these that differ.
    pub mismatches: u64,
    /// Number of frames broadcast.
    pub broadcasts: u64,
    /// Number of packages switched in.
    pub switches: u64,
    /// When and why comparing stopped, if it did.
    pub parted: Option<String>,
    /// When and why the node stopped, if it did and was not restarted.
    pub ended: Option<String>,
    /// Number of restarts.
    pub restarts: u64,
    /// Stack never used, if the node reports it. \[byte\]
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

/// Why a co-simulation failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum CosimError {
    /// A node failed.
    #[error(transparent)]
    Node(#[from] NodeError),
    /// The simulation failed.
    #[error(transparent)]
    Run(RunError),
    /// A stop was requested.
    #[error("interrupted; nothing is left running")]
    Interrupted,
    /// The scenario has no network, so there is no package to tell a node which agent it is.
    #[error("scenario {scenario} has no network; add [network] and [outer_law]")]
    NoNetwork {
        /// Its name.
        scenario: String,
    },
    /// The scenario's health settings differ from the nodes'.
    #[error(
        "scenario {scenario} has its own [health], but nodes in the loop use the recommended settings; \
         remove [health], or set its plausible_margin = {margin:?}, restart_after = {restart}, \
         fall_back_after = 0",
        margin = HealthSettings::RECOMMENDED.plausible_margin,
        restart = HealthSettings::RECOMMENDED.restart_after.map_or(0, |steps| steps.get()),
    )]
    Health {
        /// Its name.
        scenario: String,
    },
    /// The nodes' firmware does not have the scenario's trigger.
    #[error(transparent)]
    Trigger(#[from] SimulationOnly),
    /// The path of a node's socket is taken.
    #[error("{}: {what}; refusing to replace it; choose another folder with --serve", path.display())]
    Occupied {
        /// The socket.
        path: PathBuf,
        /// What is there.
        what: &'static str,
    },
    /// A file cannot be written.
    #[error(transparent)]
    Output(#[from] OutputError),
    /// Authentic frames over links that fail.
    #[error(
        "scenario {scenario} has links that fail or agents that are down at times; co-simulation can compare such \
         scenarios only without keys, because simulated agents exchange neither hello nor sync; leave \
         out --keys and --network-key"
    )]
    KeysOverLinks {
        /// Its name.
        scenario: String,
    },
    /// Agents that are down at times, in a way that nodes cannot be.
    #[error(
        "scenario {scenario} has agents that are down at times: co-simulation takes emulated nodes down only \
         while it serves no clients, and replaces only those whose packages it may write; leave out --serve and \
         other boards, sign with a private key, or remove [[life]]"
    )]
    Life {
        /// Its name.
        scenario: String,
    },
    /// Clients cannot be served.
    #[error("{}: {error}; pass --serve a writable folder with a short path", path.display())]
    Serve {
        /// The folder or the socket.
        path: PathBuf,
        /// The system's error.
        #[source]
        error: io::Error,
    },
}

/// Returns the scenario with the nodes' health settings and without recording.
///
/// # Errors
/// [`CosimError::NoNetwork`], [`CosimError::Health`] or [`CosimError::Trigger`].
pub fn prepared(scenario: &Scenario) -> Result<Scenario, CosimError> {
    let name = || scenario.name.clone();
    if scenario.network.is_none() {
        return Err(CosimError::NoNetwork { scenario: name() });
    }
    scenario.check_for_nodes()?;
    // The interval of reports does not affect the agent.
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

/// Runs a scenario together with its nodes, and serves them to clients if `service` is given.
///
/// # Errors
/// See [`CosimError`]. In any case, no process, pipe or socket is left behind.
pub fn cosimulate(
    scenario: &Scenario,
    seed: u64,
    setup: Setup<'_>,
    service: Option<&Service>,
    progress: &dyn Progress,
) -> Result<CosimReport, CosimError> {
    let scenario = prepared(scenario)?;
    if setup.keys.is_some() && !scenario.delivers_all() {
        return Err(CosimError::KeysOverLinks { scenario: scenario.name });
    }
    let can_replace = setup.remove_flash.is_some();
    if !scenario.life.is_empty()
        && (service.is_some() || scenario.life.iter().any(|d| d.is_replaced && !can_replace))
    {
        return Err(CosimError::Life { scenario: scenario.name });
    }
    let relay = service.map(|service| Relay::new(service, &scenario, seed)).transpose()?;
    let mut lockstep = Lockstep::new(setup, relay, &scenario, seed);
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
    let elapsed_s = lockstep.started.map_or(0.0, |started| started.elapsed().as_secs_f64());
    lockstep.query_stacks()?;
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
