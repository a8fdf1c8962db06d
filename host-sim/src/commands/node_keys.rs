//! A node's keys: giving and taking them, and what a status says about them.

use std::path::Path;

use agent_core::AgentId;
use agent_core::service::{Problem, Session};
use serde::Serialize;

use super::connection::RETRY_POLICY;
use super::key::Passphrase;
use super::{CommandError, ErrorCode};
use crate::keys::{KeyFolder, epoch_now};
use crate::service::provision::{self, NewKeys};
use crate::service::{Client, ServiceError, push};
use crate::terminal;

/// What a node says about its keys, for JSON.
#[derive(Serialize)]
pub(super) struct KeysReport {
    provisioned: bool,
    agent: Option<AgentId>,
    epoch: Option<u32>,
    /// Numbers, the one for sending first.
    network_keys: Vec<u8>,
}

impl KeysReport {
    /// Creates a report of the node's session, `None` from a node without keys.
    pub(super) fn new(session: Option<&Session>) -> Self {
        Self {
            provisioned: session.is_some(),
            agent: session.map(|session| session.agent),
            epoch: session.and_then(|session| session.epoch),
            network_keys: session.map(network_keys).unwrap_or_default(),
        }
    }
}

fn network_keys(session: &Session) -> Vec<u8> {
    session.network_keys.iter().flatten().copied().collect()
}

/// Formats the session as a line to append to a status; `None` from a node without keys.
pub(super) fn text(session: Option<&Session>) -> String {
    let Some(session) = session else { return "  not provisioned\n".to_owned() };
    let epoch = match session.epoch {
        Some(epoch) => format!("boot epoch {epoch}"),
        None => "no boot epoch: its flash cannot record one".to_owned(),
    };
    let keys = match network_keys(session).as_slice() {
        [] => "no network key".to_owned(),
        [only] => format!("network key {only}"),
        [first, rest @ ..] => {
            let rest: Vec<_> = rest.iter().map(u8::to_string).collect();
            format!("network key {first}, also accepts {}", rest.join(", "))
        }
    };
    format!("  provisioned as agent {}, {epoch}, {keys}\n", session.agent)
}

/// Makes the node `agent`, with the keys of the folder.
pub(super) fn provision(
    node: &mut Client,
    keys: &KeyFolder,
    passphrase: &Passphrase,
    agent: AgentId,
) -> Result<(), CommandError> {
    if provision::session(node, RETRY_POLICY)?.is_none() {
        terminal::note(format_args!(
            "the node is not provisioned, so its port key crosses the line in the clear"
        ));
    }
    // A node never goes back to an epoch that is over; the clock is above all epochs of a node whose
    // flash has been lost.
    let epoch = epoch_now();
    let [signing, other] = keys.operators().private_files();
    let mut give = |file: &Path| -> Result<_, CommandError> {
        let operator = passphrase.key(file)?;
        let new = NewKeys { fleet: keys.fleet(), operator: Some(&operator), epoch };
        Ok(provision::provision(node, &new, agent, RETRY_POLICY))
    };
    match give(&signing)? {
        // During a rotation, the firmware of a blank node may know only the other key.
        Err(ServiceError::Refused(Problem::NotSigned)) if other != signing => give(&other)??,
        given => given?,
    }
    operator_keys(node, keys)
}

/// Gives the node the network keys and the operator keys of the folder.
pub(super) fn rotate(node: &mut Client, keys: &KeyFolder) -> Result<(), CommandError> {
    provision::network_keys(node, &keys.fleet().network_keys(), RETRY_POLICY)?;
    operator_keys(node, keys)
}

/// Gives the node the operator keys, if they have ever been rotated and it accepts only signed packages.
fn operator_keys(node: &mut Client, keys: &KeyFolder) -> Result<(), CommandError> {
    let Some(bytes) = keys.operators().for_nodes()? else { return Ok(()) };
    if !push::status(node, RETRY_POLICY)?.firmware.signed_only {
        return Ok(());
    }
    match provision::operator_keys(node, &bytes, RETRY_POLICY) {
        Err(ServiceError::Refused(Problem::Package(report))) => Err(CommandError::new(
            ErrorCode::PackageRefused,
            format!(
                "the node would no longer accept the package it is using ({report}), so it keeps its \
                 current operator keys; push a package signed with the new key, and try again"
            ),
        )),
        given => Ok(given?),
    }
}

/// Makes the node forget its keys, agent and packages.
pub(super) fn factory_reset(node: &mut Client) -> Result<(), CommandError> {
    if provision::factory_reset(node, RETRY_POLICY)? {
        return Ok(());
    }
    Err(CommandError::new(
        ErrorCode::Node,
        "the node has confirmed the factory reset, but has not restarted without keys; check it with \
         `host-sim node ENDPOINT`, and power-cycle it",
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_status_tells_of_the_keys() {
        let mut session = Session {
            agent: 2,
            epoch: Some(7),
            counter: 0,
            proof: 1,
            network_keys: [Some(4), Some(3)],
        };
        let line = "  provisioned as agent 2, boot epoch 7, network key 4, also accepts 3\n";
        assert_eq!(text(Some(&session)), line);
        let report = KeysReport::new(Some(&session));
        assert_eq!((report.agent, report.network_keys), (Some(2), vec![4, 3]));
        (session.epoch, session.network_keys) = (None, [None; 2]);
        let line = text(Some(&session));
        assert!(line.contains("no boot epoch") && line.ends_with("no network key\n"), "{line}");
        assert_eq!(text(None), "  not provisioned\n");
        assert!(!KeysReport::new(None).provisioned);
    }
}
