//! What a node is asked.

use core::num::NonZeroU32;

use serde::{Deserialize, Serialize};

use crate::Tick;
pub use crate::wire::frame::Numbers;

/// What a node is asked or told.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
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

/// What a node tells without being asked, beside events.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Subscription {
    /// A state with every so many ticks; `None` for none.
    pub state_every: Option<NonZeroU32>,
    /// Whether a state comes with the outer weights.
    pub outer_weights: bool,
}
