//! Errors of the store.

use embedded_storage::nor_flash::NorFlashErrorKind;
use serde::{Deserialize, Serialize};

/// Why a call is refused. Nothing has changed, except as the variants describe.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub enum StoreError {
    /// The flash driver reports an error. The affected upload, if any, is dropped.
    Flash(#[serde(with = "flash_kind")] NorFlashErrorKind),
    /// Data reads back differently from what was written. The affected upload, if any, is dropped.
    Verify {
        /// Offset from the start of the region. \[byte\]
        offset: u32,
    },
    /// A journal entry cannot be read and may be the newest record, and recording anything would
    /// require erasing it. Another boot may be able to read it; if none can,
    /// [`Store::forget_unreadable`](super::Store::forget_unreadable) gives it up.
    Unreadable {
        /// Offset from the start of the region. \[byte\]
        offset: u32,
    },
    /// The slots have not been loaded yet: call [`Store::load`](super::Store::load) first.
    NotLoaded,
    /// A package is on trial, and the other slot holds the one to revert to.
    OnTrial,
    /// No package is on trial.
    NotOnTrial,
    /// The package is empty or too long.
    Length {
        /// The length. \[byte\]
        found: u32,
        /// Length of a slot. \[byte\]
        maximum: u32,
    },
    /// There is no upload.
    NoUpload,
    /// The bytes do not continue the upload.
    Gap {
        /// Bytes received so far; the sender continues from here.
        received: u32,
    },
    /// The bytes exceed the announced length.
    PastEnd {
        /// The announced length. \[byte\]
        length: u32,
    },
    /// A repeated part of the upload differs from what was received: it is another package.
    Conflict {
        /// Start of the repetition. \[byte\]
        offset: u32,
    },
    /// The upload is not complete.
    Incomplete {
        /// Bytes received so far; the sender continues from here.
        received: u32,
        /// The announced length.
        length: u32,
    },
    /// No package is staged.
    NothingStaged,
    /// The staged package has changed since it was staged.
    Damaged,
    /// This is done too often; an upload stays as it is and can be continued.
    TooOften {
        /// When it will be allowed again. \[s\]
        retry_after_seconds: u32,
    },
    /// A note has an unknown kind, is too long, or is one kind more than the journal has room for.
    Note,
}

impl core::fmt::Display for StoreError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match *self {
            Self::Flash(kind) => write!(f, "flash: {kind}"),
            Self::Verify { offset } => {
                write!(f, "flash at {offset:#x} does not read back as written")
            }
            Self::Unreadable { offset } => {
                write!(
                    f,
                    "the journal entry at {offset:#x} is unreadable and may be the newest record"
                )
            }
            Self::NotLoaded => write!(f, "the slots have not been loaded yet"),
            Self::OnTrial => write!(f, "a package is on trial"),
            Self::NotOnTrial => write!(f, "no package is on trial"),
            Self::Length { found, maximum } => {
                write!(f, "invalid package length: {found} bytes, expected 1 to {maximum}")
            }
            Self::NoUpload => write!(f, "no upload is in progress"),
            Self::Gap { received } => write!(f, "gap in the upload: expected byte {received}"),
            Self::PastEnd { length } => {
                write!(f, "the upload exceeds the announced {length} bytes")
            }
            Self::Conflict { offset } => {
                write!(f, "the bytes at {offset} differ from those received earlier")
            }
            Self::Incomplete { received, length } => {
                write!(f, "the upload is incomplete: {received} of {length} bytes received")
            }
            Self::NothingStaged => write!(f, "no package is staged"),
            Self::Damaged => write!(f, "the staged package is damaged"),
            Self::TooOften { retry_after_seconds } => {
                write!(
                    f,
                    "this has been done too often recently; to limit load and wear of the flash, try \
                     again in {retry_after_seconds} s"
                )
            }
            Self::Note => write!(f, "the journal has no room for this note"),
        }
    }
}

impl core::error::Error for StoreError {}

/// Why a package was refused: by the store's rules or by the caller's check.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum CheckedError<E> {
    /// The store refused the call.
    Store(StoreError),
    /// The check refused the package.
    Refused(E),
}

impl<E> From<StoreError> for CheckedError<E> {
    fn from(error: StoreError) -> Self {
        Self::Store(error)
    }
}

impl<E: core::fmt::Display> core::fmt::Display for CheckedError<E> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Store(error) => write!(f, "{error}"),
            Self::Refused(error) => write!(f, "package refused: {error}"),
        }
    }
}

impl<E: core::error::Error> core::error::Error for CheckedError<E> {}

/// Why a recorded package was not loaded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Refusal<E> {
    /// The slot's bytes differ from the recorded ones.
    Checksum,
    /// The check refused the package.
    Check(E),
}

impl<E: core::fmt::Display> core::fmt::Display for Refusal<E> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Checksum => write!(f, "its bytes differ from the recorded ones"),
            Self::Check(error) => write!(f, "{error}"),
        }
    }
}

impl<E: core::error::Error> core::error::Error for Refusal<E> {}

/// Serialises the flash driver's error, whose type postcard cannot handle.
mod flash_kind {
    use embedded_storage::nor_flash::NorFlashErrorKind;
    use serde::{Deserialize, Deserializer, Serializer};

    const KINDS: [NorFlashErrorKind; 2] =
        [NorFlashErrorKind::NotAligned, NorFlashErrorKind::OutOfBounds];

    #[expect(clippy::trivially_copy_pass_by_ref, reason = "required by serde")]
    pub(super) fn serialize<S: Serializer>(
        kind: &NorFlashErrorKind,
        serializer: S,
    ) -> Result<S::Ok, S::Error> {
        let place = KINDS.iter().position(|known| known == kind).unwrap_or(KINDS.len());
        serializer.serialize_u8(place as u8)
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(
        deserializer: D,
    ) -> Result<NorFlashErrorKind, D::Error> {
        let place = usize::from(u8::deserialize(deserializer)?);
        Ok(KINDS.get(place).copied().unwrap_or(NorFlashErrorKind::Other))
    }
}
