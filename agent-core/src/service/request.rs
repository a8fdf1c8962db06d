//! Requests to a node.

use core::num::NonZeroU32;

use serde::{Deserialize, Serialize};

pub use crate::wire::frame::Numbers;
use crate::wire::secret::{SECRET_LENGTH, Secret};
use crate::{AgentId, Tick};

/// A request to a node.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Request<'a> {
    /// Report the node's identity and status.
    Query,
    /// Start the upload of a package of this length into the slot that is not in use.
    Begin {
        /// Length of the package. \[byte\]
        length: u32,
    },
    /// A part of the package.
    Chunk {
        /// Offset in the package. \[byte\]
        offset: u32,
        /// At most [`super::CHUNK_LENGTH_MAX`] bytes.
        bytes: &'a [u8],
    },
    /// The package is complete: verify it and keep it for activation.
    Stage,
    /// Use the staged package from the next step on, on trial.
    Activate,
    /// Confirm the package on trial.
    Confirm,
    /// End the trial: return to what was in use before, from the next step on.
    Revert,
    /// Restart as after power-on.
    Reset,
    /// Select the unsolicited reports.
    Subscribe(Subscription),
    /// Return the samples kept for training, oldest first.
    Samples {
        /// Skip samples before this tick.
        from: Tick,
        /// Largest number of samples; a node may send fewer. The answer tells where to continue.
        most: u8,
    },
    /// Continue from this estimate of the state, as if started with it.
    StartAt {
        /// `x_hat`, shape `[n]`.
        estimate: Numbers,
    },
    /// A frame has arrived from a neighbour. Only for a node in the loop; not answered.
    Frame {
        /// The frame as broadcast.
        bytes: &'a [u8],
    },
    /// Attempt a step. Only for a node in the loop; answered by the node's reports, the last being
    /// a [`State`](super::Response::State).
    Tick {
        /// Sampling periods since the previous request: 1, or more to simulate a late node.
        periods: u32,
        /// `y_i`, shape `[m]`; `None` to simulate a failed sensor.
        measurement: Option<Numbers>,
    },
    /// Report how the package in use performs, its trial, and what the board knows of its resets.
    Report,
    /// Discard the journal entries that cannot be read, so that updates can continue.
    ForgetUnreadable,
    /// The head of a numbered request: the request itself follows, and so does each part of its
    /// answer a [`Response::Answer`](super::Response::Answer) with this number.
    Numbered {
        /// The number.
        number: u16,
    },
    /// Report what a laptop must know to seal requests.
    Session,
    /// The head of a sealed request, after its number if it has one: see `service::seal`.
    Sealed(Seal),
    /// Give the node its port key and its agent. Not sealed if it has no port key yet; then the
    /// operator must have signed it if the firmware accepts only signed packages.
    Provision {
        /// A [`Provision`], encoded.
        bytes: &'a [u8],
    },
    /// Use these network keys in place of the previous ones; the sending key comes first. Must be sealed.
    NetworkKeys {
        /// One or two keys: for each, its number and its 16 bytes.
        bytes: &'a [u8],
    },
    /// Forget keys, agent and packages, but neither the epochs nor the highest package activated, and
    /// restart. Must be sealed.
    FactoryReset,
    /// Accept packages signed with these of the operator's keys. Must be sealed, and only for firmware
    /// with a public key.
    OperatorKeys {
        /// Nothing: only the public key built into the firmware is valid. Otherwise 1 if it is valid and
        /// 0 if not, and one more public key of 32 bytes.
        bytes: &'a [u8],
    },
}

impl Request<'_> {
    /// Returns whether a node with a port key carries out this request even if it is not sealed.
    #[must_use]
    pub fn is_free(&self) -> bool {
        matches!(self, Self::Query | Self::Report | Self::Session)
    }
}

/// What makes a sealed request unlike any other.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Seal {
    /// Greater than that of every sealed request before it in the node's epoch.
    pub counter: u32,
    /// Random: two laptops may choose the same counter for two requests of which one is lost.
    pub salt: [u8; 8],
}

/// A node's port key and agent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Provision {
    /// The agent: the node then refuses packages of all others.
    pub agent: AgentId,
    /// The port key.
    pub port_key: Secret,
    /// Least epoch from now on, from the operator's clock: above those of an earlier life whose flash
    /// has been lost.
    pub epoch: u32,
}

/// The label of what is signed for a provision.
const LABEL: [u8; 16] = *b"provision a node";

impl Provision {
    /// Length of its encoding. \[byte\]
    pub const LENGTH: usize = 4 + SECRET_LENGTH + 4;

    /// Returns its encoding: agent, port key, epoch, little-endian. The request has these bytes, and
    /// after them nothing or the operator's signature of [`Self::signed_bytes`].
    #[must_use]
    pub fn to_bytes(&self) -> [u8; Self::LENGTH] {
        let parts =
            [&self.agent.to_le_bytes()[..], &self.port_key.to_bytes(), &self.epoch.to_le_bytes()];
        let mut bytes = [0; Self::LENGTH];
        bytes.iter_mut().zip(parts.into_iter().flatten()).for_each(|(place, byte)| *place = *byte);
        bytes
    }

    /// Returns what the operator signs: a label, so that it cannot be taken for anything else that is
    /// signed with the same key, and the encoding.
    #[must_use]
    pub fn signed_bytes(&self) -> [u8; LABEL.len() + Self::LENGTH] {
        let mut bytes = [0; LABEL.len() + Self::LENGTH];
        let all = LABEL.into_iter().chain(self.to_bytes());
        bytes.iter_mut().zip(all).for_each(|(place, byte)| *place = byte);
        bytes
    }

    /// Decodes the bytes of a request; also returns what follows.
    #[must_use]
    pub fn split(bytes: &[u8]) -> Option<(Self, &[u8])> {
        let (agent, rest) = bytes.split_first_chunk()?;
        let (port_key, rest) = rest.split_first_chunk()?;
        let (epoch, signature) = rest.split_first_chunk()?;
        let provision = Self {
            agent: AgentId::from_le_bytes(*agent),
            port_key: Secret::new(*port_key),
            epoch: u32::from_le_bytes(*epoch),
        };
        Some((provision, signature))
    }
}

/// Unsolicited reports, in addition to events.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Subscription {
    /// Interval between reported states; `None` for none. \[ticks\]
    pub state_every: Option<NonZeroU32>,
    /// Whether states include the outer weights.
    pub outer_weights: bool,
}
