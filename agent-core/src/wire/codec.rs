//! The encoding of frames, packages and messages: postcard's wire format
//! (<https://postcard.jamesmunns.com/wire-format>), restricted to one byte string per value.
//!
//! postcard also accepts integers with superfluous continuation bytes. Such an encoding is longer than
//! the one postcard writes, and no other choice is left to a writer, so comparing lengths is enough:
//! each value has exactly one encoding on processors of any word length, and no ignored byte can differ
//! between two copies.
//!
//! Cost: linear in the length. Invariant: decoding never panics, whatever the bytes.

use serde::{Deserialize, Serialize};

use super::writer;

/// Decodes the value at the start of `bytes` and returns it with the remaining bytes; `None` if the
/// bytes are invalid or not in their canonical form.
// One copy of each, even where the optimiser would inline.
#[inline(never)]
pub(crate) fn take<'a, T>(bytes: &'a [u8]) -> Option<(T, &'a [u8])>
where
    T: Serialize + Deserialize<'a>,
{
    let (value, rest) = postcard::take_from_bytes::<T>(bytes).ok()?;
    let length = writer::length(&value)?;
    (length == bytes.len() - rest.len()).then_some((value, rest))
}

/// Decodes the value that `bytes` hold; `None` if bytes are left over.
pub(crate) fn whole<'a, T: Serialize + Deserialize<'a>>(bytes: &'a [u8]) -> Option<T> {
    take(bytes).and_then(|(value, rest)| rest.is_empty().then_some(value))
}

#[cfg(test)]
mod tests {
    extern crate std;

    use std::{string::String, vec::Vec};

    use proptest::prelude::*;

    use super::*;

    /// One value of each type that the formats use.
    type Mixed<'a> =
        (u64, Option<u16>, bool, &'a str, [u8; 3], f32, heapless::Vec<(u8, u32), 4>, &'a [u8]);

    fn written(value: &impl Serialize) -> Vec<u8> {
        postcard::to_slice(value, &mut [0; 200]).unwrap().to_vec()
    }

    proptest! {
        #[test]
        fn decoding_undoes_encoding(
            integer: u64, shift in 0u32..64, optional: Option<u16>, flag: bool,
            text in "\\PC{0,8}", bits: u32,
            pairs in prop::collection::vec(any::<(u8, u32)>(), 0..4),
            bytes in prop::collection::vec(any::<u8>(), 0..9),
        ) {
            let number = f32::from_bits(bits);
            let pairs = heapless::Vec::<_, 4>::from_slice(&pairs).unwrap();
            let value: Mixed<'_> =
                (integer >> shift, optional, flag, &text, [7; 3], number, pairs, &bytes);
            let mut stream = written(&value);
            let mut bytes = heapless::Vec::<u8, 200>::new();
            prop_assert_eq!(writer::append(&value, &mut bytes), Some(()));
            prop_assert_eq!(&bytes[..], &stream[..]);
            // Bit for bit, NaN included.
            prop_assert_eq!(whole::<Mixed<'_>>(&stream).map(|read| written(&read)), Some(stream.clone()));
            stream.push(9);
            prop_assert!(whole::<Mixed<'_>>(&stream).is_none());
            prop_assert_eq!(take::<Mixed<'_>>(&stream).map(|(_, rest)| rest.to_vec()), Some(std::vec![9]));
        }

        /// Every decoded value encodes to the same bytes.
        #[test]
        fn only_the_shortest_encoding_is_taken(bytes in prop::collection::vec(
            prop_oneof![Just(0), Just(1), Just(0x80), Just(0xff), any::<u8>()], 0..30)) {
            if let Some((value, rest)) = take::<Mixed<'_>>(&bytes) {
                prop_assert_eq!([&written(&value), rest].concat(), bytes);
            } else if let Some((value, rest)) = take::<u64>(&bytes) {
                prop_assert_eq!([&written(&value), rest].concat(), bytes);
            }
        }

        #[test]
        fn text_is_valid_utf8_and_nothing_else(
            bytes in prop::collection::vec(prop_oneof![any::<u8>(), 0..0x80u8, 0xc0..=0xf4u8], 0..6),
            text: String,
        ) {
            for bytes in [&bytes[..], text.as_bytes()] {
                let mut room = std::vec![0; bytes.len() + 10];
                let stream = &*postcard::to_slice(bytes, &mut room).unwrap();
                prop_assert_eq!(whole::<&str>(stream), core::str::from_utf8(bytes).ok());
            }
        }
    }

    #[test]
    fn missing_overlong_and_out_of_range_values_are_refused() {
        assert_eq!(whole::<u64>(&[0xac, 0x02]), Some(300));
        assert_eq!(whole::<u64>(&[]), None);
        assert_eq!(whole::<u64>(&[0x80]), None);
        assert_eq!(whole::<u64>(&[0xac, 0x82, 0]), None);
        assert_eq!(whole::<u16>(&[0x80, 0x80, 0x04]), None);
        assert_eq!(whole::<&[u8]>(&[2, 1]), None);
        assert_eq!(whole::<bool>(&[2]), None);
        assert_eq!(whole::<Option<u8>>(&[2, 0]), None);
        assert_eq!(whole::<f32>(&[1, 2, 3]), None);
        assert_eq!(whole::<heapless::Vec<u8, 2>>(&[3, 0, 0, 0]), None);
    }
}
