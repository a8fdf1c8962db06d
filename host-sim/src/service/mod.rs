//! Talking to a running node over its service port.
//!
//! | module | purpose |
//! | --- | --- |
//! | [`mod@line`] | bytes to and from a node, with a deadline for everything |
//! | [`address`] | where a node is found: a socket or a serial line |
//! | [`hint`] | what to do about refusals and garbage |
//! | [`client`] | messages on a line: requests, their answers, and what comes unasked |
//! | [`nodes_file`] | what the nodes in a folder of sockets are part of |
//! | [`push`] | a weight package into a node |
//! | [`record`], [`record_file`] | a node's samples, for training, and the file that they are written into |
//!
//! The messages are agent-core's: [`agent_core::service`].

pub mod address;
pub mod client;
pub mod hint;
pub mod line;
pub mod nodes_file;
pub mod push;
pub mod record;
pub mod record_file;

pub use address::Address;
pub use client::{Client, RetryPolicy, ServiceError};
pub use line::{Line, LineError};

use agent_core::service::Response;

/// What a node says, with its numbers in vectors.
pub type Message<'a> = Response<'a, Vec<f32>>;
