//! A node of a run, and what is known of it.

use agent_core::Tick;

use super::BoardReport;
use super::board::Board;
use super::compare::Mismatch;
use super::fault::Fault;

/// A node and what is known of it.
#[derive(Debug)]
pub(super) struct LoopNode {
    pub(super) board: Board,
    pub(super) neighbours: Vec<usize>,
    /// What it broadcast for the coming tick.
    pub(super) frames: Vec<Vec<u8>>,
    /// Whether those are what the simulated agent broadcast.
    pub(super) frames_agree: bool,
    pub(super) report: BoardReport,
}

impl LoopNode {
    /// A node that has broadcast nothing yet.
    pub(super) fn new(board: Board, neighbours: Vec<usize>, report: BoardReport) -> Self {
        Self { board, neighbours, frames: Vec::new(), frames_agree: true, report }
    }

    /// From here on it is not compared.
    pub(super) fn stop_comparing(&mut self, tick: Tick, reason: &str) {
        if self.report.parted.is_none() {
            self.report.parted = Some(format!("from tick {tick} on, because {reason}"));
        }
    }

    /// Whether it takes steps no more.
    pub(super) fn has_ended(&self) -> bool {
        self.report.ended.is_some()
    }

    /// It takes no more steps. To its neighbours, the simulated agent stands in for it.
    pub(super) fn end(&mut self, tick: Tick, fault: &Fault) {
        self.stop_comparing(tick, "it has ended");
        self.report.ended = Some(format!("at tick {tick}: {fault}"));
        self.board.kill();
    }

    /// It has broadcast what no simulated agent has.
    pub(super) fn broadcast_alone(&mut self, frames: Vec<Vec<u8>>) {
        if !frames.is_empty() {
            self.report.broadcasts += frames.len() as u64;
            self.frames_agree = false;
            self.frames = frames;
        }
    }

    /// Counts a mismatch, unless the node is not compared any more, and returns one that counts.
    pub(super) fn note(&mut self, mismatch: Option<Mismatch>) -> Option<Mismatch> {
        if self.report.parted.is_some() {
            return None;
        }
        self.report.mismatches += u64::from(mismatch.is_some());
        mismatch
    }
}
