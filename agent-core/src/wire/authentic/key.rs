//! Network keys, and the keys derived from them.

use crate::AgentId;
use crate::wire::secret::{Purpose, SECRET_LENGTH, Secret};

/// A key that all nodes of a network share, with the number by which frames name it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NetworkKey {
    number: u8,
    secret: Secret,
}

impl NetworkKey {
    /// Length of number and key. \[byte\]
    pub const LENGTH: usize = 1 + SECRET_LENGTH;

    /// Creates the network key with this number.
    #[must_use]
    pub const fn new(number: u8, secret: Secret) -> Self {
        Self { number, secret }
    }

    /// Returns the number of the key.
    #[must_use]
    pub const fn number(&self) -> u8 {
        self.number
    }

    /// Returns number and key as the store and [`NetworkKeys`](crate::service::Request::NetworkKeys)
    /// have them.
    #[must_use]
    pub fn to_bytes(&self) -> [u8; Self::LENGTH] {
        let mut bytes = [self.number; Self::LENGTH];
        let [_, key @ ..] = &mut bytes;
        *key = self.secret.to_bytes();
        bytes
    }

    /// Returns the tag of a frame's `bytes` if they come from `sender`.
    ///
    /// Each sender has a key of its own, so that a frame cannot be reflected to its sender or
    /// passed off as another agent's.
    pub(super) fn tag(&self, sender: AgentId, bytes: &[u8]) -> u64 {
        self.secret.derive(Purpose::Frame, sender).hash(bytes)
    }
}
