//! The initial states of a study: the scenario's own, and others within the plant's reach.

use crate::flow::plant_course;
use crate::scenario::{Scenario, drawn_state};

use super::{CommandError, ErrorCode};

/// Draws `count - 1` initial states besides the scenario's own: uniform within plus and minus the half
/// widths that the scenario draws its own state from, or else the largest magnitude of each component
/// along the plant's trajectory.
pub(super) fn others(
    scenario: &Scenario,
    count: u64,
    seed: u64,
) -> Result<Vec<Vec<f64>>, CommandError> {
    if count <= 1 {
        return Ok(Vec::new());
    }
    if scenario.plant.recording().is_some() {
        return Err(recorded());
    }
    let half_widths = match &scenario.initial_spread {
        Some(spread) => spread.clone(),
        None => reach(scenario)?,
    };
    Ok((1..count).map(|number| drawn_state(&half_widths, seed, number)).collect())
}

/// Returns the error that a recording has no other initial states.
pub(super) fn recorded() -> CommandError {
    CommandError::usage(
        "--initial-states: a recording has only one initial state; leave the option out",
    )
}

/// Returns the largest magnitude of each component of the state along the plant's trajectory.
fn reach(scenario: &Scenario) -> Result<Vec<f64>, CommandError> {
    let course = plant_course(scenario).map_err(|error| {
        CommandError::new(ErrorCode::Run, format!("--initial-states, half widths: {error}"))
    })?;
    Ok(course.reach())
}

/// Returns the scenario that begins in this state.
pub(super) fn begun_in(scenario: &Scenario, state: &[f64]) -> Scenario {
    Scenario { initial_state: state.to_owned(), initial_spread: None, ..scenario.clone() }
}
