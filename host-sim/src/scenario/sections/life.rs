//! `[[life]]`.

use super::agents::agent;
use super::run::window;
use crate::scenario::error::ScenarioError;
use crate::scenario::reader::Table;
use crate::scenario::{Time, Window};

/// A time in which an agent is down. It then reboots: what it had in RAM is lost, its packages are
/// kept.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Downtime {
    /// The agent, from 0.
    pub agent: usize,
    /// When. \[s\]
    pub window: Window,
    /// Whether another node takes its place: one with the package that the agent had at the start.
    pub is_replaced: bool,
}

/// Reads `[[life]]`.
pub(in crate::scenario) fn life(
    root: &Table<'_>,
    time: &Time,
    agents: usize,
) -> Result<Vec<Downtime>, ScenarioError> {
    let tables = root.get_tables("life")?;
    let mut life: Vec<Downtime> = Vec::with_capacity(tables.len());
    for table in &tables {
        table.only(&["agent", "from", "to", "replaced"])?;
        let agent = agent(&table.require("agent", "2")?, agents)?;
        let window = window(table, time)?;
        let is_replaced =
            table.get("replaced", "true").map_or(Ok(false), |value| value.boolean())?;
        let overlaps = |other: &&Downtime| {
            other.agent == agent && other.window.from < window.to && window.from < other.window.to
        };
        if let Some(other) = life.iter().find(overlaps) {
            let problem = format!(
                "agent {} is already down from {} to {}",
                agent + 1,
                other.window.from,
                other.window.to
            );
            return Err(table.error(problem, "write times that do not overlap"));
        }
        life.push(Downtime { agent, window, is_replaced });
    }
    Ok(life)
}
