//! The checksum of frames, packages, records and messages: CRC-32 (ISO-HDLC, the one of
//! Ethernet).
//!
//! Any change of up to 32 bits in a row is found, and any single bit; 1 of 4 billion other
//! changes is not. Cost: about 14 operations a byte; memory: a table of 64 bytes in flash, since
//! one of a whole kilobyte would save a node no more than some 100 operations a frame.

/// Bytes in a checksum.
pub const CHECKSUM_LENGTH: usize = 4;

/// The polynomial of the algorithm, its lowest power in the highest bit.
const POLYNOMIAL: u32 = 0xedb8_8320;

/// Which four bits take what out of the register.
const TABLE: [u32; 16] = table();

const fn table() -> [u32; 16] {
    let mut table = [0; 16];
    let mut bits = 0;
    while bits < table.len() {
        let mut remainder = bits as u32;
        let mut shift = 0;
        while shift < 4 {
            remainder =
                if remainder & 1 == 0 { remainder >> 1 } else { remainder >> 1 ^ POLYNOMIAL };
            shift += 1;
        }
        table[bits] = remainder;
        bits += 1;
    }
    table
}

/// The checksum of all `parts`, one after another.
#[must_use]
pub fn crc32(parts: &[&[u8]]) -> u32 {
    let mut checksum = Checksum::new();
    parts.iter().for_each(|part| checksum.update(part));
    checksum.finish()
}

/// The checksum of bytes that come bit by bit.
#[derive(Clone)]
pub struct Checksum(u32);

impl Checksum {
    /// That of no byte.
    #[must_use]
    pub fn new() -> Self {
        Self(u32::MAX)
    }

    /// Takes the next bytes.
    #[inline(never)]
    pub fn update(&mut self, bytes: &[u8]) {
        // The index has four bits, so it is always in the table.
        let shifted = |register: u32| register >> 4 ^ TABLE[(register & 0xf) as usize];
        self.0 = bytes
            .iter()
            .fold(self.0, |register, &byte| shifted(shifted(register ^ u32::from(byte))));
    }

    /// The checksum of all bytes so far.
    #[must_use]
    pub fn finish(self) -> u32 {
        !self.0
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
