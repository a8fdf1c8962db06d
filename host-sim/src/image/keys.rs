//! Keys in an image, recorded by the node's own store.

use agent_core::AgentId;
use agent_core::store::{KEYED_HALF_MIN, MappedFlash, Store};
use agent_core::wire::authentic::NetworkKey;

use super::{COMMIT, FIRMWARE, Image, ImageError, RamFlash};
use crate::keys::FleetKeys;

impl Image {
    /// Records in the commit area what a node records when it is provisioned as `agent`: port key,
    /// network keys, and that all epochs below `epoch` are over ([`crate::keys::epoch_now`]); and the
    /// `operators` ([`crate::keys::Operators::for_nodes`]).
    ///
    /// # Errors
    /// If the commit area has no room for keys.
    pub fn provision(
        mut self,
        keys: &FleetKeys,
        operators: Option<&[u8]>,
        agent: AgentId,
        epoch: u32,
    ) -> Result<Self, ImageError> {
        let found = self.region.commit_length / 2;
        if found < KEYED_HALF_MIN {
            return Err(ImageError::NoRoomForKeys { found, needed: KEYED_HALF_MIN });
        }
        let weights = self.segments.iter().filter(|segment| segment.name != FIRMWARE);
        let flash = RamFlash::holding(&self.region, weights);
        let mut store = Store::open(flash, self.region.layout()).map_err(ImageError::Layout)?;
        let network: Vec<u8> = keys.network_keys().iter().flat_map(NetworkKey::to_bytes).collect();
        store
            .skip_epochs(epoch)
            .and_then(|()| store.record_port_key(keys.port_secret(agent), agent))
            .and_then(|()| store.record_network_keys(&network))
            .and_then(|()| store.record_operator_keys(operators.unwrap_or_default()))
            .map_err(ImageError::Keys)?;
        let flash = store.into_flash();
        for segment in self.segments.iter_mut().filter(|segment| segment.name == COMMIT) {
            let start = (segment.address - self.region.origin) as usize;
            let end = start + segment.bytes.len();
            segment.bytes.copy_from_slice(&flash.mapped()[start..end]);
        }
        Ok(self)
    }
}
