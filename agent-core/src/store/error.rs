//! Why the store refuses something.

use embedded_storage::nor_flash::NorFlashErrorKind;
use serde::{Deserialize, Serialize};

/// Why a call is refused. Nothing has changed then, but for what the variants say.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub enum StoreError {
    /// The flash driver reports an error. An unfinished upload that it hit is dropped.
    Flash(#[serde(with = "flash_kind")] NorFlashErrorKind),
    /// What was written reads differently. An unfinished upload that it hit is dropped.
    Verify {
        /// Where, from the start of the region. \[byte\]
        offset: u32,
    },
    /// A place of the journal cannot be read and may hold the newest record, and to record
    /// anything it would have to be erased. Another boot may read it; if none does,
    /// [`Store::forget_unreadable`](super::Store::forget_unreadable) gives it up.
    Unreadable {
        /// Where, from the start of the region. \[byte\]
        offset: u32,
    },
    /// Nobody has looked yet at what lies in the slots: [`Store::load`](super::Store::load) first.
    NotLoaded,
    /// A package is on trial, and what lies in the other slot is the way back.
    OnTrial,
    /// No package is on trial.
    NotOnTrial,
    /// A package of this length is empty or too long.
    Length {
        /// The length. \[byte\]
        found: u32,
        /// What a slot holds. \[byte\]
        maximum: u32,
    },
    /// There is no upload.
    NoUpload,
    /// The bytes do not continue what has been received.
    Gap {
        /// How many bytes have been; the sender goes on from here.
        received: u32,
    },
    /// The bytes would exceed the length that was announced.
    PastEnd {
        /// That length. \[byte\]
        length: u32,
    },
    /// Bytes that were received before are repeated, but changed: another package.
    Conflict {
        /// Where the repetition began. \[byte\]
        offset: u32,
    },
    /// The upload is not complete.
    Incomplete {
        /// How many bytes have been received; the sender goes on from here.
        received: u32,
        /// How many there are to be.
        length: u32,
    },
    /// No package waits for its activation.
    NothingStaged,
    /// The staged package is no longer what was staged.
    Damaged,
}

impl core::fmt::Display for StoreError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match *self {
            Self::Flash(kind) => write!(f, "flash: {kind}"),
            Self::Verify { offset } => write!(f, "flash at {offset:#x} reads not as written"),
            Self::Unreadable { offset } => {
                write!(f, "the journal at {offset:#x} cannot be read and may be the newest record")
            }
            Self::NotLoaded => write!(f, "the slots have not been looked at yet"),
            Self::OnTrial => write!(f, "a package is on trial"),
            Self::NotOnTrial => write!(f, "no package is on trial"),
            Self::Length { found, maximum } => {
                write!(f, "a package of {found} bytes, expected 1 to {maximum}")
            }
            Self::NoUpload => write!(f, "there is no upload"),
            Self::Gap { received } => write!(f, "a gap: the next byte is {received}"),
            Self::PastEnd { length } => write!(f, "more than the {length} bytes announced"),
            Self::Conflict { offset } => {
                write!(f, "the bytes at {offset} differ from those received before")
            }
            Self::Incomplete { received, length } => {
                write!(f, "{received} of {length} bytes have been received")
            }
            Self::NothingStaged => write!(f, "no package waits for its activation"),
            Self::Damaged => write!(f, "the staged package is damaged"),
        }
    }
}

impl core::error::Error for StoreError {}

/// Why a package does not get on, by the store's rules or by the caller's check.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum CheckedError<E> {
    /// The store refuses the call.
    Store(StoreError),
    /// The check refuses the package.
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
            Self::Refused(error) => write!(f, "the package is refused: {error}"),
        }
    }
}

impl<E: core::error::Error> core::error::Error for CheckedError<E> {}

/// Why a recorded package was not loaded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Refusal<E> {
    /// The slot's bytes are not the recorded ones.
    Checksum,
    /// The check refuses them.
    Check(E),
}

impl<E: core::fmt::Display> core::fmt::Display for Refusal<E> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match self {
            Self::Checksum => write!(f, "its bytes are not the recorded ones"),
            Self::Check(error) => write!(f, "{error}"),
        }
    }
}

impl<E: core::error::Error> core::error::Error for Refusal<E> {}

/// How a message carries what a flash driver says: postcard knows nothing of the foreign type.
mod flash_kind {
    use embedded_storage::nor_flash::NorFlashErrorKind;
    use serde::{Deserialize, Deserializer, Serializer};

    const KINDS: [NorFlashErrorKind; 2] =
        [NorFlashErrorKind::NotAligned, NorFlashErrorKind::OutOfBounds];

    #[expect(clippy::trivially_copy_pass_by_ref, reason = "serde asks for it")]
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
