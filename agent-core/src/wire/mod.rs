//! Bytes on a radio or a serial line: frames, framing, and checksums.
//!
//! Depends on [`math`](crate::math) only.

#[cfg(feature = "field")]
pub mod announced;
#[cfg(feature = "authentic-frames")]
pub mod authentic;
pub mod cobs;
pub(crate) mod codec;
pub mod crc;
pub mod frame;
pub mod secret;
pub(crate) mod sequence;
pub mod words;
pub(crate) mod writer;

/// Length of the longest frame of any version, for buffers. \[byte\]
#[cfg(feature = "authentic-frames")]
pub const LENGTH_MAX: usize = authentic::LENGTH_MAX;
/// Length of the longest frame of any version, for buffers. \[byte\]
#[cfg(not(feature = "authentic-frames"))]
pub const LENGTH_MAX: usize = frame::FRAME_LENGTH_MAX;
