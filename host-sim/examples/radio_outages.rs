//! Runs the paper's scenario over a link of one's own: radios that hear nothing for a while.
//!
//! ```sh
//! cargo run --release -p host-sim --example radio_outages
//! ```
//!
//! To make such a link a key of scenario files, see "Add a link or sensor model" in CONTRIBUTING.md.

use std::error::Error;
use std::fmt::Write as _;

use agent_core::Tick;
use host_sim::engine::link::{Link, Lossless};
use host_sim::engine::{RunError, RunOptions, RunResult, Silent, run_over};
use host_sim::scenario::{PAPER, Scenario};

const OPTIONS: RunOptions = RunOptions { seed: 0, learning: false, bounds: false };

/// Length of an outage. \[ticks\]
const OUTAGE: Tick = 200;

/// A link whose receivers fail independently of each other, for [`OUTAGE`] ticks at a time.
pub(crate) struct Outages {
    link: Lossless,
    seed: u64,
    /// The share of time that a receiver hears nothing, 0 to 1.
    share: f64,
}

impl Outages {
    /// Creates a link along every edge of the scenario's graph.
    pub(crate) fn new(scenario: &Scenario, seed: u64, share: f64) -> Self {
        Self { link: Lossless::new(&scenario.graph), seed, share }
    }

    /// Whether `receiver`, from 0, hears nothing at `tick`: a function of the seed, the tick and the
    /// receiver, never of the order of calls, because the engine may deliver on several threads.
    fn is_deaf(&self, receiver: usize, tick: Tick) -> bool {
        let draw = mix(mix(self.seed ^ receiver as u64) ^ (tick / OUTAGE));
        // The upper 53 bits, as a number in [0, 1).
        ((draw >> 11) as f64) / ((1_u64 << 53) as f64) < self.share
    }
}

impl Link for Outages {
    fn send(&mut self, sender: usize, tick: Tick, frame: &[u8]) {
        self.link.send(sender, tick, frame);
    }

    fn deliver(&self, receiver: usize, tick: Tick, accept: &mut dyn FnMut(&[u8])) {
        if !self.is_deaf(receiver, tick) {
            self.link.deliver(receiver, tick, accept);
        }
    }
}

/// Steele, Lea and Flood's SplitMix64: a different number for each argument, evenly distributed.
fn mix(number: u64) -> u64 {
    let sum = number.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let once = (sum ^ (sum >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let twice = (once ^ (once >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    twice ^ (twice >> 31)
}

/// Runs the scenario with receivers that are deaf for this share of the time.
pub(crate) fn result(scenario: &Scenario, share: f64) -> Result<RunResult, RunError> {
    run_over(scenario, Outages::new(scenario, OPTIONS.seed, share), OPTIONS, &Silent)
}

fn main() -> Result<(), Box<dyn Error>> {
    let scenario = Scenario::parse("paper", PAPER)?;
    let mut text = "RMSE of each agent by the share of time that its radio is deaf\n".to_owned();
    for share in [0.0, 0.05, 0.2, 0.5] {
        let _ = write!(text, "{:4.0} %", 100.0 * share);
        for agent in &result(&scenario, share)?.agents {
            let _ = write!(text, " {:8.4}", agent.rmse().unwrap_or(f64::NAN));
        }
        text.push('\n');
    }
    print!("{text}");
    Ok(())
}
