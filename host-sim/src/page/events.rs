//! Times of broadcasts, or their number in intervals if they are too many to draw.

use std::path::Path;

use serde::Serialize;

use super::TableError;
use super::table::each_row;

/// Broadcasts that are listed one by one at most.
const LISTED: usize = 150_000;
/// Intervals in which broadcasts are counted otherwise.
const INTERVALS: u64 = 500;

/// The broadcasts of each agent.
#[derive(Debug, PartialEq, Serialize)]
pub struct Events {
    /// Duration of a step. \[s\]
    step_s: f64,
    /// For each agent the step of its first broadcast, and the number of steps from each to the next.
    /// Empty if broadcasts are counted.
    gaps: Vec<Vec<u64>>,
    /// Length of an interval. \[steps\]
    interval: u64,
    /// For each agent the number of broadcasts in each interval. Empty if broadcasts are listed.
    counts: Vec<Vec<u32>>,
}

/// Reads `events.csv` of a run of this many agents and steps of length `step_size` \[s\].
///
/// # Errors
/// If the table cannot be read or is not of its kind.
pub fn read(path: &Path, agents: usize, steps: u64, step_size: f64) -> Result<Events, TableError> {
    let mut ticks: Vec<Vec<u64>> = vec![Vec::new(); agents];
    each_row(path, |row| {
        let agent = row.number::<usize>(0)?.checked_sub(1);
        let of_agent = agent.and_then(|index| ticks.get_mut(index));
        let of_agent = of_agent.ok_or_else(|| row.wrong(0, "the number of an agent"))?;
        let time: f64 = row.number(2)?;
        if !(0.0..1e15).contains(&time) {
            return Err(row.wrong(2, "a time"));
        }
        of_agent.push((time / step_size).round() as u64);
        Ok(true)
    })?;
    Ok(Events::new(ticks, steps, step_size))
}

impl Events {
    /// `ticks` are in ascending order.
    fn new(ticks: Vec<Vec<u64>>, steps: u64, step_s: f64) -> Self {
        let interval = steps.div_ceil(INTERVALS).max(1);
        let mut events = Self { step_s, gaps: Vec::new(), interval, counts: Vec::new() };
        if ticks.iter().map(Vec::len).sum::<usize>() <= LISTED {
            events.gaps = ticks.into_iter().map(gaps).collect();
        } else {
            let intervals = usize::try_from(steps / interval + 1).unwrap_or(usize::MAX);
            let counts = |ticks: Vec<u64>| {
                let mut counts = vec![0; intervals];
                for tick in ticks {
                    let place = usize::try_from(tick / interval).unwrap_or(usize::MAX);
                    counts[place.min(intervals - 1)] += 1;
                }
                counts
            };
            events.counts = ticks.into_iter().map(counts).collect();
        }
        events
    }
}

fn gaps(ticks: Vec<u64>) -> Vec<u64> {
    let mut before = 0;
    let gap = |tick: u64| {
        let gap = tick.saturating_sub(before);
        before = tick;
        gap
    };
    ticks.into_iter().map(gap).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_broadcasts_are_listed_and_many_are_counted() {
        let few = Events::new(vec![vec![0, 3, 10], vec![]], 1_000, 1e-3);
        assert_eq!((few.gaps, few.counts), (vec![vec![0, 3, 7], vec![]], vec![]));
        let all: Vec<u64> = (0..=100_000).collect();
        let many = Events::new(vec![all.clone(), all], 100_000, 1e-3);
        assert!(many.gaps.is_empty());
        assert_eq!((many.interval, many.counts.len(), many.counts[0].len()), (200, 2, 501));
        assert_eq!(many.counts[1].iter().sum::<u32>(), 100_001);
    }
}
