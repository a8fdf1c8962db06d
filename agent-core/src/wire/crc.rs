//! The checksum of frames, packages, records and messages: CRC-32 (ISO-HDLC, as used by Ethernet),
//! from the crate `crc`.
//!
//! It detects every change of a single bit and every burst of up to 32 bits; it misses 1 in 4
//! billion other changes. Cost and memory: docs/decisions/0011-small-firmware.md.

use ::crc::{CRC_32_ISO_HDLC, Crc, Digest, Table};

/// Length of a checksum in bytes.
pub const CHECKSUM_LENGTH: usize = 4;

/// One table of 1 KiB, in flash.
static ALGORITHM: Crc<u32, Table<1>> = Crc::<u32, Table<1>>::new(&CRC_32_ISO_HDLC);

/// Returns the checksum of the concatenated `parts`.
// One copy of the loop, which the optimiser unrolls.
#[inline(never)]
#[must_use]
pub fn crc32(parts: &[&[u8]]) -> u32 {
    let mut checksum = Checksum::new();
    parts.iter().for_each(|part| checksum.update(part));
    checksum.finish()
}

/// Computes the checksum of bytes that arrive in pieces.
#[derive(Clone)]
pub(crate) struct Checksum(Digest<'static, u32, Table<1>>);

impl Checksum {
    /// Starts with no bytes.
    pub(crate) fn new() -> Self {
        Self(ALGORITHM.digest())
    }

    /// Appends the next bytes.
    #[inline]
    pub(crate) fn update(&mut self, bytes: &[u8]) {
        self.0.update(bytes);
    }

    /// Returns the checksum of all bytes so far.
    pub(crate) fn finish(self) -> u32 {
        self.0.finalize()
    }
}

impl core::fmt::Debug for Checksum {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "Checksum({:08x})", self.clone().finish())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn has_the_check_value_of_the_catalogue() {
        // The catalogue of CRC algorithms gives this for the nine digits.
        assert_eq!(crc32(&[b"123456789"]), 0xcbf4_3926);
        assert_eq!(crc32(&[b"1234", b"", b"56789"]), 0xcbf4_3926);
    }
}
