//! Statistics of a soak test.

use std::collections::BTreeMap;
use std::fmt;
use std::time::{Duration, Instant};

use agent_core::service::receive;
use host_sim::service::Message;

/// Interval between two lines of progress.
const INTERVAL: Duration = Duration::from_secs(5);

/// Statistics so far.
#[derive(Debug)]
pub(super) struct Tally {
    begun: Instant,
    told: Instant,
    pub(super) steps: u64,
    pub(super) node_steps: u64,
    pub(super) compared_bytes: u64,
    pub(super) mismatching_bytes: u64,
    pub(super) wrong_acceptances: u64,
    faults: BTreeMap<&'static str, u64>,
    pushed: BTreeMap<&'static str, u64>,
    answers: BTreeMap<String, u64>,
    events: BTreeMap<&'static str, u64>,
    pub(super) longest_answer: Duration,
    /// Stack that a node never used. \[byte\]
    stack_unused: Option<u32>,
    pub(super) recoveries: u64,
    /// The error bound after faults, and the largest error found.
    pub(super) bound: f64,
    pub(super) largest_error: f64,
}

impl Tally {
    pub(super) fn new() -> Self {
        let now = Instant::now();
        Self {
            begun: now,
            told: now,
            steps: 0,
            node_steps: 0,
            compared_bytes: 0,
            mismatching_bytes: 0,
            wrong_acceptances: 0,
            faults: BTreeMap::new(),
            pushed: BTreeMap::new(),
            answers: BTreeMap::new(),
            events: BTreeMap::new(),
            longest_answer: Duration::ZERO,
            stack_unused: None,
            recoveries: 0,
            bound: f64::INFINITY,
            largest_error: 0.0,
        }
    }

    pub(super) fn fault(&mut self, kind: &'static str) {
        *self.faults.entry(kind).or_default() += 1;
    }

    /// Counts the start of a push of a package of this kind.
    pub(super) fn push(&mut self, kind: &'static str) {
        *self.pushed.entry(kind).or_default() += 1;
    }

    /// Counts the result of a request about packages.
    pub(super) fn answer(&mut self, answer: String) {
        *self.answers.entry(answer).or_default() += 1;
    }

    pub(super) fn event(&mut self, event: &'static str) {
        *self.events.entry(event).or_default() += 1;
    }

    pub(super) fn count_of(&self, name: &str) -> u64 {
        let tables = [&self.faults, &self.pushed, &self.events];
        let counts = tables.iter().filter_map(|table| table.get(name));
        counts.chain(self.answers.get(name)).sum()
    }

    /// Records a node's unused stack, if reported.
    pub(super) fn stack(&mut self, message: &[u8]) {
        if let Some(Message::Status(status) | Message::Hello(status)) = receive(message) {
            let least = self.stack_unused.into_iter().chain(status.stack_unused).min();
            self.stack_unused = least;
        }
    }

    fn rate(&self) -> f64 {
        self.steps as f64 / self.begun.elapsed().as_secs_f64()
    }

    /// Prints the progress every few seconds.
    pub(super) fn progress(&mut self, steps: u64) {
        if self.told.elapsed() < INTERVAL {
            return;
        }
        self.told = Instant::now();
        println!(
            "soak: {} of {steps} steps, {:.0} steps/s, {} faults, {} resets and restarts",
            self.steps,
            self.rate(),
            self.faults.values().sum::<u64>(),
            self.count_of("reset") + self.count_of("power cut"),
        );
    }
}

impl fmt::Display for Tally {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let line = |f: &mut fmt::Formatter<'_>, name: &str, value: &dyn fmt::Display| {
            writeln!(f, "  {name:44} {value:>12}")
        };
        line(f, "steps", &self.steps)?;
        line(f, "steps of nodes", &self.node_steps)?;
        line(f, "bytes compared", &self.compared_bytes)?;
        line(f, "mismatching bytes", &self.mismatching_bytes)?;
        writeln!(f, "faults")?;
        for (name, count) in &self.faults {
            line(f, name, count)?;
        }
        writeln!(f, "packages pushed")?;
        for (name, count) in &self.pushed {
            line(f, name, count)?;
        }
        writeln!(f, "answers")?;
        for (name, count) in &self.answers {
            line(f, name, count)?;
        }
        writeln!(f, "of nodes")?;
        for (name, count) in &self.events {
            line(f, name, count)?;
        }
        if let Some(bytes) = self.stack_unused {
            line(f, "least unused stack [byte]", &bytes)?;
        }
        line(f, "wrong acceptances", &self.wrong_acceptances)?;
        line(f, "calm periods with recovery", &self.recoveries)?;
        line(f, "largest error in them", &format_args!("{:.4}", self.largest_error))?;
        line(f, "bound of that error", &format_args!("{:.4}", self.bound))?;
        line(
            f,
            "longest answer [ms]",
            &format_args!("{:.1}", self.longest_answer.as_secs_f64() * 1e3),
        )?;
        line(f, "seconds", &format_args!("{:.1}", self.begun.elapsed().as_secs_f64()))?;
        line(f, "steps/s", &format_args!("{:.0}", self.rate()))
    }
}
