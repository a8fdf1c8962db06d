//! Compares a node's steps with the simulated agent's, bit for bit.

use std::fmt;

use agent_core::Tick;
use agent_core::service::State;
use serde::Serialize;

use crate::engine::run_observer::AgentStep;

/// A difference between node and simulator.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Mismatch {
    /// The agent, from 1.
    pub agent: usize,
    /// The tick of the step.
    pub tick: Tick,
    /// What differs.
    pub quantity: &'static str,
    /// Index of the component or byte, from 0; row-major for outer weights.
    pub component: Option<usize>,
    /// Value on the node; a number is followed by its bits.
    pub node: String,
    /// Value in the simulator.
    pub simulator: String,
}

impl fmt::Display for Mismatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { agent, tick, quantity, component, node, simulator } = self;
        write!(f, "agent {agent}, tick {tick}: {quantity}")?;
        if let Some(component) = component {
            write!(f, "[{component}]")?;
        }
        write!(f, " is {node} on the node and {simulator} in the simulator")
    }
}

/// A quantity, its component, and both values.
type Difference = (&'static str, Option<usize>, String, String);

/// Returns the first difference between a node's step at `tick`, with its `state` and `frames`, and the
/// simulated one; `agent` is numbered from 0.
#[must_use]
pub fn first_mismatch(
    agent: usize,
    tick: Tick,
    state: Option<&State<Vec<f32>>>,
    frames: &[Vec<u8>],
    step: &AgentStep<'_>,
) -> Option<Mismatch> {
    let difference = match state {
        Some(state) => of_state(tick, state, step),
        None => Some(("state", None, "not reported".to_owned(), format!("of tick {tick}"))),
    };
    let broadcast = step.broadcast;
    let difference = difference.or_else(|| of_frames(frames, broadcast));
    difference.map(|difference| mismatch(agent, tick, difference))
}

/// Returns the first difference between the initial broadcasts of a node and the simulated agent.
#[must_use]
pub fn announcement_mismatch(
    agent: usize,
    frames: &[Vec<u8>],
    announcement: Option<&[u8]>,
) -> Option<Mismatch> {
    of_frames(frames, announcement).map(|difference| mismatch(agent, 0, difference))
}

fn mismatch(agent: usize, tick: Tick, difference: Difference) -> Mismatch {
    let (quantity, component, node, simulator) = difference;
    Mismatch { agent: agent + 1, tick, quantity, component, node, simulator }
}

fn of_state(tick: Tick, state: &State<Vec<f32>>, step: &AgentStep<'_>) -> Option<Difference> {
    if state.tick != tick {
        return Some(("tick", None, state.tick.to_string(), tick.to_string()));
    }
    if state.outcome != step.outcome {
        let (node, simulator) = (format!("{:?}", state.outcome), format!("{:?}", step.outcome));
        return Some(("outcome", None, node, simulator));
    }
    of_numbers("derivative", &state.derivative, step.derivative.unwrap_or(&[]))
        .or_else(|| of_numbers("estimate", &state.estimate, step.estimate))
        .or_else(|| of_numbers("outer weights", &state.outer_weights, &step.outer_weights))
}

fn of_numbers(quantity: &'static str, node: &[f32], simulator: &[f32]) -> Option<Difference> {
    if node.len() != simulator.len() {
        let count = |numbers: &[f32]| format!("{} numbers", numbers.len());
        return Some((quantity, None, count(node), count(simulator)));
    }
    let component = node.iter().zip(simulator).position(|(a, b)| a.to_bits() != b.to_bits())?;
    let shown = |number: f32| format!("{number:e} ({:#010x})", number.to_bits());
    Some((quantity, Some(component), shown(node[component]), shown(simulator[component])))
}

fn of_frames(node: &[Vec<u8>], simulator: Option<&[u8]>) -> Option<Difference> {
    let frame = match (node, simulator) {
        ([], None) => return None,
        ([frame], Some(_)) => frame,
        _ => {
            let count = |count| match count {
                0 => "none".to_owned(),
                1 => "one frame".to_owned(),
                count => format!("{count} frames"),
            };
            let simulated = count(usize::from(simulator.is_some()));
            return Some(("broadcast", None, count(node.len()), simulated));
        }
    };
    let simulated = simulator?;
    if frame.len() != simulated.len() {
        let length = |frame: &[u8]| format!("{} bytes", frame.len());
        return Some(("frame", None, length(frame), length(simulated)));
    }
    let byte = frame.iter().zip(simulated).position(|(a, b)| a != b)?;
    let shown = |byte: u8| format!("{byte:#04x}");
    Some(("frame", Some(byte), shown(frame[byte]), shown(simulated[byte])))
}

#[cfg(test)]
mod tests {
    use agent_core::service::Outcome;

    use super::*;
    use crate::cosim::board::Turn;

    const FRAME: [u8; 3] = [1, 2, 3];

    fn step(broadcast: Option<&[u8]>) -> AgentStep<'_> {
        AgentStep {
            tick: 7,
            measurement: Some(&[1.0]),
            outcome: Outcome::Stepped,
            estimate: &[1.0, 2.0],
            derivative: Some(&[0.0, -3.0]),
            outer_weights: vec![0.5; 4],
            broadcast,
        }
    }

    fn mismatch_of(agent: usize, turn: &Turn, step: &AgentStep<'_>) -> Option<Mismatch> {
        first_mismatch(agent, 7, turn.state.as_ref(), &turn.frames, step)
    }

    fn turn() -> Turn {
        let state = State {
            tick: 7,
            outcome: Outcome::Stepped,
            estimate: vec![1.0, 2.0],
            derivative: vec![0.0, -3.0],
            outer_weights: vec![0.5; 4],
        };
        Turn { state: Some(state), frames: vec![vec![1, 2, 3]], unsolicited: Vec::new() }
    }

    #[test]
    fn equal_bits_are_not_a_mismatch() {
        assert_eq!(mismatch_of(0, &turn(), &step(Some(&FRAME))), None);
    }

    #[test]
    fn every_difference_is_named_precisely() {
        let difference = |change: fn(&mut State<Vec<f32>>)| {
            let mut turn = turn();
            change(turn.state.as_mut().unwrap());
            mismatch_of(1, &turn, &step(Some(&FRAME))).unwrap().to_string()
        };
        let on = "agent 2, tick 7: ";
        assert_eq!(
            difference(|state| state.tick = 8),
            format!("{on}tick is 8 on the node and 7 in the simulator")
        );
        assert_eq!(
            difference(|state| state.outcome = Outcome::Diverged),
            format!("{on}outcome is Diverged on the node and Stepped in the simulator")
        );
        // Negative zero differs from zero.
        assert_eq!(
            difference(|state| state.derivative[0] = -0.0),
            format!(
                "{on}derivative[0] is -0e0 (0x80000000) on the node and 0e0 (0x00000000) in the \
                 simulator"
            )
        );
        assert_eq!(
            difference(|state| state.estimate[1] = f32::from_bits(2.0f32.to_bits() + 1)),
            format!(
                "{on}estimate[1] is 2.0000002e0 (0x40000001) on the node and 2e0 (0x40000000) in \
                 the simulator"
            )
        );
        assert_eq!(
            difference(|state| state.outer_weights.clear()),
            format!("{on}outer weights is 0 numbers on the node and 4 numbers in the simulator")
        );
        let mut other = turn();
        other.frames[0][2] = 9;
        let mismatch = mismatch_of(1, &other, &step(Some(&FRAME))).unwrap().to_string();
        assert_eq!(mismatch, format!("{on}frame[2] is 0x09 on the node and 0x03 in the simulator"));
        let mismatch = mismatch_of(1, &turn(), &step(None)).unwrap().to_string();
        assert_eq!(
            mismatch,
            format!("{on}broadcast is one frame on the node and none in the simulator")
        );
    }
}
