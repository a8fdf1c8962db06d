//! Why an agent does not take a step.

use crate::Tick;

/// Why a step was not taken.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum StepError {
    /// Time did not advance, or cannot any further.
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
    /// The state or the inbox was made for another number of neighbours.
    Neighbours {
        /// Neighbours in the parameters.
        expected: usize,
        /// Places in the state or the inbox.
        found: usize,
    },
    /// The network has another number of features than there are outer weights for.
    Features {
        /// Rows of the outer weights.
        expected: usize,
        /// Width of the network's last inner layer.
        found: usize,
    },
    /// The network takes another number of inputs than the state has components.
    NetworkInputs {
        /// The state dimension.
        expected: usize,
        /// Inputs of the network.
        found: usize,
    },
    /// The estimate or the outer weights would not be finite any more.
    ///
    /// A sane next measurement ends it, unless the culprit is a frame with a huge estimate:
    /// empty the inbox then, or the frame will be tried again.
    Diverged,
}

impl core::fmt::Display for StepError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match *self {
            Self::Tick { last: Some(last), found } => {
                write!(f, "step {found} does not come after the last one, {last}")
            }
            Self::Tick { last: None, found } => {
                write!(f, "step {found} has no successor")
            }
            Self::Outputs { expected, found } => {
                write!(f, "{found} measured values, expected {expected}")
            }
            Self::MeasurementNotFinite { output } => {
                write!(f, "the measurement of output {output} is not finite")
            }
            Self::Neighbours { expected, found } => {
                write!(f, "places for {found} neighbours, expected {expected}")
            }
            Self::Features { expected, found } => {
                write!(f, "the network has {found} features, the outer weights {expected}")
            }
            Self::NetworkInputs { expected, found } => {
                write!(f, "the network has {found} inputs, the state {expected} components")
            }
            Self::Diverged => write!(f, "estimate or outer weights would overflow"),
        }
    }
}

impl core::error::Error for StepError {}
