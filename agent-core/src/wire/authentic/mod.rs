//! Authentic frames: frames of version 2, which only a node with the network's key can make.
//!
//! On the wire, a frame is the postcard encoding of header and payload, followed by a tag:
//!
//! | field | type | encoding |
//! | --- | --- | --- |
//! | version | `u8` | one byte, [`VERSION`] |
//! | key | `u8` | one byte, the number of the network key |
//! | sender | [`AgentId`] | variable-length integer |
//! | epoch | `u32` | variable-length integer, rises with every boot of the sender |
//! | sequence | `u32` | variable-length integer, counts the broadcasts of an epoch from 0 |
//! | tick | `u64` | variable-length integer, the step at which the sample was taken |
//! | payload kind | enum | variable-length integer: 0 estimate, 1 hello, 2 sync |
//! | payload | | see [`Payload`]; an estimate is its length, then little-endian words |
//! | tag | `u64` | eight bytes, SipHash-2-4 of all bytes before it |
//!
//! The tag replaces the checksum of version 1. Its key is derived from the network key and the
//! sender's number. Which authentic frames are *believed*, because they are newer than all before,
//! is decided by [`crate::agent::trust`].
//!
//! Cost: linear in the length; see `docs/decisions` for the choice of the algorithm. Invariant:
//! opening never panics, whatever the bytes.

mod key;

pub use key::NetworkKey;

use serde::{Deserialize, Serialize};

use crate::INPUTS_MAX;
use crate::math::numeric::all_finite;
use crate::wire::frame::{FrameError, Numbers};
use crate::wire::{codec, writer};
use crate::{AgentId, StateVector, Tick};

/// Version of authentic frames.
pub const VERSION: u8 = 2;

/// Length of a tag. \[byte\]
pub const TAG_LENGTH: usize = 8;

/// Length of the longest authentic frame: below the 127 bytes of IEEE 802.15.4. \[byte\]
pub const LENGTH_MAX: usize = 1 + 1 + 5 + 5 + 5 + 10 + 1 + 5 + 5 + 1 + 4 * INPUTS_MAX + TAG_LENGTH;

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

/// An authentic frame. `V` holds an estimate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct AuthenticFrame<V> {
    /// The agent that broadcasts.
    pub sender: AgentId,
    /// When, on the sender's clock that never goes back.
    pub stamp: Stamp,
    /// Tick at which the sample was taken.
    pub tick: Tick,
    /// What the frame carries.
    pub payload: Payload<V>,
}

/// The payload of an authentic frame. `V` holds an estimate, shape `[n]`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Payload<V> {
    /// `x_hat_i(t_k)`: a broadcast of the observer.
    Estimate(V),
    /// The sender has started and asks each neighbour for a sync.
    Hello,
    /// Answers the hello of one agent with the sender's last broadcast.
    Sync {
        /// The agent whose hello is answered.
        to: AgentId,
        /// The epoch of that hello.
        epoch: u32,
        /// `x_hat_i(t_k)` of the last broadcast, whose stamp and tick the frame has.
        estimate: V,
    },
}

/// The fields before the tag.
#[derive(Serialize, Deserialize)]
struct Body<V> {
    version: u8,
    key: u8,
    sender: AgentId,
    stamp: Stamp,
    tick: Tick,
    payload: Payload<V>,
}

impl AuthenticFrame<&[f32]> {
    /// Returns the bytes to broadcast, tagged with `key`. The estimate has at most [`INPUTS_MAX`]
    /// components; a longer one gives no bytes.
    #[must_use]
    pub fn seal(&self, key: &NetworkKey) -> Bytes {
        let &Self { sender, stamp, tick, payload } = self;
        let body = Body { version: VERSION, key: key.number(), sender, stamp, tick, payload };
        let mut bytes = Bytes::new();
        // Everything fits: LENGTH_MAX is the sum of every field's largest size.
        if writer::append(&body, &mut bytes).is_none() {
            return Bytes::new();
        }
        let tag = key.tag(sender, &bytes).to_le_bytes();
        let _ = bytes.extend_from_slice(&tag);
        bytes
    }
}

impl<const N: usize> AuthenticFrame<StateVector<N>> {
    /// Opens the frame in `bytes`, which must contain nothing else, with whichever of `keys` it
    /// names.
    ///
    /// # Errors
    /// [`FrameError::Length`], [`FrameError::Version`], [`FrameError::Malformed`],
    /// [`FrameError::Tag`] for a key that is not known as well as for a tag that does not match,
    /// [`FrameError::Dimension`] or [`FrameError::NotFinite`].
    pub fn open(bytes: &[u8], keys: &[NetworkKey]) -> Result<Self, FrameError> {
        let AuthenticFrame { sender, stamp, tick, payload } = open(bytes, keys)?;
        let vector = |numbers: Numbers| {
            let found = numbers.len();
            let components: [f32; N] =
                numbers.into_array().map_err(|_| FrameError::Dimension { expected: N, found })?;
            let estimate = StateVector::from(components);
            all_finite(&estimate).then_some(estimate).ok_or(FrameError::NotFinite { sender })
        };
        let payload = match payload {
            Payload::Estimate(numbers) => Payload::Estimate(vector(numbers)?),
            Payload::Hello => Payload::Hello,
            Payload::Sync { to, epoch, estimate } => {
                Payload::Sync { to, epoch, estimate: vector(estimate)? }
            }
        };
        Ok(Self { sender, stamp, tick, payload })
    }
}

/// Opens a frame without checking the components. One function for all dimensions.
fn open(bytes: &[u8], keys: &[NetworkKey]) -> Result<AuthenticFrame<Numbers>, FrameError> {
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
    let Body { key, sender, stamp, tick, payload, .. } =
        codec::whole::<Body<Numbers>>(body).ok_or(FrameError::Malformed)?;
    let refused = FrameError::Tag { sender };
    let key = keys.iter().find(|known| known.number() == key).ok_or(refused)?;
    if key.tag(sender, body) != u64::from_le_bytes(*tag) {
        return Err(refused);
    }
    Ok(AuthenticFrame { sender, stamp, tick, payload })
}

#[cfg(test)]
mod tests;
