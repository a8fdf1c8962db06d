//! `[health]`.

use std::num::NonZeroU32;

use agent_core::health::{FallBack, HealthSettings};

use crate::scenario::error::ScenarioError;
use crate::scenario::reader::{Table, Value};

/// Default of `return_after`, as a multiple of `fall_back_after`: falling back should be quick,
/// returning to the network slow.
const RETURN_FACTOR: u32 = 10;

/// A symptom that makes an agent fall back.
#[derive(Clone, Copy, PartialEq)]
enum Sign {
    OutsideBox,
    Projection,
    Diverged,
}

const SIGNS: [(&str, Sign); 3] = [
    ("outside-box", Sign::OutsideBox),
    ("projection", Sign::Projection),
    ("diverged", Sign::Diverged),
];

pub(in crate::scenario) fn health(
    root: &Table<'_>,
    has_network: bool,
) -> Result<Option<HealthSettings>, ScenarioError> {
    let Some(table) = root.get_table("health")? else { return Ok(None) };
    if !has_network {
        let hint = "add a [network] table, or remove this one";
        return Err(table.error("there is no network to monitor", hint));
    }
    table.only(&[
        "fall_back_after",
        "return_after",
        "fall_back_on",
        "plausible_margin",
        "restart_after",
    ])?;
    let plausible_margin = match table.get("plausible_margin", "10.0") {
        Some(value) => margin(&value)?,
        None => HealthSettings::RECOMMENDED.plausible_margin,
    };
    let restart_after =
        steps_or_never(&table, "restart_after", HealthSettings::RECOMMENDED.restart_after)?;
    let fall_back = fall_back(&table)?;
    // Telemetry has no receiver in a simulated run.
    let telemetry_interval = u32::MAX;
    Ok(Some(HealthSettings { fall_back, plausible_margin, restart_after, telemetry_interval }))
}

fn fall_back(table: &Table<'_>) -> Result<Option<FallBack>, ScenarioError> {
    let after = steps_or_never(table, "fall_back_after", None)?;
    let written = match table.get("return_after", "100") {
        Some(value) => NonZeroU32::new(value.integer(1..=u32::MAX)?),
        None => None,
    };
    let list = table.get("fall_back_on", "[\"outside-box\", \"diverged\"]");
    let signs = list.as_ref().map_or(Ok(SIGNS.map(|(_, sign)| sign).to_vec()), signs)?;
    // Without `fall_back_after` the other two keys are checked but unused.
    let Some(after) = after else { return Ok(None) };
    let return_after = written
        .unwrap_or_else(|| after.saturating_mul(NonZeroU32::MIN.saturating_add(RETURN_FACTOR - 1)));
    Ok(Some(FallBack {
        after,
        return_after,
        outside_box: signs.contains(&Sign::OutsideBox),
        projection_active: signs.contains(&Sign::Projection),
        diverged: signs.contains(&Sign::Diverged),
    }))
}

/// Reads a number of steps; 0 means never.
fn steps_or_never(
    table: &Table<'_>,
    key: &str,
    default: Option<NonZeroU32>,
) -> Result<Option<NonZeroU32>, ScenarioError> {
    match table.get(key, "10") {
        Some(value) => Ok(NonZeroU32::new(value.integer(0..=u32::MAX)?)),
        None => Ok(default),
    }
}

/// Reads a margin that is above 0 in the agents' single precision as well.
fn margin(value: &Value<'_>) -> Result<f32, ScenarioError> {
    let margin = value.number_in("a number above 0", |number| number as f32 > 0.0)?;
    Ok(margin as f32)
}

fn signs(value: &Value<'_>) -> Result<Vec<Sign>, ScenarioError> {
    let list = value.list("use \"outside-box\"")?;
    if list.is_empty() {
        let hint = "name at least one, or set fall_back_after = 0";
        return Err(value.error("is empty", hint));
    }
    let mut signs = Vec::with_capacity(list.len());
    for entry in &list {
        let sign = entry.choice(&SIGNS)?;
        if signs.contains(&sign) {
            return Err(entry.error("is listed twice", "list each one once"));
        }
        signs.push(sign);
    }
    Ok(signs)
}
