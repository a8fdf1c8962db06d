//! Errors of requests.

use agent_core::AgentId;
use agent_core::service::{PROTOCOL_VERSION, Problem};

use crate::service::LineError;
use crate::service::hint::of_refusal;

/// Why a request failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ServiceError {
    /// The line failed.
    #[error("{0}{hint}", hint = line_hint(.0))]
    Line(#[from] LineError),
    /// The received bytes are not messages.
    #[error(
        "no readable answer: received {bytes} bytes with {damaged} damaged and {intact} intact \
         messages; {hint}"
    )]
    Garbage {
        /// Number of received bytes.
        bytes: u64,
        /// Number of damaged messages.
        damaged: u64,
        /// Number of intact messages.
        intact: u64,
        /// What to do.
        hint: String,
    },
    /// The node uses a different version of the protocol.
    #[error(
        "the node's firmware uses protocol version {found}, but this program uses version \
         {PROTOCOL_VERSION}; build both from the same source"
    )]
    Protocol {
        /// Its version.
        found: u8,
    },
    /// The node refused the request.
    #[error("refused by the node: {0}; {hint}", hint = of_refusal(*.0))]
    Refused(Problem),
    /// An unknown message.
    #[error(
        "received an unrecognised message: {0}; build firmware and host-sim from the same source"
    )]
    Unrecognised(String),
    /// An unexpected message.
    #[error(
        "received {found} instead of {expected}; check that no other program is using the node, and try again"
    )]
    Unexpected {
        /// The message received.
        found: String,
        /// The message expected.
        expected: &'static str,
    },
    /// The node does not have the port key that the operator expects.
    #[error(
        "the node says that it is agent {agent}, but its proof does not match the key folder: it was \
         provisioned from another folder, or is not the node it claims to be; pass its folder with \
         `--keys FOLDER`"
    )]
    Proof {
        /// The agent it claims to be.
        agent: AgentId,
    },
    /// The node accepts no sealed requests.
    #[error(
        "the node cannot record a boot epoch in its flash, so it accepts no sealed requests; power-cycle it, \
         and replace the board if that does not help"
    )]
    NoEpoch,
    /// The request is only sent to a provisioned node.
    #[error("the node is not provisioned; {hint}", hint = of_refusal(Problem::NotProvisioned))]
    NotProvisioned,
    /// Every counter of the node's epoch has been used.
    #[error("the node's counter of sealed requests is exhausted; power-cycle it, and try again")]
    CounterUsedUp,
    /// The operating system provides no random numbers.
    #[error(
        "no random numbers from the operating system: {0}; send the request from another machine"
    )]
    Random(#[source] getrandom::Error),
}

fn line_hint(error: &LineError) -> &'static str {
    match error {
        LineError::Interrupted => "",
        LineError::Silent => {
            "; check that the board is running and that no other program is using it, and try again"
        }
        LineError::Closed => {
            "; check that the board or its co-simulation is still running; if the co-simulation has \
             reported that the node stopped, restart it with `host-sim node ENDPOINT reset`"
        }
        LineError::System(_) => "; reconnect the board, and try again",
    }
}
