//! `[exchange]`.

use agent_core::agent::exchange::ExchangeParams;

use crate::scenario::Time;
use crate::scenario::error::ScenarioError;
use crate::scenario::reader::{Table, Value};

/// Longest time in `[exchange]`, in steps.
const STEPS_MAX: f64 = u32::MAX as f64;

/// Reads `[exchange]`; all its times are in seconds.
pub(in crate::scenario) fn exchange(
    root: &Table<'_>,
    time: &Time,
) -> Result<ExchangeParams, ScenarioError> {
    let Some(table) = root.get_table("exchange")? else { return Ok(ExchangeParams::PAPER) };
    table.only(&["heartbeat", "gap", "repeat", "fade", "delay", "smoothing"])?;
    let steps = |key: &str, example: &str| {
        table.get(key, example).map_or(Ok(0), |value| in_steps(&value, time))
    };
    let fade = match table.get("fade", "[0.3, 0.6]") {
        None => [0, 0],
        Some(value) => {
            value.numbers_of(2, "age up to full weight, age without weight")?;
            let ages = value.list("use a time >= 0")?;
            let [from, to] = [in_steps(&ages[0], time)?, in_steps(&ages[1], time)?];
            if from > to || to == 0 {
                return Err(value.wrong("decreases, or ends at 0"));
            }
            [from, to]
        }
    };
    let exchange = ExchangeParams {
        heartbeat: steps("heartbeat", "0.2")?,
        gap: steps("gap", "0.01")?,
        repeat: steps("repeat", "0.03")?,
        fade_from: fade[0],
        fade_to: fade[1],
        delay: steps("delay", "0.01")?,
        smoothing: steps("smoothing", "0.03")?,
    };
    match table.get("gap", "0.01") {
        Some(gap) if exchange.validate().is_err() => {
            Err(gap.error("is above the heartbeat", "use a gap of at most exchange.heartbeat"))
        }
        _ => Ok(exchange),
    }
}

/// Returns the exchange of the preset "robust" over links with this delay \[s\].
pub(in crate::scenario) fn robust(time: &Time, delay: f64) -> ExchangeParams {
    let steps = |seconds: f64| (seconds / time.step_size).round() as u32;
    ExchangeParams {
        heartbeat: steps(0.2),
        gap: steps(0.01),
        repeat: steps(0.04),
        delay: steps(delay),
        ..ExchangeParams::PAPER
    }
}

/// Returns a time in steps, rounded; a time above 0 is at least one step.
fn in_steps(value: &Value<'_>, time: &Time) -> Result<u32, ScenarioError> {
    let seconds = value.not_negative()?;
    let steps = seconds / time.step_size;
    if steps > STEPS_MAX {
        return Err(value.wrong(format_args!("is {}, more than 2^32 steps", value.written())));
    }
    Ok(if seconds > 0.0 { (steps.round() as u32).max(1) } else { 0 })
}
