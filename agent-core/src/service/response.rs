//! What a node says.

use serde::{Deserialize, Serialize, Serializer};

use super::{Problem, RefusalReport, Upload};
use crate::agent::StepError;
use crate::health::{BoardErrors, HealthCounters, WatchedStep};
use crate::store::Slot;
use crate::{AgentId, StateVector, Tick};

/// What a node says. `V` holds numbers: [`Rows`] on the node, a vector on the host.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum Response<'a, V> {
    /// Answers a query.
    Status(Status),
    /// The node has just begun, and this is how it found itself. Nobody asked.
    Hello(Status),
    /// How much of an upload there is.
    Upload(Upload),
    /// The package has been verified and waits for its activation.
    Staged {
        /// Its version.
        version: u32,
    },
    /// Which package is in use from the next step on.
    InUse {
        /// Its version; `None` if it is none.
        version: Option<u32>,
    },
    /// What was asked for has been done.
    Done,
    /// What was asked for has not been done, and nothing has changed.
    Refused(Problem),
    /// A sample for training.
    Sample {
        /// When it was taken.
        tick: Tick,
        /// `x_hat`, shape `[n]`.
        estimate: V,
        /// `d/dt x_hat`, shape `[n]`. \[state unit/s\]
        derivative: V,
    },
    /// There are no more samples to this request.
    SamplesEnd {
        /// Where the next request goes on.
        next: Tick,
    },
    /// What the last step did. Nobody asked, but somebody has subscribed.
    State(State<V>),
    /// What has been noticed so far. Nobody asked.
    Health {
        /// When.
        tick: Tick,
        /// How often what happened.
        counters: HealthCounters,
    },
    /// Something that happens once. Nobody asked.
    Event(Event),
    /// What the node has broadcast to its neighbours; only a node in the loop says so.
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
}

impl<V> Response<'_, V> {
    /// Whether this answers a request, or is a part of the answer.
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
            | Self::SamplesEnd { .. } => true,
            Self::Hello(_)
            | Self::State(_)
            | Self::Health { .. }
            | Self::Event(_)
            | Self::Broadcast { .. }
            | Self::BoardErrors { .. } => false,
        }
    }
}

/// Something that happens once.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Event {
    /// The package on trial has proved itself, and the store knows.
    Confirmed {
        /// From which tick on.
        tick: Tick,
        /// Its version.
        version: u32,
    },
    /// Something on the board does not work, and the node goes on without it. Told after every greeting
    /// and before every status.
    BoardFault(BoardFault),
}

/// What may not work on a board whose node works.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum BoardFault {
    /// The crystal or the PLL did not start: the chip runs from its internal oscillator, slower and
    /// less accurately, and its sampling periods are as inaccurate.
    Clock,
}

/// An agent's state after the step at a tick.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct State<V> {
    /// The tick `k` of the step.
    pub tick: Tick,
    /// What came of it.
    pub outcome: Outcome,
    /// `x_hat(t_(k+1))`, shape `[n]`; empty if the node has no package.
    pub estimate: V,
    /// `d/dt x_hat(t_k)`, shape `[n]`; empty if no step was taken. \[state unit/s\]
    pub derivative: V,
    /// `W_hat(t_(k+1))`, row by row, shape `[L, n]`; empty if nobody subscribed to it.
    pub outer_weights: V,
}

/// What came of an attempt at a step.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Outcome {
    /// The step was taken.
    Stepped,
    /// The agent was lost and has begun anew.
    Restarted,
    /// There is no package, and so no agent.
    NoPackage,
    /// The sensor did not deliver.
    NoMeasurement,
    /// The measurement had another number of components than the agent measures.
    MeasurementLength,
    /// A measurement was infinite or not a number.
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

/// Who a node is, and how it is.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Status {
    /// [`PROTOCOL_VERSION`](super::PROTOCOL_VERSION) of the node. Always the first field.
    pub protocol: u8,
    /// What was compiled into the node.
    pub firmware: Firmware,
    /// The tick of the next step, if none is skipped.
    pub tick: Tick,
    /// The package in use; without one a node observes nothing, or is the agent that is built into
    /// its firmware.
    pub package: Option<PackageStatus>,
    /// Whether a package waits for its activation.
    pub staged: bool,
    /// The unfinished upload.
    pub upload: Option<Upload>,
    /// Why the packages in slot A and slot B were refused when the node began, if they were.
    pub refused_at_start: [Option<RefusalReport>; 2],
    /// Bytes of the stack that have never been used, if the board can tell.
    pub stack_unused: Option<u32>,
    /// Samples that are kept for training.
    pub samples: u32,
    /// Messages that arrived damaged.
    pub messages_damaged: u32,
    /// Times that the sensor did not deliver.
    pub measurements_missing: u32,
    /// Frames that could not be handed to the link.
    pub broadcasts_lost: u32,
    /// What else has been noticed.
    pub health: HealthCounters,
}

/// What was compiled into a node.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Firmware {
    /// Major, minor and patch version.
    pub version: [u8; 3],
    /// `n`, components of the state.
    pub dimension: u8,
    /// Most features `L` that there is room for.
    pub features: u8,
    /// Most neighbours that there is room for.
    pub neighbours: u8,
    /// Whether packages have to be signed.
    pub signed_only: bool,
    /// A sample in so many ticks is kept for training.
    pub sample_stride: u32,
}

/// The package in use.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PackageStatus {
    /// The agent that the node is.
    pub agent: AgentId,
    /// The package's version.
    pub version: u32,
    /// CRC-32 of its bytes, by which a file can be recognised.
    pub checksum: u32,
    /// `dt`, which makes times of ticks. \[s\]
    pub step_size: f32,
    /// Where it lies.
    pub slot: Slot,
    /// If it is on trial, how many good steps in a row it has taken and how many it takes.
    pub trial: Option<(u32, u32)>,
    /// Whether the network is in use; it is left out while it has fallen back.
    pub network_in_use: bool,
}

/// Vectors of the state space that are sent as one sequence of numbers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rows<'a, const N: usize>(pub &'a [StateVector<N>]);

impl<'a, const N: usize> Rows<'a, N> {
    /// One vector.
    #[must_use]
    pub fn one(vector: &'a StateVector<N>) -> Self {
        Self(core::slice::from_ref(vector))
    }
}

impl<const N: usize> Serialize for Rows<'_, N> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        use serde::ser::SerializeSeq;
        let mut sequence = serializer.serialize_seq(Some(self.0.len().saturating_mul(N)))?;
        for number in self.0.iter().flatten() {
            sequence.serialize_element(number)?;
        }
        sequence.end()
    }
}
