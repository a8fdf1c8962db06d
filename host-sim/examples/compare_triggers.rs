//! Runs a scenario with several triggers, and compares how accurate the agents are with how often
//! they broadcast.
//!
//! ```sh
//! cargo run --release -p host-sim --example compare_triggers -- [SCENARIO]
//! ```
//!
//! `SCENARIO` is a file or the name of a built-in scenario; without it, the paper's. The agents run
//! without learning, so that only the trigger differs.

use std::error::Error;
use std::fmt::Write as _;
use std::num::NonZeroU32;
use std::path::Path;

use host_sim::engine::{RunError, RunOptions, Silent, run};
use host_sim::scenario::{Scenario, TriggerModel, built_in};

const OPTIONS: RunOptions = RunOptions { seed: 0, learning: false, bounds: false };

/// Returns the triggers to compare: their names, and the scenario with each of them.
fn variants(scenario: &Scenario) -> Vec<(String, Scenario)> {
    let mut variants = Vec::new();
    for factor in [1.0, 4.0, 16.0] {
        let mut scenario = scenario.clone();
        scenario.trigger = TriggerModel::Event;
        scenario.design.epsilon *= factor;
        variants.push((format!("event, epsilon = {}", scenario.design.epsilon), scenario));
    }
    for every in [1, 4, 16].into_iter().filter_map(NonZeroU32::new) {
        let trigger = TriggerModel::Periodic { every };
        variants.push((format!("every {every} steps"), Scenario { trigger, ..scenario.clone() }));
    }
    variants
}

/// Returns a table: for each trigger and agent the root mean square error and the broadcasts.
pub(crate) fn table(scenario: &Scenario) -> Result<String, RunError> {
    let mut text = format!("{:24}", "RMSE / broadcasts");
    for agent in 1..=scenario.agents.len() {
        let _ = write!(text, " {:>16}", format!("agent {agent}"));
    }
    text.push('\n');
    for (name, scenario) in variants(scenario) {
        let _ = write!(text, "{name:24}");
        let result = match run(&scenario, OPTIONS, &Silent) {
            // A finding, and not a reason to leave out the other triggers.
            Err(RunError::Step { agent, time, .. }) => {
                let _ = writeln!(text, " agent {agent} diverges at t = {time} s");
                continue;
            }
            result => result?,
        };
        for agent in &result.agents {
            // The evaluation window can be empty.
            let error = agent.rmse().unwrap_or(f64::NAN);
            let _ = write!(text, " {error:8.4} /{:6}", agent.broadcasts());
        }
        text.push('\n');
    }
    Ok(text)
}

fn main() -> Result<(), Box<dyn Error>> {
    let name = std::env::args().nth(1).unwrap_or_else(|| "paper".to_owned());
    let scenario = match built_in(&name) {
        Some(text) => Scenario::parse(&name, text)?,
        None => Scenario::load(Path::new(&name))?,
    };
    print!("{}", table(&scenario)?);
    Ok(())
}
