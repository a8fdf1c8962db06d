//! What carries frames from agent to agent: one file a model.
//!
//! The engine hands over encoded frames and takes back encoded frames; what happens to them
//! in between is the link's matter. Links that lose, delay or reorder wrap another one behind
//! the same trait.
//!
//! A new model is a file here, a variant of [`ScenarioLink`], and a variant of
//! [`LinkModel`](crate::scenario::LinkModel) with the keys that it reads from `[link]`.

mod lossless;

use agent_core::Tick;

pub use lossless::Lossless;

use crate::scenario::{LinkModel, Scenario};

/// Carries frames between the agents of one network.
///
/// The engine calls [`Link::send`] for the broadcasts of one tick in ascending order of the
/// sender, then [`Link::deliver`] once for each receiver, possibly from several threads.
pub trait Link: Sync {
    /// Takes the frame that `sender` (from 0) broadcast at `tick`.
    fn send(&mut self, sender: usize, tick: Tick, frame: &[u8]);

    /// Hands to `accept` every frame that reaches `receiver` (from 0) in time for its step at
    /// `tick`.
    fn deliver(&self, receiver: usize, tick: Tick, accept: impl FnMut(&[u8]));
}

/// The link that a scenario describes.
#[derive(Clone, Debug)]
pub enum ScenarioLink {
    /// See [`Lossless`].
    Lossless(Lossless),
}

impl ScenarioLink {
    /// Creates the link of a run. `seed` is the run's, for models that draw random numbers.
    #[must_use]
    pub fn new(scenario: &Scenario, _seed: u64) -> Self {
        match scenario.link {
            LinkModel::Lossless => Self::Lossless(Lossless::new(&scenario.graph)),
        }
    }
}

impl Link for ScenarioLink {
    fn send(&mut self, sender: usize, tick: Tick, frame: &[u8]) {
        match self {
            Self::Lossless(link) => link.send(sender, tick, frame),
        }
    }

    #[inline]
    fn deliver(&self, receiver: usize, tick: Tick, accept: impl FnMut(&[u8])) {
        match self {
            Self::Lossless(link) => link.deliver(receiver, tick, accept),
        }
    }
}
