//! The trait of all layers, and what they act on.

use std::sync::Arc;

use crate::scenario::EdgeSettings;

/// One copy of a frame, on its way from the sender to one neighbour.
#[derive(Clone, Debug)]
pub struct Transmission {
    /// The sender, from 0.
    pub sender: usize,
    /// The receiver, from 0.
    pub receiver: usize,
    /// Number of the broadcast, from 0 for each sender.
    pub number: u64,
    /// 0 for the copy itself, 1 for its duplicate.
    pub twin: u8,
    /// When it arrives. \[s\]
    pub arrival: f64,
    /// The frame, shared by its copies until one is changed.
    pub bytes: Arc<[u8]>,
}

impl Transmission {
    /// Returns the coordinates of this copy for random numbers.
    #[must_use]
    pub fn at(&self) -> [u64; 3] {
        [self.sender as u64, self.receiver as u64, self.number | u64::from(self.twin) << 56]
    }
}

/// What a layer does to copies of frames, in words that follow their number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Effect {
    /// They do not arrive.
    Loses(&'static str),
    /// They arrive later, changed or more often.
    Alters(&'static str),
}

/// Something that happens to copies of frames.
pub trait Layer: Send + Sync + std::fmt::Debug {
    /// Returns its name in reports.
    fn name(&self) -> &'static str;

    /// Returns what it does.
    fn effect(&self) -> Effect;

    /// Carries a copy over an edge with these settings: calls `next` with what comes out, which may be
    /// nothing.
    fn carry(
        &mut self,
        edge: &EdgeSettings,
        transmission: Transmission,
        next: &mut dyn FnMut(Transmission),
    );

    /// Returns how many copies it has lost, changed, held up or added.
    fn count(&self) -> u64;
}
