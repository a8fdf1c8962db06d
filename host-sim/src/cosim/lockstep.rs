//! The run_observer of a run that takes nodes along, step by step.
//!
//! All nodes are fed before the first is listened to, so that they work at the same time. A node
//! gets the frames that its neighbours' nodes have broadcast, not those of the simulated agents:
//! the nodes are a network of their own, and whatever goes wrong in it goes on.

use std::ops::ControlFlow;
use std::time::Instant;

use agent_core::Tick;
use agent_core::service::Status;

use super::board::Turn;
use super::compare::{Mismatch, announcement_mismatch, first_mismatch};
use super::fault::{Fault, NodeError};
use super::loop_node::LoopNode;
use super::relay::Relay;
use super::{BoardReport, Notice, Setup};
use crate::engine::run_observer::{AgentStart, AgentStep, RunObserver, RunObserverError, Switch};
use crate::packages::PackageBytes;

/// The nodes of a run.
pub(super) struct Lockstep<'s> {
    setup: Setup<'s>,
    pub(super) nodes: Vec<LoopNode>,
    /// What each node began with, as its flash holds it.
    packages: Vec<PackageBytes>,
    pub(super) relay: Option<Relay>,
    pub(super) first_mismatch: Option<Mismatch>,
    pub(super) steps: u64,
    /// Whether a signal asked for the end of a run that is not served.
    pub(super) interrupted: bool,
    /// When all nodes had begun.
    pub(super) begun: Option<Instant>,
}

impl<'s> Lockstep<'s> {
    pub(super) fn new(setup: Setup<'s>, relay: Option<Relay>) -> Self {
        Self {
            setup,
            nodes: Vec::new(),
            packages: Vec::new(),
            relay,
            first_mismatch: None,
            steps: 0,
            interrupted: false,
            begun: None,
        }
    }

    fn named(&self, index: usize, fault: Fault) -> NodeError {
        let board = self.nodes[index].board.label().to_owned();
        NodeError { agent: index + 1, board, fault }
    }

    /// What a fault means: the end of the node where others can still talk to the rest, otherwise the
    /// end of the run.
    fn fault(&mut self, index: usize, tick: Tick, fault: Fault) -> Result<(), NodeError> {
        let Some(relay) = &mut self.relay else { return Err(self.named(index, fault)) };
        let node = &mut self.nodes[index];
        if matches!(fault, Fault::Interrupted) {
            // The run ends in front of the next step.
            node.stop_comparing(tick, "the run was ended in the middle of its step");
            return Ok(());
        }
        node.end(tick, &fault);
        relay.end_node(index);
        let error = self.named(index, fault);
        self.setup.tell(&Notice::Ended(&error));
        Ok(())
    }

    fn noted(&mut self, index: usize, mismatch: Option<Mismatch>) {
        let mismatch = self.nodes[index].note(mismatch);
        if self.first_mismatch.is_none() {
            self.first_mismatch = mismatch;
        }
    }

    /// Starts all nodes before the first is waited for.
    fn start(&mut self, agents: &[AgentStart<'_>]) -> Result<(), NodeError> {
        for (index, agent) in agents.iter().enumerate() {
            // Scenarios without a network have been refused before.
            let Some(package) = agent.package else { continue };
            let package = self.setup.signed(package);
            let board = self.setup.board(index, &package)?;
            let report = BoardReport::new(index + 1, board.label());
            self.nodes.push(LoopNode::new(board, agent.neighbours.clone(), report));
            self.packages.push(package);
        }
        Ok(())
    }

    /// Starts a node that has ended again, with what its flash holds.
    fn start_again(&mut self, index: usize, tick: Tick) -> Result<Status, NodeError> {
        let mut board = self.setup.board(index, &self.packages[index])?;
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

    /// Asks every node, at the end, what it never used of its stack.
    pub(super) fn ask_for_stacks(&mut self) -> Result<(), NodeError> {
        for index in 0..self.nodes.len() {
            let node = &mut self.nodes[index];
            if node.has_ended() {
                continue;
            }
            match node.board.status() {
                Ok(status) => node.report.stack_unused = status.stack_unused,
                // The run has its result, whatever a node still has to say.
                Err(_) if self.relay.is_some() || self.interrupted => {}
                Err(fault) => return Err(self.named(index, fault)),
            }
        }
        Ok(())
    }

    fn feed(&mut self, tick: Tick, agents: &[AgentStep<'_>]) -> Result<(), NodeError> {
        for (index, agent) in agents.iter().enumerate() {
            if self.nodes.get(index).is_some_and(LoopNode::has_ended) {
                continue;
            }
            let (before, rest) = self.nodes.split_at_mut(index);
            let Some((node, after)) = rest.split_first_mut() else { break };
            let frames = node.neighbours.iter().flat_map(|&neighbour| {
                let sender = match neighbour.checked_sub(index + 1) {
                    Some(later) => &after[later],
                    None => &before[neighbour],
                };
                sender.frames.iter().map(Vec::as_slice)
            });
            if let Err(fault) = node.board.feed(frames, agent.measurement) {
                self.fault(index, tick, fault)?;
            }
        }
        Ok(())
    }

    /// Compares what a node did, and passes it on.
    fn took_turn(&mut self, index: usize, tick: Tick, turn: Turn, agent: &AgentStep<'_>) {
        let node = &mut self.nodes[index];
        let mismatch = first_mismatch(index, tick, &turn, agent);
        let expected = agent.broadcast;
        node.frames_agree = turn.frames.iter().map(Vec::as_slice).eq(expected);
        node.report.broadcasts += turn.frames.len() as u64;
        node.report.compared += u64::from(node.report.parted.is_none());
        if let Some(relay) = &mut self.relay {
            relay.pass_on(index, &turn);
        }
        node.frames = turn.frames;
        self.noted(index, mismatch);
    }

    /// A node that was fed with what no simulated agent broadcast goes its own way, too.
    fn part_with_neighbours(&mut self, tick: Tick) {
        for index in 0..self.nodes.len() {
            let neighbours = &self.nodes[index].neighbours;
            let strange = neighbours.iter().copied().find(|&neighbour| {
                let sender = &self.nodes[neighbour];
                sender.report.parted.is_some() && !sender.frames_agree
            });
            if let Some(neighbour) = strange {
                let reason = format!("its neighbour {} goes its own way", neighbour + 1);
                self.nodes[index].stop_comparing(tick, &reason);
            }
        }
    }
}

impl RunObserver for Lockstep<'_> {
    fn begin(&mut self, agents: &[AgentStart<'_>]) -> Result<(), RunObserverError> {
        self.start(agents)?;
        for (index, agent) in agents.iter().enumerate().take(self.nodes.len()) {
            let (node, package) = (&mut self.nodes[index], &self.packages[index]);
            if self.setup.erased {
                let waits = node.board.rejoin();
                waits.map_err(|fault| self.named(index, fault))?;
                self.nodes[index].stop_comparing(0, "it waits for a package");
                continue;
            }
            let begun = node.board.begin(package, agent.estimate);
            let frames = begun.map_err(|fault| self.named(index, fault))?;
            let announcement = agent.announcement;
            let mismatch = announcement_mismatch(index, &frames, announcement);
            self.nodes[index].report.broadcasts += frames.len() as u64;
            self.nodes[index].frames = frames;
            self.noted(index, mismatch);
        }
        if let Some(relay) = &mut self.relay {
            relay.begin(self.packages.iter().filter(|_| !self.setup.erased));
            self.setup.tell(&Notice::Reachable);
        }
        self.begun = Some(Instant::now());
        Ok(())
    }

    fn before_step(
        &mut self,
        tick: Tick,
        switches: &mut Vec<Switch>,
    ) -> Result<ControlFlow<()>, RunObserverError> {
        match &self.relay {
            // For a run that is served it is the end that was meant.
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
        relay.learned(switches);
        let between = relay.between_steps(tick, &mut self.nodes, switches, &self.setup.stop);
        for (index, fault) in between.faults {
            self.fault(index, tick, fault)?;
        }
        for restart in between.restarts {
            let started = self.start_again(restart.node, tick);
            let Some(relay) = &mut self.relay else { break };
            match started {
                Ok(status) => {
                    relay.started_again(&restart, status);
                    self.setup.tell(&Notice::StartedAgain { agent: restart.node + 1 });
                }
                Err(error) => self.setup.tell(&Notice::Ended(&error)),
            }
        }
        if let Some(share) = between.late {
            self.setup.tell(&Notice::Late { share });
        }
        Ok(ControlFlow::Continue(()))
    }

    fn after_step(&mut self, tick: Tick, agents: &[AgentStep<'_>]) -> Result<(), RunObserverError> {
        self.part_with_neighbours(tick);
        self.feed(tick, agents)?;
        for (index, agent) in agents.iter().enumerate() {
            let simulated = agent.broadcast;
            if !self.nodes[index].has_ended() {
                match self.nodes[index].board.turn() {
                    Ok(turn) => self.took_turn(index, tick, turn, agent),
                    Err(fault) => self.fault(index, tick, fault)?,
                }
            }
            let node = &mut self.nodes[index];
            if node.has_ended() {
                node.frames = simulated.into_iter().map(<[u8]>::to_vec).collect();
                node.frames_agree = true;
            }
        }
        self.steps += 1;
        Ok(())
    }
}

impl Drop for Lockstep<'_> {
    fn drop(&mut self) {
        // All at once, so that their waits overlap.
        self.nodes.iter_mut().for_each(|node| node.board.terminate());
    }
}
