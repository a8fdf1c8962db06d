//! Runs the field observer on the Lorenz system along paths of 4 to 32 agents: how the error grows with the distance
//! from the agents that measure.
//!
//! ```sh
//! cargo run --release -p host-sim --example paths
//! ```
//!
//! The scenario is `field-observer/lorenz-star.toml` with another graph: the first three agents measure one component each,
//! all others the sum of all components, which is not a direction and so not used. Every hop delivers a frame one step later, so a path has a latency, and halving the step
//! halves it. It prints the errors of the first and of the last agent in relation to the requested one, with the plant's
//! `f` in place of a network, and with one network for all that is trained in the run.

use std::error::Error;

use host_sim::engine::{RunOptions, Silent, run};
use host_sim::scenario::{Method, Scenario};
use rayon::prelude::*;

type Failure = Box<dyn Error + Send + Sync>;

/// Errors of the first and of the last agent, in relation to the requested one.
///
/// # Errors
/// The run fails.
pub(crate) fn errors(agents: usize, step: f64, knows_f: bool) -> Result<[f64; 2], Failure> {
    let star = include_str!("field-observer/lorenz-star.toml");
    let changed = |text: &str, old: &str, new: &str| {
        text.contains(old).then(|| text.replace(old, new)).ok_or(format!("{old} is not there"))
    };
    let path = changed(star, "edges = [[1, 2], [1, 3]]", "topology = \"path\"")?;
    let text = changed(&path, "step = 0.001", &format!("step = {step:?}"))?
        + &"[[agents]]\noutput_matrix = [[1.0, 1.0, 1.0]]\n".repeat(agents.saturating_sub(3));
    let mut scenario = Scenario::parse("path.toml", &text)?;
    if knows_f {
        scenario.method = Method::KnownModel;
        scenario.learning.clear();
    }
    let observer = scenario.observer.as_mut().ok_or("no observer")?;
    // The paper's observer, from whose estimates the network would learn, errs too much along long paths.
    observer.from = 0.0;
    let requested = observer.error;
    let options = RunOptions { seed: 0, learning: true, bounds: false };
    let result = run(&scenario, options, &Silent)?;
    // The root of the summed variances, of which `rmse` is a share.
    let (rows, window) = (result.traces.rows(), &scenario.evaluation);
    let rows: Vec<usize> = (0..rows)
        .filter(|&row| (window.from..=window.to).contains(&result.traces.time()[row]))
        .collect();
    let mean =
        |f: &dyn Fn(usize) -> f64| rows.iter().map(|&row| f(row)).sum::<f64>() / rows.len() as f64;
    let variance = |c: usize| {
        let average = mean(&|row| result.traces.truth(row)[c]);
        mean(&|row| (result.traces.truth(row)[c] - average).powi(2))
    };
    let size = (0..scenario.dimension()).map(variance).sum::<f64>().sqrt();
    let share = |agent: usize| {
        let rmse = result.agents[agent].rmse().ok_or("no error")?;
        Ok::<_, Failure>(rmse / size / requested)
    };
    Ok([share(0)?, share(agents - 1)?])
}

fn main() -> Result<(), Failure> {
    println!(
        "agents  step [ms]  error/requested with the plant's f: first  last  with a trained network: first  last"
    );
    let cases: Vec<_> =
        [4, 8, 16, 32].iter().flat_map(|&agents| [(agents, 1e-3), (agents, 5e-4)]).collect();
    let both = |&(agents, step): &(usize, f64)| {
        Ok([errors(agents, step, true)?, errors(agents, step, false)?])
    };
    let found: Vec<_> = cases.par_iter().map(both).collect::<Result<_, Failure>>()?;
    for ((agents, step), [known, trained]) in cases.iter().zip(found) {
        println!(
            "{agents:6}  {:9}  {:43.2}  {:4.2}  {:29.2}  {:4.2}",
            1e3 * step,
            known[0],
            known[1],
            trained[0],
            trained[1]
        );
    }
    Ok(())
}
