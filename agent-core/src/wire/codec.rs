//! Reads what frames, packages and requests are written in: postcard's wire format
//! (<https://postcard.jamesmunns.com/wire-format>), as far as they use it.
//!
//! By hand, and not by serde: what is read here is read on a node, where the generic way takes three
//! times the flash. And of all ways to write an integer only the shortest is taken, so that there is
//! one byte string for one value, on processors of any word length.
//!
//! Cost: some 15 operations a byte of an integer. Invariant: any bytes can be read, without a panic;
//! whether the values are theirs, [`Reader::finish`] says.

/// Takes one value after another from the front of some bytes.
///
/// Values that are not there are read as zeros, so that a description of a message needs no error
/// handling; nothing that was read counts until [`Self::finish`] has said that all was well.
#[derive(Clone, Debug)]
pub(crate) struct Reader<'a> {
    rest: &'a [u8],
    is_damaged: bool,
}

impl<'a> Reader<'a> {
    pub(crate) fn new(bytes: &'a [u8]) -> Self {
        Self { rest: bytes, is_damaged: false }
    }

    /// What has not been read, if everything so far was what was asked for.
    pub(crate) fn finish(self) -> Option<&'a [u8]> {
        (!self.is_damaged).then_some(self.rest)
    }

    /// Lets [`Self::finish`] fail: a value has been read that must not be.
    pub(crate) fn refuse(&mut self) {
        self.is_damaged = true;
    }

    #[inline(never)]
    pub(crate) fn byte(&mut self) -> u8 {
        match self.rest.split_first() {
            Some((&byte, rest)) => {
                self.rest = rest;
                byte
            }
            None => {
                self.refuse();
                0
            }
        }
    }

    /// The next `length` bytes; none if there are not as many.
    #[inline(never)]
    pub(crate) fn bytes(&mut self, length: usize) -> &'a [u8] {
        match self.rest.split_at_checked(length) {
            Some((bytes, rest)) => {
                self.rest = rest;
                bytes
            }
            None => {
                self.refuse();
                &[]
            }
        }
    }

    /// The next `LENGTH` bytes.
    pub(crate) fn array<const LENGTH: usize>(&mut self) -> [u8; LENGTH] {
        // Others are read where there are not as many.
        self.bytes(LENGTH).try_into().unwrap_or([0; LENGTH])
    }

    /// A sequence of bytes with its length before it.
    pub(crate) fn sequence(&mut self) -> &'a [u8] {
        let length = self.u32();
        self.bytes(length as usize)
    }

    /// A sequence of bytes that is UTF-8.
    pub(crate) fn text(&mut self) -> &'a str {
        // As `core::str::from_utf8`, which is made for speed and takes twice the code.
        match self.sequence().utf8_chunks().next() {
            None => "",
            Some(chunk) if chunk.invalid().is_empty() => chunk.valid(),
            Some(_) => {
                self.refuse();
                ""
            }
        }
    }

    /// A yes or no; also whether a value follows that may be missing.
    #[inline(never)]
    pub(crate) fn flag(&mut self) -> bool {
        match self.byte() {
            0 => false,
            1 => true,
            _ => {
                self.refuse();
                false
            }
        }
    }

    /// One of the variants of an enumeration, in their order.
    pub(crate) fn one_of<T: Copy>(&mut self, variants: &[T]) -> Option<T> {
        // Place 128 and those behind it take more than a byte; there are none.
        variants.get(usize::from(self.byte())).copied()
    }

    pub(crate) fn u16(&mut self) -> u16 {
        u16::try_from(self.u32()).unwrap_or_else(|_| {
            self.refuse();
            0
        })
    }

    #[inline(never)]
    pub(crate) fn u32(&mut self) -> u32 {
        u32::try_from(self.u64()).unwrap_or_else(|_| {
            self.refuse();
            0
        })
    }

    /// Seven bits a byte, the lowest first; the highest bit of a byte says that another follows.
    #[inline(never)]
    pub(crate) fn u64(&mut self) -> u64 {
        const MORE: u8 = 1 << 7;
        let more = self.rest.iter().take_while(|&&byte| byte & MORE != 0).count();
        let bytes = self.bytes(more + 1);
        let mut value = 0_u64;
        for &byte in bytes.iter().rev() {
            if value >> (u64::BITS - 7) != 0 {
                self.refuse();
            }
            value = value << 7 | u64::from(byte & !MORE);
        }
        // A last byte without any bit adds nothing: there is a shorter way.
        if more > 0 && bytes.last() == Some(&0) {
            self.refuse();
        }
        value
    }

    pub(crate) fn f32(&mut self) -> f32 {
        f32::from_le_bytes(self.array())
    }
}

/// Appends an integer to `bytes` as [`Reader::u64`] reads it; what does not fit is left out.
pub(crate) fn push_integer<const CAPACITY: usize>(
    bytes: &mut heapless::Vec<u8, CAPACITY>,
    mut value: u64,
) {
    while value >= 1 << 7 {
        let _ = bytes.push(value as u8 | 1 << 7);
        value >>= 7;
    }
    let _ = bytes.push(value as u8);
}

#[cfg(test)]
mod tests {
    extern crate std;

    use std::{string::String, vec};

    use proptest::prelude::*;

    use super::*;

    fn whole<'a, T>(bytes: &'a [u8], read: impl FnOnce(&mut Reader<'a>) -> T) -> Option<T> {
        let mut reader = Reader::new(bytes);
        let value = read(&mut reader);
        matches!(reader.finish(), Some([])).then_some(value)
    }

    proptest! {
        #[test]
        fn integers_are_read_and_written_as_postcard_does(value: u64, shift in 0u32..64) {
            let value = value >> shift;
            let mut buffer = [0; 10];
            let expected = &*postcard::to_slice(&value, &mut buffer).unwrap();
            let mut bytes = heapless::Vec::<u8, 10>::new();
            push_integer(&mut bytes, value);
            prop_assert_eq!(&bytes[..], expected);
            prop_assert_eq!(whole(expected, Reader::u64), Some(value));
            prop_assert_eq!(whole(expected, Reader::u32), u32::try_from(value).ok());
            prop_assert_eq!(whole(expected, Reader::u16), u16::try_from(value).ok());
        }

        /// What is read is what postcard reads, if it is what postcard would write.
        #[test]
        fn only_the_shortest_way_is_taken(bytes in prop::collection::vec(
            prop_oneof![Just(0), Just(0x80), Just(0xff), any::<u8>()], 0..12)) {
            let mut buffer = [0; 10];
            let expected = postcard::from_bytes::<u64>(&bytes).ok().filter(|value| {
                *postcard::to_slice(value, &mut buffer).unwrap() == bytes[..]
            });
            prop_assert_eq!(whole(&bytes, Reader::u64), expected);
        }

        #[test]
        fn what_was_written_by_postcard_is_read(
            numbers in prop::collection::vec(any::<u8>(), 0..200),
            optional: Option<u16>,
            number in -1e9f32..1e9,
        ) {
            let written = postcard::to_slice(&(&numbers[..], optional, number, [7u8; 3]), &mut [0; 300])
                .map(|bytes| bytes.to_vec());
            let read = whole(&written.unwrap(), |reader| {
                let sequence = reader.sequence().to_vec();
                let optional = reader.flag().then(|| reader.u16());
                (sequence, optional, reader.f32(), reader.array())
            });
            prop_assert_eq!(read, Some((numbers, optional, number, [7u8; 3])));
        }
    }

    proptest! {
        #[test]
        fn text_is_what_the_standard_library_takes(
            bytes in prop::collection::vec(prop_oneof![any::<u8>(), 0..0x80u8, 0xc0..=0xf4u8], 0..6),
            text: String,
        ) {
            for bytes in [&bytes[..], text.as_bytes()] {
                let mut written = vec![0; bytes.len() + 10];
                let written = &*postcard::to_slice(bytes, &mut written).unwrap();
                prop_assert_eq!(whole(written, Reader::text), core::str::from_utf8(bytes).ok());
            }
        }
    }

    #[test]
    fn what_is_not_there_is_damage() {
        assert_eq!(whole(&[], Reader::byte), None);
        assert_eq!(whole(&[0x80], Reader::u64), None);
        assert_eq!(whole(&[2, 1], Reader::sequence), None);
        assert_eq!(whole(&[2], Reader::flag), None);
        assert_eq!(whole(&[1, 2, 3], Reader::f32), None);
        assert_eq!(whole(&[1], |reader| reader.one_of(&['a', 'b'])), Some(Some('b')));
        assert_eq!(whole(&[2], |reader| reader.one_of(&['a', 'b'])), Some(None));
    }
}
