//! `name`, `[time]`, `[evaluation]` and `[record]`.

use std::num::NonZeroU32;

use crate::plant::Integrator;
use crate::scenario::error::ScenarioError;
use crate::scenario::reader::{Table, Value};
use crate::scenario::{Record, Time, Window};

/// Maximum number of steps in a run: 11 days at one millisecond.
const STEPS_MAX: f64 = 1e9;
/// Maximum length of the name, which becomes part of file names.
const NAME_LENGTH_MAX: usize = 64;

pub(in crate::scenario) fn name(root: &Table<'_>) -> Result<String, ScenarioError> {
    let value = root.require("name", "\"first-try\"")?;
    let name = value.text()?;
    let letters = name.chars().all(|c| c.is_ascii_alphanumeric() || c == '-' || c == '_');
    if name.is_empty() || name.len() > NAME_LENGTH_MAX || !letters {
        let hint = format!("use 1 to {NAME_LENGTH_MAX} ASCII letters, digits, - or _");
        return Err(value.error(format_args!("`{name}` cannot be used in file names"), hint));
    }
    Ok(name.to_owned())
}

pub(in crate::scenario) fn time(root: &Table<'_>) -> Result<Time, ScenarioError> {
    let table = root.require_table("time")?;
    table.only(&["duration", "step", "plant_integrator"])?;
    let duration_value = table.require("duration", "10.0")?;
    let (duration, step_value) = (duration_value.positive()?, table.require("step", "0.01")?);
    let step_size = step_value.positive()?;
    let integrator =
        table.get("plant_integrator", "\"euler\"").map_or(Ok(Integrator::Euler), |value| {
            value.choice(&[("euler", Integrator::Euler), ("rk4", Integrator::Rk4)])
        })?;
    let steps = duration / step_size;
    if steps > STEPS_MAX {
        // With a step of a tenth of a millisecond, which is short.
        let (value, advice) = match duration / 1e-4 > STEPS_MAX {
            true => (duration_value, "a shorter duration or a longer step"),
            false => (step_value, "a longer step"),
        };
        let problem = format!("is {}, which gives {steps:e} steps", value.written());
        return Err(value.error(problem, format!("use {advice}, for at most 1e9 steps")));
    }
    // The ratio of two decimal fractions is off by a few rounding errors.
    let whole = steps.round();
    if whole < 1.0 || (steps - whole).abs() > 1e-9 * whole {
        let (duration, step) = (duration_value.written(), step_value.written());
        let problem = format!("is {duration}, not a whole number of steps of {step}");
        let nearest = (whole.max(1.0) * step_size * 1e9).round() / 1e9;
        let hint = format!("use a multiple of the step, such as {nearest}");
        return Err(duration_value.error(problem, hint));
    }
    Ok(Time { duration, step_size, integrator })
}

/// Checks that the run is not longer than a recording of this duration \[s\].
pub(in crate::scenario) fn check_recorded(
    root: &Table<'_>,
    time: &Time,
    recorded: f64,
) -> Result<(), ScenarioError> {
    if time.duration <= recorded + 1e-9 {
        return Ok(());
    }
    let value = root.require_table("time")?.require("duration", "10.0")?;
    let steps = (recorded / time.step_size).floor();
    let longest = (steps * time.step_size * 1e9).round() / 1e9;
    Err(value.error(
        format_args!("is {}, longer than the recording of {recorded} s", value.written()),
        format_args!("use at most {longest}"),
    ))
}

pub(in crate::scenario) fn evaluation(
    root: &Table<'_>,
    time: &Time,
) -> Result<Window, ScenarioError> {
    let second_half = Window { from: 0.5 * time.duration, to: time.duration };
    let Some(table) = root.get_table("evaluation")? else { return Ok(second_half) };
    table.only(&["from", "to"])?;
    let from = table.get("from", "5.0");
    let to = table.get("to", "10.0");
    let from_time = from.as_ref().map_or(Ok(second_half.from), Value::not_negative)?;
    let to_time = to.as_ref().map_or(Ok(second_half.to), Value::positive)?;
    let window = Window { from: from_time, to: to_time };
    if let Some(to) = to.filter(|_| window.to > time.duration) {
        return Err(after_the_end(&to, time));
    }
    if window.ticks(time).is_empty() {
        let problem = format!("contains no step: from {} to {}", window.from, window.to);
        return Err(table.error(problem, "use from < to"));
    }
    Ok(window)
}

/// Reads `from` and `to` of a table: by default, from the start and to the end of the run.
pub(super) fn window(table: &Table<'_>, time: &Time) -> Result<Window, ScenarioError> {
    let (from, to) = (table.get("from", "5.0"), table.get("to", "10.0"));
    let window = Window {
        from: from.as_ref().map_or(Ok(0.0), Value::not_negative)?,
        to: to.as_ref().map_or(Ok(time.duration), Value::positive)?,
    };
    // The run's end is allowed, so that a table can say "until the end".
    for value in [from, to].into_iter().flatten() {
        if value.not_negative()? > time.duration {
            return Err(after_the_end(&value, time));
        }
    }
    if window.ticks(time).is_empty() {
        let problem = format!("contains no step: from {} to {}", window.from, window.to);
        return Err(table.error(problem, "use from < to"));
    }
    Ok(window)
}

/// Creates the error for a time after the end of the run.
pub(super) fn after_the_end(value: &Value<'_>, time: &Time) -> ScenarioError {
    let problem = format!("is {}, after the end of the run", value.written());
    value.error(problem, format_args!("use a time of at most time.duration, {}", time.duration))
}

/// Checks that something at `at` \[s\] happens before the run ends.
pub(super) fn check_before_end(
    value: &Value<'_>,
    at: f64,
    time: &Time,
) -> Result<(), ScenarioError> {
    if time.tick(at) < time.tick(time.duration) {
        return Ok(());
    }
    let place = if at > time.duration { "after" } else { "at" };
    let problem = format!("is {}, {place} the end of the run", value.written());
    Err(value.error(problem, format_args!("use a time below time.duration, {}", time.duration)))
}

/// Limit for the traces kept in memory. \[bytes\]
const TRACE_BYTES_MAX: u64 = 1 << 31;

/// `n` is the dimension of the state.
pub(in crate::scenario) fn record(
    root: &Table<'_>,
    time: &Time,
    n: usize,
    agents: usize,
) -> Result<Record, ScenarioError> {
    let record = written_record(root)?;
    // Time and true state take 8 bytes a number, estimates 4.
    let row = 8 * (1 + n as u64) + 4 * (n as u64 * agents as u64);
    let bytes = |stride: u64| time.tick(time.duration) / stride * row;
    let Some(stride) = record.trace_stride.map(|stride| u64::from(stride.get())) else {
        return Ok(record);
    };
    if bytes(stride) > TRACE_BYTES_MAX {
        let gigabytes = bytes(stride) as f64 / 1e9;
        let enough = bytes(1).div_ceil(TRACE_BYTES_MAX);
        let problem = format!("would keep {gigabytes:.1} GB of traces in memory");
        let hint = format!("set record.trace_stride = {enough}, or 0 for no traces");
        return Err(match root.get_table("record")? {
            Some(table) => table.error(problem, hint),
            None => root.error(problem, hint),
        });
    }
    Ok(record)
}

fn written_record(root: &Table<'_>) -> Result<Record, ScenarioError> {
    let every_step = Record { trace_stride: NonZeroU32::new(1), events: true, samples: false };
    let Some(table) = root.get_table("record")? else { return Ok(every_step) };
    table.only(&["trace_stride", "events", "samples"])?;
    let trace_stride = match table.get("trace_stride", "10") {
        Some(value) => NonZeroU32::new(value.integer(0..=u32::MAX)?),
        None => every_step.trace_stride,
    };
    let events = table.get("events", "true").map_or(Ok(every_step.events), |v| v.boolean())?;
    let samples = table.get("samples", "true").map_or(Ok(every_step.samples), |v| v.boolean())?;
    Ok(Record { trace_stride, events, samples })
}
