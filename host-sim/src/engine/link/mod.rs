//! What carries frames from agent to agent.
//!
//! The engine hands over encoded frames and takes back encoded frames; what happens to them
//! in between is the link's matter. Links that lose, delay or reorder wrap another one behind
//! the same trait.

use agent_core::Tick;
use agent_core::wire::frame::FrameBytes;

use crate::graph::Graph;

/// Carries frames between the agents of one network.
///
/// The engine calls [`Link::send`] for the broadcasts of one tick in ascending order of the
/// sender, then [`Link::deliver`] once for each receiver, possibly from several threads.
pub trait Link: Sync {
    /// Takes the broadcast that `sender` (from 0) made at `tick`.
    fn send(&mut self, sender: usize, tick: Tick, bytes: &FrameBytes);

    /// Hands to `accept` every frame that reaches `receiver` (from 0) in time for its step at
    /// `tick`.
    fn deliver(&self, receiver: usize, tick: Tick, accept: impl FnMut(&[u8]));
}

/// The paper's link: every broadcast reaches all neighbours at once and unharmed.
#[derive(Clone, Debug)]
pub struct Lossless {
    neighbours: Vec<Vec<usize>>,
    last: Vec<Option<(Tick, FrameBytes)>>,
}

impl Lossless {
    /// A link along every edge of `graph`.
    #[must_use]
    pub fn new(graph: &Graph) -> Self {
        let agents = graph.agents();
        let neighbours = (0..agents)
            .map(|i| graph.neighbours(i).iter().map(|neighbour| neighbour.agent).collect())
            .collect();
        Self { neighbours, last: vec![None; agents] }
    }
}

impl Link for Lossless {
    fn send(&mut self, sender: usize, tick: Tick, bytes: &FrameBytes) {
        self.last[sender] = Some((tick, bytes.clone()));
    }

    #[inline]
    fn deliver(&self, receiver: usize, tick: Tick, mut accept: impl FnMut(&[u8])) {
        for &neighbour in &self.neighbours[receiver] {
            match &self.last[neighbour] {
                Some((sent, bytes)) if *sent == tick => accept(bytes),
                _ => {}
            }
        }
    }
}
