//! What a node is asked.

use core::num::NonZeroU32;

use serde::Serialize;

use super::Message;
use crate::INPUTS_MAX;
use crate::Tick;
use crate::wire::codec::Reader;

/// Components of a state or of a measurement.
pub type Numbers = heapless::Vec<f32, INPUTS_MAX>;

/// What a node is asked or told.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub enum Request<'a> {
    /// Who are you, and how are you?
    Query,
    /// A package of this length follows, into the slot that is not in use.
    Begin {
        /// Its length. \[byte\]
        length: u32,
    },
    /// A part of the package.
    Chunk {
        /// Where it belongs. \[byte\]
        offset: u32,
        /// At most [`super::CHUNK_LENGTH_MAX`] bytes.
        bytes: &'a [u8],
    },
    /// The package is complete: verify it, and keep it for its activation.
    Stage,
    /// Use the staged package from the next step on, on trial.
    Activate,
    /// The trial has succeeded.
    Confirm,
    /// The trial has failed: use what was in use before, from the next step on.
    Revert,
    /// Begin anew as after switching on.
    Reset,
    /// What to tell without being asked.
    Subscribe(Subscription),
    /// The samples that the node has kept for training, oldest first.
    Samples {
        /// Not those before this tick.
        from: Tick,
        /// Not more than these; the answer says how to go on.
        most: u8,
    },
    /// Go on from this estimate of the state, as if switched on with it.
    StartAt {
        /// `x_hat`, shape `[n]`.
        estimate: Numbers,
    },
    /// A frame has arrived from a neighbour. Only for a node in the loop, and without an answer.
    Frame {
        /// The frame as it was broadcast.
        bytes: &'a [u8],
    },
    /// It is time for a step. Only for a node in the loop; what the node then has to tell follows,
    /// a [`State`](super::Response::State) last.
    Tick {
        /// Sampling periods that have begun since the last one: 1, or more if the node is to believe
        /// that it was late.
        periods: u32,
        /// `y_i`, shape `[m]`; `None` if the sensor is to have failed.
        measurement: Option<Numbers>,
    },
}

// By hand, since a node does it: see `crate::wire::codec`. Writing is serde's.
impl<'a> Message<'a> for Request<'a> {
    #[inline(never)]
    fn decode(bytes: &'a [u8]) -> Option<Self> {
        let mut reader = Reader::new(bytes);
        let request = match reader.byte() {
            0 => Self::Query,
            1 => Self::Begin { length: reader.u32() },
            2 => Self::Chunk { offset: reader.u32(), bytes: reader.sequence() },
            3 => Self::Stage,
            4 => Self::Activate,
            5 => Self::Confirm,
            6 => Self::Revert,
            7 => Self::Reset,
            8 => Self::Subscribe(Subscription {
                state_every: match reader.flag() {
                    true => Some(NonZeroU32::new(reader.u32())?),
                    false => None,
                },
                outer_weights: reader.flag(),
            }),
            9 => Self::Samples { from: reader.u64(), most: reader.byte() },
            10 => Self::StartAt { estimate: read_numbers(&mut reader)? },
            11 => Self::Frame { bytes: reader.sequence() },
            12 => Self::Tick {
                periods: reader.u32(),
                measurement: match reader.flag() {
                    true => Some(read_numbers(&mut reader)?),
                    false => None,
                },
            },
            _ => return None,
        };
        reader.finish()?.is_empty().then_some(request)
    }
}

/// How many there are, then one after another.
fn read_numbers(reader: &mut Reader<'_>) -> Option<Numbers> {
    let mut numbers = Numbers::new();
    for _ in 0..reader.byte() {
        numbers.push(reader.f32()).ok()?;
    }
    Some(numbers)
}

/// What a node tells without being asked, beside events.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Subscription {
    /// A state with every so many ticks; `None` for none.
    pub state_every: Option<NonZeroU32>,
    /// Whether a state comes with the outer weights.
    pub outer_weights: bool,
}
