//! Authentic frames in a co-simulation.
//!
//! Simulated agents broadcast frames of version 1. Nodes with network keys broadcast authentic ones
//! with the same content, which are compared without epoch and tag, and passed on as they are. A hello
//! and its answer have no counterpart in the simulation: they are passed on and not compared.
//!
//! A node that has just started believes no neighbour, while a simulated agent hears its own from the
//! first step on. So the co-simulation, which has the keys, turns the first frame of each neighbour
//! into the answer to a hello that the node has not sent yet. From then on nodes are on their own.

use agent_core::AgentId;
use agent_core::wire::authentic::{self, Header, Kind, NetworkKey, Stamp};
use agent_core::wire::frame::{AnyFrame, Words};

/// Returns a node's frame as a simulated agent broadcasts it; `None` for a hello or an answer to one.
/// A frame that is not authentic has no bytes.
pub(super) fn plain(bytes: &[u8], keys: &[NetworkKey]) -> Option<Vec<u8>> {
    let Ok((header, words)) = authentic::open(bytes, keys) else { return Some(Vec::new()) };
    let Header { sender, stamp, tick, kind } = header;
    let payload = kind.payload().filter(|_| kind.answered().is_none())?;
    let words: Words = words.iter().copied().collect();
    let frame = AnyFrame { sender, sequence: stamp.sequence, tick, payload, words };
    Some(frame.encode().to_vec())
}

/// Returns the epoch of a node's frame; `None` if it is not authentic.
pub(super) fn epoch(bytes: &[u8], keys: &[NetworkKey]) -> Option<u32> {
    authentic::open(bytes, keys).ok().map(|(header, _)| header.stamp.epoch)
}

/// Returns a node's frame as the answer to the hello of another one in its `epoch`; unchanged if it is
/// not authentic.
pub(super) fn answer(bytes: &[u8], to: AgentId, epoch: u32, keys: &[NetworkKey]) -> Vec<u8> {
    let (Ok((header, words)), Some(key)) = (authentic::open(bytes, keys), keys.first()) else {
        return bytes.to_vec();
    };
    let Some(payload) = header.kind.payload() else { return bytes.to_vec() };
    let header = Header { kind: Kind::answer(payload, to, epoch), ..header };
    authentic::seal(&header, words, key).to_vec()
}

/// Returns the frame of a simulated agent as its node would have broadcast it in its `epoch`.
pub(super) fn sealed(bytes: &[u8], epoch: u32, keys: &[NetworkKey]) -> Vec<u8> {
    let (Ok(frame), Some(key)) = (AnyFrame::decode(bytes), keys.first()) else {
        return bytes.to_vec();
    };
    let AnyFrame { sender, sequence, tick, payload, words } = frame;
    let kind = Kind::broadcast(payload);
    let header = Header { sender, stamp: Stamp { epoch, sequence }, tick, kind };
    authentic::seal(&header, &words, key).to_vec()
}

#[cfg(test)]
mod tests {
    use agent_core::wire::frame::Payload;
    use agent_core::wire::secret::Secret;

    use super::*;

    #[test]
    fn a_frame_survives_sealing_and_opening() {
        let keys = [NetworkKey::new(1, Secret::new([3; 16]))];
        let words = [1.0_f32, -2.5].into_iter().map(f32::to_le_bytes).collect();
        let payload = Payload::Estimate;
        let frame = AnyFrame { sender: 2, sequence: 7, tick: 300, payload, words }.encode();
        let bytes = sealed(&frame, 90, &keys);
        assert_eq!(plain(&bytes, &keys), Some(frame.to_vec()));
        assert_eq!(epoch(&bytes, &keys), Some(90));
        let sync = answer(&bytes, 1, 80, &keys);
        assert_eq!(plain(&sync, &keys), None);
        assert_eq!(epoch(&sync, &keys), Some(90));
        // A frame of version 1 from a node with keys does not count as equal.
        assert_eq!(plain(&frame, &keys), Some(Vec::new()));
        assert_eq!(epoch(&frame, &keys), None);
    }
}
