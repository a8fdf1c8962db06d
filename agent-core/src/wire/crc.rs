//! The checksum of frames, packages, records and messages: CRC-32 (ISO-HDLC, as used by Ethernet),
//! from the crate `crc`.
//!
//! It detects every change of a single bit and every burst of up to 32 bits; it misses 1 in 4
//! billion other changes. Cost and memory: docs/decisions/0011-small-firmware.md.

pub(crate) use integrity::Checksum;

/// Length of a checksum in bytes.
pub const CHECKSUM_LENGTH: usize = 4;

/// Returns the checksum of the concatenated `parts`.
#[must_use]
pub fn crc32(parts: &[&[u8]]) -> u32 {
    let mut checksum = Checksum::new();
    parts.iter().for_each(|part| checksum.update(part));
    checksum.finish()
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
