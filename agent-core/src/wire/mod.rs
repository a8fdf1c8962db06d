//! Bytes on a radio or a serial line: frames, framing, and checksums.
//!
//! Depends on [`math`](crate::math) only.

#[cfg(feature = "authentic-frames")]
pub mod authentic;
pub mod cobs;
pub(crate) mod codec;
pub mod crc;
pub mod frame;
pub mod secret;
pub(crate) mod sequence;
pub(crate) mod writer;
