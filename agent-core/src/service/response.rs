//! Responses of a node.

use serde::{Deserialize, Serialize};

use super::{Problem, RefusalReport, Report, Upload};
use crate::agent::StepError;
use crate::health::{BoardErrors, HealthCounters, RevertReason, WatchedStep};
use crate::store::Slot;
use crate::{AgentId, StateVector, Tick};

/// A response of a node. `V` holds numbers: a slice on the node, a vector on the host.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Response<'a, V> {
    /// Answers a query.
    Status(Status),
    /// The node has just started, with this status. Unsolicited.
    Hello(Status),
    /// Progress of an upload.
    Upload(Upload),
    /// The package has been verified and can be activated.
    Staged {
        /// Version of the package.
        version: u32,
    },
    /// The package in use from the next step on.
    InUse {
        /// Version of the package; `None` if none is in use.
        version: Option<u32>,
    },
    /// The request has been carried out.
    Done,
    /// The request was refused; nothing has changed.
    Refused(Problem),
    /// A sample for training.
    Sample {
        /// Tick at which it was taken.
        tick: Tick,
        /// `x_hat`, shape `[n]`.
        estimate: V,
        /// `d/dt x_hat`, shape `[n]`. \[state unit/s\]
        derivative: V,
    },
    /// The end of the samples for this request.
    SamplesEnd {
        /// Tick from which the next request continues.
        next: Tick,
    },
    /// Result of the last step. Unsolicited, by subscription.
    State(State<V>),
    /// The health counters. Unsolicited.
    Health {
        /// Tick of the report.
        tick: Tick,
        /// The counters.
        counters: HealthCounters,
    },
    /// A single event. Unsolicited.
    Event(Event),
    /// A frame broadcast to the neighbours; only from a node in the loop.
    Broadcast {
        /// The frame.
        bytes: &'a [u8],
    },
    /// What sensor and link have reported so far: before a status if anything has failed, and
    /// otherwise, like the health, at most once in an interval and only if it has changed.
    BoardErrors {
        /// When.
        tick: Tick,
        /// How often what failed.
        counters: BoardErrors,
    },
    /// Answers a request for a report.
    Report(Report),
    /// The head of a part of the answer to a numbered request: that part follows.
    Answer {
        /// The number of the request.
        number: u16,
    },
    /// Answers a request for the session; `None` from a node without a port key.
    Session(Option<Session>),
}

/// What a laptop must know to seal requests to a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Session {
    /// The agent that the node was provisioned as.
    pub agent: AgentId,
    /// The epoch, which changes with every boot; `None` if the node cannot record one, and so accepts
    /// no sealed request.
    pub epoch: Option<u32>,
    /// Counter of the last sealed request in this epoch, 0 before the first one.
    pub counter: u32,
    /// Proof that the node has the port key, over all of this.
    pub proof: u64,
    /// Numbers of the network keys, the one for sending first.
    pub network_keys: [Option<u8>; 2],
}

impl<V> Response<'_, V> {
    /// Returns whether this answers a request, fully or in part.
    #[must_use]
    pub fn is_answer(&self) -> bool {
        match self {
            Self::Status(_)
            | Self::Upload(_)
            | Self::Staged { .. }
            | Self::InUse { .. }
            | Self::Done
            | Self::Refused(_)
            | Self::Sample { .. }
            | Self::SamplesEnd { .. }
            | Self::Report(_)
            | Self::Session(_)
            | Self::Answer { .. } => true,
            Self::Hello(_)
            | Self::State(_)
            | Self::Health { .. }
            | Self::Event(_)
            | Self::Broadcast { .. }
            | Self::BoardErrors { .. } => false,
        }
    }
}

/// A single event.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Event {
    /// The package on trial has been confirmed in the store.
    Confirmed {
        /// First tick of the confirmed package.
        tick: Tick,
        /// Version of the package.
        version: u32,
    },
    /// Something on the board does not work, and the node carries on without it. Sent after every greeting
    /// and before every status.
    BoardFault(BoardFault),
    /// The trial of a package has failed, and what was in use before is in use again from the next
    /// step on.
    Reverted {
        /// Last tick of the package.
        tick: Tick,
        /// Version of the package.
        version: u32,
        /// Why.
        reason: RevertReason,
    },
}

/// Faults of a board whose node still works.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum BoardFault {
    /// The crystal or the PLL did not start: the chip runs from its internal oscillator, slower and
    /// less accurate, and so are its sampling periods.
    Clock,
}

/// An agent's state after the step at a tick.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct State<V> {
    /// The tick `k` of the step.
    pub tick: Tick,
    /// Outcome of the step.
    pub outcome: Outcome,
    /// `x_hat(t_(k+1))`, shape `[n]`; empty if the node has no package.
    pub estimate: V,
    /// `d/dt x_hat(t_k)`, shape `[n]`; empty if no step was taken. \[state unit/s\]
    pub derivative: V,
    /// `W_hat(t_(k+1))`, row by row, shape `[L, n]`; empty unless subscribed.
    pub outer_weights: V,
}

/// Outcome of an attempted step.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Outcome {
    /// The step was taken.
    Stepped,
    /// The estimate was unusable and the agent has been restarted.
    Restarted,
    /// No package is in use, so there is no agent.
    NoPackage,
    /// The sensor delivered no measurement: the step was taken without one, and is not a sample for
    /// training.
    NoMeasurement,
    /// The measurement has the wrong number of components.
    MeasurementLength,
    /// A measurement was infinite or not a number; a node takes the step without it.
    MeasurementNotFinite,
    /// A result would not have been finite.
    Diverged,
    /// Any other reason.
    Refused,
}

impl From<&StepError> for Outcome {
    fn from(error: &StepError) -> Self {
        match error {
            StepError::Outputs { .. } => Self::MeasurementLength,
            StepError::MeasurementNotFinite { .. } => Self::MeasurementNotFinite,
            StepError::Diverged => Self::Diverged,
            _ => Self::Refused,
        }
    }
}

impl<const N: usize> From<&WatchedStep<N>> for Outcome {
    fn from(step: &WatchedStep<N>) -> Self {
        match step {
            WatchedStep::Taken(_) => Self::Stepped,
            WatchedStep::Refused(error) => Self::from(error),
            WatchedStep::Restarted(_) => Self::Restarted,
        }
    }
}

/// Identity and status of a node.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Status {
    /// [`PROTOCOL_VERSION`](super::PROTOCOL_VERSION) of the node. Always the first field.
    pub protocol: u8,
    /// Properties of the firmware.
    pub firmware: Firmware,
    /// The tick of the next step, if none is skipped.
    pub tick: Tick,
    /// The package in use; without one a node is idle, or runs the agent built into its firmware.
    pub package: Option<PackageStatus>,
    /// Whether a staged package can be activated.
    pub staged: bool,
    /// The unfinished upload.
    pub upload: Option<Upload>,
    /// Why the packages in slot A and slot B were refused when the node started, if they were.
    pub refused_at_start: [Option<RefusalReport>; 2],
    /// Bytes of the stack that have never been used, if the board can tell.
    pub stack_unused: Option<u32>,
    /// Number of samples kept for training.
    pub samples: u32,
    /// Number of messages that arrived damaged.
    pub messages_damaged: u32,
    /// Number of missing measurements.
    pub measurements_missing: u32,
    /// Number of frames that the link did not accept.
    pub broadcasts_lost: u32,
    /// The health counters.
    pub health: HealthCounters,
}

/// Properties of a node's firmware.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Firmware {
    /// Major, minor and patch version.
    pub version: [u8; 3],
    /// `n`, the state dimension.
    pub dimension: u8,
    /// Largest number of features `L`.
    pub features: u8,
    /// Largest number of neighbours.
    pub neighbours: u8,
    /// Whether packages must be signed.
    pub signed_only: bool,
    /// Interval between samples kept for training. \[ticks\]
    pub sample_stride: u32,
}

/// The package in use.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PackageStatus {
    /// The agent that the node is.
    pub agent: AgentId,
    /// Version of the package.
    pub version: u32,
    /// CRC-32 of its bytes, to match it with a file.
    pub checksum: u32,
    /// `dt`, the length of a tick. \[s\]
    pub step_size: f32,
    /// Slot of the package.
    pub slot: Slot,
    /// During a trial: consecutive good steps so far, and the number needed.
    pub trial: Option<(u32, u32)>,
    /// Whether the network is in use; false during a fallback.
    pub network_in_use: bool,
}

/// Returns the numbers of `rows`, one row after the other.
#[must_use]
pub fn numbers<const N: usize>(rows: &[StateVector<N>]) -> &[f32] {
    // A vector of numbers has their size and alignment.
    bytemuck::try_cast_slice(rows).unwrap_or_default()
}
