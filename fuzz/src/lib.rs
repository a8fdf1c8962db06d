//! Code shared by the fuzz targets: aligned bytes, corrected headers and checksums, and real
//! packages as seeds.
//!
//! A fuzzer cannot guess a checksum, so every target tries its bytes twice: unchanged, and with the
//! checksums corrected ([`correct_package`], [`correct_frame`]), which reaches the code behind them.

mod aligned;
mod frames;
mod sample;

pub use aligned::Aligned;
pub use frames::Event;
pub use sample::SamplePackage;

use agent_core::package::{FORMAT_VERSION, HEADER_LENGTH, MAGIC, SIGNATURE_BLOCK_LENGTH};
use agent_core::wire::crc::crc32;

const CHECKSUM_LENGTH: usize = 4;

/// Overwrites the header of a package with the one that matches its body and, if the old header's
/// length leaves exactly a signature at the end, the signature's checksum. Fewer bytes than a
/// header are left unchanged.
pub fn correct_package(bytes: &mut [u8]) {
    let Some((header, rest)) = bytes.split_first_chunk_mut::<HEADER_LENGTH>() else { return };
    let [.., l0, l1, l2, l3, _, _, _, _] = *header;
    let stated = u32::from_le_bytes([l0, l1, l2, l3]) as usize;
    let is_signed = stated.checked_add(SIGNATURE_BLOCK_LENGTH) == Some(rest.len());
    let (body, block) = rest.split_at_mut(if is_signed { stated } else { rest.len() });
    let (covered, checksum) = header.split_at_mut(HEADER_LENGTH - CHECKSUM_LENGTH);
    covered[..3].copy_from_slice(&MAGIC);
    covered[3] = FORMAT_VERSION;
    covered[4..].copy_from_slice(&(body.len() as u32).to_le_bytes());
    checksum.copy_from_slice(&crc32(&[covered, body]).to_le_bytes());
    correct_frame(block);
}

/// Overwrites the last four bytes with the checksum of the preceding ones.
pub fn correct_frame(bytes: &mut [u8]) {
    if let Some((body, checksum)) = bytes.split_last_chunk_mut::<CHECKSUM_LENGTH>() {
        *checksum = crc32(&[body]).to_le_bytes();
    }
}
