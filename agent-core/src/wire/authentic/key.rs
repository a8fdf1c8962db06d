//! Network keys, and the keys derived from them.

use siphasher::sip::SipHasher24;
use siphasher::sip128::SipHasher24 as Derivation;

use crate::AgentId;

/// Length of a network key. \[byte\]
pub const KEY_LENGTH: usize = 16;

/// A key that all nodes of a network share, with the number by which frames name it.
///
/// There is no way to print the key itself.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct NetworkKey {
    number: u8,
    key: [u8; KEY_LENGTH],
}

impl core::fmt::Debug for NetworkKey {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("NetworkKey").field("number", &self.number).finish_non_exhaustive()
    }
}

impl NetworkKey {
    /// Creates the network key with this number from 128 random bits.
    #[must_use]
    pub const fn new(number: u8, key: [u8; KEY_LENGTH]) -> Self {
        Self { number, key }
    }

    /// Returns the number of the key.
    #[must_use]
    pub const fn number(&self) -> u8 {
        self.number
    }

    /// Returns the key itself, for the store.
    pub(crate) const fn to_bytes(self) -> [u8; KEY_LENGTH] {
        self.key
    }

    /// Returns the tag of a frame's `bytes` if they come from `sender`.
    ///
    /// Each sender has a key of its own, so that a frame cannot be reflected to its sender or
    /// passed off as another agent's.
    pub(super) fn tag(&self, sender: AgentId, bytes: &[u8]) -> u64 {
        let [l0, l1, l2, l3, l4] = LABEL;
        let [s0, s1, s2, s3] = sender.to_le_bytes();
        let purpose = [l0, l1, l2, l3, l4, s0, s1, s2, s3];
        let derived = Derivation::new_with_key(&self.key).hash(&purpose).as_bytes();
        SipHasher24::new_with_key(&derived).hash(bytes)
    }
}

/// Separates the frames' keys from any other that is derived from a network key.
const LABEL: [u8; 5] = *b"frame";
