//! The core's parameter errors, in terms of scenario keys.

use core::fmt;

use agent_core::math::parameter::ParameterError;
use agent_core::package::Refusal;

/// Displays a parameter error with the scenario's keys instead of the core's names.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InScenario(pub ParameterError);

impl fmt::Display for InScenario {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            ParameterError::OutOfRange { parameter: NORM, value, .. } => write!(
                f,
                "network.outer has the norm {value:e} in single precision, expected at most \
                 outer_law.bound"
            ),
            ParameterError::OutOfRange { parameter, value, expected } => {
                write!(f, "{} is {value:e}, expected {expected}", key(parameter))
            }
            ParameterError::Length { parameter, expected, found } => {
                write!(f, "{} has {found} entries, expected {expected}", key(parameter))
            }
            ParameterError::NotSymmetric { parameter, row, column } => {
                let (row, column) = (row + 1, column + 1);
                write!(f, "{} is not symmetric at row {row}, column {column}", key(parameter))
            }
            other => other.fmt(f),
        }
    }
}

/// The core's name for the norm of the outer weights.
const NORM: &str = "norm of outer_weights";

/// Returns the scenario key of a core parameter, or the keys it is computed from.
fn key(parameter: &'static str) -> &'static str {
    match parameter {
        "observer.gain" => "design.gain",
        "observer.neighbours" => "the list of neighbours in [graph]",
        "observer.neighbours.weight" => "an edge weight in [graph]",
        "output_matrix" => "agents.output_matrix",
        "step_size" => "time.step",
        "projection.radius" => "outer_law.bound minus outer_law.boundary_layer",
        "projection.boundary_layer" => "outer_law.boundary_layer",
        "projection.smoothing" => "outer_law.smoothing",
        "projection.smoothness" => "outer_law.smoothness",
        "trigger.hold_error_weight" => "phi_1 (from design.gain, design.kappa and design.k2)",
        "trigger.consensus_weight" => "phi_2 (from design.gain, design.kappa and design.k2)",
        "trigger.threshold" => "design.epsilon divided by the number of agents",
        other => other,
    }
}

/// Displays a refusal with the scenario's keys.
pub(super) fn refusal(refusal: &Refusal) -> String {
    match refusal {
        Refusal::Parameter(error) => InScenario(*error).to_string(),
        other => other.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_name_scenario_keys() {
        let out = |parameter, value| {
            let expected = "1e-15 to 1e15";
            InScenario(ParameterError::OutOfRange { parameter, value, expected }).to_string()
        };
        assert_eq!(
            out("projection.radius", 1e38),
            "outer_law.bound minus outer_law.boundary_layer is 1e38, expected 1e-15 to 1e15"
        );
        assert_eq!(out("step_size", 0.0), "time.step is 0e0, expected 1e-15 to 1e15");
        assert_eq!(
            out(NORM, f32::NAN),
            "network.outer has the norm NaN in single precision, expected at most outer_law.bound"
        );
    }
}
