//! Requests to a node.

use core::num::NonZeroU32;

use serde::{Deserialize, Serialize};

use crate::Tick;
pub use crate::wire::frame::Numbers;

/// A request to a node.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Request<'a> {
    /// Report the node's identity and status.
    Query,
    /// Start the upload of a package of this length into the slot that is not in use.
    Begin {
        /// Length of the package. \[byte\]
        length: u32,
    },
    /// A part of the package.
    Chunk {
        /// Offset in the package. \[byte\]
        offset: u32,
        /// At most [`super::CHUNK_LENGTH_MAX`] bytes.
        bytes: &'a [u8],
    },
    /// The package is complete: verify it and keep it for activation.
    Stage,
    /// Use the staged package from the next step on, on trial.
    Activate,
    /// Confirm the package on trial.
    Confirm,
    /// End the trial: return to what was in use before, from the next step on.
    Revert,
    /// Restart as after power-on.
    Reset,
    /// Select the unsolicited reports.
    Subscribe(Subscription),
    /// Return the samples kept for training, oldest first.
    Samples {
        /// Skip samples before this tick.
        from: Tick,
        /// Largest number of samples; the answer tells where to continue.
        most: u8,
    },
    /// Continue from this estimate of the state, as if started with it.
    StartAt {
        /// `x_hat`, shape `[n]`.
        estimate: Numbers,
    },
    /// A frame has arrived from a neighbour. Only for a node in the loop; not answered.
    Frame {
        /// The frame as broadcast.
        bytes: &'a [u8],
    },
    /// Attempt a step. Only for a node in the loop; answered by the node's reports, the last being
    /// a [`State`](super::Response::State).
    Tick {
        /// Sampling periods since the previous request: 1, or more to simulate a late node.
        periods: u32,
        /// `y_i`, shape `[m]`; `None` to simulate a failed sensor.
        measurement: Option<Numbers>,
    },
    /// Report how the package in use performs, its trial, and what the board knows of its resets.
    Report,
    /// Give up the entries of the journal that cannot be read, so that updates go on.
    ForgetUnreadable,
    /// The head of a numbered request: the request itself follows, and so does each part of its
    /// answer a [`Response::Answer`](super::Response::Answer) with this number.
    Numbered {
        /// The number.
        number: u16,
    },
}

/// Unsolicited reports, in addition to events.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Subscription {
    /// Interval between reported states; `None` for none. \[ticks\]
    pub state_every: Option<NonZeroU32>,
    /// Whether states include the outer weights.
    pub outer_weights: bool,
}
