//! What a node knows of its network, in the journal: network keys, port key, and epochs.
//!
//! | note | content |
//! | --- | --- |
//! | 2 | at most two network keys: for each, its number (one byte) and its 16 bytes |
//! | 3 | the port key, 16 bytes, and the agent that the node was provisioned as, `u32`, little-endian |
//! | 4 | the end of the reserved epochs, `u32`, little-endian |
//! | 5 | 1 if the firmware's public key is still valid, otherwise 0, and one more public key, 32 bytes |
//!
//! A key is replaced by one record, so a power cut leaves the old one or the new one. No answer of
//! the service protocol contains a key. What was replaced stays in flash until its half of the
//! journal is erased; anyone who can read the chip's flash can read keys.
//!
//! With the state and the count of boots these are six kinds: see [`KEYED_HALF_MIN`].
//!
//! Invariants: an epoch is handed out once, because it is reserved, in two copies that are read back,
//! before it is used; a reset removes the keys and keeps the epochs.

use super::layout::PAIR_LENGTH;
use super::{Contents, MappedFlash, Note, Phase, Store, StoreError};
use crate::AgentId;
use crate::package::signature::PublicKey;
use crate::wire::authentic::NetworkKey;
use crate::wire::secret::{SECRET_LENGTH, Secret};

const NETWORK_KEYS: u8 = 2;
const PORT_KEY: u8 = 3;
const EPOCHS: u8 = 4;
const OPERATOR_KEYS: u8 = 5;

/// Length that each half of the commit area needs on a node with keys: a pair for each of six kinds, and
/// one for a record that has to be written twice. \[byte\]
pub const KEYED_HALF_MIN: u32 = 7 * PAIR_LENGTH;

/// The largest number of network keys: the one in use and, during a rotation, the other one.
pub const NETWORK_KEYS_MAX: usize = 2;

/// The operator's public keys: packages may be signed for any of them.
pub type OperatorKeys = heapless::Vec<PublicKey, 2>;

/// The network keys of a node. Frames are sealed with the first one.
pub type NetworkKeys = heapless::Vec<NetworkKey, NETWORK_KEYS_MAX>;

impl<F: MappedFlash> Store<F> {
    /// Returns the network keys, none before the node is provisioned.
    pub fn network_keys(&mut self) -> NetworkKeys {
        self.note(NETWORK_KEYS).map(|note| network_keys(note.as_bytes())).unwrap_or_default()
    }

    /// Records network keys in place of the previous ones, the one in use first: for each, its number and
    /// its 16 bytes.
    ///
    /// # Errors
    /// [`StoreError::Note`] if there is none, more than [`NETWORK_KEYS_MAX`], or two with the same
    /// number; a failure to write the journal.
    pub fn record_network_keys(&mut self, keys: &[u8]) -> Result<(), StoreError> {
        match keys.as_chunks::<{ NetworkKey::LENGTH }>() {
            ([_], []) => {}
            ([[first, ..], [second, ..]], []) if first != second => {}
            _ => return Err(StoreError::Note),
        }
        self.record_note(NETWORK_KEYS, keys)
    }

    /// Returns the port key and the agent that the node was provisioned as, if it was.
    pub fn port_key(&mut self) -> Option<(Secret, AgentId)> {
        let note = self.note(PORT_KEY)?;
        let (key, agent) = note.as_bytes().split_first_chunk()?;
        Some((Secret::new(*key), AgentId::from_le_bytes(agent.try_into().ok()?)))
    }

    /// Records port key and agent in place of the previous ones.
    ///
    /// # Errors
    /// A failure to write the journal.
    pub fn record_port_key(&mut self, key: Secret, agent: AgentId) -> Result<(), StoreError> {
        let mut note = [0; SECRET_LENGTH + size_of::<AgentId>()];
        let bytes = key.to_bytes().into_iter().chain(agent.to_le_bytes());
        note.iter_mut().zip(bytes).for_each(|(place, byte)| *place = byte);
        self.record_note(PORT_KEY, &note)
    }

    /// Returns the operator's public keys that are valid for firmware with the public key `built_in`; none
    /// if what has been recorded means nothing.
    pub fn operator_keys(&mut self, built_in: PublicKey) -> OperatorKeys {
        let note = self.note(OPERATOR_KEYS);
        let bytes = note.as_ref().map_or(&[][..], Note::as_bytes);
        operator_keys(bytes, built_in).unwrap_or_default()
    }

    /// Records which of the operator's public keys are valid in place of what was recorded before: see
    /// [`operator_keys`].
    ///
    /// # Errors
    /// [`StoreError::Note`] if the bytes mean nothing; a failure to write the journal.
    pub fn record_operator_keys(&mut self, bytes: &[u8]) -> Result<(), StoreError> {
        decoded(bytes)?;
        self.record_note(OPERATOR_KEYS, bytes)
    }

    /// Removes all keys, the port key last, so that a reset interrupted by a power cut can be
    /// repeated with it. Epochs stay.
    ///
    /// # Errors
    /// A failure to write the journal.
    pub fn remove_keys(&mut self) -> Result<(), StoreError> {
        self.record_note(NETWORK_KEYS, &[])?;
        if cfg!(feature = "signature") {
            self.record_note(OPERATOR_KEYS, &[])?;
        }
        self.record_note(PORT_KEY, &[])
    }

    /// Forgets the packages, but not which was the highest that has been activated, and then the keys:
    /// see [`Self::remove_keys`].
    ///
    /// # Errors
    /// A failure to write the journal; what has been forgotten by then stays forgotten.
    pub fn reset(&mut self) -> Result<(), StoreError> {
        self.upload = None;
        let packages = [None; 2];
        self.commit(Contents { in_use: None, phase: Phase::Confirmed, packages, ..self.contents })?;
        self.remove_keys()
    }

    /// Reserves `count` epochs that have never been handed out and returns the first one and the end.
    /// They are in flash, in two copies that have been read back.
    ///
    /// # Errors
    /// [`StoreError::Note`] if fewer are left, if the record of the previous ones is damaged, or if the
    /// journal has no room; [`StoreError::Unreadable`] if it may hold a newer record behind a fault
    /// that passes; a failure to write it.
    pub fn reserve_epochs(&mut self, count: u32) -> Result<(u32, u32), StoreError> {
        let first = self.epochs_end()?;
        let end = first.checked_add(count).ok_or(StoreError::Note)?;
        self.record_note(EPOCHS, &end.to_le_bytes())?;
        Ok((first, end))
    }

    /// Skips all epochs below `first`; does nothing if they are already in use.
    ///
    /// # Errors
    /// Same as for [`Self::reserve_epochs`].
    pub fn skip_epochs(&mut self, first: u32) -> Result<(), StoreError> {
        if first <= self.epochs_end()? {
            return Ok(());
        }
        self.record_note(EPOCHS, &first.to_le_bytes())
    }

    /// Returns the end of the epochs that have been reserved so far.
    ///
    /// # Errors
    /// Same as for [`Self::reserve_epochs`].
    pub fn epochs_end(&mut self) -> Result<u32, StoreError> {
        if let Some(offset) = self.journal.held_by() {
            return Err(StoreError::Unreadable { offset });
        }
        let Some(note) = self.note(EPOCHS) else { return Ok(0) };
        note.as_bytes().try_into().map(u32::from_le_bytes).map_err(|_| StoreError::Note)
    }
}

/// Returns the operator's public keys that these bytes make valid for firmware with the public key
/// `built_in`: without bytes only this one; otherwise a byte, 1 if it stays valid and 0 if not, and
/// one more public key of 32 bytes.
///
/// # Errors
/// [`StoreError::Note`] if the bytes are anything else.
pub fn operator_keys(bytes: &[u8], built_in: PublicKey) -> Result<OperatorKeys, StoreError> {
    let note = decoded(bytes)?;
    // There is room for both.
    let mut keys = OperatorKeys::new();
    if !matches!(note, Some((false, _))) {
        let _ = keys.push(built_in);
    }
    if let Some((_, other)) = note {
        let _ = keys.push(other);
    }
    Ok(keys)
}

fn decoded(bytes: &[u8]) -> Result<Option<(bool, PublicKey)>, StoreError> {
    let Some((flag, key)) = bytes.split_first() else { return Ok(None) };
    let key = key.try_into().ok().and_then(PublicKey::decoded);
    match (flag, key) {
        (0 | 1, Some(key)) => Ok(Some((*flag == 1, key))),
        _ => Err(StoreError::Note),
    }
}

/// Returns the network keys in these bytes: for each, its number and its 16 bytes.
#[must_use]
pub fn network_keys(bytes: &[u8]) -> NetworkKeys {
    let (entries, _) = bytes.as_chunks::<{ NetworkKey::LENGTH }>();
    let mut keys = NetworkKeys::new();
    // A note has room for three.
    for [number, key @ ..] in entries.iter().take(NETWORK_KEYS_MAX) {
        let _ = keys.push(NetworkKey::new(*number, Secret::new(*key)));
    }
    keys
}
