//! The keys of a fleet, from a key folder or for one run.

use agent_core::AgentId;
use agent_core::wire::authentic::NetworkKey;
use agent_core::wire::secret::Secret;

use super::{FleetSecret, NetworkNumbers, PortKeys};

/// Returns the epoch of a node that is provisioned now: seconds since 1970, which fit until 2106.
#[must_use]
pub fn epoch_now() -> u32 {
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    u32::try_from(now.unwrap_or_default().as_secs()).unwrap_or(u32::MAX).min(EPOCH_MAX)
}

/// The highest epoch with which nodes can be provisioned, in 2097.
const EPOCH_MAX: u32 = 0xf000_0000;

/// The secret of a fleet, and the numbers of its network keys.
#[derive(Clone, Debug)]
pub struct FleetKeys {
    secret: FleetSecret,
    numbers: NetworkNumbers,
}

impl FleetKeys {
    /// Creates the keys from the secret and the numbers of the network keys in use.
    #[must_use]
    pub fn new(secret: FleetSecret, numbers: NetworkNumbers) -> Self {
        Self { secret, numbers }
    }

    /// Creates keys from the operating system's randomness.
    ///
    /// # Errors
    /// If the system provides no random numbers.
    pub fn generate() -> Result<Self, getrandom::Error> {
        let mut bytes = [0; 32];
        getrandom::fill(&mut bytes)?;
        Ok(Self::new(FleetSecret::new(bytes), NetworkNumbers::FIRST))
    }

    /// Returns the port keys of all agents.
    #[must_use]
    pub fn port_keys(&self) -> PortKeys {
        PortKeys::Fleet(self.secret.clone())
    }

    /// Returns the secret of an agent's port key, to provision its node.
    #[must_use]
    pub fn port_secret(&self, agent: AgentId) -> Secret {
        self.secret.port_secret(agent)
    }

    /// Returns the numbers of the network keys in use, the one for sending first.
    #[must_use]
    pub fn network_numbers(&self) -> NetworkNumbers {
        self.numbers
    }

    /// Returns the network keys in use, the one for sending first.
    #[must_use]
    pub fn network_keys(&self) -> Vec<NetworkKey> {
        self.numbers.iter().map(|number| self.secret.network_key(number)).collect()
    }
}
