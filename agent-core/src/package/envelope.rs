//! Header, checksum and signature around a package's body.
//!
//! | bytes | contents |
//! | --- | --- |
//! | 0..3 | [`MAGIC`] |
//! | 3 | [`FORMAT_VERSION`] |
//! | 4..8 | length of the body, little-endian |
//! | 8..12 | CRC-32 (ISO-HDLC) of bytes 0..8 and the body, little-endian |
//! | 12.. | the body |
//! | then, if signed | Ed25519 signature of all bytes before it, 64 bytes, and its CRC-32 |
//!
//! Signing does not change the bytes before the signature. The signature has its own checksum, so
//! that a node without a public key also refuses a damaged one.
//!
//! Invariant: of two byte strings that differ in one bit, at most one is an envelope.

use super::{FORMAT_VERSION, PackageError};
use crate::package::signature::SIGNATURE_LENGTH;
use crate::wire::crc::{CHECKSUM_LENGTH, crc32};

/// Magic number of every package: observer weight package.
pub const MAGIC: [u8; 3] = *b"OWP";
/// Length of the header. \[bytes\]
pub const HEADER_LENGTH: usize = 12;
/// Length of a signature with its checksum. \[bytes\]
pub const SIGNATURE_BLOCK_LENGTH: usize = SIGNATURE_LENGTH + CHECKSUM_LENGTH;

/// Length of the part of the header that its checksum covers.
const COVERED_LENGTH: usize = HEADER_LENGTH - CHECKSUM_LENGTH;

/// The undamaged parts of a package; the body has not been decoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Envelope<'a> {
    /// The body.
    pub body: &'a [u8],
    /// The bytes that are signed: header and body.
    pub signed_part: &'a [u8],
    /// The signature, if any. It has not been verified yet.
    pub signature: Option<&'a [u8; SIGNATURE_LENGTH]>,
}

impl<'a> Envelope<'a> {
    /// Splits `bytes`, which must be exactly one package.
    ///
    /// # Errors
    /// [`PackageError::Length`], [`PackageError::Magic`], [`PackageError::FormatVersion`],
    /// [`PackageError::Checksum`] or [`PackageError::SignatureChecksum`].
    pub fn open(bytes: &'a [u8]) -> Result<Self, PackageError> {
        Self::split(bytes, true)
    }

    /// Splits a package that was opened before and has not changed since, as a checksum over all of
    /// it has shown; its own checksums are not computed again.
    ///
    /// # Errors
    /// [`PackageError::Length`], [`PackageError::Magic`] or [`PackageError::FormatVersion`].
    pub fn open_unchanged(bytes: &'a [u8]) -> Result<Self, PackageError> {
        Self::split(bytes, false)
    }

    #[inline(never)]
    fn split(bytes: &'a [u8], is_in_doubt: bool) -> Result<Self, PackageError> {
        let matches = |parts: &[&[u8]], checksum: [u8; CHECKSUM_LENGTH]| {
            !is_in_doubt || crc32(parts) == u32::from_le_bytes(checksum)
        };
        let too_short = PackageError::Length { expected: HEADER_LENGTH, found: bytes.len() };
        let (covered, rest) = bytes.split_first_chunk::<COVERED_LENGTH>().ok_or(too_short)?;
        let (&checksum, rest) = rest.split_first_chunk::<CHECKSUM_LENGTH>().ok_or(too_short)?;
        let &[m0, m1, m2, version, l0, l1, l2, l3] = covered;
        if [m0, m1, m2] != MAGIC {
            return Err(PackageError::Magic);
        }
        if version != FORMAT_VERSION {
            return Err(PackageError::FormatVersion { found: version });
        }
        let length = u32::from_le_bytes([l0, l1, l2, l3]) as usize;
        let wrong_length = PackageError::Length {
            expected: length.saturating_add(HEADER_LENGTH),
            found: bytes.len(),
        };
        let (body, block) = rest.split_at_checked(length).ok_or(wrong_length)?;
        if !matches(&[covered, body], checksum) {
            return Err(PackageError::Checksum);
        }
        let signed_part = bytes.get(..HEADER_LENGTH + length).ok_or(wrong_length)?;
        let signature = match block {
            [] => None,
            block => {
                let (signature, checksum) =
                    block.split_first_chunk::<SIGNATURE_LENGTH>().ok_or(wrong_length)?;
                if !matches(&[signature], checksum.try_into().map_err(|_| wrong_length)?) {
                    return Err(PackageError::SignatureChecksum);
                }
                Some(signature)
            }
        };
        Ok(Self { body, signed_part, signature })
    }
}

impl Envelope<'_> {
    /// Returns the length of the package at the start of `bytes`, whatever follows it, for a flash
    /// slot with unknown contents. Includes the signature if there is an undamaged one.
    #[must_use]
    pub fn length_in(bytes: &[u8]) -> Option<usize> {
        let (_, rest) = bytes.split_first_chunk::<{ MAGIC.len() + 1 }>()?;
        let (&length, _) = rest.split_first_chunk::<4>()?;
        let unsigned = HEADER_LENGTH.checked_add(u32::from_le_bytes(length) as usize)?;
        let signed = unsigned.checked_add(SIGNATURE_BLOCK_LENGTH)?;
        [signed, unsigned]
            .into_iter()
            .find(|&length| bytes.get(..length).is_some_and(|bytes| Envelope::open(bytes).is_ok()))
    }
}

/// Returns the header of a package with this body.
pub(super) fn header(body: &[u8]) -> Option<[u8; HEADER_LENGTH]> {
    let length = u32::try_from(body.len()).ok()?.to_le_bytes();
    let mut header = [0; HEADER_LENGTH];
    let (covered, checksum) = header.split_at_mut_checked(COVERED_LENGTH)?;
    let parts = MAGIC.iter().chain(&[FORMAT_VERSION]).chain(&length);
    covered.iter_mut().zip(parts).for_each(|(place, byte)| *place = *byte);
    let sum = crc32(&[covered, body]).to_le_bytes();
    checksum.iter_mut().zip(&sum).for_each(|(place, byte)| *place = *byte);
    Some(header)
}

/// Returns the bytes that follow the body of a signed package.
#[must_use]
pub fn signature_block(signature: &[u8; SIGNATURE_LENGTH]) -> [u8; SIGNATURE_BLOCK_LENGTH] {
    let mut block = [0; SIGNATURE_BLOCK_LENGTH];
    let checksum = crc32(&[signature]).to_le_bytes();
    let parts = signature.iter().chain(&checksum);
    block.iter_mut().zip(parts).for_each(|(place, byte)| *place = *byte);
    block
}
