//! Runs the field observer on plants, graphs and output matrices that it was not tuned for: everything is derived
//! from one requested error.
//!
//! ```sh
//! cargo run --release -p host-sim --example random_geometries -- [GEOMETRIES]
//! ```
//!
//! For each of five plants it draws connected graphs of 4 to 12 agents, each of which measures one or two random linear
//! combinations of the state. Printed are, over all geometries, the worst agent's error in relation to the requested one and
//! the broadcasts per agent per second: without a network, with one that the agents trained in the run, and with
//! the plant's own `f`, which no agent knows.

use std::error::Error;
use std::f64::consts::TAU;
use std::fmt::Write as _;
use std::ops::Range;

use host_sim::engine::traces::Traces;
use host_sim::engine::{RunError, RunOptions, Silent, run};
use host_sim::scenario::Scenario;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

/// Requested error, a fraction of the state's standard deviation.
const ERROR: f64 = 0.014;
/// Features of the network.
const FEATURES: usize = 12;
/// Rows of the traces are so many steps apart.
const STRIDE: u32 = 5;
const STEP: f64 = 1e-3;
/// When errors and broadcasts are evaluated. \[s\]
const EVALUATED: [f64; 2] = [20.0, 30.0];

type Failure = Box<dyn Error + Send + Sync>;

/// A plant: its states' derivatives, its initial state, and the amplitudes of its disturbance.
pub(crate) struct Plant {
    pub(crate) name: &'static str,
    derivative: Vec<String>,
    initial_state: Vec<f64>,
    amplitudes: Vec<f64>,
}

/// Returns the plants, whose states are `s1`, `s2`, ...
pub(crate) fn plants() -> Vec<Plant> {
    let lorenz = ["10*(s2 - s1)", "s1*(28 - s3) - s2", "s1*s2 - 8/3*s3"];
    let duffing = [
        "s2",
        "-0.2*s2 - s1 - s1^3 + 0.5*(s3 - s1)",
        "s4",
        "-0.3*s4 - 0.8*s3 - 0.7*s3^3 + 0.5*(s1 - s3)",
    ];
    let pendulums = [
        "s2",
        "-4*sin(s1) - 0.15*s2 + 1.5*(s3 - s1)",
        "s4",
        "-5*sin(s3) - 0.15*s4 + 1.5*(s1 + s5 - 2*s3)",
        "s6",
        "-6*sin(s5) - 0.15*s6 + 1.5*(s3 - s5)",
    ];
    let linear = [
        "s2",
        "-2*s1 - 0.04*s2 + s3 - s1",
        "s4",
        "-5*s3 - 0.04*s4 + s1 + s5 - 2*s3",
        "s6",
        "-8*s5 - 0.04*s6 + s3 - s5",
    ];
    // Indices count in a circle.
    let at = |index: usize| index % 6 + 1;
    let lorenz96 =
        |c: usize| format!("(s{} - s{})*s{} - s{} + 8", at(c + 1), at(c + 4), at(c + 5), at(c));
    let plant = |name, derivative: &[&str], initial_state: &[f64], amplitudes: &[f64]| Plant {
        name,
        derivative: derivative.iter().map(|&rate| rate.to_owned()).collect(),
        initial_state: initial_state.to_owned(),
        amplitudes: amplitudes.to_owned(),
    };
    vec![
        plant("Lorenz", &lorenz, &[1.0, 1.0, 20.0], &[2.0, 3.0, 2.0]),
        plant("Duffing", &duffing, &[1.5, 0.0, -1.0, 0.5], &[0.2, 1.5, 0.2, 1.2]),
        plant(
            "pendulums",
            &pendulums,
            &[1.0, 0.0, -0.5, 0.0, 0.5, 0.0],
            &[0.05, 2.0, 0.05, 1.5, 0.05, 1.8],
        ),
        plant(
            "linear",
            &linear,
            &[1.0, 0.0, -0.5, 0.0, 0.5, 0.0],
            &[0.05, 0.3, 0.05, 0.3, 0.05, 0.3],
        ),
        Plant {
            name: "Lorenz-96",
            derivative: (0..6).map(lorenz96).collect(),
            initial_state: vec![8.0, 9.0, 7.0, 8.5, 7.5, 8.0],
            amplitudes: vec![1.5; 6],
        },
    ]
}

/// What agents know of the plant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Knowledge {
    /// They use no network.
    Nothing,
    /// They train one network for all on what they record in the run.
    Trained,
    /// The plant's own `f` in place of a network.
    Plant,
}

/// Returns the scenario of a plant with agents, graph, outputs and disturbance that `seed` draws. A network can
/// represent rates up to `largest`, shape `[n]`.
fn scenario(
    plant: &Plant,
    seed: u64,
    knowledge: Knowledge,
    largest: &[f64],
) -> Result<Scenario, Failure> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let n = plant.initial_state.len();
    let states: Vec<String> = (1..=n).map(|state| format!("s{state}")).collect();
    let mut wave = |amplitude: &f64| {
        let (frequency, phase) = (random.random_range(1.0..4.0), random.random_range(0.0..TAU));
        format!("{amplitude:?}*sin({frequency:?}*t + {phase:?})")
    };
    let components: Vec<String> = plant.amplitudes.iter().map(&mut wave).collect();
    // Together, the agents see the whole state.
    let rows = loop {
        let agents = random.random_range(4..=12);
        let rows: Vec<usize> = (0..agents).map(|_| random.random_range(1..=2)).collect();
        if rows.iter().sum::<usize>() >= n {
            break rows;
        }
    };
    let mut edges = Vec::new();
    for second in 2..=rows.len() {
        // A tree, so that the graph is connected, and some more.
        let (parent, other) = (random.random_range(1..second), random.random_range(1..second));
        edges.push([parent, second]);
        if other != parent && random.random_bool(0.15) {
            edges.push([other, second]);
        }
    }
    let layer = |nodes: usize| format!("{{ nodes = {nodes}, activation = \"tanh\" }}");
    let layers = [layer(12), layer(12), layer(FEATURES)].join(", ");
    let outer: Vec<Vec<f64>> = (0..FEATURES)
        .map(|_| largest.iter().map(|largest| largest * random.random_range(-0.5..0.5)).collect())
        .collect();
    let bound = 2.0 * outer.iter().flatten().map(|weight| weight * weight).sum::<f64>().sqrt();
    let (method, learning) = match knowledge {
        Knowledge::Nothing => ("observer", "network = false"),
        Knowledge::Plant => ("known-f", "hold = \"model\""),
        Knowledge::Trained => ("observer", LEARNING),
    };
    let [from, to] = EVALUATED;
    let mut text = format!(
        "name = \"random-geometry\"\nmethod = \"{method}\"\n\
         [plant]\nmodel = \"expressions\"\nstates = {states:?}\nderivative = {:?}\ninitial_state = {:?}\n\
         [disturbance]\nmodel = \"expressions\"\ncomponents = {components:?}\n\
         [time]\nduration = {to:?}\nstep = {STEP:?}\n\
         [design]\ngain = 100.0\nk2 = 10.0\nkappa = 1.0\nrho = 2.0\ndelta = 0.3\nepsilon = 100.0\n\
         [graph]\nedges = {edges:?}\n\
         [evaluation]\nfrom = {from:?}\nto = {to:?}\n\
         [record]\ntrace_stride = {STRIDE}\nevents = false\nsamples = false\n\
         [network]\nlayers = [{layers}]\ninner = {{ random = \"glorot\" }}\nouter = {outer:?}\n\
         [outer_law]\ngain = 1.0\nbound = {bound:?}\n\
         [observer]\npreset = \"field\"\nerror = {ERROR:?}\n{learning}\n",
        plant.derivative, plant.initial_state,
    );
    for rows in rows {
        let mut row = || (0..n).map(|_| random.random_range(-1.0..1.0)).collect::<Vec<f64>>();
        let rows: Vec<Vec<f64>> = (0..rows).map(|_| row()).collect();
        let _ = write!(text, "[[agents]]\noutput_matrix = {rows:?}\n");
    }
    Ok(Scenario::parse("random geometry", &text)?)
}

/// One network for all, from the first half of the run.
const LEARNING: &str = "hold = \"model\"\n\
    [[learning]]\ncollect_from = 5.0\ncollect_to = 15.0\napply_at = 16.0\nrecipe = \"smoothed\"\nshared = true\n\
    [recipes.smoothed]\nsmoothing_window = 0.05\ndecimation = 10\ninitial = { random = \"glorot\" }\nepochs = 80\n\
    goal = 0.0";

/// Returns the largest rates of the state, shape `[n]`. \[1/s\]
fn largest_rates(traces: &Traces) -> Vec<f64> {
    let between = f64::from(STRIDE) * STEP;
    let rate = |row: usize, c: usize| (traces.truth(row + 1)[c] - traces.truth(row)[c]) / between;
    let largest = |c| (1..traces.rows() - 1).map(|row| rate(row, c).abs()).fold(0.0, f64::max);
    (0..traces.dimension()).map(largest).collect()
}

/// Returns the worst agent's error in the evaluation window: the root mean square over time and components, each
/// in standard deviations of the plant's over the whole run, which is what `observer.error` is a fraction of.
fn worst_error(traces: &Traces) -> f64 {
    let n = traces.dimension();
    let start = traces.time().partition_point(|&time| time < EVALUATED[0]);
    let mean = |rows: Range<usize>, value: &dyn Fn(usize) -> f64| {
        let count = rows.len() as f64;
        rows.map(value).sum::<f64>() / count
    };
    let variance = |c: usize| {
        let middle = mean(0..traces.rows(), &|row| traces.truth(row)[c]);
        mean(0..traces.rows(), &|row| (traces.truth(row)[c] - middle).powi(2))
    };
    let variances: Vec<f64> = (0..n).map(variance).collect();
    let squared = |agent: usize| {
        let of = |c: usize| {
            let error = |row| f64::from(traces.estimate(row, agent)[c]) - traces.truth(row)[c];
            mean(start..traces.rows(), &|row| error(row).powi(2)) / variances[c]
        };
        (0..n).map(of).sum::<f64>() / n as f64
    };
    (0..traces.agents()).map(squared).fold(0.0, f64::max).sqrt()
}

/// What one geometry gave: the worst agent's error in relation to the requested one, and broadcasts per agent per second.
pub(crate) type Found = (f64, f64);

/// Runs a geometry with each knowledge; `None` where the scenario is refused, because no settings keep the
/// requested error.
///
/// # Errors
/// A run fails for another reason.
pub(crate) fn geometry(
    plant: &Plant,
    seed: u64,
) -> Result<[(Knowledge, Option<Found>); 3], Failure> {
    let mut largest = vec![1.0; plant.initial_state.len()];
    let mut found = [Knowledge::Nothing, Knowledge::Trained, Knowledge::Plant].map(|k| (k, None));
    for (knowledge, found) in &mut found {
        let scenario = scenario(plant, seed, *knowledge, &largest)?;
        let result =
            match run(&scenario, RunOptions { seed, learning: true, bounds: false }, &Silent) {
                Err(RunError::Observer(_)) => continue,
                result => result?,
            };
        largest = largest_rates(&result.traces);
        let broadcasts: u64 = result.agents.iter().map(|agent| agent.broadcasts_evaluated).sum();
        let seconds = (EVALUATED[1] - EVALUATED[0]) * result.agents.len() as f64;
        *found = Some((worst_error(&result.traces) / ERROR, broadcasts as f64 / seconds));
    }
    Ok(found)
}

/// Returns the median and the largest of these numbers.
fn median_and_largest(mut numbers: Vec<f64>) -> (f64, f64) {
    numbers.sort_by(f64::total_cmp);
    let at = |index: usize| numbers.get(index).copied().unwrap_or(f64::NAN);
    (at(numbers.len() / 2), at(numbers.len().saturating_sub(1)))
}

fn main() -> Result<(), Failure> {
    let count: u64 = std::env::args().nth(1).map_or(Ok(25), |count| count.parse())?;
    println!(
        "plant      knows    refused  error/requested, median (worst)  broadcasts, median (worst) [1/s]"
    );
    for plant in plants() {
        let runs: Vec<_> = (1..=count)
            .into_par_iter()
            .map(|seed| geometry(&plant, seed))
            .collect::<Result<_, _>>()?;
        for index in 0..3 {
            let knowledge = runs[0][index].0;
            let found: Vec<Found> = runs.iter().filter_map(|run| run[index].1).collect();
            let (error, worst) = median_and_largest(found.iter().map(|run| run.0).collect());
            let (often, most) = median_and_largest(found.iter().map(|run| run.1).collect());
            println!(
                "{:9}  {:7}  {:7}  {error:23.2} ({worst:.2})  {often:25.1} ({most:.1})",
                plant.name,
                format!("{knowledge:?}").to_lowercase(),
                runs.len() - found.len(),
            );
        }
    }
    Ok(())
}
