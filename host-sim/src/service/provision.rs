//! Gives a node its keys, or takes them away.

use std::time::{Duration, Instant};

use agent_core::AgentId;
use agent_core::service::{Problem, Provision, Request, Session};
use agent_core::wire::authentic::NetworkKey;

use super::push::done;
use super::{Client, LineError, Message, RetryPolicy, ServiceError};
use crate::keys::FleetKeys;
use crate::signing::OperatorKey;

/// How long a node may take to forget its keys and restart: it erases its flash.
const FACTORY_RESET_MAX: Duration = Duration::from_secs(15);

/// Interval at which the node is asked whether it is ready again.
const POLL_INTERVAL: Duration = Duration::from_millis(200);

/// Requests a node's session; `None` if it is not provisioned, or if its firmware does not know keys.
///
/// # Errors
/// See [`ServiceError`].
pub fn session(
    client: &mut Client,
    retry_policy: RetryPolicy,
) -> Result<Option<Session>, ServiceError> {
    let session =
        client.request(&Request::Session, retry_policy, &mut |_| {}, "a session", |m| match m {
            Message::Session(session) => Some(*session),
            _ => None,
        });
    match session {
        Err(ServiceError::Refused(Problem::Unknown)) => Ok(None),
        session => session,
    }
}

/// What nodes are given.
#[derive(Clone, Copy, Debug)]
pub struct NewKeys<'k> {
    /// The keys.
    pub fleet: &'k FleetKeys,
    /// Signs a node's first keys, which is needed if its firmware accepts only signed packages.
    pub operator: Option<&'k OperatorKey>,
    /// The least epoch from now on: [`crate::keys::epoch_now`].
    pub epoch: u32,
}

/// Gives a node the port key of `agent`, and the network keys. The client must have the port keys. A
/// node that is not provisioned gets its port key in the clear.
///
/// # Errors
/// See [`ServiceError`].
pub fn provision(
    client: &mut Client,
    keys: &NewKeys<'_>,
    agent: AgentId,
    retry_policy: RetryPolicy,
) -> Result<(), ServiceError> {
    let &NewKeys { fleet, operator, epoch } = keys;
    let provision = Provision { agent, port_key: fleet.port_secret(agent), epoch };
    let mut bytes = provision.to_bytes().to_vec();
    if let Some(operator) = operator {
        bytes.extend(operator.sign(&provision.signed_bytes()));
    }
    let request = Request::Provision { bytes: &bytes };
    client.request(&request, retry_policy, &mut |_| {}, "a confirmation", done)?;
    // The port key is another one from now on.
    client.forget_session();
    network_keys(client, &fleet.network_keys(), retry_policy)
}

/// Gives a node network keys in place of the previous ones.
///
/// # Errors
/// See [`ServiceError`].
pub fn network_keys(
    client: &mut Client,
    keys: &[NetworkKey],
    retry_policy: RetryPolicy,
) -> Result<(), ServiceError> {
    let bytes = &keys.iter().flat_map(NetworkKey::to_bytes).collect::<Vec<_>>();
    let request = Request::NetworkKeys { bytes };
    client.request(&request, retry_policy, &mut |_| {}, "a confirmation", done)
}

/// Makes a node accept packages signed with other keys of the operator: see
/// [`crate::keys::Operators::for_nodes`]. Only for a node that accepts only signed packages.
///
/// # Errors
/// See [`ServiceError`].
pub fn operator_keys(
    client: &mut Client,
    bytes: &[u8],
    retry_policy: RetryPolicy,
) -> Result<(), ServiceError> {
    let request = Request::OperatorKeys { bytes };
    client.request(&request, retry_policy, &mut |_| {}, "a confirmation", done)
}

/// Makes a node forget its keys, and waits until it has restarted. Returns whether it has.
///
/// # Errors
/// See [`ServiceError`].
pub fn factory_reset(client: &mut Client, retry_policy: RetryPolicy) -> Result<bool, ServiceError> {
    let start = Instant::now();
    client.ask(&Request::FactoryReset, FACTORY_RESET_MAX, &mut |_| {}, "a confirmation", done)?;
    client.expect_reset();
    while start.elapsed() < FACTORY_RESET_MAX {
        std::thread::sleep(POLL_INTERVAL);
        client.prepare_delimiter();
        match session(client, RetryPolicy { tries: 1, ..retry_policy }) {
            Ok(None) => return Ok(true),
            // Still busy, or restarting in the middle of a message.
            Ok(Some(_))
            | Err(
                ServiceError::Line(LineError::Silent)
                | ServiceError::Garbage { .. }
                | ServiceError::Unrecognised(_),
            ) => {}
            Err(error) => return Err(error),
        }
    }
    Ok(false)
}
