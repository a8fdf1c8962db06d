//! Header, checksum and signature around a package's body.
//!
//! | bytes | what |
//! | --- | --- |
//! | 0..3 | [`MAGIC`] |
//! | 3 | [`FORMAT_VERSION`] |
//! | 4..8 | length of the body, little-endian |
//! | 8..12 | CRC-32 (ISO-HDLC) of bytes 0..8 and the body, little-endian |
//! | 12.. | the body |
//! | then, if signed | Ed25519 signature of all bytes before it, 64 bytes, and its CRC-32 |
//!
//! Signing changes no byte that was there before. The signature has a checksum of its own, so
//! that a node without a public key refuses a damaged one, too.
//!
//! Invariant: of two byte strings that differ in one bit at most one is an envelope.

use super::{FORMAT_VERSION, PackageError};
use crate::package::signature::SIGNATURE_LENGTH;
use crate::wire::crc::{CHECKSUM_LENGTH, crc32};

/// What every package starts with: observer weight package.
pub const MAGIC: [u8; 3] = *b"OWP";
/// Bytes before the body. \[bytes\]
pub const HEADER_LENGTH: usize = 12;
/// Signature and its checksum. \[bytes\]
pub const SIGNATURE_BLOCK_LENGTH: usize = SIGNATURE_LENGTH + CHECKSUM_LENGTH;

/// The part of the header that its checksum covers.
const COVERED_LENGTH: usize = HEADER_LENGTH - CHECKSUM_LENGTH;

/// A package's bytes, taken apart and found undamaged; the body has not been looked into.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Envelope<'a> {
    /// The body.
    pub body: &'a [u8],
    /// What a signature signs: header and body.
    pub signed_part: &'a [u8],
    /// The signature, if there is one. Nobody has verified it yet.
    pub signature: Option<&'a [u8; SIGNATURE_LENGTH]>,
}

impl<'a> Envelope<'a> {
    /// Takes `bytes` apart, which must be a package and nothing but it.
    ///
    /// # Errors
    /// [`PackageError::Length`], [`PackageError::Magic`], [`PackageError::FormatVersion`],
    /// [`PackageError::Checksum`] or [`PackageError::SignatureChecksum`].
    pub fn open(bytes: &'a [u8]) -> Result<Self, PackageError> {
        Self::split(bytes, true)
    }

    /// Takes apart what was opened before and has not changed since, as a checksum over all of it
    /// has shown: those in it are not computed again.
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
    /// The length of the package that `bytes` begin with, whatever follows it: for a slot of
    /// flash of which nobody knows what was written to it. With a signature if there is an
    /// undamaged one.
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

/// The header of a package with this body.
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

/// What follows the body of a signed package.
#[must_use]
pub fn signature_block(signature: &[u8; SIGNATURE_LENGTH]) -> [u8; SIGNATURE_BLOCK_LENGTH] {
    let mut block = [0; SIGNATURE_BLOCK_LENGTH];
    let checksum = crc32(&[signature]).to_le_bytes();
    let parts = signature.iter().chain(&checksum);
    block.iter_mut().zip(parts).for_each(|(place, byte)| *place = *byte);
    block
}
