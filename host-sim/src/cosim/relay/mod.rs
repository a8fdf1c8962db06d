//! Serves the nodes of a running co-simulation to clients, over one socket per node, as if they
//! were real boards.
//!
//! Between two steps, the relay forwards requests of clients to the nodes, and the answers back:
//! one request per node, its clients taking turns, and more only while there is time until the next
//! step. So a client that floods a node with requests does not slow down the others. A client that
//! does not read loses messages, and eventually its connection. The relay handles two things
//! itself: the node always reports everything to the co-simulation, whatever its clients subscribe
//! to, and time and frames come only from the simulator.
//!
//! Sealed requests go to the node unchanged. Only the node's port key reveals what is in them, so the
//! relay opens copies: with the co-simulation's keys, or with the key by which a client provisioned the
//! node in its presence. There is no third way by which a node can have a key, since the
//! co-simulation could not have started it; so what the relay cannot open, the node refuses. The two
//! things above are thus kept from the node even if they are sealed. A provisioned node's refusal to
//! take a request that is not sealed holds at its socket, too.
//!
//! A node that exits or hangs is stopped. The others continue, with the simulated agent in its
//! place, and a reset request restarts it.
//!
//! A package activated by a client is also switched in for the simulated agent before the next
//! step, so that the comparison continues. It stops for a node that a client resets or starts from a
//! different estimate, and for a node that receives, from such a node, frames that the simulated
//! neighbour did not send.

mod client;
mod node_socket;
mod pace;

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use agent_core::Tick;
use agent_core::service::Status;
use client::Reply;
use node_socket::NodeSocket;
use pace::Pace;

use super::board::Turn;
use super::fault::Fault;
use super::loop_node::LoopNode;
use super::socket::Socket;
use super::{CosimError, Service};
use crate::engine::run_observer::Switch;
use crate::files::output::create_folders;
use crate::packages::PackageBytes;
use crate::scenario::Scenario;
use crate::service::nodes_file::{self, NodesFile};
use crate::stop::Stop;

/// Interval for polling clients.
const POLL_INTERVAL: Duration = Duration::from_millis(5);

/// The sockets and the pacing.
pub(super) struct Relay {
    sockets: Vec<NodeSocket>,
    /// The file that describes the run.
    nodes_file: PathBuf,
    /// Duration of a step in real time.
    step: Duration,
    pace: Pace,
    stop: Arc<AtomicBool>,
}

/// What happened between two steps.
#[derive(Default)]
pub(super) struct Between {
    /// Nodes, from 0, that failed.
    pub(super) faults: Vec<(usize, Fault)>,
    /// Nodes to restart.
    pub(super) restarts: Vec<Restart>,
    /// Achieved fraction of the speed, if a notice is due.
    pub(super) late: Option<f64>,
}

/// A client's request to restart a node.
pub(super) struct Restart {
    /// The node, from 0.
    pub(super) node: usize,
    client: usize,
    /// Number of the request, if it has one.
    number: Option<u16>,
}

impl Relay {
    /// Opens the sockets.
    pub(super) fn new(
        service: &Service,
        scenario: &Scenario,
        seed: u64,
    ) -> Result<Self, CosimError> {
        let folder = &service.folder;
        create_folders(folder)
            .map_err(|error| CosimError::Serve { path: folder.clone(), error })?;
        let path = |agent| folder.join(format!("agent-{agent}.sock"));
        let agents = 1..=scenario.agents.len();
        // Check all paths before changing anything.
        agents.clone().try_for_each(|agent| Socket::check(&path(agent)).map(|_| ()))?;
        if NodesFile::is_occupied(folder) {
            let what = "not a list of served nodes";
            return Err(CosimError::Occupied { path: folder.join(nodes_file::NAME), what });
        }
        let sockets = agents.map(|agent| Socket::bind(path(agent)).map(NodeSocket::new));
        let sockets = sockets.collect::<Result<_, CosimError>>()?;
        let nodes_file = NodesFile::new(&scenario.name, scenario.hash, seed).write(folder)?;
        let step = Duration::from_secs_f64(scenario.time.step_size / service.speed);
        Ok(Self { sockets, nodes_file, step, pace: Pace::default(), stop: service.stop.clone() })
    }

    /// Returns whether the run should end.
    pub(super) fn is_over(&self, stop: &Stop) -> bool {
        stop.is_requested() || self.stop.load(Ordering::Relaxed)
    }

    /// Records the initial packages of the nodes.
    pub(super) fn begin<'p>(&mut self, packages: impl Iterator<Item = &'p PackageBytes>) {
        for (socket, package) in self.sockets.iter_mut().zip(packages) {
            socket.in_use = Some(package.clone());
        }
    }

    /// Disconnects the clients of a stopped node.
    pub(super) fn end_node(&mut self, index: usize) {
        self.sockets[index].clients.clear();
    }

    /// Answers the request to restart a node, and sends a greeting to all its clients.
    pub(super) fn restarted(&mut self, restart: &Restart, status: Status) {
        let socket = &mut self.sockets[restart.node];
        (socket.in_use, socket.before) = (None, None);
        if let Some(client) = socket.clients.get_mut(restart.client) {
            client.answer(restart.number, &Reply::Done);
        }
        for client in &mut socket.clients {
            client.send(&Reply::Hello(status));
            client.write_out();
        }
    }

    /// Returns the achieved fraction of the requested speed, at most 1.
    pub(super) fn real_time_kept(&self) -> f64 {
        self.pace.kept(self.step)
    }

    /// Records packages switched in by learning cycles.
    pub(super) fn record_switches(&mut self, switches: &[Switch]) {
        for switch in switches {
            self.sockets[switch.agent].switched(Some(switch.package.clone()));
        }
    }

    /// Serves clients until the step at `tick` is due.
    pub(super) fn between_steps(
        &mut self,
        tick: Tick,
        nodes: &mut [LoopNode],
        switches: &mut Vec<Switch>,
        stop: &Stop,
    ) -> Between {
        let mut between = Between::default();
        let due = self.pace.due();
        loop {
            let mut busy = false;
            for (index, (socket, node)) in self.sockets.iter_mut().zip(&mut *nodes).enumerate() {
                if between.faults.iter().any(|(ended, _)| *ended == index) {
                    continue;
                }
                if node.has_ended() {
                    if between.restarts.is_empty()
                        && let Some((client, number)) = socket.restart_requested()
                    {
                        between.restarts.push(Restart { node: index, client, number });
                    }
                    continue;
                }
                match socket.serve(tick, node) {
                    Ok(served) => {
                        busy |= served.request;
                        switches.extend(served.switch.map(|(package, back)| Switch {
                            agent: index,
                            package,
                            back,
                        }));
                    }
                    Err(fault) => between.faults.push((index, fault)),
                }
            }
            let left = due.saturating_duration_since(Instant::now());
            if left.is_zero() || self.is_over(stop) || !between.restarts.is_empty() {
                break;
            }
            // Sleep only if there was no request.
            if !busy {
                std::thread::sleep(left.min(POLL_INTERVAL));
            }
        }
        between.late = self.pace.advance(due, self.step, Instant::now());
        between
    }

    /// Forwards the results of a node's step to its clients.
    pub(super) fn forward(&mut self, index: usize, turn: &Turn) {
        let socket = &mut self.sockets[index];
        socket.notice(&turn.unsolicited);
        for client in &mut socket.clients {
            for bytes in &turn.unsolicited {
                client.forward(bytes);
            }
            if let Some(state) = &turn.state {
                client.send_state(state);
            }
            client.write_out();
        }
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        // Best effort: the run is over.
        let _ = std::fs::remove_file(&self.nodes_file);
    }
}
