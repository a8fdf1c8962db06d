//! Link models, which carry frames between agents.
//!
//! A link receives encoded frames from the engine and delivers encoded frames. [`Lossless`] is the
//! paper's; [`Layered`] passes every copy of a frame through layers, one file each:
//!
//! | layer | does |
//! | --- | --- |
//! | `medium` | frames wait for the shared medium, for slots, and for the duty cycle |
//! | `connection` | edges that are gone for some time, partitions |
//! | `burst`, `loss` | loss, in bursts and independent |
//! | `delay` | constant delay and jitter, which also changes the order |
//! | `duplicate` | copies that arrive twice |
//! | `corrupt` | changed bytes |
//!
//! To add a layer, add a file here with a type that implements [`layer::Layer`], list it in
//! [`Layered::new`], and add its key to [`EdgeSettings`](crate::scenario::EdgeSettings);
//! `CONTRIBUTING.md` has the steps.

mod burst;
mod calendar;
mod connection;
mod corrupt;
mod delay;
mod duplicate;
pub mod layer;
mod layered;
mod loss;
mod lossless;
mod medium;

use agent_core::Tick;
use serde::Serialize;

pub use layer::Effect;
pub use layered::Layered;
pub use lossless::Lossless;

use crate::scenario::Scenario;

/// Carries frames between the agents of one network. Agents are numbered from 0.
///
/// For each tick the engine calls [`Link::send`] for its broadcasts in ascending order of the sender,
/// then [`Link::advance`], then [`Link::deliver`] once for each receiver, possibly from several
/// threads.
pub trait Link: Sync {
    /// Sends the frame that `sender` broadcast at `tick`.
    fn send(&mut self, sender: usize, tick: Tick, frame: &[u8]);

    /// Moves time on to `tick`, before its frames are delivered.
    fn advance(&mut self, tick: Tick) {
        let _ = tick;
    }

    /// Calls `accept` with every frame that reaches `receiver` in time for its step at `tick`.
    fn deliver(&self, receiver: usize, tick: Tick, accept: &mut dyn FnMut(&[u8]));

    /// Returns what happened to the frames of `sender`; `None` if the link does not count.
    fn traffic(&self, sender: usize) -> Option<Traffic> {
        let _ = sender;
        None
    }

    /// Returns what each layer did, in the order of the layers.
    fn layer_counts(&self) -> Vec<LayerCount> {
        Vec::new()
    }
}

/// What happened to the frames of one sender. A frame has one copy for each neighbour.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Traffic {
    /// Copies that reached a neighbour, duplicates included.
    pub delivered: u64,
    /// Copies that did not. Those in transit at the end are neither.
    pub lost: u64,
    /// Time for which the sender occupied the medium. \[s\]
    pub airtime: f64,
}

/// How often a layer did what it is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct LayerCount {
    /// The layer.
    pub layer: &'static str,
    /// What it is for.
    #[serde(skip)]
    pub effect: Effect,
    /// Number of copies of frames; for the medium of frames replaced, and of steps waited by them.
    pub count: u64,
}

/// The link of a run: the one that the scenario describes, or one that the caller brings. One type for both,
/// so that the engine is compiled once for each state dimension.
pub(super) enum RunLink<'l> {
    /// See [`Lossless`].
    Lossless(Lossless),
    /// See [`Layered`].
    Layered(Box<Layered>),
    /// The caller's.
    Custom(Box<dyn Link + 'l>),
}

impl RunLink<'_> {
    /// Creates the link of a run. `seed` is the run's seed, for layers that draw random numbers.
    pub(super) fn new(scenario: &Scenario, seed: u64) -> Self {
        if scenario.delivers_all() {
            Self::Lossless(Lossless::new(&scenario.graph))
        } else {
            Self::Layered(Box::new(Layered::new(scenario, seed)))
        }
    }
}

impl Link for RunLink<'_> {
    #[inline]
    fn send(&mut self, sender: usize, tick: Tick, frame: &[u8]) {
        match self {
            Self::Lossless(link) => link.send(sender, tick, frame),
            Self::Layered(link) => link.send(sender, tick, frame),
            Self::Custom(link) => link.send(sender, tick, frame),
        }
    }

    #[inline]
    fn advance(&mut self, tick: Tick) {
        match self {
            Self::Lossless(link) => link.advance(tick),
            Self::Layered(link) => link.advance(tick),
            Self::Custom(link) => link.advance(tick),
        }
    }

    #[inline]
    fn deliver(&self, receiver: usize, tick: Tick, accept: &mut dyn FnMut(&[u8])) {
        match self {
            Self::Lossless(link) => link.deliver(receiver, tick, accept),
            Self::Layered(link) => link.deliver(receiver, tick, accept),
            Self::Custom(link) => link.deliver(receiver, tick, accept),
        }
    }

    fn traffic(&self, sender: usize) -> Option<Traffic> {
        match self {
            Self::Lossless(link) => link.traffic(sender),
            Self::Layered(link) => link.traffic(sender),
            Self::Custom(link) => link.traffic(sender),
        }
    }

    fn layer_counts(&self) -> Vec<LayerCount> {
        match self {
            Self::Lossless(link) => link.layer_counts(),
            Self::Layered(link) => link.layer_counts(),
            Self::Custom(link) => link.layer_counts(),
        }
    }
}

#[cfg(test)]
mod tests;
