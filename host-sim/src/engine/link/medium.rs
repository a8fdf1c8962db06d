//! A shared medium: of the frames within reach of each other, one at a time.
//!
//! A frame occupies the medium at its sender and at the sender's neighbours. It starts as soon as it is
//! free at all of them, so no two frames collide, as with a perfect arbiter: what is left of a radio's
//! contention is the wait. Of those that can start at the same time, the one that has waited longest is
//! first. A node has
//! one frame waiting: a newer one takes its place, because an estimate is of no use once there is a
//! newer one.
//!
//! A frame of `b` bytes takes `8 (6 + b) / rate`: four bytes of preamble, the start-of-frame delimiter
//! and the length come before it (IEEE 802.15.4, O-QPSK at 2.4 GHz). Then the medium stays free for 12
//! symbols of four bits, 40 after a frame of more than 18 bytes.
//!
//! After an airtime of `a` a sender is silent for `a (1/duty_cycle - 1)`.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

use agent_core::Tick;

use crate::graph::Graph;
use crate::scenario::{MediumSettings, Time};

/// Bytes that IEEE 802.15.4 sends before a frame: preamble, start-of-frame delimiter, length.
const HEADER: usize = 6;
/// Bits of a symbol.
const SYMBOL: f64 = 4.0;
/// Longest frame with the short gap after it. \[byte\]
const SHORT: usize = 18;
/// Gaps between frames. \[symbol\]
const GAPS: [f64; 2] = [12.0, 40.0];
/// Rate of IEEE 802.15.4 at 2.4 GHz. \[bit/s\]
pub(super) const STANDARD_RATE: f64 = 250_000.0;

/// Returns the time on air of a frame of this many bytes. \[s\]
#[must_use]
pub(super) fn airtime(bytes: usize, rate: f64) -> f64 {
    (8 * (HEADER + bytes)) as f64 / rate
}

fn gap(bytes: usize, rate: f64) -> f64 {
    GAPS[usize::from(bytes > SHORT)] * SYMBOL / rate
}

/// A frame that waits or starts.
#[derive(Clone, Debug)]
pub(super) struct Waiting {
    pub(super) sender: usize,
    pub(super) number: u64,
    pub(super) bytes: std::sync::Arc<[u8]>,
    /// Since when the sender has had a frame waiting. \[s\]
    since: f64,
    /// When this frame was handed over. \[s\]
    sent: f64,
}

/// When a frame can start, ordered for a heap: the next one is the greatest.
#[derive(Debug, PartialEq)]
struct Start {
    time: f64,
    since: f64,
    sender: usize,
}

impl Start {
    fn new(time: f64, waiting: &Waiting) -> Self {
        Self { time, since: waiting.since, sender: waiting.sender }
    }
}

impl Eq for Start {}

impl Ord for Start {
    fn cmp(&self, other: &Self) -> Ordering {
        let time = other.time.total_cmp(&self.time);
        time.then(other.since.total_cmp(&self.since)).then(other.sender.cmp(&self.sender))
    }
}

impl PartialOrd for Start {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

#[derive(Debug)]
pub(super) struct Medium {
    settings: MediumSettings,
    graph: Graph,
    time: Time,
    /// For each agent, when the medium is free there. \[s\]
    free: Vec<f64>,
    /// For each agent, when it may send again. \[s\]
    allowed: Vec<f64>,
    waiting: Vec<Option<Waiting>>,
    /// The waiting agents.
    queue: Vec<usize>,
    held_up: u64,
}

impl Medium {
    pub(super) fn new(settings: MediumSettings, graph: &Graph, time: Time) -> Self {
        let agents = graph.agents();
        Self {
            settings,
            graph: graph.clone(),
            time,
            free: vec![0.0; agents],
            allowed: vec![0.0; agents],
            waiting: vec![None; agents],
            queue: Vec::new(),
            held_up: 0,
        }
    }

    /// Hands a frame over; returns whether it takes the place of one that has not been sent.
    pub(super) fn submit(
        &mut self,
        sender: usize,
        number: u64,
        tick: Tick,
        bytes: std::sync::Arc<[u8]>,
    ) -> bool {
        let sent = self.time.at(tick);
        let before = self.waiting[sender].take();
        let since = before.as_ref().map_or(sent, |before| before.since);
        if before.is_none() {
            self.queue.push(sender);
        }
        self.waiting[sender] = Some(Waiting { sender, number, bytes, since, sent });
        before.is_some()
    }

    /// Starts the frames that can start before the next tick, when new ones are handed over; calls
    /// `start` with each, its airtime and its end \[s\].
    pub(super) fn advance(&mut self, tick: Tick, mut start: impl FnMut(&Waiting, f64, f64)) {
        // Times are multiples of the step up to rounding.
        let before = self.time.at(tick + 1) - 1e-6 * self.time.step_size;
        let waiting = self.queue.iter().filter_map(|&sender| self.waiting[sender].as_ref());
        let mut starts: BinaryHeap<_> =
            waiting.map(|waiting| Start::new(self.earliest(waiting), waiting)).collect();
        // A start only moves later when another frame starts, so the first one that is still right is
        // the next.
        while let Some(Start { time, sender, .. }) = starts.pop() {
            if time >= before {
                break;
            }
            let Some(waiting) = self.waiting[sender].clone() else { continue };
            let begins = self.earliest(&waiting);
            if begins > time {
                starts.push(Start::new(begins, &waiting));
            } else {
                self.occupy(&waiting, begins, &mut start);
            }
        }
        let waiting = &self.waiting;
        self.queue.retain(|&sender| waiting[sender].is_some());
        self.held_up += self.queue.len() as u64;
    }

    /// Withdraws the waiting frame of this sender; returns whether there is one.
    pub(super) fn withdraw(&mut self, sender: usize) -> bool {
        self.queue.retain(|&other| other != sender);
        self.waiting[sender].take().is_some()
    }

    fn occupy(
        &mut self,
        waiting: &Waiting,
        begins: f64,
        start: &mut impl FnMut(&Waiting, f64, f64),
    ) {
        let MediumSettings { rate, duty_cycle, .. } = self.settings;
        let sender = waiting.sender;
        let airtime = airtime(waiting.bytes.len(), rate);
        let end = begins + airtime;
        let free = end + gap(waiting.bytes.len(), rate);
        self.free[sender] = free;
        for neighbour in self.graph.neighbours(sender) {
            let place = &mut self.free[neighbour.agent];
            *place = place.max(free);
        }
        self.allowed[sender] = begins + airtime / duty_cycle;
        self.waiting[sender] = None;
        start(waiting, airtime, end);
    }

    /// Returns the earliest start of a frame, as things are. \[s\]
    fn earliest(&self, waiting: &Waiting) -> f64 {
        let sender = waiting.sender;
        let own = self.free[sender].max(self.allowed[sender]).max(waiting.sent);
        let start = self
            .graph
            .neighbours(sender)
            .iter()
            .fold(own, |start, neighbour| start.max(self.free[neighbour.agent]));
        let Some(slot) = self.settings.slot else { return start };
        let slots = f64::from(self.settings.slots);
        let own_slot = (sender as u64 % u64::from(self.settings.slots)) as f64;
        // The first slot that is the sender's and does not begin before `start`.
        let round = ((start / slot - own_slot - 1e-9) / slots).ceil().max(0.0);
        (round * slots + own_slot) * slot
    }

    /// Returns for how many steps frames have waited, all added up.
    pub(super) fn count(&self) -> u64 {
        self.held_up
    }
}
