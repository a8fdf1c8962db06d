//! Decodes the input of the target `frame`.

use crate::correct_frame;

/// The length that encodes a step of the agent.
const STEP: u8 = 0x7f;
/// Set if a frame's checksum is to be corrected.
const CORRECTED: u8 = 0x80;

/// An event for an agent.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Event {
    /// The agent takes a step.
    Step,
    /// The agent receives these bytes.
    Received(Vec<u8>),
}

impl Event {
    /// Returns the events in an input: each starts with a byte whose low seven bits are the length
    /// of the received bytes, or 127 for a step, and whose top bit requests a corrected checksum.
    /// The last frame is as long as the input allows.
    pub fn read(mut input: &[u8]) -> impl Iterator<Item = Self> {
        std::iter::from_fn(move || {
            let (&head, rest) = input.split_first()?;
            if head & !CORRECTED == STEP {
                input = rest;
                return Some(Self::Step);
            }
            let length = usize::from(head & !CORRECTED).min(rest.len());
            let (bytes, rest) = rest.split_at(length);
            input = rest;
            let mut bytes = bytes.to_vec();
            if head & CORRECTED != 0 {
                correct_frame(&mut bytes);
            }
            Some(Self::Received(bytes))
        })
    }

    /// Appends the event to an input. Received bytes must be shorter than 127 bytes.
    pub fn write(&self, input: &mut Vec<u8>) {
        match self {
            Self::Step => input.push(STEP),
            Self::Received(bytes) => {
                input.push(bytes.len() as u8 | CORRECTED);
                input.extend_from_slice(bytes);
            }
        }
    }
}
