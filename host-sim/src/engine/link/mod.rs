//! Link models, which carry frames between agents: one file per model.
//!
//! A link receives encoded frames from the engine and delivers encoded frames. Links that lose,
//! delay or reorder frames wrap another link behind the same trait.
//!
//! To add a model, add a file here, a variant of [`ScenarioLink`], and a variant of
//! [`LinkModel`] with its keys in `[link]`; `CONTRIBUTING.md` has the steps.

mod lossless;

use agent_core::Tick;

pub use lossless::Lossless;

use crate::scenario::{LinkModel, Scenario};

/// Carries frames between the agents of one network.
///
/// The engine calls [`Link::send`] for the broadcasts of one tick in ascending order of the
/// sender, then [`Link::deliver`] once for each receiver, possibly from several threads.
pub trait Link: Sync {
    /// Sends the frame that `sender`, from 0, broadcast at `tick`.
    fn send(&mut self, sender: usize, tick: Tick, frame: &[u8]);

    /// Calls `accept` with every frame that reaches `receiver`, from 0, in time for its step at
    /// `tick`.
    fn deliver(&self, receiver: usize, tick: Tick, accept: impl FnMut(&[u8]));
}

/// The link described by a scenario.
#[derive(Clone, Debug)]
pub enum ScenarioLink {
    /// See [`Lossless`].
    Lossless(Lossless),
}

impl ScenarioLink {
    /// Creates the link of a run. `seed` is the run's seed, for models that draw random numbers.
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
