//! The one checksum of this crate: CRC-32 as in Ethernet and zip (ISO-HDLC), for frames and for
//! everything in flash.
//!
//! Cost: one table look-up a byte. Memory: a table of 1 KiB in flash, once, whoever uses it.

use crc::{CRC_32_ISO_HDLC, Crc, Table};

/// Bytes of an encoded checksum.
pub const CHECKSUM_LENGTH: usize = 4;

// A static and not a constant: a constant would be a table at every place that names it.
static CHECKSUM: Crc<u32, Table<1>> = Crc::<u32, Table<1>>::new(&CRC_32_ISO_HDLC);

/// CRC-32 (ISO-HDLC) of `parts`, one after the other.
#[must_use]
pub fn crc32(parts: &[&[u8]]) -> u32 {
    let mut digest = CHECKSUM.digest();
    for part in parts {
        digest.update(part);
    }
    digest.finalize()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn is_the_algorithm_of_the_catalogue_however_the_bytes_are_cut() {
        // The check value that the catalogue of CRC algorithms gives for this one.
        assert_eq!(crc32(&[b"123456789"]), 0xcbf4_3926);
        assert_eq!(crc32(&[b"1234", b"", b"56789"]), 0xcbf4_3926);
    }
}
