//! Header, checksums and signature around the content of a package, in both formats.
//!
//! Format 1:
//!
//! | bytes | contents |
//! | --- | --- |
//! | 0..4 | [`MAGIC`], 1 |
//! | 4..8 | length of the body, little-endian |
//! | 8..12 | CRC-32 (ISO-HDLC) of bytes 0..8 and the body, little-endian |
//! | 12.. | the body |
//! | then, if signed | Ed25519 signature of all bytes before it, 64 bytes, and its CRC-32 |
//!
//! Format 2: a [`Header`] of 128 bytes, which is what gets signed, the signature block, which is zero
//! if the package is not signed, and the sections.
//!
//! Signing changes no byte outside the signature block. The signature has its own checksum, so that
//! even a node without a public key refuses a package whose signature is damaged.
//!
//! Invariant: of two byte strings that differ in one bit, at most one is an envelope.

use super::header::{DIGEST_LENGTH, HEADER2_LENGTH, Header, digest_in};
use super::signature::{SIGNATURE_BLOCK_LENGTH, SIGNATURE_LENGTH};
use super::{Format, MAGIC, PackageError};
use crate::wire::crc::{CHECKSUM_LENGTH, crc32};

/// Length of the header of format 1. \[bytes\]
pub const HEADER_LENGTH: usize = 12;

/// Length of the part of the header of format 1 that its checksum covers.
const COVERED_LENGTH: usize = HEADER_LENGTH - CHECKSUM_LENGTH;

/// The undamaged parts of a package; the body has not been decoded.
#[derive(Clone, Debug, PartialEq)]
pub struct Envelope<'a> {
    /// The body of a package of format 1, the sections of one of format 2.
    pub body: &'a [u8],
    /// The bytes that are signed: header and body in format 1, the header in format 2.
    pub signed_part: &'a [u8],
    /// The signature, if any. It has not been verified yet.
    pub signature: Option<&'a [u8; SIGNATURE_LENGTH]>,
    /// The header of a package of format 2.
    pub header: Option<Header>,
    /// The digest of the body in the header of format 2. It has not been compared yet.
    pub(super) digest: Option<&'a [u8; DIGEST_LENGTH]>,
}

impl<'a> Envelope<'a> {
    /// Splits `bytes`, which must be exactly one package.
    ///
    /// # Errors
    /// [`PackageError::Length`], [`PackageError::Magic`], [`PackageError::FormatVersion`],
    /// [`PackageError::Checksum`] or [`PackageError::SignatureChecksum`]; in format 2 also the
    /// errors of [`Header::decode`].
    pub fn open(bytes: &'a [u8]) -> Result<Self, PackageError> {
        Self::split(bytes, true)
    }

    /// Splits a package that was opened before and has not changed since, as a checksum over all of
    /// it has shown; its own checksums are not computed again.
    ///
    /// # Errors
    /// Same as [`Self::open`], except for checksums.
    pub fn open_unchanged(bytes: &'a [u8]) -> Result<Self, PackageError> {
        Self::split(bytes, false)
    }

    #[inline(never)]
    fn split(bytes: &'a [u8], is_in_doubt: bool) -> Result<Self, PackageError> {
        match Format::of(bytes)? {
            Format::One => Self::split_format1(bytes, is_in_doubt),
            Format::Two => Self::split_format2(bytes, is_in_doubt),
        }
    }

    fn split_format1(bytes: &'a [u8], is_in_doubt: bool) -> Result<Self, PackageError> {
        let too_short = PackageError::Length { expected: HEADER_LENGTH, found: bytes.len() };
        let (covered, rest) = bytes.split_first_chunk::<COVERED_LENGTH>().ok_or(too_short)?;
        let (&checksum, rest) = rest.split_first_chunk::<CHECKSUM_LENGTH>().ok_or(too_short)?;
        let &[_, _, _, _, l0, l1, l2, l3] = covered;
        let length = u32::from_le_bytes([l0, l1, l2, l3]) as usize;
        let wrong_length = PackageError::Length {
            expected: length.saturating_add(HEADER_LENGTH),
            found: bytes.len(),
        };
        let (body, block) = rest.split_at_checked(length).ok_or(wrong_length)?;
        if is_in_doubt && crc32(&[covered, body]) != u32::from_le_bytes(checksum) {
            return Err(PackageError::Checksum);
        }
        let signed_part = bytes.get(..HEADER_LENGTH + length).ok_or(wrong_length)?;
        let signature = match block {
            [] => None,
            block => {
                let block: &[u8; SIGNATURE_BLOCK_LENGTH] =
                    block.try_into().map_err(|_| wrong_length)?;
                Some(signature_in(block, is_in_doubt)?)
            }
        };
        Ok(Self { body, signed_part, signature, header: None, digest: None })
    }

    fn split_format2(bytes: &'a [u8], is_in_doubt: bool) -> Result<Self, PackageError> {
        let (start, body) = Self::split_start(bytes, is_in_doubt)?;
        let header = start.header.as_ref().ok_or(PackageError::Malformed)?;
        let (expected, found) = (header.length as usize, bytes.len());
        if expected != found {
            return Err(PackageError::Length { expected, found });
        }
        if is_in_doubt && crc32(&[body]) != header.checksum {
            return Err(PackageError::Checksum);
        }
        Ok(Self { body, ..start })
    }

    /// Splits header and signature block from the bytes that follow them, which need not be there.
    /// The envelope that is returned has an empty body.
    pub(super) fn split_start(
        bytes: &'a [u8],
        is_in_doubt: bool,
    ) -> Result<(Self, &'a [u8]), PackageError> {
        let expected = HEADER2_LENGTH + SIGNATURE_BLOCK_LENGTH;
        let too_short = PackageError::Length { expected, found: bytes.len() };
        let (signed_part, rest) = bytes.split_first_chunk().ok_or(too_short)?;
        let (block, rest) = rest.split_first_chunk().ok_or(too_short)?;
        let header = Header::parse(signed_part, is_in_doubt)?;
        let is_signed = block.iter().any(|&byte| byte != 0);
        let signature = if is_signed { Some(signature_in(block, is_in_doubt)?) } else { None };
        let (header, digest) = (Some(header), digest_in(signed_part));
        Ok((Self { body: &[], signed_part, signature, header, digest }, rest))
    }
}

/// Returns the signature in its block.
fn signature_in(
    block: &[u8; SIGNATURE_BLOCK_LENGTH],
    is_in_doubt: bool,
) -> Result<&[u8; SIGNATURE_LENGTH], PackageError> {
    let damaged = PackageError::SignatureChecksum;
    let (signature, checksum) = block.split_first_chunk::<SIGNATURE_LENGTH>().ok_or(damaged)?;
    let checksum = checksum.first_chunk::<CHECKSUM_LENGTH>().ok_or(damaged)?;
    if is_in_doubt && crc32(&[signature]) != u32::from_le_bytes(*checksum) {
        return Err(damaged);
    }
    Ok(signature)
}

impl Format {
    /// Returns the format of the package that starts with `bytes`, of which it needs four.
    ///
    /// # Errors
    /// [`PackageError::Length`], [`PackageError::Magic`] or [`PackageError::FormatVersion`].
    pub fn of(bytes: &[u8]) -> Result<Self, PackageError> {
        let too_short = PackageError::Length { expected: MAGIC.len() + 1, found: bytes.len() };
        let &[m0, m1, m2, number] = bytes.first_chunk().ok_or(too_short)?;
        if [m0, m1, m2] != MAGIC {
            return Err(PackageError::Magic);
        }
        match number {
            1 => Ok(Self::One),
            2 => Ok(Self::Two),
            found => Err(PackageError::FormatVersion { found }),
        }
    }
}

impl Envelope<'_> {
    /// Returns the length of the package at the start of `bytes`, whatever follows it, for a flash
    /// slot with unknown contents. Includes the signature if there is an undamaged one.
    #[must_use]
    pub fn length_in(bytes: &[u8]) -> Option<usize> {
        let is_whole = |&length: &usize| {
            bytes.get(..length).is_some_and(|bytes| Envelope::open(bytes).is_ok())
        };
        let (_, rest) = bytes.split_first_chunk::<{ MAGIC.len() + 1 }>()?;
        match Format::of(bytes).ok()? {
            Format::One => {
                let (&length, _) = rest.split_first_chunk::<4>()?;
                let unsigned = HEADER_LENGTH.checked_add(u32::from_le_bytes(length) as usize)?;
                let signed = unsigned.checked_add(SIGNATURE_BLOCK_LENGTH)?;
                [signed, unsigned].into_iter().find(is_whole)
            }
            Format::Two => {
                let length = Header::decode(bytes).ok()?.length as usize;
                Some(length).filter(is_whole)
            }
        }
    }
}

/// Returns the header of a package of format 1 with this body.
pub(super) fn header(body: &[u8]) -> Option<[u8; HEADER_LENGTH]> {
    let length = u32::try_from(body.len()).ok()?.to_le_bytes();
    let mut header = [0; HEADER_LENGTH];
    let (covered, checksum) = header.split_at_mut_checked(COVERED_LENGTH)?;
    let magic = Format::One.magic();
    let parts = magic.iter().chain(&length);
    covered.iter_mut().zip(parts).for_each(|(place, byte)| *place = *byte);
    let sum = crc32(&[covered, body]).to_le_bytes();
    checksum.iter_mut().zip(&sum).for_each(|(place, byte)| *place = *byte);
    Some(header)
}

/// Returns the signature block: in format 1 the bytes that follow the body of a signed package, in
/// format 2 those that follow the header.
#[must_use]
pub fn signature_block(signature: &[u8; SIGNATURE_LENGTH]) -> [u8; SIGNATURE_BLOCK_LENGTH] {
    let mut block = [0; SIGNATURE_BLOCK_LENGTH];
    let checksum = crc32(&[signature]).to_le_bytes();
    let parts = signature.iter().chain(&checksum);
    block.iter_mut().zip(parts).for_each(|(place, byte)| *place = *byte);
    block
}
