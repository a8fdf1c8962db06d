//! The run observer that steps nodes along with the simulated agents.
//!
//! Inputs are sent to all nodes before the first result is received, so that they compute in
//! parallel. A node gets the frames broadcast by its neighbours' nodes, not those of the simulated
//! agents, so an error propagates through the nodes as in a real network.
//!
//! If the scenario has links that are not ideal, or nodes that are down at times, the nodes' frames
//! pass a link of their own with the same seed: the same frames have the same fate as in the
//! simulation. A node that is down has its process ended, and starts again with its flash.

use std::borrow::Cow;
use std::io;
use std::ops::ControlFlow;
use std::time::Instant;

use agent_core::service::Status;
use agent_core::wire::authentic::NetworkKey;
use agent_core::{AgentId, Tick};

use super::authentic;
use super::board::Turn;
use super::compare::{Mismatch, announcement_mismatch, first_mismatch};
use super::fault::{Fault, NodeError};
use super::loop_node::LoopNode;
use super::relay::Relay;
use super::{BoardReport, Notice, Setup};
use crate::engine::link::{Layered, Link};
use crate::engine::run_observer::{AgentStart, AgentStep, RunObserver, RunObserverError, Switch};
use crate::keys::{FleetKeys, epoch_now};
use crate::packages::PackageBytes;
use crate::scenario::{Downtime, Scenario};
use crate::service::provision::NewKeys;

/// The nodes of a run.
pub(super) struct Lockstep<'s, 'r> {
    setup: Setup<'s>,
    pub(super) nodes: Vec<LoopNode>,
    /// The link between the nodes; `None` for an ideal one.
    link: Option<Layered>,
    scenario: &'r Scenario,
    /// The network keys, if nodes broadcast authentic frames.
    network_keys: Vec<NetworkKey>,
    /// Initial package of each node, as stored in its flash.
    packages: Vec<PackageBytes>,
    pub(super) relay: Option<Relay>,
    pub(super) first_mismatch: Option<Mismatch>,
    pub(super) steps: u64,
    /// Whether a run without clients was interrupted.
    pub(super) interrupted: bool,
    /// When all nodes had started.
    pub(super) started: Option<Instant>,
}

impl<'s, 'r> Lockstep<'s, 'r> {
    pub(super) fn new(
        setup: Setup<'s>,
        relay: Option<Relay>,
        scenario: &'r Scenario,
        seed: u64,
    ) -> Self {
        let network_keys = setup.keys.map(FleetKeys::network_keys).unwrap_or_default();
        Self {
            setup,
            link: (!scenario.delivers_all()).then(|| Layered::new(scenario, seed)),
            scenario,
            nodes: Vec::new(),
            network_keys,
            packages: Vec::new(),
            relay,
            first_mismatch: None,
            steps: 0,
            interrupted: false,
            started: None,
        }
    }

    /// Returns a node's frames as a simulated agent broadcasts them, for comparison.
    fn plain(&self, frames: &[Vec<u8>]) -> Vec<Vec<u8>> {
        match self.network_keys.as_slice() {
            [] => frames.to_vec(),
            keys => frames.iter().filter_map(|bytes| authentic::plain(bytes, keys)).collect(),
        }
    }

    /// Takes a node's frames for its neighbours.
    fn keep_frames(&mut self, index: usize, frames: Vec<Vec<u8>>) {
        let keys = &self.network_keys;
        let epoch = frames.iter().rev().find_map(|bytes| authentic::epoch(bytes, keys));
        let node = &mut self.nodes[index];
        node.epoch = epoch.or(node.epoch);
        node.frames = frames;
    }

    fn named(&self, index: usize, fault: Fault) -> NodeError {
        let board = self.nodes[index].board.label().to_owned();
        NodeError { agent: index + 1, board, fault }
    }

    /// Handles a fault: it ends the node if the run serves clients, and the run otherwise.
    fn fault(&mut self, index: usize, tick: Tick, fault: Fault) -> Result<(), NodeError> {
        let Some(relay) = &mut self.relay else { return Err(self.named(index, fault)) };
        let node = &mut self.nodes[index];
        if matches!(fault, Fault::Interrupted) {
            // The run ends before the next step.
            node.stop_comparing(tick, "the run was interrupted during its step");
            return Ok(());
        }
        node.end(tick, &fault);
        relay.end_node(index);
        let error = self.named(index, fault);
        self.setup.notify(&Notice::Ended(&error));
        Ok(())
    }

    fn record(&mut self, index: usize, mismatch: Option<Mismatch>) {
        let mismatch = self.nodes[index].note(mismatch);
        if self.first_mismatch.is_none() {
            self.first_mismatch = mismatch;
        }
    }

    /// Starts all nodes before waiting for the first.
    fn start(&mut self, agents: &[AgentStart<'_>]) -> Result<(), NodeError> {
        for (index, agent) in agents.iter().enumerate() {
            // `prepared` refuses scenarios without a network.
            let Some(package) = agent.package else { continue };
            let package = self.setup.signed(package);
            let board = self.setup.board(index, &package)?;
            let report = BoardReport::new(index + 1, board.label());
            let (neighbours, estimate) = (agent.neighbours.clone(), agent.estimate.to_vec());
            self.nodes.push(LoopNode::new(board, neighbours, estimate, report));
            self.packages.push(package);
        }
        Ok(())
    }

    /// Restarts a node from the contents of its flash.
    fn restart(&mut self, index: usize, tick: Tick) -> Result<Status, NodeError> {
        let mut board = self.setup.board(index, &self.packages[index])?;
        // A client may have provisioned the node.
        if let Some(keys) = self.nodes[index].board.keys() {
            board.set_keys(keys.clone());
        }
        let rejoined = board.rejoin();
        let node = &mut self.nodes[index];
        node.board = board;
        node.report.ended = None;
        node.report.restarts += 1;
        (node.frames, node.frames_agree) = (Vec::new(), false);
        match rejoined {
            Ok(status) => Ok(status),
            Err(fault) => {
                self.nodes[index].end(tick, &fault);
                Err(self.named(index, fault))
            }
        }
    }

    /// Queries the unused stack of every node at the end.
    pub(super) fn query_stacks(&mut self) -> Result<(), NodeError> {
        for index in 0..self.nodes.len() {
            let node = &mut self.nodes[index];
            if node.has_ended() || node.is_down {
                continue;
            }
            match node.board.status() {
                Ok(status) => node.report.stack_unused = status.stack_unused,
                // Ignored: the run already has its result.
                Err(_) if self.relay.is_some() || self.interrupted => {}
                Err(fault) => return Err(self.named(index, fault)),
            }
        }
        Ok(())
    }

    fn feed(&mut self, tick: Tick, agents: &[Option<AgentStep<'_>>]) -> Result<(), NodeError> {
        for (index, agent) in agents.iter().enumerate() {
            if self.nodes.get(index).is_some_and(|node| node.has_ended() || node.is_down) {
                continue;
            }
            let (before, rest) = self.nodes.split_at_mut(index);
            let Some((node, after)) = rest.split_first_mut() else { break };
            match &self.link {
                Some(link) => link.deliver(index, tick, &mut |bytes| {
                    node.board.hand([Cow::from(bytes)].into_iter());
                }),
                None => {
                    let keys = self.network_keys.as_slice();
                    let LoopNode { board, neighbours, epoch, .. } = &mut *node;
                    let frames = neighbours.iter().flat_map(|&neighbour| {
                        let sender = match neighbour.checked_sub(index + 1) {
                            Some(later) => &after[later],
                            None => &before[neighbour],
                        };
                        sender.frames.iter().map(|bytes| match *epoch {
                            // Numbers of agents count from 1.
                            Some(epoch) if self.steps == 0 => {
                                let to = AgentId::try_from(index + 1).unwrap_or(AgentId::MAX);
                                Cow::from(authentic::answer(bytes, to, epoch, keys))
                            }
                            _ => Cow::from(bytes.as_slice()),
                        })
                    });
                    board.hand(frames);
                }
            }
            let Some(agent) = agent else { continue };
            let periods = node.periods_until(agent.tick);
            if let Err(fault) = node.board.feed(periods, agent.measurement) {
                self.fault(index, tick, fault)?;
            }
        }
        Ok(())
    }

    /// Takes nodes down and starts them again at `tick`, as the scenario has it, and sends the frames
    /// of `tick` over the link.
    fn move_on(&mut self, tick: Tick) -> Result<(), NodeError> {
        let scenario = self.scenario;
        let ticks = |downtime: &Downtime| downtime.window.ticks(&scenario.time);
        let last = scenario.steps();
        let ends = |d: &&Downtime| ticks(d).end == tick && tick < last;
        for downtime in scenario.life.iter().filter(ends) {
            if !self.nodes[downtime.agent].has_ended() {
                self.boot(downtime, tick)?;
            }
        }
        for downtime in scenario.life.iter().filter(|d| ticks(d).start == tick) {
            let node = &mut self.nodes[downtime.agent];
            node.is_down = true;
            node.frames.clear();
            node.board.kill();
        }
        let Some(link) = &mut self.link else { return Ok(()) };
        for (index, node) in self.nodes.iter().enumerate() {
            for frame in &node.frames {
                link.send(index, tick, frame);
            }
        }
        link.advance(tick);
        Ok(())
    }

    /// Starts a node that the scenario has had down, with the contents of its flash, or a new one in its place.
    fn boot(&mut self, downtime: &Downtime, tick: Tick) -> Result<(), NodeError> {
        let index = downtime.agent;
        if let Some(remove_flash) = self.setup.remove_flash.filter(|_| downtime.is_replaced) {
            let failed =
                |error: io::Error| Fault::Start(format!("its flash cannot be removed: {error}"));
            remove_flash(index).map_err(|error| self.named(index, failed(error)))?;
        }
        let board = self.setup.board(index, &self.packages[index])?;
        let node = &mut self.nodes[index];
        node.board = board;
        (node.is_down, node.tick) = (false, None);
        node.report.restarts += 1;
        let started = node.board.rejoin().and_then(|_| node.board.start_at(&node.initial_estimate));
        match started {
            Ok(frames) => {
                node.report.broadcasts += frames.len() as u64;
                self.keep_frames(index, frames);
                Ok(())
            }
            Err(fault) => self.fault(index, tick, fault),
        }
    }

    /// Compares a node's step, and forwards it to clients.
    fn handle_turn(&mut self, index: usize, turn: Turn, agent: &AgentStep<'_>) {
        let plain = self.plain(&turn.frames);
        let node = &mut self.nodes[index];
        let mismatch = first_mismatch(index, agent.tick, turn.state.as_ref(), &plain, agent);
        node.frames_agree = plain.iter().map(Vec::as_slice).eq(agent.broadcast);
        node.report.broadcasts += turn.frames.len() as u64;
        node.report.compared += u64::from(node.report.parted.is_none());
        if let Some(relay) = &mut self.relay {
            relay.forward(index, &turn);
        }
        self.keep_frames(index, turn.frames);
        self.record(index, mismatch);
    }

    /// Stops comparing nodes that received frames no simulated agent broadcast.
    fn propagate_deviations(&mut self, tick: Tick) {
        for index in 0..self.nodes.len() {
            let neighbours = &self.nodes[index].neighbours;
            let deviating = neighbours.iter().copied().find(|&neighbour| {
                let sender = &self.nodes[neighbour];
                sender.report.parted.is_some() && !sender.frames_agree
            });
            if let Some(neighbour) = deviating {
                let reason =
                    format!("its neighbour {} deviates from the simulation", neighbour + 1);
                self.nodes[index].stop_comparing(tick, &reason);
            }
        }
    }
}

impl RunObserver for Lockstep<'_, '_> {
    fn begin(&mut self, agents: &[AgentStart<'_>]) -> Result<(), RunObserverError> {
        self.start(agents)?;
        for (index, agent) in agents.iter().enumerate().take(self.nodes.len()) {
            let (node, package) = (&mut self.nodes[index], &self.packages[index]);
            if self.setup.erased {
                let rejoined = node.board.rejoin();
                rejoined.map_err(|fault| self.named(index, fault))?;
                self.nodes[index].stop_comparing(0, "it is waiting for a package");
                continue;
            }
            let keys = self.setup.keys.map(|fleet| NewKeys {
                fleet,
                operator: self.setup.signer,
                epoch: epoch_now(),
            });
            let started = node.board.begin(package, agent.estimate, keys.as_ref());
            let frames = started.map_err(|fault| self.named(index, fault))?;
            if agent.announcement.is_none() {
                continue;
            }
            let mismatch = announcement_mismatch(index, &self.plain(&frames), agent.announcement);
            self.nodes[index].report.broadcasts += frames.len() as u64;
            self.keep_frames(index, frames);
            self.record(index, mismatch);
        }
        if let Some(relay) = &mut self.relay {
            relay.begin(self.packages.iter().filter(|_| !self.setup.erased));
            self.setup.notify(&Notice::Reachable);
        }
        self.move_on(0)?;
        self.started = Some(Instant::now());
        Ok(())
    }

    fn before_step(
        &mut self,
        tick: Tick,
        switches: &mut Vec<Switch>,
    ) -> Result<ControlFlow<()>, RunObserverError> {
        match &self.relay {
            // The normal end of a run that serves clients.
            Some(relay) if relay.is_over(&self.setup.stop) => return Ok(ControlFlow::Break(())),
            None if self.setup.stop.is_requested() => {
                self.interrupted = true;
                return Ok(ControlFlow::Break(()));
            }
            _ => {}
        }
        for switch in &*switches {
            let node = &mut self.nodes[switch.agent];
            if node.has_ended() {
                continue;
            }
            let package = self.setup.signed(&switch.package);
            match node.board.push(package.as_bytes()) {
                Ok(()) => node.report.switches += 1,
                Err(fault) => self.fault(switch.agent, tick, fault)?,
            }
        }
        let Some(relay) = &mut self.relay else { return Ok(ControlFlow::Continue(())) };
        relay.record_switches(switches);
        let between = relay.between_steps(tick, &mut self.nodes, switches, &self.setup.stop);
        for (index, fault) in between.faults {
            self.fault(index, tick, fault)?;
        }
        for restart in between.restarts {
            let started = self.restart(restart.node, tick);
            let Some(relay) = &mut self.relay else { break };
            match started {
                Ok(status) => {
                    relay.restarted(&restart, status);
                    self.setup.notify(&Notice::Restarted { agent: restart.node + 1 });
                }
                Err(error) => self.setup.notify(&Notice::Ended(&error)),
            }
        }
        if let Some(share) = between.late {
            self.setup.notify(&Notice::Late { share });
        }
        Ok(ControlFlow::Continue(()))
    }

    fn after_step(
        &mut self,
        tick: Tick,
        agents: &[Option<AgentStep<'_>>],
    ) -> Result<(), RunObserverError> {
        self.propagate_deviations(tick);
        self.feed(tick, agents)?;
        for (index, agent) in agents.iter().enumerate() {
            let Some(agent) = agent else {
                self.nodes[index].frames.clear();
                continue;
            };
            let simulated = agent.broadcast;
            if !self.nodes[index].has_ended() {
                match self.nodes[index].board.turn() {
                    Ok(turn) => self.handle_turn(index, turn, agent),
                    Err(fault) => self.fault(index, tick, fault)?,
                }
            }
            let node = &mut self.nodes[index];
            if node.has_ended() {
                let bytes = |plain: &[u8]| match node.epoch {
                    Some(epoch) => authentic::sealed(plain, epoch, &self.network_keys),
                    None => plain.to_vec(),
                };
                node.frames = simulated.into_iter().map(bytes).collect();
                node.frames_agree = true;
            }
        }
        self.move_on(tick + 1)?;
        self.steps += 1;
        Ok(())
    }
}

impl Drop for Lockstep<'_, '_> {
    fn drop(&mut self) {
        // Terminate all before waiting for the first.
        self.nodes.iter_mut().for_each(|node| node.board.terminate());
    }
}
