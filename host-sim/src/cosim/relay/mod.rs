//! Nodes of a running co-simulation, offered to others: a socket for each, at which anybody can talk
//! to the node as if it were on a desk.
//!
//! Between two steps the relay hands requests of clients to the nodes, and their answers back: one
//! request a node, of its clients in turn, and more only while there is time left until the next
//! step. So a client that asks without end does not slow the others down, and one that does not read loses what
//! it does not read, and then its connection. Two things the relay keeps to itself: the node goes on to tell
//! everything to the co-simulation, whatever its clients subscribe to, and time and frames come from
//! the simulator only.
//!
//! A node that dies or hangs takes no more steps; the others go on, with the simulated agent in its
//! place. A request to reset it starts it again.
//!
//! A package that a client has activated is switched in for the simulated agent, too, before the next
//! step: the comparison goes on. A node that a client resets, or lets begin elsewhere, is not
//! compared any more, nor is one that hears frames of such a node which its simulated neighbour
//! did not send.

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
use crate::packages::PackageBytes;
use crate::scenario::Scenario;
use crate::service::nodes_file::{self, NodesFile};
use crate::stop::Stop;

/// Longest rest between two looks at the clients.
const REST: Duration = Duration::from_millis(5);

/// The sockets and the pace.
pub(super) struct Relay {
    sockets: Vec<NodeSocket>,
    /// The file that says what they are part of.
    told: PathBuf,
    /// One step in real time.
    step: Duration,
    pace: Pace,
    stop: Arc<AtomicBool>,
}

/// What happened between two steps.
#[derive(Default)]
pub(super) struct Between {
    /// Nodes, from 0, that cannot go on.
    pub(super) faults: Vec<(usize, Fault)>,
    /// Nodes that are to be started again.
    pub(super) restarts: Vec<Restart>,
    /// How much of the speed is kept, if that is to be told.
    pub(super) late: Option<f64>,
}

/// A client wants a node to be started again.
pub(super) struct Restart {
    /// The node, from 0.
    pub(super) node: usize,
    client: usize,
}

impl Relay {
    /// Opens the sockets.
    pub(super) fn new(
        service: &Service,
        scenario: &Scenario,
        seed: u64,
    ) -> Result<Self, CosimError> {
        let folder = &service.folder;
        std::fs::create_dir_all(folder)
            .map_err(|error| CosimError::Serve { path: folder.clone(), error })?;
        let path = |agent| folder.join(format!("agent-{agent}.sock"));
        let agents = 1..=scenario.agents.len();
        // Nothing is touched before all places are known to be free.
        agents.clone().try_for_each(|agent| Socket::check(&path(agent)).map(|_| ()))?;
        if NodesFile::is_occupied(folder) {
            let what = "there is something here that is not about nodes";
            return Err(CosimError::Occupied { path: folder.join(nodes_file::NAME), what });
        }
        let sockets = agents.map(|agent| Socket::bind(path(agent)).map(NodeSocket::new));
        let sockets = sockets.collect::<Result<_, CosimError>>()?;
        let told = NodesFile::new(&scenario.name, scenario.hash, seed).write(folder)?;
        let step = Duration::from_secs_f64(scenario.time.step_size / service.speed);
        Ok(Self { sockets, told, step, pace: Pace::default(), stop: service.stop.clone() })
    }

    /// Whether a stop was requested.
    pub(super) fn is_over(&self, stop: &Stop) -> bool {
        stop.is_requested() || self.stop.load(Ordering::Relaxed)
    }

    /// The nodes have begun with these packages.
    pub(super) fn begin<'p>(&mut self, packages: impl Iterator<Item = &'p PackageBytes>) {
        for (door, package) in self.sockets.iter_mut().zip(packages) {
            door.in_use = Some(package.clone());
        }
    }

    /// A node takes no more steps: its clients hear no more of it.
    pub(super) fn end_node(&mut self, index: usize) {
        self.sockets[index].clients.clear();
    }

    /// A node has been started again: the one who wanted it gets an answer, and all a greeting.
    pub(super) fn started_again(&mut self, restart: &Restart, status: Status) {
        let door = &mut self.sockets[restart.node];
        (door.in_use, door.before) = (None, None);
        if let Some(client) = door.clients.get_mut(restart.client) {
            client.say(&Reply::Done);
        }
        for client in &mut door.clients {
            client.say(&Reply::Hello(status));
            client.write_out();
        }
    }

    /// How much of the speed that was asked for has been kept, at most 1.
    pub(super) fn real_time_kept(&self) -> f64 {
        self.pace.kept(self.step)
    }

    /// A learning cycle has switched packages in.
    pub(super) fn learned(&mut self, switches: &[Switch]) {
        for switch in switches {
            self.sockets[switch.agent].switched(Some(switch.package.clone()));
        }
    }

    /// Waits until it is time for the step at `tick`, and serves clients meanwhile.
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
            for (index, (door, node)) in self.sockets.iter_mut().zip(&mut *nodes).enumerate() {
                if between.faults.iter().any(|(ended, _)| *ended == index) {
                    continue;
                }
                if node.has_ended() {
                    if between.restarts.is_empty()
                        && let Some(client) = door.wants_restart()
                    {
                        between.restarts.push(Restart { node: index, client });
                    }
                    continue;
                }
                match door.serve(tick, node) {
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
            // Where there is time left, the next request is not kept waiting.
            if !busy {
                std::thread::sleep(left.min(REST));
            }
        }
        between.late = self.pace.advance(due, self.step, Instant::now());
        between
    }

    /// Tells the clients of a node what it did in its turn.
    pub(super) fn pass_on(&mut self, index: usize, turn: &Turn) {
        let door = &mut self.sockets[index];
        for client in &mut door.clients {
            for bytes in &turn.unasked {
                client.forward(bytes);
            }
            if let Some(state) = &turn.state {
                client.tell(state);
            }
            client.write_out();
        }
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        // Best effort: the run is over.
        let _ = std::fs::remove_file(&self.told);
    }
}
