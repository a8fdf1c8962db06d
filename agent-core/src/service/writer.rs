//! Writes messages as postcard does (<https://postcard.jamesmunns.com/wire-format>), straight into
//! the stream.
//!
//! Nothing that a message consists of can fail to be written here, and the compiler sees that: what
//! is left of a message's description is a load and a call for each field, a third of what
//! postcard's own serializer takes on a node, and no path that panics at any optimisation level.

use serde::ser::{
    Impossible, Serialize, SerializeSeq, SerializeStruct, SerializeStructVariant, SerializeTuple,
    Serializer,
};

use crate::wire::cobs::Encoder;

/// Writes one message into the stream.
pub(super) struct Writer<S>(Encoder<S>);

/// Something that no message consists of: a map, or a sequence that does not know its length.
#[derive(Clone, Copy, Debug)]
pub(super) struct Unsupported;

impl<S: FnMut(&[u8])> Writer<S> {
    pub(super) fn new(sink: S) -> Self {
        Self(Encoder::new(sink))
    }

    pub(super) fn finish(self) {
        self.0.finish();
    }

    #[inline(never)]
    fn byte(&mut self, byte: u8) {
        self.0.extend(&[byte]);
    }

    #[inline(never)]
    fn integer(&mut self, mut value: u32) {
        while value >= 1 << 7 {
            self.byte(value as u8 | 1 << 7);
            value >>= 7;
        }
        self.byte(value as u8);
    }

    #[inline(never)]
    fn long_integer(&mut self, mut value: u64) {
        while value > u64::from(u32::MAX) {
            self.byte(value as u8 | 1 << 7);
            value >>= 7;
        }
        self.integer(value as u32);
    }

    /// A sequence is its length, then what it consists of.
    #[inline(never)]
    fn bytes(&mut self, bytes: &[u8]) {
        self.integer(bytes.len() as u32);
        self.0.extend(bytes);
    }

    #[inline(never)]
    fn number(&mut self, number: f32) {
        self.0.extend(&number.to_le_bytes());
    }
}

impl serde::ser::Error for Unsupported {
    fn custom<T: core::fmt::Display>(_: T) -> Self {
        Self
    }
}

impl core::fmt::Display for Unsupported {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("no message consists of this")
    }
}

impl core::error::Error for Unsupported {}

/// What is written as something else is.
macro_rules! written_as {
    ($($method:ident($type:ty) as $other:ident,)*) => {$(
        #[inline(always)]
        fn $method(self, value: $type) -> Result<(), Unsupported> {
            self.$other(value.into());
            Ok(())
        }
    )*};
}

/// What no message consists of.
macro_rules! not_written {
    ($($method:ident($($type:ty),*) -> $output:ty,)*) => {$(
        fn $method(self, $(_: $type),*) -> Result<$output, Unsupported> {
            Err(Unsupported)
        }
    )*};
}

impl<S: FnMut(&[u8])> Serializer for &mut Writer<S> {
    type Ok = ();
    type Error = Unsupported;
    type SerializeSeq = Self;
    type SerializeTuple = Self;
    type SerializeTupleStruct = Impossible<(), Unsupported>;
    type SerializeTupleVariant = Impossible<(), Unsupported>;
    type SerializeMap = Impossible<(), Unsupported>;
    type SerializeStruct = Self;
    type SerializeStructVariant = Self;

    written_as! {
        serialize_bool(bool) as byte,
        serialize_u8(u8) as byte,
        serialize_u16(u16) as integer,
        serialize_u32(u32) as integer,
        serialize_u64(u64) as long_integer,
        serialize_f32(f32) as number,
    }

    not_written! {
        serialize_i8(i8) -> (),
        serialize_i16(i16) -> (),
        serialize_i32(i32) -> (),
        serialize_i64(i64) -> (),
        serialize_f64(f64) -> (),
        serialize_char(char) -> (),
        serialize_str(&str) -> (),
        serialize_unit() -> (),
        serialize_unit_struct(&'static str) -> (),
        serialize_map(Option<usize>) -> Impossible<(), Unsupported>,
        serialize_tuple_struct(&'static str, usize) -> Impossible<(), Unsupported>,
        serialize_tuple_variant(&'static str, u32, &'static str, usize) -> Impossible<(), Unsupported>,
    }

    #[inline(always)]
    fn serialize_bytes(self, bytes: &[u8]) -> Result<(), Unsupported> {
        self.bytes(bytes);
        Ok(())
    }

    #[inline(always)]
    fn serialize_none(self) -> Result<(), Unsupported> {
        self.serialize_bool(false)
    }

    #[inline(always)]
    fn serialize_some<T: Serialize + ?Sized>(self, value: &T) -> Result<(), Unsupported> {
        self.byte(1);
        value.serialize(self)
    }

    #[inline(always)]
    fn serialize_newtype_struct<T: Serialize + ?Sized>(
        self,
        _: &'static str,
        value: &T,
    ) -> Result<(), Unsupported> {
        value.serialize(self)
    }

    #[inline(always)]
    fn serialize_unit_variant(
        self,
        _: &'static str,
        index: u32,
        _: &'static str,
    ) -> Result<(), Unsupported> {
        self.serialize_u32(index)
    }

    #[inline(always)]
    fn serialize_newtype_variant<T: Serialize + ?Sized>(
        self,
        _: &'static str,
        index: u32,
        _: &'static str,
        value: &T,
    ) -> Result<(), Unsupported> {
        self.integer(index);
        value.serialize(self)
    }

    #[inline(always)]
    fn serialize_struct_variant(
        self,
        _: &'static str,
        index: u32,
        _: &'static str,
        _: usize,
    ) -> Result<Self, Unsupported> {
        self.integer(index);
        Ok(self)
    }

    #[inline(always)]
    fn serialize_struct(self, _: &'static str, _: usize) -> Result<Self, Unsupported> {
        Ok(self)
    }

    #[inline(always)]
    fn serialize_seq(self, length: Option<usize>) -> Result<Self, Unsupported> {
        self.integer(length.ok_or(Unsupported)? as u32);
        Ok(self)
    }

    #[inline(always)]
    fn serialize_tuple(self, _: usize) -> Result<Self, Unsupported> {
        Ok(self)
    }

    fn collect_str<T: core::fmt::Display + ?Sized>(self, _: &T) -> Result<(), Unsupported> {
        Err(Unsupported)
    }

    fn is_human_readable(&self) -> bool {
        false
    }
}

/// A part is written like a whole.
macro_rules! written_one_by_one {
    ($($trait:ident::$method:ident($($key:ty)?),)*) => {$(
        impl<S: FnMut(&[u8])> $trait for &mut Writer<S> {
            type Ok = ();
            type Error = Unsupported;

            #[inline(always)]
            fn $method<T: Serialize + ?Sized>(
                &mut self,
                $(_: $key,)?
                value: &T,
            ) -> Result<(), Unsupported> {
                value.serialize(&mut **self)
            }

            #[inline(always)]
            fn end(self) -> Result<(), Unsupported> {
                Ok(())
            }
        }
    )*};
}

written_one_by_one! {
    SerializeSeq::serialize_element(),
    SerializeTuple::serialize_element(),
    SerializeStruct::serialize_field(&'static str),
    SerializeStructVariant::serialize_field(&'static str),
}
