//! The secret of a fleet, and the keys derived from it.
//!
//! A key is the first 16 bytes of HKDF-SHA256 (RFC 5869) without salt, with the secret as input and,
//! as info, a label and the number, `u32`, little-endian:
//!
//! | key | label | number |
//! | --- | --- | --- |
//! | port key | `port key` | the agent |
//! | network key | `network key` | the key's number |

use agent_core::AgentId;
use agent_core::service::seal::PortKey;
use agent_core::wire::authentic::NetworkKey;
use agent_core::wire::secret::{SECRET_LENGTH, Secret};
use hkdf::Hkdf;
use sha2::Sha256;
use zeroize::Zeroizing;

use crate::signing::OperatorKey;

/// The secret from which the keys of a fleet's nodes and of its network are derived; wiped from memory
/// when dropped.
#[derive(Clone)]
pub struct FleetSecret(Zeroizing<[u8; 32]>);

impl FleetSecret {
    /// Creates the secret from 32 random bytes.
    #[must_use]
    pub fn new(bytes: [u8; 32]) -> Self {
        Self(Zeroizing::new(bytes))
    }

    pub(super) fn from_key(key: &OperatorKey) -> Self {
        Self(key.secret_bytes())
    }

    /// Returns the secret of an agent's port key.
    #[must_use]
    pub fn port_secret(&self, agent: AgentId) -> Secret {
        self.derive(b"port key", agent)
    }

    /// Returns an agent's port key.
    #[must_use]
    pub fn port_key(&self, agent: AgentId) -> PortKey {
        PortKey::new(self.port_secret(agent))
    }

    /// Returns the secret of the network key with this number.
    #[must_use]
    pub fn network_secret(&self, number: u8) -> Secret {
        self.derive(b"network key", number.into())
    }

    /// Returns the network key with this number.
    #[must_use]
    pub fn network_key(&self, number: u8) -> NetworkKey {
        NetworkKey::new(number, self.network_secret(number))
    }

    fn derive(&self, label: &[u8], number: u32) -> Secret {
        let mut key = Zeroizing::new([0; SECRET_LENGTH]);
        Hkdf::<Sha256>::new(None, self.0.as_ref())
            .expand_multi_info(&[label, &number.to_le_bytes()], key.as_mut())
            // HKDF-SHA256 gives up to 255 times 32 bytes.
            .expect("16 bytes can be derived");
        Secret::new(*key)
    }
}

/// Omits the secret, which must not appear in logs.
impl std::fmt::Debug for FleetSecret {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("FleetSecret(..)")
    }
}

/// Where a client takes the port key of a node from.
#[derive(Clone, Debug)]
pub enum PortKeys {
    /// Every agent's is derived from this secret.
    Fleet(FleetSecret),
    /// There is one node, which has this key.
    Node(PortKey),
}

impl PortKeys {
    /// Returns the port key of an agent's node.
    #[must_use]
    pub fn of(&self, agent: AgentId) -> PortKey {
        match self {
            Self::Fleet(secret) => secret.port_key(agent),
            Self::Node(key) => *key,
        }
    }
}
