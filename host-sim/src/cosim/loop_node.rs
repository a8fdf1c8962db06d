//! A node in the loop with its state in the co-simulation.

use agent_core::Tick;

use super::BoardReport;
use super::board::Board;
use super::compare::Mismatch;
use super::fault::Fault;

/// A node in the loop.
#[derive(Debug)]
pub(super) struct LoopNode {
    pub(super) board: Board,
    pub(super) neighbours: Vec<usize>,
    /// Its broadcasts for the next tick.
    pub(super) frames: Vec<Vec<u8>>,
    /// Whether these equal the simulated agent's broadcasts.
    pub(super) frames_agree: bool,
    /// The tick of its last step; `None` since it has started.
    pub(super) tick: Option<Tick>,
    /// Where it starts.
    pub(super) initial_estimate: Vec<f32>,
    /// Whether the scenario has it down.
    pub(super) is_down: bool,
    /// The epoch of its last authentic frame.
    pub(super) epoch: Option<u32>,
    pub(super) report: BoardReport,
}

impl LoopNode {
    /// Creates a node that has not broadcast yet.
    pub(super) fn new(
        board: Board,
        neighbours: Vec<usize>,
        initial_estimate: Vec<f32>,
        report: BoardReport,
    ) -> Self {
        Self {
            board,
            neighbours,
            frames: Vec::new(),
            frames_agree: true,
            tick: None,
            initial_estimate,
            is_down: false,
            epoch: None,
            report,
        }
    }

    /// Returns how many periods pass for the node up to its step at `tick`.
    pub(super) fn periods_until(&mut self, tick: Tick) -> u32 {
        let passed = match self.tick.replace(tick) {
            Some(last) => tick.saturating_sub(last),
            // Its first step is that of tick 0.
            None => tick.saturating_add(1),
        };
        u32::try_from(passed).unwrap_or(u32::MAX)
    }

    /// Stops comparing the node from this tick on.
    pub(super) fn stop_comparing(&mut self, tick: Tick, reason: &str) {
        if self.report.parted.is_none() {
            self.report.parted = Some(format!("from tick {tick} on, because {reason}"));
        }
    }

    /// Returns whether the node has stopped stepping.
    pub(super) fn has_ended(&self) -> bool {
        self.report.ended.is_some()
    }

    /// Ends the node. The simulated agent takes its place for its neighbours.
    pub(super) fn end(&mut self, tick: Tick, fault: &Fault) {
        self.stop_comparing(tick, "it has stopped");
        self.report.ended = Some(format!("at tick {tick}: {fault}"));
        self.board.kill();
    }

    /// Records broadcasts that the simulated agent did not make.
    pub(super) fn broadcast_alone(&mut self, frames: Vec<Vec<u8>>) {
        if !frames.is_empty() {
            self.report.broadcasts += frames.len() as u64;
            self.frames_agree = false;
            self.frames = frames;
        }
    }

    /// Counts and returns a mismatch, if the node is still being compared.
    pub(super) fn note(&mut self, mismatch: Option<Mismatch>) -> Option<Mismatch> {
        if self.report.parted.is_some() {
            return None;
        }
        self.report.mismatches += u64::from(mismatch.is_some());
        mismatch
    }
}
