//! Secrets of 128 bits, and the keys derived from them.

use serde::{Deserialize, Serialize};

/// Length of a secret. \[byte\]
pub const SECRET_LENGTH: usize = 16;

/// A secret of 128 random bits. Its `Debug` output leaves them out.
#[derive(Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Secret([u8; SECRET_LENGTH]);

impl core::fmt::Debug for Secret {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str("Secret(..)")
    }
}

impl Secret {
    /// Creates the secret from 128 random bits.
    #[must_use]
    pub const fn new(bits: [u8; SECRET_LENGTH]) -> Self {
        Self(bits)
    }

    /// Returns the bits, for the store and the wire.
    #[must_use]
    pub(crate) const fn to_bytes(self) -> [u8; SECRET_LENGTH] {
        self.0
    }

    /// Derives the key for one purpose, and one number in it. Nothing about the secret, or the key of
    /// another purpose or number, follows from it: SipHash-2-4 is a pseudo-random function.
    #[cfg(feature = "authentic-frames")]
    pub(crate) fn derive(&self, purpose: Purpose, number: u32) -> Self {
        let mut derived = [0; SECRET_LENGTH];
        let (halves, _) = derived.as_chunks_mut();
        for (half, index) in halves.iter_mut().zip(0u8..) {
            let [n0, n1, n2, n3] = number.to_le_bytes();
            *half = self.hash(&[purpose as u8, index, n0, n1, n2, n3]).to_le_bytes();
        }
        Self(derived)
    }

    /// Returns the hash of `bytes` with this key, SipHash-2-4.
    #[cfg(feature = "authentic-frames")]
    pub(crate) fn hash(&self, bytes: &[u8]) -> u64 {
        integrity::hash(&self.0, bytes)
    }
}

/// What a derived key is for.
#[cfg(feature = "authentic-frames")]
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Purpose {
    /// Tags of the frames of one sender, from a network key.
    Frame = 1,
    /// Encryption of requests, from a port key.
    Request = 2,
    /// Proof that a node has the port key, from that key.
    Proof = 3,
}
