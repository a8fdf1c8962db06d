//! Seals requests to a provisioned node.
//!
//! In its [`Session`] the node states what a seal needs, and proves that it has the port key of the
//! agent it claims to be. A session ends when the node restarts, and is out of step after another
//! client has sealed a request; both show as refusals, after which the client asks for it again.
//!
//! Two requests sealed with the same nonce would reveal something of each other, and another client
//! may have sealed one that was lost on the way. So each seal has a random salt.

use agent_core::service::seal::PortKey;
use agent_core::service::{REQUEST_LENGTH_MAX, Request, Seal, Session};

use super::error::ServiceError;
use crate::keys::PortKeys;

/// Seals the requests of one client.
#[derive(Debug)]
pub(super) struct Sealing {
    keys: PortKeys,
    node: Node,
}

/// What is known about the node.
#[derive(Clone, Copy, Debug)]
enum Node {
    Unknown,
    NotProvisioned,
    Provisioned { key: PortKey, epoch: u32, counter: u32 },
}

impl Sealing {
    pub(super) fn new(keys: PortKeys) -> Self {
        Self { keys, node: Node::Unknown }
    }

    pub(super) fn keys(&self) -> &PortKeys {
        &self.keys
    }

    /// Returns whether the node is known to be provisioned.
    pub(super) fn is_provisioned(&self) -> bool {
        matches!(self.node, Node::Provisioned { .. })
    }

    /// Returns whether requests of this kind are sealed for a provisioned node. Stimuli are not:
    /// only a simulator sends them, to a node in the loop.
    pub(super) fn applies_to(request: &Request<'_>) -> bool {
        !request.is_free() && !matches!(request, Request::Frame { .. } | Request::Tick { .. })
    }

    /// Returns whether the node must first be asked for its session.
    pub(super) fn needs_session(&self) -> bool {
        matches!(self.node, Node::Unknown)
    }

    /// Forgets the session.
    pub(super) fn forget(&mut self) {
        self.node = Node::Unknown;
    }

    /// Takes the node's answer to a request for its session; `None` if it is not provisioned.
    pub(super) fn begin(&mut self, session: Option<&Session>) -> Result<(), ServiceError> {
        let Some(session) = session else {
            self.node = Node::NotProvisioned;
            return Ok(());
        };
        let &Session { agent, epoch, counter, proof, .. } = session;
        let epoch = epoch.ok_or(ServiceError::NoEpoch)?;
        let key = self.keys.of(agent);
        if key.proof(session) != proof {
            return Err(ServiceError::Proof { agent });
        }
        self.node = Node::Provisioned { key, epoch, counter };
        Ok(())
    }

    /// Returns the request as it is sent: head, encrypted request, tag. `None` if the node is not
    /// provisioned, so that the request is sent as it is.
    pub(super) fn seal(&mut self, request: &Request<'_>) -> Result<Option<Vec<u8>>, ServiceError> {
        let Node::Provisioned { key, epoch, counter } = &mut self.node else {
            return match request {
                // Refused, but only after the keys have crossed the line in the clear.
                Request::NetworkKeys { .. }
                | Request::OperatorKeys { .. }
                | Request::FactoryReset => Err(ServiceError::NotProvisioned),
                _ => Ok(None),
            };
        };
        *counter = counter.checked_add(1).ok_or(ServiceError::CounterUsedUp)?;
        let mut salt = [0; 8];
        getrandom::fill(&mut salt).map_err(ServiceError::Random)?;
        let seal = Seal { counter: *counter, salt };
        let mut sealed = encoded(&Request::Sealed(seal));
        let mut body = encoded(request);
        let tag = key.seal(*epoch, &seal, &mut body);
        sealed.append(&mut body);
        sealed.extend(tag);
        Ok(Some(sealed))
    }

    /// Decrypts what another client has sealed for this node.
    pub(super) fn open(&self, seal: &Seal, mut sealed: Vec<u8>) -> Option<Vec<u8>> {
        let Node::Provisioned { key, epoch, .. } = &self.node else { return None };
        key.open(*epoch, seal, &mut sealed).map(<[u8]>::to_vec)
    }
}

fn encoded(request: &Request<'_>) -> Vec<u8> {
    // Every request fits.
    let mut bytes = [0; REQUEST_LENGTH_MAX];
    postcard::to_slice(request, &mut bytes).map(|bytes| bytes.to_vec()).unwrap_or_default()
}
