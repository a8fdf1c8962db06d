//! Errors of [`AgentState::step`](crate::AgentState::step).

use crate::Tick;

/// Why a step was refused.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum StepError {
    /// The tick does not advance, or is the last one.
    Tick {
        /// The tick of the last step; `None` if there was none.
        last: Option<Tick>,
        /// The tick given.
        found: Tick,
    },
    /// The measurement has the wrong length.
    Outputs {
        /// Rows of the output matrix.
        expected: usize,
        /// Length of the measurement.
        found: usize,
    },
    /// A measurement is infinite or not a number.
    MeasurementNotFinite {
        /// Index of the output, from 0.
        output: usize,
    },
    /// The state or the inbox has slots for a different number of neighbours.
    Neighbours {
        /// Neighbours in the parameters.
        expected: usize,
        /// Slots in the state or the inbox.
        found: usize,
    },
    /// The network's number of features differs from the rows of the outer weights.
    Features {
        /// Rows of the outer weights.
        expected: usize,
        /// Width of the network's last inner layer.
        found: usize,
    },
    /// The network's input dimension differs from the state dimension.
    NetworkInputs {
        /// The state dimension.
        expected: usize,
        /// Inputs of the network.
        found: usize,
    },
    /// The estimate or the outer weights would become infinite or NaN.
    ///
    /// The next plausible measurement resolves this, unless the cause is a frame with a huge
    /// estimate: in that case clear the inbox, or the frame is tried again.
    Diverged,
}

impl core::fmt::Display for StepError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match *self {
            Self::Tick { last: Some(last), found } => {
                write!(f, "step {found} is not after the last step, {last}")
            }
            Self::Tick { last: None, found } => {
                write!(f, "step {found} is the last possible step")
            }
            Self::Outputs { expected, found } => {
                write!(f, "the measurement has {found} values, expected {expected}")
            }
            Self::MeasurementNotFinite { output } => {
                write!(f, "the measurement of output {output} is not finite")
            }
            Self::Neighbours { expected, found } => {
                write!(
                    f,
                    "the state or inbox has slots for {found} neighbours, expected {expected}"
                )
            }
            Self::Features { expected, found } => {
                write!(f, "the network has {found} features, expected {expected}")
            }
            Self::NetworkInputs { expected, found } => {
                write!(f, "the network has {found} inputs, expected {expected}")
            }
            Self::Diverged => write!(f, "the estimate or the outer weights would overflow"),
        }
    }
}

impl core::error::Error for StepError {}
