//! `[clock]`, and `clock` of an agent.

use crate::scenario::Time;
use crate::scenario::error::ScenarioError;
use crate::scenario::reader::Table;

/// The clock of an agent. The default is the paper's: all agents share one.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ClockSettings {
    /// How far the clock is ahead at `t = 0`. \[s\]
    pub offset: f64,
    /// How much faster it runs, in parts per million.
    pub drift: f64,
    /// Half-width of the uniform distribution of the time, within a step, at which the agent
    /// measures. \[s\]
    pub jitter: f64,
    /// Probability that the agent misses a step.
    pub missed: f64,
}

/// Furthest ahead that a clock can be: its ticks are counted in 32 bits at a node's start. \[s\]
const OFFSET_MAX: f64 = 1e6;

/// Clocks that differ by more than this are broken. \[ppm\]
const DRIFT_MAX: f64 = 100_000.0;

/// Reads `[clock]`.
pub(in crate::scenario) fn clock(
    root: &Table<'_>,
    time: &Time,
) -> Result<ClockSettings, ScenarioError> {
    match root.get_table("clock")? {
        Some(table) => settings(&table, ClockSettings::default(), time),
        None => Ok(ClockSettings::default()),
    }
}

/// Reads a table of clock keys; those that are missing are as in `default`.
pub(super) fn settings(
    table: &Table<'_>,
    default: ClockSettings,
    time: &Time,
) -> Result<ClockSettings, ScenarioError> {
    table.only(&["offset", "drift", "jitter", "missed"])?;
    let drift = table.get("drift", "50.0").map_or(Ok(default.drift), |value| {
        value.number_in("-100000 to 100000 ppm", |drift| drift.abs() <= DRIFT_MAX)
    })?;
    Ok(ClockSettings {
        offset: table.get("offset", "0.1").map_or(Ok(default.offset), |value| {
            value.number_in("0 to 1000000 seconds", |offset| (0.0..=OFFSET_MAX).contains(&offset))
        })?,
        drift,
        jitter: table.get("jitter", "0.0001").map_or(Ok(default.jitter), |value| {
            value.number_in("0 to time.step", |jitter| (0.0..=time.step_size).contains(&jitter))
        })?,
        missed: table.get("missed", "0.01").map_or(Ok(default.missed), |v| v.probability())?,
    })
}
