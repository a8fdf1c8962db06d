//! The paper's link: every broadcast reaches all neighbours immediately and intact.

use agent_core::Tick;

use super::medium::{STANDARD_RATE, airtime};
use super::{Link, Traffic};
use crate::graph::Graph;

/// Delivers every broadcast to all neighbours.
#[derive(Clone, Debug)]
pub struct Lossless {
    neighbours: Vec<Vec<usize>>,
    /// The last broadcast of each agent, and its tick.
    last: Vec<(Option<Tick>, Vec<u8>)>,
    traffic: Vec<Traffic>,
}

impl Lossless {
    /// Creates a link along every edge of `graph`.
    #[must_use]
    pub fn new(graph: &Graph) -> Self {
        let agents = graph.agents();
        let neighbours = (0..agents)
            .map(|i| graph.neighbours(i).iter().map(|neighbour| neighbour.agent).collect())
            .collect();
        let last = vec![(None, Vec::new()); agents];
        Self { neighbours, last, traffic: vec![Traffic::default(); agents] }
    }
}

impl Link for Lossless {
    fn send(&mut self, sender: usize, tick: Tick, frame: &[u8]) {
        let (sent, bytes) = &mut self.last[sender];
        *sent = Some(tick);
        bytes.clear();
        bytes.extend_from_slice(frame);
        let traffic = &mut self.traffic[sender];
        traffic.delivered += self.neighbours[sender].len() as u64;
        traffic.airtime += airtime(frame.len(), STANDARD_RATE);
    }

    #[inline]
    fn deliver(&self, receiver: usize, tick: Tick, accept: &mut dyn FnMut(&[u8])) {
        for &neighbour in &self.neighbours[receiver] {
            let (sent, bytes) = &self.last[neighbour];
            if *sent == Some(tick) {
                accept(bytes);
            }
        }
    }

    fn traffic(&self, sender: usize) -> Option<Traffic> {
        Some(self.traffic[sender])
    }
}
