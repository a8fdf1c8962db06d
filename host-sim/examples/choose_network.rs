//! Trains networks of several widths on one recording, writes the best one as a weight package, and
//! runs the scenario with it.
//!
//! ```sh
//! host-sim run paper --out first
//! cargo run --release -p host-sim --example choose_network -- first/agent1_cycle1_samples.csv best.weights
//! ```
//!
//! The recording is agent 1's of the paper's scenario. The outer weights stay as recorded, so the last
//! layer keeps its width; the layers before it get the widths to compare.

use std::error::Error;
use std::ops::ControlFlow;
use std::path::Path;

use agent_core::observer::network::{Architecture, Layer};
use host_sim::engine::{RunOptions, Silent, run};
use host_sim::learning::trained::{INITIAL_VERSION, Trained, TrainingTask};
use host_sim::packages::Recording;
use host_sim::scenario::{Network, PAPER, Scenario};

const AGENT: usize = 0;
const SEED: u64 = 0;
const OPTIONS: RunOptions = RunOptions { seed: SEED, learning: false, bounds: false };

/// Trains the scenario's network, its hidden layers changed to `width`, on the recording.
fn train(
    scenario: &Scenario,
    network: &Network,
    width: u8,
    recording: &Recording,
) -> Result<Trained, Box<dyn Error>> {
    let mut layers: Vec<Layer> = network.architecture.layers().to_vec();
    if let Some((_, hidden)) = layers.split_last_mut() {
        hidden.iter_mut().for_each(|layer| layer.width = width);
    }
    let architecture = Architecture::new(scenario.dimension(), &layers)?;
    let network = Network { architecture, ..network.clone() };
    let task = TrainingTask {
        scenario,
        network: &network,
        recipe: scenario.recipe("better").ok_or("the scenario has no recipe better")?,
        agent: AGENT,
        cycle: 0,
        seed: SEED,
        epoch: 0,
        version: INITIAL_VERSION + 1,
    };
    Ok(task.carry_out(recording, &mut |_| ControlFlow::Continue(()))?)
}

/// Trains one network for each width and writes the one that explains most to `out`; returns what
/// was found.
pub(crate) fn choose(
    scenario: &Scenario,
    widths: &[u8],
    samples: &Path,
    out: &Path,
) -> Result<String, Box<dyn Error>> {
    let network = scenario.network.as_ref().ok_or("the scenario has no network")?;
    let features = network.architecture.features();
    let recording = Recording::load(samples, scenario.dimension(), features)?;
    let mut text = "width  parameters  error on the test samples\n".to_owned();
    let mut best: Option<(f64, Trained)> = None;
    for &width in widths {
        let trained = train(scenario, network, width, &recording)?;
        let test = trained.quality.test.ok_or("the recipe keeps no samples for the test")?;
        let parameters = trained.package.architecture().parameter_count();
        text += &format!("{width:5}  {parameters:10}  {:.5}\n", test.error);
        if best.as_ref().is_none_or(|(error, _)| test.error < *error) {
            best = Some((test.error, trained));
        }
    }
    let (_, best) = best.ok_or("no widths to compare")?;
    best.package.save(out)?;

    // The same run with the scenario's untrained network and with this one.
    let mut changed = scenario.clone();
    changed.agents[AGENT].package = Some(best.package);
    for (name, scenario) in [("untrained", scenario), ("trained", &changed)] {
        let error = run(scenario, OPTIONS, &Silent)?.agents[AGENT].rmse();
        text += &format!("RMSE of agent 1, {name}: {:.4}\n", error.unwrap_or(f64::NAN));
    }
    Ok(text)
}

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [samples, out] = &arguments[..] else {
        return Err("usage: choose_network SAMPLES.csv OUT.weights".into());
    };
    let scenario = Scenario::parse("paper", PAPER)?;
    print!("{}", choose(&scenario, &[4, 8, 12, 16], Path::new(samples), Path::new(out))?);
    Ok(())
}
