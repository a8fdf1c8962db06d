//! Health counters of agents, as text and JSON.

use std::fmt::Write;

#[cfg(unix)]
use agent_core::health::BoardErrors;
use agent_core::health::HealthCounters;
use serde::{Serialize, Serializer};

use crate::engine::statistics::AgentStatistics;

/// Number of agents listed individually.
const LINES: usize = 12;

/// Counters as a JSON object, with one field per counter.
#[derive(Clone, Copy, Debug)]
pub(super) struct HealthReport(pub(super) HealthCounters);

impl Serialize for HealthReport {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map(named(&self.0).map(|(name, _, count)| (name, count)))
    }
}

/// Returns each counter's JSON name, description and value.
fn named(counters: &HealthCounters) -> impl Iterator<Item = (&'static str, &'static str, u32)> {
    let rows = HealthCounters::TABLE.into_iter().zip(counters.to_array());
    rows.map(|((name, text), count)| (name, text, count))
}

/// Returns the nonzero counters on one line.
#[cfg(unix)]
pub(super) fn line(counters: &HealthCounters) -> String {
    counted(HealthCounters::TABLE.into_iter().zip(counters.to_array()))
}

/// Returns the errors reported by sensor and link, on one line.
#[cfg(unix)]
pub(super) fn board_line(errors: &BoardErrors) -> String {
    counted(BoardErrors::TABLE.into_iter().zip(errors.to_array()))
}

/// Returns the nonzero counts, on one line.
#[cfg(unix)]
fn counted(counts: impl Iterator<Item = ((&'static str, &'static str), u32)>) -> String {
    let counts = counts.filter(|(_, count)| *count > 0);
    let parts: Vec<_> = counts.map(|((_, what), count)| part(what, count)).collect();
    if parts.is_empty() { "nothing to report".to_owned() } else { parts.join(", ") }
}

/// Formats a counter; one that has reached its limit says so.
fn part(what: &str, count: u32) -> String {
    if count == u32::MAX { format!("{what}: {count} or more") } else { format!("{what}: {count}") }
}

/// Returns a line for each agent with nonzero counters, or nothing if no agent was monitored.
pub(super) fn table(agents: &[AgentStatistics]) -> String {
    let watched = agents.iter().enumerate();
    let watched: Vec<_> = watched.filter_map(|(i, agent)| Some((i + 1, agent.health?))).collect();
    if watched.is_empty() {
        return String::new();
    }
    let mut text = String::from("Health\n");
    let nonzero = |(_, counters): &&(usize, HealthCounters)| *counters != HealthCounters::default();
    for (agent, counters) in watched.iter().filter(nonzero).take(LINES) {
        let counted = named(counters).filter(|(_, _, count)| *count > 0);
        let parts: Vec<_> = counted.map(|(_, what, count)| part(what, count)).collect();
        // Writing into a string cannot fail.
        let _ = writeln!(text, "  agent {agent}: {}", parts.join(", "));
    }
    match watched.iter().filter(nonzero).count() {
        0 => text.push_str("  nothing to report\n"),
        count if count > LINES => {
            let _ = writeln!(
                text,
                "  and {} more agents; use --format json to list them all",
                count - LINES
            );
        }
        _ => {}
    }
    text.push('\n');
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(health: Option<HealthCounters>) -> AgentStatistics {
        let mut agent = AgentStatistics::default();
        agent.health = health;
        agent
    }

    #[test]
    fn only_nonzero_counters_are_printed() {
        let zero = HealthCounters::default();
        let counters = HealthCounters { outside_box: 40, fall_backs: 2, returns: 1, ..zero };
        assert_eq!(table(&[of(None), of(None)]), "");
        assert_eq!(table(&[of(None), of(Some(zero))]), "Health\n  nothing to report\n\n");
        assert_eq!(
            table(&[of(Some(zero)), of(Some(counters)), of(None)]),
            "Health\n  agent 2: steps outside the trained box: 40, \
             fallbacks to feedback alone: 2, returns to the network: 1\n\n"
        );
        let many = vec![of(Some(counters)); 15];
        let text = table(&many);
        assert_eq!(text.lines().count(), 1 + 12 + 1 + 1);
        assert!(
            text.ends_with("  and 3 more agents; use --format json to list them all\n\n"),
            "{text}"
        );
    }

    #[test]
    fn every_counter_has_its_own_field() {
        let counters = HealthCounters { restarts: 3, ..HealthCounters::default() };
        let value = serde_json::to_value(HealthReport(counters)).unwrap();
        let fields = value.as_object().unwrap();
        assert_eq!((fields.len(), &fields["restarts"]), (15, &3.into()));
        assert_eq!(fields.values().filter(|&count| *count == 0).count(), 14);
    }
}
