//! Communicates with a running node over its service port.
//!
//! | module | purpose |
//! | --- | --- |
//! | [`mod@line`] | byte connection to a node, with timeouts |
//! | [`address`] | addresses of nodes: sockets and serial lines |
//! | [`hint`] | hints for refusals and unreadable input |
//! | [`client`] | requests, answers and unsolicited messages |
//! | [`provision`] | gives a node its keys, or takes them away |
//! | [`nodes_file`] | describes the nodes in a folder of sockets |
//! | [`push`] | sends a weight package to a node |
//! | [`record`], [`record_file`] | records a node's samples for training |
//!
//! The messages are agent-core's: [`agent_core::service`].

pub mod address;
pub mod client;
pub mod hint;
pub mod line;
pub mod nodes_file;
pub mod provision;
pub mod push;
pub mod record;
pub mod record_file;

pub use address::Address;
pub use client::{Client, RetryPolicy, ServiceError};
pub use line::{Line, LineError};

use agent_core::service::Response;

/// A message from a node, with owned vectors.
pub type Message<'a> = Response<'a, Vec<f32>>;
