//! Steps all agents: chunk by chunk, on several threads if there are enough of them.

use rayon::prelude::*;

use super::agents::{SimulatedAgent, Surroundings};
use super::lanes::{CHUNK, LaneMode, Lanes};

/// Groups the networks of all agents, chunk by chunk. To be repeated when agents have other networks.
pub(super) fn lanes<const N: usize>(
    agents: &[SimulatedAgent<'_, N>],
    mode: LaneMode,
) -> Vec<Lanes<N>> {
    let chunks = agents.chunks(CHUNK);
    chunks.map(|agents| Lanes::new(agents.iter().map(SimulatedAgent::network), mode)).collect()
}

/// Steps every agent that is not `down`; returns whether any failed.
#[inline]
pub(super) fn step<const N: usize>(
    agents: &mut [SimulatedAgent<'_, N>],
    lanes: &mut [Lanes<N>],
    down: &[bool],
    around: &Surroundings<'_, N>,
) -> bool {
    // For fewer, waking a thread costs more than stepping them; and so does handing all to the only one.
    if agents.len() < 2 * CHUNK || rayon::current_num_threads() == 1 {
        let chunks = agents.chunks_mut(CHUNK).zip(lanes).enumerate();
        chunks.fold(false, |failed, (chunk, (agents, lanes))| {
            failed | step_chunk(agents, lanes, down, around, chunk * CHUNK)
        })
    } else {
        let chunks = agents.par_chunks_mut(CHUNK).zip(lanes).enumerate();
        chunks
            .map(|(chunk, (agents, lanes))| step_chunk(agents, lanes, down, around, chunk * CHUNK))
            .reduce(|| false, |a, b| a | b)
    }
}

/// Steps one chunk, whose first agent has the number `first`; returns whether any agent failed.
#[inline]
fn step_chunk<const N: usize>(
    agents: &mut [SimulatedAgent<'_, N>],
    lanes: &mut Lanes<N>,
    down: &[bool],
    around: &Surroundings<'_, N>,
    first: usize,
) -> bool {
    let mut failed = false;
    lanes.evaluate(|agent| agents[agent].network_input());
    for (place, agent) in agents.iter_mut().enumerate() {
        if !down[first + place] {
            let computed = lanes.computed(place, agent.network());
            agent.step(around, first + place, computed);
            failed |= agent.failure.is_some();
        }
    }
    failed
}
