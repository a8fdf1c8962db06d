//! Writes values in postcard's format, as postcard itself does, in less flash and without a path that
//! panics when compiled for size.
//!
//! postcard's serialiser is compiled once for each type and destination, and slices the varints that
//! it writes. This one is compiled once for each type: where the bytes go is decided at run time.
//! The types that node and host exchange need no characters, maps or 128-bit integers, so those are
//! refused.
//!
//! Cost: one indirect call per field. Invariant: what is written is what postcard would write, which
//! a test of [`super::codec`] compares.

use postcard::Error;
use serde::{Serialize, Serializer, ser};

/// Passes the encoding of `value` to `sink` piece by piece.
///
/// # Errors
/// The value has a sequence of unknown length, or a type that no message has.
#[inline(never)]
pub(crate) fn write(value: &impl Serialize, sink: &mut dyn FnMut(&[u8])) -> Result<(), Error> {
    value.serialize(&mut Writer { sink: Some(sink), length: 0 })
}

/// Returns the length of the encoding of `value`; `None` as for [`write`]. \[byte\]
pub(crate) fn length(value: &impl Serialize) -> Option<usize> {
    let mut writer = Writer { sink: None, length: 0 };
    value.serialize(&mut writer).ok()?;
    Some(writer.length)
}

/// Appends the encoding of `value` to `bytes`; `None` if there is no room, or as for [`write`].
pub(crate) fn append<const CAPACITY: usize>(
    value: &impl Serialize,
    bytes: &mut heapless::Vec<u8, CAPACITY>,
) -> Option<()> {
    let mut fits = true;
    write(value, &mut |piece| fits &= bytes.extend_from_slice(piece).is_ok()).ok()?;
    fits.then_some(())
}

/// Length of the longest varint, that of a `u64`. \[byte\]
const VARINT: usize = 10;

/// Where bytes go.
type Sink<'s> = &'s mut dyn FnMut(&[u8]);

struct Writer<'s> {
    /// `None` to count bytes only.
    sink: Option<Sink<'s>>,
    /// Bytes so far, if they are counted only.
    length: usize,
}

impl Writer<'_> {
    fn extend(&mut self, bytes: &[u8]) {
        match &mut self.sink {
            Some(sink) => sink(bytes),
            None => self.length += bytes.len(),
        }
    }

    #[inline(never)]
    fn varint(&mut self, mut value: u64) {
        if self.sink.is_none() {
            // Seven bits a byte, and one byte for zero.
            let bits = u64::BITS - (value | 1).leading_zeros();
            self.length += bits.div_ceil(7) as usize;
            return;
        }
        let mut bytes = [0; VARINT];
        let mut length = 0;
        for byte in &mut bytes {
            *byte = value as u8 & 0x7f;
            length += 1;
            value >>= 7;
            if value == 0 {
                break;
            }
            *byte |= 0x80;
        }
        self.extend(bytes.get(..length).unwrap_or_default());
    }

    /// Small magnitudes of either sign give short varints.
    fn zigzag(&mut self, value: i64) {
        self.varint((value << 1 ^ value >> 63) as u64);
    }

    fn counted(&mut self, length: Option<usize>) -> Result<&mut Self, Error> {
        self.varint(length.ok_or(Error::SerializeSeqLengthUnknown)? as u64);
        Ok(self)
    }

    fn variant(&mut self, index: u32) -> &mut Self {
        self.varint(index.into());
        self
    }
}

/// Methods that write an integer.
macro_rules! integers {
    ($($name:ident($type:ty) => $write:ident),* $(,)?) => {
        $(fn $name(self, value: $type) -> Result<(), Error> {
            self.$write(value.into());
            Ok(())
        })*
    };
}

impl Serializer for &mut Writer<'_> {
    type Ok = ();
    type Error = Error;
    type SerializeSeq = Self;
    type SerializeTuple = Self;
    type SerializeTupleStruct = Self;
    type SerializeTupleVariant = Self;
    type SerializeMap = ser::Impossible<(), Error>;
    type SerializeStruct = Self;
    type SerializeStructVariant = Self;

    integers!(
        serialize_u16(u16) => varint, serialize_u32(u32) => varint, serialize_u64(u64) => varint,
        serialize_i16(i16) => zigzag, serialize_i32(i32) => zigzag, serialize_i64(i64) => zigzag,
    );

    fn serialize_u8(self, value: u8) -> Result<(), Error> {
        self.extend(&[value]);
        Ok(())
    }

    fn serialize_i8(self, value: i8) -> Result<(), Error> {
        self.serialize_u8(value as u8)
    }

    fn serialize_bool(self, value: bool) -> Result<(), Error> {
        self.serialize_u8(value.into())
    }

    fn serialize_f32(self, value: f32) -> Result<(), Error> {
        self.extend(&value.to_le_bytes());
        Ok(())
    }

    fn serialize_f64(self, value: f64) -> Result<(), Error> {
        self.extend(&value.to_le_bytes());
        Ok(())
    }

    fn serialize_char(self, _: char) -> Result<(), Error> {
        Err(Error::WontImplement)
    }

    fn serialize_str(self, text: &str) -> Result<(), Error> {
        self.serialize_bytes(text.as_bytes())
    }

    fn serialize_bytes(self, bytes: &[u8]) -> Result<(), Error> {
        self.varint(bytes.len() as u64);
        self.extend(bytes);
        Ok(())
    }

    fn serialize_none(self) -> Result<(), Error> {
        self.serialize_u8(0)
    }

    fn serialize_some<T: Serialize + ?Sized>(self, value: &T) -> Result<(), Error> {
        self.extend(&[1]);
        value.serialize(self)
    }

    fn serialize_unit(self) -> Result<(), Error> {
        Ok(())
    }

    fn serialize_unit_struct(self, _: &'static str) -> Result<(), Error> {
        Ok(())
    }

    fn serialize_unit_variant(
        self,
        _: &'static str,
        index: u32,
        _: &'static str,
    ) -> Result<(), Error> {
        self.variant(index);
        Ok(())
    }

    fn serialize_newtype_struct<T: Serialize + ?Sized>(
        self,
        _: &'static str,
        value: &T,
    ) -> Result<(), Error> {
        value.serialize(self)
    }

    fn serialize_newtype_variant<T: Serialize + ?Sized>(
        self,
        _: &'static str,
        index: u32,
        _: &'static str,
        value: &T,
    ) -> Result<(), Error> {
        value.serialize(self.variant(index))
    }

    fn serialize_seq(self, length: Option<usize>) -> Result<Self, Error> {
        self.counted(length)
    }

    fn serialize_tuple(self, _: usize) -> Result<Self, Error> {
        Ok(self)
    }

    fn serialize_tuple_struct(self, _: &'static str, _: usize) -> Result<Self, Error> {
        Ok(self)
    }

    fn serialize_tuple_variant(
        self,
        _: &'static str,
        index: u32,
        _: &'static str,
        _: usize,
    ) -> Result<Self, Error> {
        Ok(self.variant(index))
    }

    fn serialize_map(self, _: Option<usize>) -> Result<Self::SerializeMap, Error> {
        Err(Error::WontImplement)
    }

    fn serialize_struct(self, _: &'static str, _: usize) -> Result<Self, Error> {
        Ok(self)
    }

    fn serialize_struct_variant(
        self,
        _: &'static str,
        index: u32,
        _: &'static str,
        _: usize,
    ) -> Result<Self, Error> {
        Ok(self.variant(index))
    }

    fn collect_str<T: core::fmt::Display + ?Sized>(self, _: &T) -> Result<(), Error> {
        Err(Error::WontImplement)
    }

    fn is_human_readable(&self) -> bool {
        false
    }
}

/// The parts of a compound value follow one another, without anything between them or after them.
macro_rules! compound {
    ($($part:ident::$method:ident($($key:ty)?)),* $(,)?) => {
        $(impl ser::$part for &mut Writer<'_> {
            type Ok = ();
            type Error = Error;

            fn $method<T: Serialize + ?Sized>(&mut self, $(_: $key,)? value: &T) -> Result<(), Error> {
                value.serialize(&mut **self)
            }

            fn end(self) -> Result<(), Error> {
                Ok(())
            }
        })*
    };
}

compound!(
    SerializeSeq::serialize_element(),
    SerializeTuple::serialize_element(),
    SerializeTupleStruct::serialize_field(),
    SerializeTupleVariant::serialize_field(),
    SerializeStruct::serialize_field(&'static str),
    SerializeStructVariant::serialize_field(&'static str),
);
