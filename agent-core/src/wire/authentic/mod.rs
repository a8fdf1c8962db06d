//! Authentic frames: frames of version 2, which only a node with the network's key can make.
//!
//! On the wire, a frame is the postcard encoding of a header, the estimate, and a tag:
//!
//! | field | type | encoding |
//! | --- | --- | --- |
//! | version | `u8` | one byte, [`VERSION`] |
//! | key | `u8` | one byte, the number of the network key |
//! | sender | [`AgentId`] | variable-length integer |
//! | epoch | `u32` | variable-length integer, rises with every boot of the sender |
//! | sequence | `u32` | variable-length integer, counts the broadcasts of an epoch from 0 |
//! | tick | `u64` | variable-length integer, the step at which the sample was taken |
//! | kind | enum | variable-length integer: 0 estimate, 1 hello, 2 sync, 3 field, 4 field sync, 5 farewell |
//! | to | [`AgentId`] | variable-length integer; only in a sync |
//! | epoch of the hello | `u32` | variable-length integer; only in a sync |
//! | content | `[f32]` | four bytes each, little-endian, as in version 1; none in a hello or a farewell |
//! | tag | `u64` | eight bytes, SipHash-2-4 of all bytes before it |
//!
//! The tag replaces the checksum of version 1. Its key is derived from the network key and the
//! sender's number. Which authentic frames are *believed*, because they are newer than all earlier ones,
//! is decided by [`crate::agent::trust`].
//!
//! Cost: linear in the length; see `docs/decisions` for the choice of the algorithm. Invariant:
//! opening never panics, whatever the bytes.

mod key;

pub use key::NetworkKey;

use serde::{Deserialize, Serialize};

use crate::wire::frame::{FrameError, Payload, WORDS_MAX};
use crate::wire::writer;
use crate::{AgentId, Tick};

/// Version of authentic frames.
pub const VERSION: u8 = 2;

/// Length of a tag. \[byte\]
pub const TAG_LENGTH: usize = 8;

/// Length of the longest authentic frame: below the 127 bytes of IEEE 802.15.4. \[byte\]
pub const LENGTH_MAX: usize = 1 + 1 + 5 + 5 + 5 + 10 + 1 + 5 + 5 + 4 * WORDS_MAX + TAG_LENGTH;

const _: () = assert!(LENGTH_MAX <= 127);

/// An encoded authentic frame.
pub type Bytes = heapless::Vec<u8, LENGTH_MAX>;

/// When a frame was made, on a clock that never goes back: a node increases its epoch with every
/// boot, and its sequence with every broadcast.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Stamp {
    /// Rises with every boot, and whenever the sequence starts again.
    pub epoch: u32,
    /// Number of the broadcast in this epoch, from 0.
    pub sequence: u32,
}

/// What an authentic frame is, except for its estimate.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Header {
    /// The agent that broadcasts.
    pub sender: AgentId,
    /// When, on the sender's clock that never goes back.
    pub stamp: Stamp,
    /// Tick at which the sample was taken.
    pub tick: Tick,
    /// What the frame is for.
    pub kind: Kind,
}

/// What an authentic frame is for. Without its feature a kind is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Kind {
    /// A broadcast of the observer: the estimate is `x_hat_i(t_k)`.
    Estimate,
    /// The sender has started and asks each neighbour for a sync. The frame has no estimate.
    Hello,
    /// Answers the hello of one agent with the sender's last broadcast, whose stamp and tick the
    /// frame has.
    Sync {
        /// The agent whose hello is answered.
        to: AgentId,
        /// The epoch of that hello.
        epoch: u32,
    },
    /// Like [`Kind::Estimate`], from an agent with the field observer.
    Field,
    /// Like [`Kind::Sync`], from an agent with the field observer.
    FieldSync {
        /// The agent whose hello is answered.
        to: AgentId,
        /// The epoch of that hello.
        epoch: u32,
    },
    /// The sender is about to stall. The frame has no estimate.
    Farewell,
}

impl Kind {
    /// The kind of a broadcast with this content.
    #[must_use]
    pub fn broadcast(payload: Payload) -> Self {
        match payload {
            Payload::Estimate => Self::Estimate,
            Payload::Field => Self::Field,
            Payload::Farewell => Self::Farewell,
        }
    }

    /// The kind of an answer to `to`'s hello in `epoch` with this content. A farewell answers nothing.
    #[must_use]
    pub fn answer(payload: Payload, to: AgentId, epoch: u32) -> Self {
        match payload {
            Payload::Estimate => Self::Sync { to, epoch },
            Payload::Field => Self::FieldSync { to, epoch },
            Payload::Farewell => Self::Farewell,
        }
    }

    /// Returns what the frame's words are; `None` for a hello.
    #[must_use]
    pub fn payload(self) -> Option<Payload> {
        match self {
            Self::Hello => None,
            Self::Estimate | Self::Sync { .. } => Some(Payload::Estimate),
            Self::Field | Self::FieldSync { .. } => Some(Payload::Field),
            Self::Farewell => Some(Payload::Farewell),
        }
    }

    /// Returns agent and epoch of the hello that the frame answers, if any.
    #[must_use]
    pub fn answered(self) -> Option<(AgentId, u32)> {
        match self {
            Self::Sync { to, epoch } => Some((to, epoch)),
            Self::FieldSync { to, epoch } => Some((to, epoch)),
            _ => None,
        }
    }
}

/// Returns the bytes to broadcast, tagged with `key`, with at most [`WORDS_MAX`] words of content;
/// more give no bytes.
#[must_use]
pub fn seal(header: &Header, words: &[[u8; 4]], key: &NetworkKey) -> Bytes {
    let mut bytes = Bytes::new();
    // Everything fits: LENGTH_MAX is the sum of every field's largest size.
    let is_written = writer::append(&(VERSION, key.number(), header), &mut bytes).is_some();
    if !is_written || words.len() > WORDS_MAX {
        return Bytes::new();
    }
    let _ = bytes.extend_from_slice(words.as_flattened());
    let tag = key.tag(header.sender, &bytes).to_le_bytes();
    let _ = bytes.extend_from_slice(&tag);
    bytes
}

/// Opens the frame in `bytes`, which must contain nothing else, with whichever of `keys` it names;
/// returns the components of the estimate as words in place.
///
/// # Errors
/// [`FrameError::Length`], [`FrameError::Version`], [`FrameError::Malformed`], or [`FrameError::Tag`]
/// for a key that is not known as well as for a tag that does not match.
pub fn open<'b>(
    bytes: &'b [u8],
    keys: &[NetworkKey],
) -> Result<(Header, &'b [[u8; 4]]), FrameError> {
    let length = FrameError::Length { found: bytes.len() };
    if bytes.len() > LENGTH_MAX {
        return Err(length);
    }
    let (body, tag) = bytes.split_last_chunk::<TAG_LENGTH>().ok_or(length)?;
    match body.first() {
        Some(&VERSION) => {}
        Some(&found) => return Err(FrameError::Version { found }),
        None => return Err(length),
    }
    // The tag covers every byte, so other encodings of the same header need not be refused.
    let ((_, key, header), rest) =
        postcard::take_from_bytes::<(u8, u8, Header)>(body).map_err(|_| FrameError::Malformed)?;
    let Header { sender, kind, .. } = header;
    let refused = FrameError::Tag { sender };
    let key = keys.iter().find(|known| known.number() == key).ok_or(refused)?;
    if key.tag(sender, body) != u64::from_le_bytes(*tag) {
        return Err(refused);
    }
    let has_words = !matches!(kind, Kind::Hello | Kind::Farewell);
    let is_known = |words| kind.payload().is_none_or(|payload| payload.is_known(words));
    match rest.as_chunks() {
        (words, []) if has_words != words.is_empty() && is_known(words.len()) => {
            Ok((header, words))
        }
        _ => Err(FrameError::Malformed),
    }
}

#[cfg(test)]
mod tests;
