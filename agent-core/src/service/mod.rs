//! What a node and a laptop say to each other: requests to the node, and its responses.
//!
//! One request gets one answer ([`Response::is_answer`]), but for [`Request::Samples`], whose
//! answer has several parts, and the two that only a node in the loop takes. What a node says
//! without being asked comes in between.
//!
//! | request | answer |
//! | --- | --- |
//! | [`Query`](Request::Query) | [`Status`](Response::Status) |
//! | [`Begin`](Request::Begin), [`Chunk`](Request::Chunk) | [`Upload`](Response::Upload) |
//! | [`Stage`](Request::Stage) | [`Staged`](Response::Staged) |
//! | [`Activate`](Request::Activate), [`Revert`](Request::Revert) | [`InUse`](Response::InUse) |
//! | [`Confirm`](Request::Confirm), [`Subscribe`](Request::Subscribe), [`StartAt`](Request::StartAt), [`Reset`](Request::Reset) | [`Done`](Response::Done) |
//! | [`Samples`](Request::Samples) | any number of [`Sample`](Response::Sample), then [`SamplesEnd`](Response::SamplesEnd) |
//! | any of them | [`Refused`](Response::Refused) |
//!
//! # A package reaches a node
//! `Begin`, `Chunk` until everything has been received, `Stage` (the node verifies the package),
//! `Activate` (it is used from the next step on, on trial), `Confirm` or enough good steps. Every
//! answer to a chunk says how much has been received; after a broken connection `Query` says it.
//! Repeating a chunk does no harm. docs/decisions/0007-weight-store.md says what a loss of power does.
//!
//! # On the wire
//! Each message is encoded by postcard and framed by [`crate::wire::cobs`]. Both enumerations only grow
//! at their ends; [`PROTOCOL_VERSION`] changes when that is not enough.
//!
//! Invariant: any bytes are a request or none; no request makes a node panic.

mod problem;
mod request;
mod response;

pub use problem::{Problem, RefusalKind, RefusalReport};
pub use request::{Numbers, Request, Subscription};
pub use response::{BoardFault, Event, Firmware, Outcome, PackageStatus, Response, Rows, State, Status};

use serde::{Deserialize, Serialize};

use crate::wire::cobs::Encoder;
use crate::wire::codec;

/// Version of the messages that this crate writes and reads.
pub const PROTOCOL_VERSION: u8 = 1;

/// Most bytes of a package that one [`Request::Chunk`] carries.
pub const CHUNK_LENGTH_MAX: usize = 128;

/// Most bytes of an encoded request, before it is framed: room for a chunk, or for a frame, or for a
/// measurement, with the fields around them.
pub const REQUEST_LENGTH_MAX: usize = CHUNK_LENGTH_MAX + 12;

/// How much of an upload there is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Upload {
    /// Bytes that have been received; the sender goes on from here.
    pub received: u32,
}

/// Frames and sends `message`: `sink` gets the bytes for the stream, piece by piece.
pub fn send(message: &impl Serialize, sink: impl FnMut(&[u8])) {
    let mut encoder = Encoder::new(sink);
    // Nothing that a message consists of fails: its sequences know their lengths.
    let _ = postcard::serialize_with_flavor(message, &mut encoder);
    encoder.finish();
}

/// The message that `bytes` hold, and nothing but it, a [`Request`] or a [`Response`]; `None` if
/// they hold none, or not in its one encoding.
///
/// `bytes` are what [`crate::wire::cobs::Decoder`] returned.
#[must_use]
pub fn receive<'a, M: Serialize + Deserialize<'a>>(bytes: &'a [u8]) -> Option<M> {
    codec::whole(bytes)
}

#[cfg(test)]
mod tests;
