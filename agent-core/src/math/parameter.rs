//! Errors in parameters, and the range checks that report them.

use crate::AgentId;

/// Why parameters, or a state created from them, are invalid.
#[derive(Clone, Copy, Debug, PartialEq)]
#[non_exhaustive]
pub enum ParameterError {
    /// A number is outside its range, or not finite.
    OutOfRange {
        /// Name of the parameter.
        parameter: &'static str,
        /// Its value.
        value: f32,
        /// The expected range, in words.
        expected: &'static str,
    },
    /// A sequence has the wrong length.
    Length {
        /// Name of the parameter.
        parameter: &'static str,
        /// The required length.
        expected: usize,
        /// The length given.
        found: usize,
    },
    /// A matrix that must be symmetric is not.
    NotSymmetric {
        /// Name of the parameter.
        parameter: &'static str,
        /// Row of one of the two entries that differ, from 0.
        row: usize,
        /// Column of that entry, from 0.
        column: usize,
    },
    /// The agent lists itself as a neighbour.
    OwnNeighbour {
        /// The agent.
        id: AgentId,
    },
    /// A neighbour is listed twice.
    RepeatedNeighbour {
        /// The neighbour.
        id: AgentId,
    },
}

impl core::fmt::Display for ParameterError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match *self {
            Self::OutOfRange { parameter, value, expected } => {
                write!(f, "{parameter} is {value}, expected {expected}")
            }
            Self::Length { parameter, expected, found } => {
                write!(f, "{parameter} has {found} entries, expected {expected}")
            }
            Self::NotSymmetric { parameter, row, column } => {
                write!(f, "{parameter} is not symmetric at row {row}, column {column}")
            }
            Self::OwnNeighbour { id } => write!(f, "agent {id} lists itself as a neighbour"),
            Self::RepeatedNeighbour { id } => write!(f, "neighbour {id} is listed twice"),
        }
    }
}

impl core::error::Error for ParameterError {}

// Separate functions, because every check builds an error of six words.

/// Checks that `value` is finite and above zero.
#[inline(never)]
pub(crate) fn positive(parameter: &'static str, value: f32) -> Result<(), ParameterError> {
    in_range(parameter, value, value > 0.0, "a finite number above 0")
}

/// Checks that `value` is finite and not negative.
#[inline(never)]
pub(crate) fn not_negative(parameter: &'static str, value: f32) -> Result<(), ParameterError> {
    in_range(parameter, value, value >= 0.0, "a finite number, 0 or above")
}

/// Checks that every value is finite.
#[inline(never)]
pub(crate) fn finite(parameter: &'static str, values: &[f32]) -> Result<(), ParameterError> {
    values.iter().try_for_each(|&value| in_range(parameter, value, true, "a finite number"))
}

fn in_range(
    parameter: &'static str,
    value: f32,
    holds: bool,
    expected: &'static str,
) -> Result<(), ParameterError> {
    if holds && value.is_finite() {
        Ok(())
    } else {
        Err(ParameterError::OutOfRange { parameter, value, expected })
    }
}
