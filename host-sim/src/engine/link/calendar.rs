//! Copies of frames in transit, by the time at which they arrive.
//!
//! Cost: `O(log F)` for a copy in transit among `F`, `O(1)` for one that arrives at once.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

use agent_core::Tick;

use super::layer::Transmission;

/// Copies in transit.
#[derive(Debug, Default)]
pub(super) struct Calendar {
    later: BinaryHeap<Entry>,
    /// Copies for the tick that is being sent.
    now: Vec<Transmission>,
    /// Number of copies so far, which decides between equal times.
    count: u64,
}

/// A copy for a later tick. The greatest is the first to arrive.
#[derive(Debug)]
struct Entry {
    due: Tick,
    order: u64,
    transmission: Transmission,
}

impl Ord for Entry {
    fn cmp(&self, other: &Self) -> Ordering {
        let arrival = other.transmission.arrival.total_cmp(&self.transmission.arrival);
        other.due.cmp(&self.due).then(arrival).then(other.order.cmp(&self.order))
    }
}

impl PartialOrd for Entry {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Eq for Entry {}

impl PartialEq for Entry {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl Calendar {
    /// Adds a copy that arrives in time for the step at `due`; `now` is the tick that is being sent.
    pub(super) fn add(&mut self, due: Tick, now: Tick, transmission: Transmission) {
        if due <= now {
            self.now.push(transmission);
            return;
        }
        self.count += 1;
        self.later.push(Entry { due, order: self.count, transmission });
    }

    /// Removes all copies that arrive up to `tick`, in the order of their arrival.
    pub(super) fn take_due(&mut self, tick: Tick, mut take: impl FnMut(Transmission)) {
        while self.later.peek().is_some_and(|entry| entry.due <= tick) {
            if let Some(entry) = self.later.pop() {
                take(entry.transmission);
            }
        }
        self.now.drain(..).for_each(take);
    }
}
