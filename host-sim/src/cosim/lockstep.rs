//! The companion of a run that takes nodes along, step by step.
//!
//! All nodes are fed before the first is listened to, so that they work at the same time. A node
//! gets the frames that its neighbours' nodes have broadcast, not those of the simulated agents:
//! the nodes are a network of their own, and whatever goes wrong in it goes on.

use std::ops::ControlFlow;
use std::time::Instant;

use agent_core::Tick;

use super::board::Board;
use super::compare::{Mismatch, announcement_mismatch, first_mismatch};
use super::fault::{Fault, NodeError};
use super::relay::Relay;
use super::{BoardReport, CosimError, Setup};
use crate::engine::companion::{AgentStart, AgentStep, Companion, CompanionError, Switch};
use crate::interruption;
use crate::packages::PackageBytes;

/// A node and what is known of it.
#[derive(Debug)]
pub(super) struct LoopNode {
    pub(super) board: Board,
    neighbours: Vec<usize>,
    /// What it broadcast for the coming tick.
    frames: Vec<Vec<u8>>,
    /// Whether those are what the simulated agent broadcast.
    frames_agree: bool,
    pub(super) report: BoardReport,
}

impl LoopNode {
    /// From here on it is not compared.
    pub(super) fn part(&mut self, tick: Tick, reason: &str) {
        if self.report.parted.is_none() {
            self.report.parted = Some(format!("from tick {tick} on, because {reason}"));
        }
    }

    /// It has broadcast what no simulated agent has.
    pub(super) fn broadcast_alone(&mut self, frames: Vec<Vec<u8>>) {
        if !frames.is_empty() {
            self.report.broadcasts += frames.len() as u64;
            self.frames_agree = false;
            self.frames = frames;
        }
    }

    fn note(&mut self, mismatch: Option<Mismatch>) -> Option<Mismatch> {
        if self.report.parted.is_some() {
            return None;
        }
        self.report.mismatches += u64::from(mismatch.is_some());
        mismatch
    }
}

/// The nodes of a run.
pub(super) struct Lockstep<'s> {
    setup: Setup<'s>,
    pub(super) nodes: Vec<LoopNode>,
    relay: Option<Relay>,
    pub(super) first_mismatch: Option<Mismatch>,
    pub(super) steps: u64,
    /// When all nodes had begun.
    pub(super) begun: Option<Instant>,
}

impl<'s> Lockstep<'s> {
    pub(super) fn new(setup: Setup<'s>, relay: Option<Relay>) -> Self {
        Self { setup, nodes: Vec::new(), relay, first_mismatch: None, steps: 0, begun: None }
    }

    fn named(&self, index: usize, fault: Fault) -> NodeError {
        let board = self.nodes[index].board.label().to_owned();
        NodeError { agent: index + 1, board, fault }
    }

    fn noted(&mut self, index: usize, mismatch: Option<Mismatch>) {
        let mismatch = self.nodes[index].note(mismatch);
        if self.first_mismatch.is_none() {
            self.first_mismatch = mismatch;
        }
    }

    /// Starts all nodes before the first is waited for.
    fn start(&mut self, agents: &[AgentStart<'_>]) -> Result<Vec<PackageBytes>, NodeError> {
        let mut packages = Vec::with_capacity(agents.len());
        for (index, agent) in agents.iter().enumerate() {
            // Scenarios without a network have been refused before.
            let Some(package) = agent.package else { continue };
            let mut board = (self.setup.start)(index, package)?;
            board.set_timeout(self.setup.timeout);
            let report = BoardReport::new(index + 1, board.label());
            self.nodes.push(LoopNode {
                board,
                neighbours: agent.neighbours.clone(),
                frames: Vec::new(),
                frames_agree: true,
                report,
            });
            packages.push(package.clone());
        }
        Ok(packages)
    }

    /// Asks every node, at the end, what it never used of its stack.
    pub(super) fn ask_for_stacks(&mut self) -> Result<(), NodeError> {
        for index in 0..self.nodes.len() {
            let node = &mut self.nodes[index];
            match node.board.status() {
                Ok(status) => node.report.stack_unused = status.stack_unused,
                Err(fault) => return Err(self.named(index, fault)),
            }
        }
        Ok(())
    }

    fn feed(&mut self, agents: &[AgentStep<'_>]) -> Result<(), NodeError> {
        for (index, agent) in agents.iter().enumerate() {
            let (before, rest) = self.nodes.split_at_mut(index);
            let Some((node, after)) = rest.split_first_mut() else { break };
            let frames = node.neighbours.iter().flat_map(|&neighbour| {
                let sender = match neighbour.checked_sub(index + 1) {
                    Some(later) => &after[later],
                    None => &before[neighbour],
                };
                sender.frames.iter().map(Vec::as_slice)
            });
            let fed = node.board.feed(frames, agent.measurement);
            fed.map_err(|fault| self.named(index, fault))?;
        }
        Ok(())
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
                self.nodes[index].part(tick, &reason);
            }
        }
    }
}

impl Companion for Lockstep<'_> {
    fn begin(&mut self, agents: &[AgentStart<'_>]) -> Result<(), CompanionError> {
        let packages = self.start(agents)?;
        for (index, package) in packages.iter().enumerate() {
            let begun = self.nodes[index].board.begin(package, agents[index].estimate);
            let frames = begun.map_err(|fault| self.named(index, fault))?;
            let announcement = agents[index].announcement.map(|frame| &frame[..]);
            let mismatch = announcement_mismatch(index, &frames, announcement);
            self.nodes[index].report.broadcasts += frames.len() as u64;
            self.nodes[index].frames = frames;
            self.noted(index, mismatch);
        }
        if let Some(relay) = &mut self.relay {
            relay.begin(packages);
        }
        self.begun = Some(Instant::now());
        Ok(())
    }

    fn before_step(
        &mut self,
        tick: Tick,
        switches: &mut Vec<Switch>,
    ) -> Result<ControlFlow<()>, CompanionError> {
        match &self.relay {
            // For a run that is served it is the end that was meant.
            Some(relay) if relay.is_over() => return Ok(ControlFlow::Break(())),
            None if interruption::requested() => return Err(CosimError::Interrupted.into()),
            _ => {}
        }
        for switch in &*switches {
            let pushed = self.nodes[switch.agent].board.push(switch.package.as_bytes());
            pushed.map_err(|fault| self.named(switch.agent, fault))?;
            self.nodes[switch.agent].report.switches += 1;
        }
        if let Some(relay) = &mut self.relay {
            relay.learned(switches);
            match relay.between_steps(tick, &mut self.nodes, switches) {
                Ok(()) => {}
                Err((index, fault)) => return Err(self.named(index, fault).into()),
            }
        }
        Ok(ControlFlow::Continue(()))
    }

    fn after_step(&mut self, tick: Tick, agents: &[AgentStep<'_>]) -> Result<(), CompanionError> {
        self.part_with_neighbours(tick);
        self.feed(agents)?;
        for (index, agent) in agents.iter().enumerate() {
            let node = &mut self.nodes[index];
            let turn = match node.board.turn() {
                Ok(turn) => turn,
                Err(fault) => return Err(self.named(index, fault).into()),
            };
            let mismatch = first_mismatch(index, tick, &turn, agent);
            let expected = agent.broadcast.map(|frame| &frame[..]);
            node.frames_agree = turn.frames.iter().map(Vec::as_slice).eq(expected);
            node.report.broadcasts += turn.frames.len() as u64;
            node.report.compared += u64::from(node.report.parted.is_none());
            if let Some(relay) = &mut self.relay {
                relay.pass_on(index, &turn);
            }
            node.frames = turn.frames;
            self.noted(index, mismatch);
        }
        self.steps += 1;
        Ok(())
    }
}

impl Drop for Lockstep<'_> {
    fn drop(&mut self) {
        // All at once, so that nobody waits for one after the other.
        self.nodes.iter_mut().for_each(|node| node.board.terminate());
    }
}
