//! Frames messages on a byte stream, such as a serial line between a node and a laptop, and detects
//! damage.
//!
//! A message is followed by its CRC-32 (four bytes, least significant first). Both are encoded with
//! COBS (consistent overhead byte stuffing, Cheshire and Baker 1999), which removes every 0 byte,
//! and a 0 byte ends the message. A receiver that joins late or has lost bytes resynchronises at
//! the next 0. Empty messages are ignored, so a sender may start with a 0.
//!
//! The encoder buffers one COBS block and the decoder one message of the longest length it accepts.
//! Neither can panic, which is why the crate `cobs` is not used.
//!
//! Cost: about 25 operations per byte, including the checksum. Memory: 264 bytes while a message is
//! encoded; `CAPACITY + 12` bytes for the decoder.

use crate::wire::crc::{CHECKSUM_LENGTH, Checksum, crc32};

/// Ends every message and occurs nowhere else.
pub const DELIMITER: u8 = 0;

/// Bytes of data in the longest COBS block.
const BLOCK_LENGTH_MAX: u8 = 254;

/// Returns the largest number of bytes that a message of `length` bytes takes on the stream,
/// including checksum and delimiter.
#[must_use]
pub const fn encoded_length_max(length: usize) -> usize {
    let data = length + CHECKSUM_LENGTH;
    data + data / BLOCK_LENGTH_MAX as usize + 1 + 1
}

/// Encodes one message piece by piece and passes each block to `sink`.
#[derive(Debug)]
pub struct Encoder<S> {
    sink: S,
    checksum: Checksum,
    /// Room for the block's code, then its data.
    block: [u8; BLOCK_LENGTH_MAX as usize + 1],
    /// Bytes of data in the block, at most [`BLOCK_LENGTH_MAX`].
    length: u8,
}

impl<S: FnMut(&[u8])> Encoder<S> {
    /// Starts a message.
    pub fn new(sink: S) -> Self {
        let block = [0; BLOCK_LENGTH_MAX as usize + 1];
        Self { sink, checksum: Checksum::new(), block, length: 0 }
    }

    /// Appends the next bytes of the message.
    #[inline(never)]
    pub fn extend(&mut self, bytes: &[u8]) {
        self.checksum.update(bytes);
        self.stuff(bytes);
    }

    /// Ends the message.
    pub fn finish(mut self) {
        let checksum = self.checksum.clone().finish().to_le_bytes();
        self.stuff(&checksum);
        self.end_block();
        (self.sink)(&[DELIMITER]);
    }

    fn stuff(&mut self, bytes: &[u8]) {
        let mut length = self.length;
        for &byte in bytes {
            if byte != 0 {
                length = length.wrapping_add(1);
                if let Some(place) = self.block.get_mut(usize::from(length)) {
                    *place = byte;
                }
                if length != BLOCK_LENGTH_MAX {
                    continue;
                }
            }
            self.length = length;
            self.end_block();
            length = 0;
        }
        self.length = length;
    }

    /// A block shorter than the longest stands for its data followed by a zero.
    fn end_block(&mut self) {
        let code = self.length.wrapping_add(1);
        if let Some(block) = self.block.get_mut(..usize::from(code)) {
            if let Some(first) = block.first_mut() {
                *first = code;
            }
            (self.sink)(block);
        }
        self.length = 0;
    }
}

/// Why received bytes are not a message. The decoder is synchronised again afterwards.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum SerialError {
    /// The message exceeds the decoder's capacity.
    TooLong,
    /// The message ended within a block or before its checksum.
    Incomplete,
    /// The checksum does not match.
    Checksum,
}

impl core::fmt::Display for SerialError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(match self {
            Self::TooLong => "the message exceeds the receiver's buffer",
            Self::Incomplete => "the message is incomplete",
            Self::Checksum => "the message's checksum does not match",
        })
    }
}

impl core::error::Error for SerialError {}

/// Finds messages of up to `CAPACITY` bytes, checksum included, in a stream.
#[derive(Clone, Debug)]
pub struct Decoder<const CAPACITY: usize> {
    message: heapless::Vec<u8, CAPACITY>,
    /// Bytes of data that the current block still lacks.
    missing: u8,
    /// Whether a zero precedes the next block.
    zero_due: bool,
    /// Whether any byte has arrived since the last delimiter.
    begun: bool,
    overflowed: bool,
}

impl<const CAPACITY: usize> Default for Decoder<CAPACITY> {
    fn default() -> Self {
        Self::new()
    }
}

impl<const CAPACITY: usize> Decoder<CAPACITY> {
    /// Creates a decoder at the start of a stream.
    #[must_use]
    pub const fn new() -> Self {
        let message = heapless::Vec::new();
        Self { message, missing: 0, zero_due: false, begun: false, overflowed: false }
    }

    /// Takes the next byte of the stream. At the end of a message, returns it without its checksum,
    /// or the error found.
    #[inline]
    pub fn push(&mut self, byte: u8) -> Option<Result<&[u8], SerialError>> {
        if byte == DELIMITER {
            return self.end();
        }
        if !self.begun {
            self.begun = true;
            self.message.clear();
        }
        if self.missing == 0 {
            if self.zero_due {
                self.keep(0);
            }
            self.missing = byte.wrapping_sub(1);
            self.zero_due = self.missing != BLOCK_LENGTH_MAX;
        } else {
            self.missing = self.missing.wrapping_sub(1);
            self.keep(byte);
        }
        None
    }

    fn keep(&mut self, byte: u8) {
        self.overflowed |= self.message.push(byte).is_err();
    }

    fn end(&mut self) -> Option<Result<&[u8], SerialError>> {
        let Self { missing, begun, overflowed, .. } = *self;
        (self.missing, self.zero_due) = (0, false);
        (self.begun, self.overflowed) = (false, false);
        if !begun {
            return None;
        }
        if overflowed {
            return Some(Err(SerialError::TooLong));
        }
        let Some((message, checksum)) = self.message.split_last_chunk::<CHECKSUM_LENGTH>() else {
            return Some(Err(SerialError::Incomplete));
        };
        if missing > 0 {
            return Some(Err(SerialError::Incomplete));
        }
        Some(if crc32(&[message]) == u32::from_le_bytes(*checksum) {
            Ok(message)
        } else {
            Err(SerialError::Checksum)
        })
    }
}

#[cfg(test)]
mod tests {
    extern crate std;

    use std::{vec, vec::Vec};

    use proptest::prelude::*;

    use super::*;

    fn encoded(message: &[u8]) -> Vec<u8> {
        let mut stream = Vec::new();
        let mut encoder = Encoder::new(|block: &[u8]| stream.extend_from_slice(block));
        // In pieces, as a serialiser writes them.
        message.chunks(7).for_each(|piece| encoder.extend(piece));
        encoder.finish();
        stream
    }

    fn decoded<const CAPACITY: usize>(stream: &[u8]) -> Vec<Result<Vec<u8>, SerialError>> {
        let mut decoder = Decoder::<CAPACITY>::new();
        let mut found = Vec::new();
        for &byte in stream {
            found.extend(decoder.push(byte).map(|message| message.map(<[u8]>::to_vec)));
        }
        found
    }

    #[test]
    fn a_message_is_encoded_as_documented() {
        // CRC-32 of the nine digits, least significant byte first, is 26 39 f4 cb.
        let expected = [&[14][..], b"123456789", &[0x26, 0x39, 0xf4, 0xcb, 0]].concat();
        assert_eq!(encoded(b"123456789"), expected);
        // A zero ends a block: 11 00 | CRC.
        let stream = encoded(&[0x11, 0]);
        assert_eq!(stream[..2], [2, 0x11]);
        assert_eq!(stream.iter().filter(|&&byte| byte == 0).count(), 1);
    }

    #[test]
    fn a_late_listener_synchronises_at_a_zero() {
        let stream = [&encoded(b"lost")[3..], &[0, 0], &encoded(b"heard")].concat();
        let found = decoded::<16>(&stream);
        assert!(found[0].is_err());
        assert_eq!(found[1..], [Ok(b"heard".to_vec())]);
    }

    #[test]
    fn each_defect_has_its_own_error() {
        let stream = encoded(b"message");
        let mut flipped = stream.clone();
        flipped[3] ^= 0x40;
        assert_eq!(decoded::<16>(&flipped), [Err(SerialError::Checksum)]);
        assert_eq!(decoded::<10>(&stream), [Err(SerialError::TooLong)]);
        assert_eq!(decoded::<16>(&[3, 1, 2, 0]), [Err(SerialError::Incomplete)]);
        let cut = [&stream[..stream.len() - 3], &[0]].concat();
        assert_eq!(decoded::<16>(&cut), [Err(SerialError::Incomplete)]);
    }

    #[test]
    fn blocks_of_every_length_around_the_longest_survive() {
        for length in 240..520 {
            for byte in [0, 7] {
                let message = vec![byte; length];
                let stream = encoded(&message);
                assert!(stream.len() <= encoded_length_max(length));
                assert_eq!(decoded::<1024>(&stream), [Ok(message)], "{length} times {byte}");
            }
        }
    }

    proptest! {
        #[test]
        fn decoding_undoes_encoding(
            messages in prop::collection::vec(prop::collection::vec(
                prop_oneof![Just(0u8), any::<u8>()], 0..600), 1..4),
        ) {
            let stream: Vec<u8> = messages.iter().flat_map(|message| encoded(message)).collect();
            let found: Result<Vec<_>, _> = decoded::<1024>(&stream).into_iter().collect();
            prop_assert_eq!(found, Ok(messages));
        }

        /// Noise spoils at most the message it hits.
        #[test]
        fn noise_ends_at_the_next_delimiter(noise in prop::collection::vec(any::<u8>(), 0..700)) {
            let stream = [&noise[..], &[0], &encoded(b"after")].concat();
            prop_assert_eq!(decoded::<64>(&stream).pop(), Some(Ok(b"after".to_vec())));
        }
    }
}
