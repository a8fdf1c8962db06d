//! The messages between a node and a laptop: requests to the node, and its responses.
//!
//! Each request gets one answer ([`Response::is_answer`]), except for [`Request::Samples`], whose
//! answer has several parts, and the two requests for a node in the loop. Unsolicited responses can
//! arrive in between.
//!
//! | request | answer |
//! | --- | --- |
//! | [`Query`](Request::Query) | [`Status`](Response::Status) |
//! | [`Begin`](Request::Begin), [`Chunk`](Request::Chunk) | [`Upload`](Response::Upload) |
//! | [`Stage`](Request::Stage) | [`Staged`](Response::Staged) |
//! | [`Activate`](Request::Activate), [`Revert`](Request::Revert) | [`InUse`](Response::InUse) |
//! | [`Report`](Request::Report) | [`Report`](Response::Report) |
//! | [`ForgetUnreadable`](Request::ForgetUnreadable) | [`Done`](Response::Done) |
//! | [`Session`](Request::Session) | [`Session`](Response::Session) |
//! | [`Provision`](Request::Provision), [`NetworkKeys`](Request::NetworkKeys), [`OperatorKeys`](Request::OperatorKeys), [`FactoryReset`](Request::FactoryReset) | [`Done`](Response::Done) |
//! | [`Confirm`](Request::Confirm), [`Subscribe`](Request::Subscribe), [`StartAt`](Request::StartAt), [`Reset`](Request::Reset) | [`Done`](Response::Done) |
//! | [`Samples`](Request::Samples) | any number of [`Sample`](Response::Sample), then [`SamplesEnd`](Response::SamplesEnd) |
//! | any of them | [`Refused`](Response::Refused) |
//!
//! # How a package reaches a node
//! `Begin`, then `Chunk` until everything has been received, `Stage` (the node verifies the
//! package), `Activate` (it is used from the next step on, on trial), `Confirm` or enough good
//! steps. Every answer to a chunk reports how much has been received; after a broken connection
//! `Query` reports it. Repeating a chunk does no harm. docs/decisions/0007-weight-store.md
//! describes the effects of power loss.
//!
//! # On the wire
//! Each message is encoded by postcard and framed by [`crate::wire::cobs`]. Both enumerations are
//! only extended at their ends; any other change requires a new [`PROTOCOL_VERSION`].
//!
//! Invariant: any bytes decode to a request or to `None`; no request makes a node panic.

mod problem;
mod report;
mod request;
mod response;
#[cfg(feature = "authentic-frames")]
pub mod seal;

pub use problem::{Problem, RefusalKind, RefusalReport};
pub use report::{FILE_NAME, LastRevert, PanicPlace, Performance, Report, ResetCause, TrialReport};
pub use request::{Numbers, Provision, Request, Seal, Subscription};
pub use response::{
    BoardFault, Event, Firmware, Outcome, PackageStatus, Response, Session, State, Status, numbers,
};

use serde::{Deserialize, Serialize};

use crate::wire::cobs::Encoder;
use crate::wire::{codec, writer};

/// Version of the messages that this crate reads and writes.
pub const PROTOCOL_VERSION: u8 = 1;

/// Largest number of package bytes in a [`Request::Chunk`].
pub const CHUNK_LENGTH_MAX: usize = 128;

/// Length of the longest encoded request before framing, in bytes: room for a chunk, a frame or a
/// measurement, with the fields around them, and for a seal.
pub const REQUEST_LENGTH_MAX: usize = CHUNK_LENGTH_MAX + 12 + SEAL_LENGTH_MAX;

/// Length by which a seal makes a request longer: index, counter, salt and tag.
const SEAL_LENGTH_MAX: usize = 1 + 5 + 8 + 16;

/// Progress of an upload.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Upload {
    /// Bytes received so far; the sender continues from here.
    pub received: u32,
}

/// Index of the heads of numbered requests and of their answers.
const NUMBERED: u8 = 15;

/// Encodes and frames `message`; passes the bytes to `sink` piece by piece.
pub fn send(message: &impl Serialize, sink: impl FnMut(&[u8])) {
    send_numbered(None, message, sink);
}

/// Like [`send`], but with a number if there is one: the head [`Request::Numbered`] before a request,
/// and [`Response::Answer`] before a response.
pub fn send_numbered(number: Option<u16>, message: &impl Serialize, sink: impl FnMut(&[u8])) {
    let mut encoder = Encoder::new(sink);
    if let Some(number) = number {
        let (head, length) = head(number);
        encoder.extend(head.get(..length).unwrap_or_default());
    }
    // Encoding cannot fail, because all sequences know their lengths.
    let _ = writer::write(message, &mut |bytes| encoder.extend(bytes));
    encoder.finish();
}

/// Like [`send_numbered`], for a node's responses: compiled once, for any sink.
#[inline(never)]
pub fn respond(number: Option<u16>, response: &Response<'_, &[f32]>, sink: &mut dyn FnMut(&[u8])) {
    send_numbered(number, response, sink);
}

/// Returns the head of a numbered message, and its length: its index and a varint.
fn head(number: u16) -> ([u8; 4], usize) {
    const MORE: u8 = 0x80;
    let low = number as u8 & !MORE;
    let middle = (number >> 7) as u8 & !MORE;
    let high = (number >> 14) as u8;
    match number {
        0..0x80 => ([NUMBERED, low, 0, 0], 2),
        0x80..0x4000 => ([NUMBERED, low | MORE, middle, 0], 3),
        _ => ([NUMBERED, low | MORE, middle | MORE, high], 4),
    }
}

/// Separates the number of a request or an answer from the rest; `None` and all bytes if it has none.
#[must_use]
pub fn split_number(bytes: &[u8]) -> (Option<u16>, &[u8]) {
    match codec::take::<Request<'_>>(bytes) {
        Some((Request::Numbered { number }, rest)) => (Some(number), rest),
        _ => (None, bytes),
    }
}

/// Separates the head of a sealed request from the encrypted rest; `None` and all bytes if the request
/// is not sealed. A number must have been separated before.
#[must_use]
pub fn split_seal(bytes: &[u8]) -> (Option<Seal>, &[u8]) {
    match codec::take::<Request<'_>>(bytes) {
        Some((Request::Sealed(seal), rest)) => (Some(seal), rest),
        _ => (None, bytes),
    }
}

/// Decodes a message, a [`Request`] or a [`Response`]; `None` if `bytes` are not exactly one
/// message in canonical form.
///
/// `bytes` are what [`crate::wire::cobs::Decoder`] returned.
#[must_use]
pub fn receive<'a, M: Serialize + Deserialize<'a>>(bytes: &'a [u8]) -> Option<M> {
    codec::whole(bytes)
}

#[cfg(test)]
mod tests;
