//! Names of the state's components.

use crate::number::counted;
use crate::plant::DIMENSION_MAX;
use crate::plant::expression::name_problem;
use crate::scenario::error::ScenarioError;
use crate::scenario::reader::{Table, Value, has};

/// Largest dimension of a state with the feature `wide`.
const WIDE_DIMENSION_MAX: usize = 40;

/// Reads the names of the state's components.
pub(super) fn states(table: &Table<'_>) -> Result<Vec<String>, ScenarioError> {
    let value = table.require("states", "[\"x\", \"v\"]")?;
    let list = value.list("write a name in quotes")?;
    check_dimension(&value, list.len(), "state", "states")?;
    let mut states: Vec<String> = Vec::with_capacity(list.len());
    for value in &list {
        let name = value.text()?;
        check_name(value, name, &states)?;
        states.push(name.to_owned());
    }
    Ok(states)
}

/// Rejects a name that is not valid in expressions, or that a state already has.
pub(super) fn check_name(
    value: &Value<'_>,
    name: &str,
    states: &[String],
) -> Result<(), ScenarioError> {
    let taken = states.iter().any(|state| state == name).then_some("is a state");
    match name_problem(name).or(taken) {
        Some(problem) => Err(value.error(
            format_args!("`{name}` {problem}"),
            "use another name of letters, digits and _ that starts with a letter",
        )),
        None => Ok(()),
    }
}

/// Checks that a network can take `inputs` known inputs in addition to `states` state components.
pub(super) fn check_inputs(
    value: &Value<'_>,
    inputs: usize,
    states: usize,
) -> Result<(), ScenarioError> {
    let room = DIMENSION_MAX.saturating_sub(states);
    if inputs <= room {
        return Ok(());
    }
    let found = has(inputs, "known input", "known inputs");
    let problem = format!("{found} in addition to {}", counted(states as u64, "state", "states"));
    let hint = match room {
        0 => "remove plant.inputs".to_owned(),
        room => format!("use at most {room}"),
    };
    Err(value.error(
        problem,
        format!("{hint}: a network has at most {DIMENSION_MAX} inputs, including the states"),
    ))
}

/// Checks a number of state components; `one` and `many` say what there is one of for each.
pub(super) fn check_dimension(
    value: &Value<'_>,
    found: usize,
    one: &str,
    many: &str,
) -> Result<(), ScenarioError> {
    if (1..=DIMENSION_MAX).contains(&found) {
        return Ok(());
    }
    let mut hint = format!("use a dimension of 1 to {DIMENSION_MAX}");
    if (1..=WIDE_DIMENSION_MAX).contains(&found) {
        hint += &format!(
            ", or build with `--features wide`, which simulates up to {WIDE_DIMENSION_MAX}"
        );
    }
    Err(value.error(has(found, one, many), hint))
}
