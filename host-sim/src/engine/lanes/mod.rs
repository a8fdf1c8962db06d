//! Networks of many agents evaluated at once, each agent in a lane of the processor's vectors.
//!
//! An agent's features depend only on its estimate before the step, so they can be computed for many agents
//! before any of them steps. [`Lanes`] groups the agents of a [`CHUNK`] by architecture into blocks of
//! [`LANES`], evaluates a block at once ([`forward`]), and hands each agent its features ([`ahead`]). An
//! agent that is down or does without its network does not ask for them.
//!
//! The instructions are chosen at run time: vectors of 16 (AVX-512), 8 (AVX2) or 4 numbers (SSE2, NEON).
//!
//! Invariants: an agent accepts features only if they belong to its own network, by the address of the
//! parameters, and to the input of its step, by its bits. What is out of date costs time and changes no
//! result. A lane has the bits that the network gives on its own, so a run has the same bits with and
//! without lanes, for any instructions.
//!
//! Memory: a second copy of the parameters of agents that have a network of their own, and 8 KiB for each chunk.

mod ahead;
mod forward;

use std::ptr;

use pulp::Arch;

use crate::basis::SharedNetwork;
pub(super) use ahead::{Ahead, Computed};
use forward::{Forward, LANES, LaneScratch, Row};

/// Agents whose networks are evaluated together before they step, while their states are in the cache.
pub(super) const CHUNK: usize = 32;

/// Smallest block: for fewer agents, the lanes that are not used cost more than the others save.
const BLOCK_MIN: usize = 4;

/// Whether the networks of many agents are evaluated at once. It changes the time that a run takes, and
/// no bit of its results.
#[derive(Clone, Copy, Debug, Default)]
pub enum LaneMode {
    /// With the longest vectors of this processor.
    #[default]
    Longest,
    /// With these instructions.
    Only(Arch),
    /// Every agent evaluates its own network.
    Off,
}

impl LaneMode {
    fn arch(self) -> Option<Arch> {
        match self {
            Self::Longest => Some(Arch::new()),
            Self::Only(arch) => Some(arch),
            Self::Off => None,
        }
    }
}

/// The networks of one chunk of agents.
#[derive(Debug, Default)]
pub(super) struct Lanes<const N: usize> {
    blocks: Vec<Block<N>>,
    /// Block and lane of each agent of the chunk that has one.
    places: Vec<Option<(usize, usize)>>,
    scratch: Box<LaneScratch>,
}

/// Agents whose networks have the same architecture.
#[derive(Debug)]
struct Block<const N: usize> {
    arch: Arch,
    /// Of each lane in use.
    networks: Vec<SharedNetwork>,
    /// The parameters by lane; none if the lanes share theirs.
    parameters: Option<Vec<Row>>,
    /// `x_hat` of each lane.
    inputs: [[f32; N]; LANES],
    /// `sigma` of each lane, shape `[lanes][L]`.
    features: Vec<f32>,
}

impl<const N: usize> Lanes<N> {
    /// Groups the networks of a chunk of agents; `None` for an agent that uses none.
    pub(super) fn new<'n>(
        networks: impl Iterator<Item = Option<&'n SharedNetwork>>,
        mode: LaneMode,
    ) -> Self {
        let Some(arch) = mode.arch() else { return Self::default() };
        let networks: Vec<_> = networks.collect();
        let mut lanes = Self { places: vec![None; networks.len()], ..Self::default() };
        let mut waiting: Vec<_> = (0..networks.len()).collect();
        // Each turn takes the agents of one block out.
        while let Some(first) = waiting.iter().find_map(|&agent| networks[agent]) {
            let fits = |agent: &usize| {
                networks[*agent].is_some_and(|own| own.architecture() == first.architecture())
            };
            let agents: Vec<_> = waiting.iter().copied().filter(fits).take(LANES).collect();
            waiting.retain(|agent| !agents.contains(agent));
            // Features at known inputs are not computed ahead.
            if agents.len() < BLOCK_MIN || first.architecture().inputs() != N {
                continue;
            }
            for (lane, &agent) in agents.iter().enumerate() {
                lanes.places[agent] = Some((lanes.blocks.len(), lane));
            }
            let networks = agents.iter().filter_map(|&agent| networks[agent].cloned()).collect();
            lanes.blocks.push(Block::new(networks, arch));
        }
        lanes
    }

    /// Computes the features of every agent in a block. `input` returns the input of its network, by its
    /// number in the chunk.
    pub(super) fn evaluate(&mut self, input: impl Fn(usize) -> [f32; N]) {
        let Self { blocks, places, scratch } = self;
        if blocks.is_empty() {
            return;
        }
        for (agent, place) in places.iter().enumerate() {
            if let Some((block, lane)) = *place {
                blocks[block].inputs[lane] = input(agent);
            }
        }
        for block in blocks {
            block.evaluate(scratch);
        }
    }

    /// Returns the features of an agent of the chunk, if they are those of `network`.
    #[inline]
    pub(super) fn computed(
        &self,
        agent: usize,
        network: Option<&SharedNetwork>,
    ) -> Option<Computed<'_, N>> {
        let (block, lane) = (*self.places.get(agent)?)?;
        let Block { networks, inputs, features, .. } = &self.blocks[block];
        if !is_same(&networks[lane], network?) {
            return None;
        }
        let count = features.len() / networks.len();
        Some(Computed { input: &inputs[lane], features: &features[lane * count..][..count] })
    }
}

/// Returns whether two networks have the same parameters in memory, and thus the same architecture.
fn is_same(a: &SharedNetwork, b: &SharedNetwork) -> bool {
    ptr::eq(a.parameters(), b.parameters())
}

impl<const N: usize> Block<N> {
    /// Creates a block of 1 to [`LANES`] networks.
    fn new(networks: Vec<SharedNetwork>, arch: Arch) -> Self {
        let parameters =
            (!networks.iter().all(|network| is_same(network, &networks[0]))).then(|| {
                let mut rows = vec![[0.0; LANES]; networks[0].parameters().len()];
                for (lane, network) in networks.iter().enumerate() {
                    for (row, &parameter) in rows.iter_mut().zip(network.parameters()) {
                        row[lane] = parameter;
                    }
                }
                rows
            });
        let features = vec![0.0; networks.len() * networks[0].architecture().features()];
        Self { arch, networks, parameters, inputs: [[0.0; N]; LANES], features }
    }

    fn evaluate(&mut self, scratch: &mut LaneScratch) {
        let Self { arch, networks, parameters, inputs, features } = self;
        let network = &networks[0];
        let mut rows = [[0.0; LANES]; N];
        for (lane, input) in inputs.iter().enumerate() {
            for (row, &x) in rows.iter_mut().zip(input) {
                row[lane] = x;
            }
        }
        let (architecture, inputs, count) = (network.architecture(), &rows[..], networks.len());
        match parameters {
            None => {
                let parameters = network.parameters();
                Forward { architecture, parameters, inputs, count, features, scratch }
                    .evaluate(*arch);
            }
            Some(parameters) => {
                Forward { architecture, parameters, inputs, count, features, scratch }
                    .evaluate(*arch);
            }
        }
    }
}

#[cfg(test)]
mod run_tests;
#[cfg(test)]
mod tests;
