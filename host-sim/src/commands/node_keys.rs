//! A node's keys: giving and taking them, and what a status tells of them.

use agent_core::AgentId;
use agent_core::service::Session;
use serde::Serialize;

use super::connection::RETRY_POLICY;
use super::key::Passphrase;
use super::{CommandError, ErrorCode};
use crate::keys::{KeyFolder, epoch_now};
use crate::service::Client;
use crate::service::provision::{self, NewKeys};
use crate::terminal;

/// What a node tells of its keys, for JSON.
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
        Some(epoch) => format!("epoch {epoch}"),
        None => "no epoch: its flash cannot record one".to_owned(),
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
    let operator = keys.operator(&mut |path| passphrase.ask(path))?;
    if provision::session(node, RETRY_POLICY)?.is_none() {
        terminal::note(format_args!(
            "the node is not provisioned, so its port key crosses the line in the clear"
        ));
    }
    // A node never goes back to an epoch that is over; the clock is above all epochs of a node whose
    // flash has been lost.
    let epoch = epoch_now();
    let keys = NewKeys { fleet: keys.fleet(), operator: Some(&operator), epoch };
    Ok(provision::provision(node, &keys, agent, RETRY_POLICY)?)
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
        let line = "  provisioned as agent 2, epoch 7, network key 4, also accepts 3\n";
        assert_eq!(text(Some(&session)), line);
        let report = KeysReport::new(Some(&session));
        assert_eq!((report.agent, report.network_keys), (Some(2), vec![4, 3]));
        (session.epoch, session.network_keys) = (None, [None; 2]);
        let line = text(Some(&session));
        assert!(line.contains("no epoch") && line.ends_with("no network key\n"), "{line}");
        assert_eq!(text(None), "  not provisioned\n");
        assert!(!KeysReport::new(None).provisioned);
    }
}
