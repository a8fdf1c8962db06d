//! CRC-32 (ISO-HDLC, as used by Ethernet), from the crate `crc`.

use crc::{CRC_32_ISO_HDLC, Crc, Digest, Table};

/// One table of 1 KiB, in a node's flash. A host has room for 16, which take 16 bytes at a time.
const TABLES: usize = if cfg!(target_pointer_width = "64") { 16 } else { 1 };

static ALGORITHM: Crc<u32, Table<TABLES>> = Crc::<u32, Table<TABLES>>::new(&CRC_32_ISO_HDLC);

/// Computes the checksum of bytes that arrive in pieces.
#[derive(Clone)]
pub struct Checksum(Digest<'static, u32, Table<TABLES>>);

impl Checksum {
    /// Starts with no bytes.
    #[must_use]
    pub fn new() -> Self {
        Self(ALGORITHM.digest())
    }

    /// Appends the next bytes.
    // One copy of the loop, which the optimiser unrolls.
    #[inline(never)]
    pub fn update(&mut self, bytes: &[u8]) {
        self.0.update(bytes);
    }

    /// Returns the checksum of all bytes so far.
    #[must_use]
    pub fn finish(self) -> u32 {
        self.0.finalize()
    }
}

impl Default for Checksum {
    fn default() -> Self {
        Self::new()
    }
}

impl core::fmt::Debug for Checksum {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "Checksum({:08x})", self.clone().finish())
    }
}
