//! The frame that an agent broadcasts, and its wire format.
//!
//! On the wire, a frame is the postcard encoding of header and payload, followed by its CRC-32
//! (ISO-HDLC, little-endian):
//!
//! | field | type | encoding |
//! | --- | --- | --- |
//! | version | `u8` | one byte, [`VERSION`] |
//! | sender | `u32` | variable-length integer |
//! | sequence | `u32` | variable-length integer, counts broadcasts from 0 |
//! | tick | `u64` | variable-length integer, the step at which the sample was taken |
//! | payload kind | enum | variable-length integer: 0 is an estimate, 1 a field announcement, 2 a farewell |
//! | content | `[f32]` | number of words as a variable-length integer, then little-endian words |
//! | checksum | `u32` | four bytes |
//!
//! More kinds of payload can be added; a receiver refuses kinds it does not know, or whose feature it was
//! built without. Delimiting and encryption are left to the layers below.
//!
//! A farewell has no words: its sender is about to stall, and neighbours leave it out until its
//! next frame.
//!
//! Cost: linear in the length. Invariant: decoding gives either a frame with a finite estimate of
//! the right dimension or an error; it never panics, whatever the bytes.

use serde::{Deserialize, Serialize};

#[cfg(feature = "exchange")]
use crate::math::numeric::zeros;
use crate::math::numeric::{all_finite, components};
#[cfg(feature = "field")]
use crate::wire::announced::Announced;
use crate::wire::crc::{CHECKSUM_LENGTH, crc32};
use crate::wire::words::{WORDS_CAPACITY, most_words};
pub use crate::wire::words::{WORDS_MAX, Words};
use crate::wire::{codec, writer};
use crate::{AgentId, INPUTS_MAX, NODE_DIMENSION_MAX, StateVector, Tick};

/// Version of the format that this crate reads and writes.
pub const VERSION: u8 = 1;

/// Length of a node's longest encoded frame, in bytes.
pub const FRAME_LENGTH_MAX: usize = length_with(WORDS_MAX);

/// Returns the length of the longest encoded frame with that many words, in bytes: version, longest
/// variable-length integers of the header, payload kind and length, words, checksum.
const fn length_with(words: usize) -> usize {
    1 + 5 + 5 + 10 + 1 + 1 + 4 * words + CHECKSUM_LENGTH
}

/// The components of a node's state or measurement.
pub type Numbers = heapless::Vec<f32, NODE_DIMENSION_MAX>;

/// An encoded frame.
pub type FrameBytes = heapless::Vec<u8, { length_with(WORDS_CAPACITY) }>;

/// One broadcast of an agent.
///
/// ```
/// use agent_core::wire::frame::FrameError;
/// use agent_core::{Frame, StateVector};
///
/// let frame = Frame::new(2, 7, 300, StateVector::<2>::zeros());
/// let mut bytes = frame.encode();
/// assert_eq!(Frame::decode(&bytes), Ok(frame));
///
/// bytes[1] ^= 1;
/// assert_eq!(Frame::<2>::decode(&bytes), Err(FrameError::Checksum));
/// ```
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Frame<const N: usize> {
    /// The agent that broadcasts.
    pub sender: AgentId,
    /// Number of earlier broadcasts by this agent.
    pub sequence: u32,
    /// Tick at which the sample was taken.
    pub tick: Tick,
    /// `x_hat_i(t_k)`, shape `[N]`.
    pub estimate: StateVector<N>,
    /// How the sample evolves, from an agent with the field observer.
    #[cfg(feature = "field")]
    pub announced: Option<Announced<N>>,
    /// Whether the sender is about to stall. The estimate is then 0 and means nothing.
    #[cfg(feature = "exchange")]
    pub is_farewell: bool,
}

/// Why received bytes or a decoded frame was refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum FrameError {
    /// Shorter than any frame, or longer than the longest.
    Length {
        /// The length in bytes.
        found: usize,
    },
    /// The checksum does not match: the bytes were changed in transit.
    Checksum,
    /// The checksum matches, but the bytes are not a frame of this version.
    Malformed,
    /// The frame has a different version.
    Version {
        /// Version of the frame.
        found: u8,
    },
    /// The tag does not match, or the network key is not known: the frame is forged, changed in
    /// transit or from another network.
    #[cfg(feature = "authentic-frames")]
    Tag {
        /// The sender it claims to come from.
        sender: AgentId,
    },
    /// The frame is authentic, but not newer than all earlier ones: it was recorded, repeated or
    /// overtaken.
    #[cfg(feature = "authentic-frames")]
    Replayed {
        /// The sender.
        sender: AgentId,
    },
    /// The frame is authentic, but nothing yet says whether it is recent: the sender has not
    /// answered this agent's hello.
    #[cfg(feature = "authentic-frames")]
    NotBelieved {
        /// The sender.
        sender: AgentId,
    },
    /// The estimate has a different dimension from the receiver's.
    Dimension {
        /// Dimension that the receiver expects.
        expected: usize,
        /// Dimension of the frame.
        found: usize,
    },
    /// A component of the estimate is infinite or not a number.
    NotFinite {
        /// The sender.
        sender: AgentId,
    },
    /// The sender is not a neighbour.
    UnknownSender {
        /// The sender.
        sender: AgentId,
    },
    /// The estimate is outside the receiver's plausible region.
    Implausible {
        /// The sender.
        sender: AgentId,
    },
    /// This frame from the sender, or a newer one, is already pending for the next step.
    DuplicateSender {
        /// The sender.
        sender: AgentId,
    },
}

impl core::fmt::Display for FrameError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match *self {
            Self::Length { found } => write!(f, "invalid frame length: {found} bytes"),
            Self::Checksum => write!(f, "the frame's checksum does not match"),
            Self::Malformed => write!(f, "invalid frame of version {VERSION}"),
            Self::Version { found } => {
                write!(f, "the frame has version {found}, expected {VERSION}")
            }
            #[cfg(feature = "authentic-frames")]
            Self::Tag { sender } => {
                write!(f, "the frame's tag does not match agent {sender} and a known network key")
            }
            #[cfg(feature = "authentic-frames")]
            Self::Replayed { sender } => {
                write!(f, "agent {sender} has already sent this frame or a newer one")
            }
            #[cfg(feature = "authentic-frames")]
            Self::NotBelieved { sender } => {
                write!(f, "agent {sender} has not answered the hello yet")
            }
            Self::Dimension { expected, found } => {
                write!(f, "the frame's estimate has {found} components, expected {expected}")
            }
            Self::NotFinite { sender } => {
                write!(f, "the estimate from agent {sender} is not finite")
            }
            Self::UnknownSender { sender } => write!(f, "agent {sender} is not a neighbour"),
            Self::Implausible { sender } => {
                write!(f, "the estimate from agent {sender} is outside the plausible region")
            }
            Self::DuplicateSender { sender } => {
                write!(f, "this frame from agent {sender}, or a newer one, is already pending")
            }
        }
    }
}

impl core::error::Error for FrameError {}

impl<const N: usize> Frame<N> {
    /// Creates a frame as the paper's observer broadcasts it.
    #[must_use]
    pub const fn new(sender: AgentId, sequence: u32, tick: Tick, estimate: StateVector<N>) -> Self {
        Self {
            sender,
            sequence,
            tick,
            estimate,
            #[cfg(feature = "field")]
            announced: None,
            #[cfg(feature = "exchange")]
            is_farewell: false,
        }
    }

    /// Creates the frame with which an agent tells its neighbours that it is about to stall.
    #[cfg(feature = "exchange")]
    #[must_use]
    pub const fn farewell(sender: AgentId, sequence: u32, tick: Tick) -> Self {
        Self { is_farewell: true, ..Self::new(sender, sequence, tick, zeros()) }
    }

    /// Whether the frame is a farewell.
    #[inline]
    #[must_use]
    pub const fn is_farewell(&self) -> bool {
        #[cfg(feature = "exchange")]
        {
            self.is_farewell
        }
        #[cfg(not(feature = "exchange"))]
        {
            false
        }
    }

    /// Returns the bytes to broadcast.
    #[must_use]
    pub fn encode(&self) -> FrameBytes {
        const { assert!(N >= 1 && N <= INPUTS_MAX, "the state dimension is 1 to INPUTS_MAX") };
        self.with_content(|payload, words| {
            encode(self.sender, self.sequence, self.tick, payload, words)
        })
    }

    /// Calls `use_content` with what the frame carries.
    #[inline]
    pub(crate) fn with_content<R>(&self, use_content: impl FnOnce(Payload, &[[u8; 4]]) -> R) -> R {
        if self.is_farewell() {
            return use_content(Payload::Farewell, &[]);
        }
        #[cfg(feature = "field")]
        if let Some(announced) = &self.announced {
            return use_content(Payload::Field, &announced.words(&self.estimate));
        }
        let words = components(&self.estimate).map(f32::to_le_bytes);
        use_content(Payload::Estimate, &words)
    }

    /// Returns the frame with this content.
    ///
    /// # Errors
    /// Same as for [`Self::decode`], of the content.
    pub(crate) fn of_content(
        (sender, sequence, tick): (AgentId, u32, Tick),
        payload: Payload,
        words: &[[u8; 4]],
    ) -> Result<Self, FrameError> {
        match payload {
            Payload::Estimate => Ok(Self::new(sender, sequence, tick, estimate(sender, words)?)),
            #[cfg(feature = "field")]
            Payload::Field => {
                let (estimate, announced) =
                    Announced::from_words(words).ok_or(FrameError::Malformed)?;
                Ok(Self {
                    announced: Some(announced),
                    ..Self::new(sender, sequence, tick, estimate)
                })
            }
            #[cfg(feature = "exchange")]
            Payload::Farewell if words.is_empty() => Ok(Self::farewell(sender, sequence, tick)),
            _ => Err(FrameError::Malformed),
        }
    }

    /// Decodes a frame from `bytes`, which must contain nothing else.
    ///
    /// # Errors
    /// [`FrameError::Length`], [`FrameError::Checksum`], [`FrameError::Malformed`],
    /// [`FrameError::Version`], [`FrameError::Dimension`] or [`FrameError::NotFinite`].
    pub fn decode(bytes: &[u8]) -> Result<Self, FrameError> {
        let (Head { sender, sequence, tick, payload, .. }, words) =
            decode(bytes, const { most_words(N) })?;
        Self::of_content((sender, sequence, tick), payload, words)
    }
}

/// A frame whose dimension is only known at run time, for programs that carry those of several
/// networks.
#[derive(Clone, Debug, PartialEq)]
pub struct AnyFrame {
    /// The agent that broadcasts.
    pub sender: AgentId,
    /// Number of earlier broadcasts by this agent.
    pub sequence: u32,
    /// Tick at which the sample was taken.
    pub tick: Tick,
    /// What the words are.
    pub payload: Payload,
    /// The words of the content, as on the wire.
    pub words: Words,
}

impl AnyFrame {
    /// Returns the bytes to broadcast.
    #[must_use]
    pub fn encode(&self) -> FrameBytes {
        encode(self.sender, self.sequence, self.tick, self.payload, &self.words)
    }

    /// Decodes a frame from `bytes`, which must contain nothing else. The words are not checked.
    ///
    /// # Errors
    /// [`FrameError::Length`], [`FrameError::Checksum`], [`FrameError::Malformed`] or
    /// [`FrameError::Version`].
    pub fn decode(bytes: &[u8]) -> Result<Self, FrameError> {
        let (Head { sender, sequence, tick, payload, .. }, words) = decode(bytes, WORDS_CAPACITY)?;
        Ok(Self { sender, sequence, tick, payload, words: words.iter().copied().collect() })
    }
}

/// Checks the components of an estimate.
///
/// # Errors
/// [`FrameError::Dimension`] or [`FrameError::NotFinite`].
pub(crate) fn estimate<const N: usize>(
    sender: AgentId,
    words: &[[u8; 4]],
) -> Result<StateVector<N>, FrameError> {
    let words: &[[u8; 4]; N] =
        words.try_into().map_err(|_| FrameError::Dimension { expected: N, found: words.len() })?;
    let estimate = StateVector::from(words.map(f32::from_le_bytes));
    if !all_finite(&estimate) {
        return Err(FrameError::NotFinite { sender });
    }
    Ok(estimate)
}

/// The fields between the version and the components.
#[derive(Serialize, Deserialize)]
struct Head {
    sender: AgentId,
    sequence: u32,
    tick: Tick,
    payload: Payload,
    /// Number of components.
    count: u16,
}

/// The kinds of payload. Without its feature a kind is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Payload {
    /// The estimate, as in the paper.
    Estimate,
    /// A head, the estimate, and how it evolves (feature `field`): `crate::wire::announced`.
    Field,
    /// Nothing: the sender is about to stall (feature `exchange`).
    Farewell,
}

impl Payload {
    /// Whether this firmware knows what such a frame of this many words is.
    pub(crate) const fn is_known(self, words: usize) -> bool {
        match self {
            Self::Estimate => true,
            Self::Field => cfg!(feature = "field"),
            Self::Farewell => cfg!(feature = "exchange") && words == 0,
        }
    }
}

/// Returns the sender that these bytes name, if they begin like a frame. Nothing is checked.
#[must_use]
pub fn named_sender(bytes: &[u8]) -> Option<AgentId> {
    let (&version, rest) = bytes.split_first()?;
    if version != VERSION {
        return None;
    }
    postcard::take_from_bytes(rest).ok().map(|(sender, _)| sender)
}

// One function for all dimensions.
fn encode(
    sender: AgentId,
    sequence: u32,
    tick: Tick,
    payload: Payload,
    words: &[[u8; 4]],
) -> FrameBytes {
    // At most WORDS_CAPACITY.
    let count = words.len() as u16;
    let head = Head { sender, sequence, tick, payload, count };
    let mut bytes = FrameBytes::new();
    // Everything fits: the capacity is the sum of every field's largest size.
    let _ = writer::append(&(VERSION, head), &mut bytes);
    let _ = bytes.extend_from_slice(words.as_flattened());
    let checksum = crc32(&[&bytes]).to_le_bytes();
    let _ = bytes.extend_from_slice(&checksum);
    bytes
}

/// Decodes `bytes` without checking the components, of which there are at most `most`. Returns them as
/// slices of `bytes`: a vector would copy them four times.
fn decode(bytes: &[u8], most: usize) -> Result<(Head, &[[u8; 4]]), FrameError> {
    let length = FrameError::Length { found: bytes.len() };
    if bytes.len() > length_with(most) {
        return Err(length);
    }
    let (body, checksum) = bytes.split_last_chunk::<CHECKSUM_LENGTH>().ok_or(length)?;
    if crc32(&[body]) != u32::from_le_bytes(*checksum) {
        return Err(FrameError::Checksum);
    }
    let (&version, rest) = body.split_first().ok_or(length)?;
    if version != VERSION {
        return Err(FrameError::Version { found: version });
    }
    let (head, rest) = codec::take::<Head>(rest).ok_or(FrameError::Malformed)?;
    match rest.as_chunks() {
        (words, [])
            if words.len() == usize::from(head.count)
                && words.len() <= most
                && head.payload.is_known(words.len()) =>
        {
            Ok((head, words))
        }
        _ => Err(FrameError::Malformed),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn frame() -> Frame<3> {
        Frame::new(2, 300, 70_000, [1.0, -2.5, 0.0].into())
    }

    #[test]
    fn the_wire_format_matches_the_table() {
        let bytes = frame().encode();
        // version, sender, sequence 300 and tick 70000 as variable-length integers, kind,
        // length, three words.
        let body = [
            1, 2, 0xac, 0x02, 0xf0, 0xa2, 0x04, 0, 3, 0, 0, 0x80, 0x3f, 0, 0, 0x20, 0xc0, 0, 0, 0,
            0,
        ];
        assert_eq!(&bytes[..body.len()], body);
        assert_eq!(&bytes[body.len()..], crc32(&[&body]).to_le_bytes());
    }

    #[test]
    fn the_sender_is_named_before_anything_is_checked() {
        let mut bytes = Frame::<3> { sender: 70_000, ..frame() }.encode();
        bytes.truncate(6);
        assert_eq!(named_sender(&bytes), Some(70_000));
        assert_eq!(named_sender(&bytes[..2]), None);
        bytes[0] = VERSION + 1;
        assert_eq!(named_sender(&bytes), None);
        assert_eq!(named_sender(&[]), None);
    }

    #[test]
    fn the_longest_frame_fits() {
        let frame = Frame::<INPUTS_MAX>::new(
            AgentId::MAX,
            u32::MAX,
            u64::MAX,
            StateVector::repeat(f32::MAX),
        );
        let bytes = frame.encode();
        assert_eq!(bytes.len(), length_with(INPUTS_MAX));
        assert_eq!(Frame::decode(&bytes), Ok(frame));
    }

    #[test]
    fn every_single_bit_flip_is_refused() {
        let bytes = frame().encode();
        for bit in 0..bytes.len() * 8 {
            let mut flipped = bytes.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(Frame::<3>::decode(&flipped), Err(FrameError::Checksum));
        }
    }

    /// Returns the frame's body after `change`, with a matching checksum.
    fn resealed(change: impl FnOnce(&mut FrameBytes)) -> FrameBytes {
        let mut bytes = frame().encode();
        bytes.truncate(bytes.len() - CHECKSUM_LENGTH);
        change(&mut bytes);
        let checksum = crc32(&[&bytes]).to_le_bytes();
        bytes.extend_from_slice(&checksum).unwrap();
        bytes
    }

    #[test]
    fn each_defect_has_its_own_error() {
        let bytes = frame().encode();
        let decode = Frame::<3>::decode;
        assert_eq!(decode(&[]), Err(FrameError::Length { found: 0 }));
        assert_eq!(decode(&[0; 4]), Err(FrameError::Length { found: 4 }));
        assert_eq!(decode(&[0; 200]), Err(FrameError::Length { found: 200 }));
        assert_eq!(decode(&bytes[..bytes.len() - 1]), Err(FrameError::Checksum));
        assert_eq!(decode(&resealed(|b| b[0] = 9)), Err(FrameError::Version { found: 9 }));
        assert_eq!(decode(&resealed(|b| b[7] = 1)), Err(FrameError::Malformed));
        // A farewell with words, and a kind that does not exist.
        assert_eq!(decode(&resealed(|b| b[7] = 2)), Err(FrameError::Malformed));
        assert_eq!(AnyFrame::decode(&resealed(|b| b[7] = 2)), Err(FrameError::Malformed));
        assert_eq!(decode(&resealed(|b| b[7] = 3)), Err(FrameError::Malformed));
        assert_eq!(decode(&resealed(|b| b.push(0).unwrap())), Err(FrameError::Malformed));
        assert_eq!(decode(&resealed(|b| b.truncate(b.len() - 1))), Err(FrameError::Malformed));
        // The sender 2, encoded with a superfluous byte.
        let longer = resealed(|b| {
            b[1] = 0x82;
            b.insert(2, 0).unwrap();
        });
        assert_eq!(decode(&longer), Err(FrameError::Malformed));
        assert_eq!(
            Frame::<2>::decode(&bytes),
            Err(FrameError::Dimension { expected: 2, found: 3 })
        );
        let infinite = Frame::<3> { estimate: [1.0, f32::INFINITY, 0.0].into(), ..frame() };
        assert_eq!(decode(&infinite.encode()), Err(FrameError::NotFinite { sender: 2 }));
    }

    #[test]
    fn a_farewell_has_no_words_and_one_byte_string() {
        let body = [1, 2, 0xac, 0x02, 0xf0, 0xa2, 0x04, 2, 0];
        let bytes = resealed(|bytes| *bytes = FrameBytes::from_slice(&body).unwrap());
        #[cfg(feature = "exchange")]
        {
            let farewell = Frame::<3>::farewell(2, 300, 70_000);
            assert_eq!(farewell.encode(), bytes);
            assert_eq!(Frame::decode(&bytes), Ok(farewell));
            assert_eq!(Frame::decode(&bytes), Ok(Frame::<1>::farewell(2, 300, 70_000)));
            let any = AnyFrame::decode(&bytes).unwrap();
            assert_eq!((any.payload, any.words.len()), (Payload::Farewell, 0));
            assert_eq!(any.encode(), bytes);
        }
        #[cfg(not(feature = "exchange"))]
        assert_eq!(Frame::<3>::decode(&bytes), Err(FrameError::Malformed));
        // The kind in two bytes, more bytes after it, or fewer.
        let changes: [fn(&mut FrameBytes); 4] = [
            |b| {
                b[7] = 0x82;
                b.insert(8, 0).unwrap();
            },
            |b| b.push(0).unwrap(),
            |b| b.truncate(8),
            |b| b.extend_from_slice(&[0; 4]).unwrap(),
        ];
        for change in changes {
            let changed = resealed(|bytes| {
                *bytes = FrameBytes::from_slice(&body).unwrap();
                change(bytes);
            });
            assert_eq!(Frame::<3>::decode(&changed), Err(FrameError::Malformed));
            assert_eq!(AnyFrame::decode(&changed), Err(FrameError::Malformed));
        }
        for bit in 0..bytes.len() * 8 {
            let mut flipped = bytes.clone();
            flipped[bit / 8] ^= 1 << (bit % 8);
            assert_eq!(Frame::<3>::decode(&flipped), Err(FrameError::Checksum));
        }
    }

    proptest! {
        #[test]
        fn decoding_undoes_encoding(
            sender: AgentId, sequence: u32, tick: u64,
            estimate in prop::array::uniform4(prop::num::f32::NORMAL | prop::num::f32::ZERO | prop::num::f32::SUBNORMAL),
        ) {
            let frame = Frame::<4>::new(sender, sequence, tick, estimate.into());
            prop_assert_eq!(Frame::decode(&frame.encode()), Ok(frame));
        }

        #[test]
        fn arbitrary_bytes_are_a_frame_or_an_error(bytes in prop::collection::vec(any::<u8>(), 0..120)) {
            let resealed = [&bytes[..], &crc32(&[&bytes]).to_le_bytes()].concat();
            for bytes in [bytes, resealed] {
                if let Ok(frame) = Frame::<3>::decode(&bytes) {
                    prop_assert!(all_finite(&frame.estimate));
                    prop_assert_eq!(&frame.encode()[..], &bytes[..]);
                }
            }
        }
    }
}
