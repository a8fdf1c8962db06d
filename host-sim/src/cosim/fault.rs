//! What can go wrong with a node in the loop.

use agent_core::service::{PROTOCOL_VERSION, Problem};

/// A node that cannot go on, and so a co-simulation that cannot.
#[derive(Debug, thiserror::Error)]
#[error("agent {agent} ({board}): {fault}")]
pub struct NodeError {
    /// The agent, from 1.
    pub agent: usize,
    /// What the node runs on.
    pub board: String,
    /// What is wrong.
    #[source]
    pub fault: Fault,
}

/// What is wrong with a node.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Fault {
    /// It says nothing.
    #[error(
        "no {expected} within {seconds} s{}; {}",
        if *damaged > 0 { format!(", only {damaged} messages that cannot be read") } else { String::new() },
        if *damaged > 0 {
            "see that firmware and host-sim are of the same version, and that the speed of a serial \
             line is right (serial:PATH@BAUD)"
        } else {
            "if it is only slow, allow more with --timeout; otherwise see that the firmware is for \
             this board and works on its own"
        }
    )]
    Silent {
        /// What was waited for.
        expected: &'static str,
        /// How long. \[s\]
        seconds: f64,
        /// Messages that came and could not be read.
        damaged: u64,
    },
    /// Its process has ended.
    #[error("its process has ended ({status}){}", quoted(.said))]
    Ended {
        /// How.
        status: String,
        /// The end of what it has written to its console.
        said: String,
    },
    /// The line to it is closed.
    #[error("the connection is closed at the other end; see what has become of the board")]
    Closed,
    /// It says more than any node has to say.
    #[error(
        "it has sent {messages} messages in place of an answer; see that its firmware is for this board, \
         and reset it"
    )]
    Flood {
        /// How many messages.
        messages: usize,
    },
    /// What it sends is no message.
    #[error(
        "it sends an unrecognised message: {0}; build firmware and host-sim from the same source"
    )]
    Nonsense(String),
    /// What it sends does not belong here.
    #[error(
        "it sends {found}, where {expected} is expected; check that no other program uses it and that \
         it does not reset on its own"
    )]
    Unexpected {
        /// What came.
        found: String,
        /// What should have.
        expected: &'static str,
    },
    /// It does not do what it is asked.
    #[error("it refuses to {request}: {problem}; {}", hint(*problem))]
    Refused {
        /// What it was asked.
        request: &'static str,
        /// Why.
        problem: Problem,
    },
    /// It speaks another version of the protocol.
    #[error(
        "its firmware speaks version {found} of the protocol, this program version \
         {PROTOCOL_VERSION}; build both from the same source"
    )]
    Protocol {
        /// Its version.
        found: u8,
    },
    /// Its firmware has no room for the agent.
    #[error(
        "the agent has {needed} {what}, the firmware has room for {room}; run a scenario that fits, \
         or build the firmware with other capacities"
    )]
    Capacity {
        /// Of what.
        what: &'static str,
        /// How many there are.
        needed: usize,
        /// How many fit.
        room: usize,
    },
    /// Its firmware takes only signed packages.
    #[error(
        "its firmware takes signed packages only, and those of a co-simulation are not; build it \
         without a public key"
    )]
    SignedOnly,
    /// It does not run the package that its flash was written with.
    #[error(
        "it does not use the package that was written into its flash{}; build the firmware with \
         the memory map that co-simulation uses (--memory)",
        refusal.as_ref().map_or(String::new(), |refusal| format!(" ({refusal})"))
    )]
    Package {
        /// Why, if it says so.
        refusal: Option<String>,
    },
    /// It cannot be started.
    #[error("{0}")]
    Start(String),
    /// Somebody asked for the end.
    #[error("interrupted")]
    Interrupted,
    /// The system reported an error.
    #[error("{0}; reconnect the board and start again")]
    System(std::io::Error),
}

fn quoted(text: &str) -> String {
    if text.is_empty() {
        "; see what has ended it, and start again".to_owned()
    } else {
        format!(" and says:\n{text}\n; fix that, or give a firmware that runs on this board")
    }
}

fn hint(problem: Problem) -> &'static str {
    match problem {
        Problem::NotInTheLoop => {
            "use firmware that is built for the loop, as `cargo xtask firmware` does for the \
             emulated board"
        }
        Problem::Package(_) | Problem::Store(_) | Problem::NoPackage => {
            "erase the board's weights, or flash it with a package of this scenario"
        }
        _ => "build firmware and host-sim from the same source",
    }
}
