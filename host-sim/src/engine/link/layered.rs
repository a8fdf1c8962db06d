//! A link of layers: every copy of a frame passes all of them, and arrives if it comes out.

use std::collections::BTreeMap;
use std::sync::Arc;

use agent_core::Tick;

use super::burst::BurstLoss;
use super::calendar::Calendar;
use super::connection::Connection;
use super::corrupt::Corrupt;
use super::delay::Delay;
use super::duplicate::Duplicate;
use super::layer::{Effect, Layer, Transmission};
use super::loss::Loss;
use super::medium::{Medium, STANDARD_RATE, airtime};
use super::{LayerCount, Link, Traffic};
use crate::graph::Graph;
use crate::scenario::{EdgeSettings, LinkSettings, Scenario, Time};

/// See the module documentation.
#[derive(Debug)]
pub struct Layered {
    graph: Graph,
    time: Time,
    schedule: Schedule,
    medium: Option<Medium>,
    layers: Vec<Box<dyn Layer>>,
    calendar: Calendar,
    /// For each agent, the ticks in which it is down, and receives nothing.
    down: Vec<Vec<std::ops::Range<Tick>>>,
    /// Number of frames of each sender so far.
    numbers: Vec<u64>,
    traffic: Vec<Traffic>,
    /// For each receiver, what has arrived for the current tick.
    arrived: Vec<Vec<Arc<[u8]>>>,
    /// Receivers for which something has arrived.
    receivers: Vec<usize>,
    /// Copies that arrived at a node that was down.
    missed: u64,
    replaced: u64,
    /// Frames that waited for the medium when their sender went down.
    withdrawn: u64,
}

/// What edges do, over time.
#[derive(Clone, Debug)]
struct Schedule {
    link: LinkSettings,
    time: Time,
    /// Indices of the rules for an edge, by its smaller and its larger agent.
    rules: BTreeMap<(usize, usize), Vec<usize>>,
}

impl Schedule {
    fn new(link: &LinkSettings, time: Time) -> Self {
        let mut rules: BTreeMap<_, Vec<_>> = BTreeMap::new();
        for (index, rule) in link.rules.iter().enumerate() {
            rules.entry(sorted(rule.ends)).or_default().push(index);
        }
        Self { link: link.clone(), time, rules }
    }

    /// Returns what the edge does to a frame that starts at `tick`.
    fn at(&self, sender: usize, receiver: usize, tick: Tick) -> EdgeSettings {
        let holds = |window: &crate::scenario::Window| window.ticks(&self.time).contains(&tick);
        let rules =
            if self.rules.is_empty() { None } else { self.rules.get(&sorted([sender, receiver])) };
        let mut rules = rules.into_iter().flatten().rev().map(|&index| &self.link.rules[index]);
        let rule = rules.find(|rule| holds(&rule.window));
        let mut edge = rule.map_or(self.link.edge, |rule| rule.edge);
        let parted = self.link.partitions.iter().any(|partition| {
            partition.group[sender] != partition.group[receiver] && holds(&partition.window)
        });
        edge.connected &= !parted;
        edge
    }
}

fn sorted(ends: [usize; 2]) -> (usize, usize) {
    (ends[0].min(ends[1]), ends[0].max(ends[1]))
}

impl Layered {
    /// Creates the link of a scenario, with every layer.
    #[must_use]
    pub fn new(scenario: &Scenario, seed: u64) -> Self {
        let Scenario { graph, link, time, life, .. } = scenario;
        let agents = graph.agents();
        let mut down = vec![Vec::new(); agents];
        for downtime in life {
            down[downtime.agent].push(downtime.window.ticks(time));
        }
        Self {
            graph: graph.clone(),
            time: *time,
            schedule: Schedule::new(link, *time),
            medium: link.medium.map(|settings| Medium::new(settings, graph, *time)),
            layers: vec![
                Box::new(Connection::default()),
                Box::new(BurstLoss::new(seed)),
                Box::new(Loss::new(seed)),
                Box::new(Delay::new(seed)),
                Box::new(Duplicate::new(seed)),
                Box::new(Corrupt::new(seed)),
            ],
            calendar: Calendar::default(),
            down,
            numbers: vec![0; agents],
            traffic: vec![Traffic::default(); agents],
            arrived: vec![Vec::new(); agents],
            receivers: Vec::new(),
            missed: 0,
            replaced: 0,
            withdrawn: 0,
        }
    }

    /// Sends a copy of a frame that ends at `end` \[s\] to each neighbour.
    fn spread(&mut self, sender: usize, number: u64, now: Tick, end: f64, bytes: &Arc<[u8]>) {
        let Self { graph, time, schedule, layers, calendar, traffic, .. } = self;
        for neighbour in graph.neighbours(sender) {
            let receiver = neighbour.agent;
            let edge = schedule.at(sender, receiver, now);
            let transmission = Transmission {
                sender,
                receiver,
                number,
                twin: 0,
                arrival: end,
                bytes: bytes.clone(),
            };
            let mut arrives = false;
            pass(layers, &edge, transmission, &mut |transmission| {
                arrives = true;
                // The first step that does not start before it; times are multiples of the step up to
                // rounding.
                let due = (transmission.arrival / time.step_size - 1e-6).ceil() as Tick;
                calendar.add(due.max(now), now, transmission);
            });
            traffic[sender].lost += u64::from(!arrives);
        }
    }
}

/// Passes a copy through the layers, one after the other.
fn pass(
    layers: &mut [Box<dyn Layer>],
    edge: &EdgeSettings,
    transmission: Transmission,
    out: &mut dyn FnMut(Transmission),
) {
    match layers {
        [] => out(transmission),
        [first, rest @ ..] => {
            first
                .carry(edge, transmission, &mut |transmission| pass(rest, edge, transmission, out));
        }
    }
}

impl Link for Layered {
    fn send(&mut self, sender: usize, tick: Tick, frame: &[u8]) {
        let number = self.numbers[sender];
        self.numbers[sender] += 1;
        let bytes: Arc<[u8]> = frame.into();
        match &mut self.medium {
            Some(medium) => {
                if medium.submit(sender, number, tick, bytes) {
                    self.replaced += 1;
                    self.traffic[sender].lost += self.graph.neighbours(sender).len() as u64;
                }
            }
            None => {
                self.traffic[sender].airtime += airtime(frame.len(), STANDARD_RATE);
                let sent = self.time.at(tick);
                self.spread(sender, number, tick, sent, &bytes);
            }
        }
    }

    fn advance(&mut self, tick: Tick) {
        for receiver in self.receivers.drain(..) {
            self.arrived[receiver].clear();
        }
        if let Some(medium) = &mut self.medium {
            for (sender, down) in self.down.iter().enumerate() {
                // A node without power sends nothing.
                if down.iter().any(|ticks| ticks.contains(&tick)) && medium.withdraw(sender) {
                    self.withdrawn += 1;
                    self.traffic[sender].lost += self.graph.neighbours(sender).len() as u64;
                }
            }
            let mut started = Vec::new();
            medium.advance(tick, |frame, airtime, end| started.push((frame.clone(), airtime, end)));
            for (frame, airtime, end) in started {
                self.traffic[frame.sender].airtime += airtime;
                self.spread(frame.sender, frame.number, tick, end, &frame.bytes);
            }
        }
        let Self { calendar, arrived, receivers, down, traffic, missed, .. } = self;
        calendar.take_due(tick, |transmission| {
            let Transmission { sender, receiver, bytes, .. } = transmission;
            if down[receiver].iter().any(|ticks| ticks.contains(&tick)) {
                *missed += 1;
                traffic[sender].lost += 1;
                return;
            }
            traffic[sender].delivered += 1;
            if arrived[receiver].is_empty() {
                receivers.push(receiver);
            }
            arrived[receiver].push(bytes);
        });
    }

    #[inline]
    fn deliver(&self, receiver: usize, _: Tick, accept: &mut dyn FnMut(&[u8])) {
        for bytes in &self.arrived[receiver] {
            accept(bytes);
        }
    }

    fn traffic(&self, sender: usize) -> Option<Traffic> {
        Some(self.traffic[sender])
    }

    fn layer_counts(&self) -> Vec<LayerCount> {
        let medium = self.medium.iter().flat_map(|medium| {
            let waited = Effect::Alters("steps of waiting for the medium");
            let replaced =
                Effect::Loses("frames that newer ones replaced while they waited for the medium");
            let withdrawn = Effect::Loses("frames whose sender went down while they waited");
            [
                ("waiting-steps", waited, medium.count()),
                ("replaced", replaced, self.replaced),
                ("sender-down", withdrawn, self.withdrawn),
            ]
        });
        let layers = self.layers.iter().map(|layer| (layer.name(), layer.effect(), layer.count()));
        let missed = Effect::Loses("because the receiver was down");
        medium
            .chain(layers)
            .chain([("receiver-down", missed, self.missed)])
            .map(|(layer, effect, count)| LayerCount { layer, effect, count })
            .collect()
    }
}
