//! Failures of a node in the loop.

use agent_core::service::{PROTOCOL_VERSION, Problem};

/// A failed node, which ends the co-simulation.
#[derive(Debug, thiserror::Error)]
#[error("agent {agent} ({board}): {fault}")]
pub struct NodeError {
    /// The agent, from 1.
    pub agent: usize,
    /// What the node runs on.
    pub board: String,
    /// The failure.
    #[source]
    pub fault: Fault,
}

/// A node's failure.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Fault {
    /// The node does not reply.
    #[error(
        "no {expected} within {seconds} s{}; {}",
        if *damaged > 0 { format!(", only {damaged} unreadable messages") } else { String::new() },
        if *damaged > 0 {
            "check that firmware and host-sim have the same version, and the baud rate of a serial line \
             (serial:PATH@BAUD)"
        } else {
            "if the node is slow, raise --timeout; otherwise check that the firmware is for this board \
             and runs on its own"
        }
    )]
    Silent {
        /// The expected message.
        expected: &'static str,
        /// The timeout. \[s\]
        seconds: f64,
        /// Number of unreadable messages.
        damaged: u64,
    },
    /// The node's process has exited.
    #[error("the process has exited ({status}){}", quoted(.output))]
    Ended {
        /// Its exit status.
        status: String,
        /// The end of its console output.
        output: String,
    },
    /// The connection was closed.
    #[error("the connection was closed by the other end; check that the board is still running")]
    Closed,
    /// The node sends more messages than any node should.
    #[error(
        "received {messages} messages instead of an answer; check that the firmware is for this board, \
         and reset it"
    )]
    Flood {
        /// Number of messages.
        messages: usize,
    },
    /// An unknown message.
    #[error(
        "received an unrecognised message: {0}; build firmware and host-sim from the same source"
    )]
    Unrecognised(String),
    /// An unexpected message.
    #[error(
        "received {found} instead of {expected}; check that no other program is using the node and that \
         it does not reset by itself"
    )]
    Unexpected {
        /// The message received.
        found: String,
        /// The message expected.
        expected: &'static str,
    },
    /// The node refused a request.
    #[error("the node refused to {request}: {problem}; {}", hint(*problem))]
    Refused {
        /// The request.
        request: &'static str,
        /// The reason.
        problem: Problem,
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
    /// The firmware's capacity is too small for the agent.
    #[error(
        "the agent has {needed} {what}, but the firmware has room for {room}; run a scenario that fits, \
         or build the firmware with larger capacities"
    )]
    Capacity {
        /// The limited quantity.
        what: &'static str,
        /// The agent's number.
        needed: usize,
        /// The firmware's capacity.
        room: usize,
    },
    /// The firmware accepts only signed packages.
    #[error(
        "the firmware accepts only signed packages, but the packages of this co-simulation are unsigned; build \
         it without a public key"
    )]
    SignedOnly,
    /// The node does not run the package written to its flash.
    #[error(
        "the node does not use the package written to its flash{}; build the firmware with the memory \
         map used here (--memory)",
        refusal.as_ref().map_or(String::new(), |refusal| format!(" ({refusal})"))
    )]
    Package {
        /// The reason, if reported.
        refusal: Option<String>,
    },
    /// The node cannot be started.
    #[error("{0}")]
    Start(String),
    /// A stop was requested.
    #[error("interrupted")]
    Interrupted,
    /// The system reported an error.
    #[error("{0}; reconnect the board and try again")]
    System(std::io::Error),
}

fn quoted(text: &str) -> String {
    if text.is_empty() {
        "; find out why it exited, and try again".to_owned()
    } else {
        format!(
            " with the output:\n{text}\n; fix the cause, or use firmware that runs on this board"
        )
    }
}

fn hint(problem: Problem) -> &'static str {
    match problem {
        Problem::NotInTheLoop => {
            "use firmware built for the loop, such as what `cargo xtask firmware` builds for the emulated board"
        }
        Problem::Package(_) | Problem::Store(_) | Problem::NoPackage => {
            "erase the board's weights, or flash it with a package of this scenario"
        }
        _ => "build firmware and host-sim from the same source",
    }
}
