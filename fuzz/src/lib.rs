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

use agent_core::package::{
    CHECKED_FIRST, HEADER_LENGTH, HEADER2_LENGTH, MAGIC, SIGNATURE_BLOCK_LENGTH, digest,
};
use agent_core::wire::crc::crc32;

const CHECKSUM_LENGTH: usize = 4;

/// Overwrites magic, length, checksums and digest of a package with those that match its content. Its
/// format is what its fourth byte says, 1 for any but 2. Fewer bytes than a header are left unchanged.
pub fn correct_package(bytes: &mut [u8]) {
    match bytes.get(MAGIC.len()) {
        Some(2) => correct_format2(bytes),
        _ => correct_format1(bytes),
    }
}

/// Like [`correct_package`]; the signature's checksum is corrected if there is a signature.
fn correct_format2(bytes: &mut [u8]) {
    let length = bytes.len() as u32;
    let Some((start, sections)) = bytes.split_first_chunk_mut::<CHECKED_FIRST>() else { return };
    let (header, block) = start.split_at_mut(HEADER2_LENGTH);
    header[..3].copy_from_slice(&MAGIC);
    header[16..20].copy_from_slice(&length.to_le_bytes());
    header[48..52].copy_from_slice(&crc32(&[sections]).to_le_bytes());
    header[52..84].copy_from_slice(&digest(sections));
    let (covered, checksum) = header.split_at_mut(HEADER2_LENGTH - CHECKSUM_LENGTH);
    checksum.copy_from_slice(&crc32(&[covered]).to_be_bytes());
    if block.iter().any(|&byte| byte != 0) {
        correct_frame(block);
    }
}

/// Like [`correct_package`]; the signature's checksum is corrected if the old header's length leaves
/// exactly a signature at the end.
fn correct_format1(bytes: &mut [u8]) {
    let Some((header, rest)) = bytes.split_first_chunk_mut::<HEADER_LENGTH>() else { return };
    let [.., l0, l1, l2, l3, _, _, _, _] = *header;
    let stated = u32::from_le_bytes([l0, l1, l2, l3]) as usize;
    let is_signed = stated.checked_add(SIGNATURE_BLOCK_LENGTH) == Some(rest.len());
    let (body, block) = rest.split_at_mut(if is_signed { stated } else { rest.len() });
    let (covered, checksum) = header.split_at_mut(HEADER_LENGTH - CHECKSUM_LENGTH);
    covered[..3].copy_from_slice(&MAGIC);
    covered[3] = 1;
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
