//! The visible state of an agent as bit patterns: equal values that differ in the sign of a zero
//! count as different here.

use agent_core::agent::hold::{Hold, HoldSlots};
use agent_core::agent::{AgentParams, AgentState, StepOutput};
use agent_core::wire::frame::Frame;

use crate::core::random_network::Member;

/// Bit patterns of single-precision numbers.
pub(crate) fn bits<'f>(values: impl IntoIterator<Item = &'f f32>) -> Vec<u32> {
    values.into_iter().map(|value| value.to_bits()).collect()
}

/// A sample: its components, tick and sequence number.
type HoldBits = (Vec<u32>, u64, u32);

fn hold_bits<const N: usize>(hold: &Hold<N>) -> HoldBits {
    (bits(hold.estimate()), hold.tick(), hold.sequence())
}

/// An agent's state.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct StateBits {
    estimate: Vec<u32>,
    outer_weights: Vec<u32>,
    norm_squared: u32,
    consensus_term: Vec<u32>,
    output_error: Vec<u32>,
    own_hold: HoldBits,
    neighbour_holds: Vec<Option<HoldBits>>,
}

/// The bits of an agent's state, through all of its public accessors.
pub(crate) fn state_bits<const N: usize, const FEATURES: usize, S>(
    params: &AgentParams<'_, N>,
    state: &AgentState<N, FEATURES, S>,
) -> StateBits
where
    S: HoldSlots<N>,
{
    StateBits {
        estimate: bits(state.estimate()),
        outer_weights: bits(state.outer_weights().rows().iter().flatten()),
        norm_squared: state.outer_weights().norm_squared().to_bits(),
        consensus_term: bits(state.consensus_term()),
        output_error: bits(state.output_error(params)),
        own_hold: hold_bits(state.own_hold()),
        neighbour_holds: state
            .neighbour_holds()
            .iter()
            .map(|hold| hold.as_ref().map(hold_bits))
            .collect(),
    }
}

/// The bits of a member's state.
pub(crate) fn member_bits<const N: usize>(member: &Member<'_, N>) -> StateBits {
    state_bits(&member.params, &member.state)
}

/// What a step returned: tick, estimate, derivative, and the encoded frame.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct OutputBits {
    tick: u64,
    estimate: Vec<u32>,
    derivative: Vec<u32>,
    broadcast: Option<Vec<u8>>,
}

/// The bits of a step's output.
pub(crate) fn output_bits<const N: usize>(output: &StepOutput<N>) -> OutputBits {
    OutputBits {
        tick: output.sample.tick,
        estimate: bits(&output.sample.estimate),
        derivative: bits(&output.sample.derivative),
        broadcast: output.broadcast.as_ref().map(Frame::encode).map(|bytes| bytes.to_vec()),
    }
}
