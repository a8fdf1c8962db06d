//! Runs the field observer on five plants with random graphs, output matrices and disturbances. Its gains, radii and
//! clips are derived from one requested error; networks and training are the same for all.
//!
//! ```sh
//! cargo run --release -p host-sim --example random_geometries -- [GEOMETRIES]
//! ```
//!
//! For each plant it draws connected graphs of 4 to 12 agents, each of which measures one or two random linear
//! combinations of the state; plants with as many states get the same ones. It prints, over all geometries, the worst
//! agent's error in relation to the requested one and the broadcasts per agent per second: without a network, with
//! one for all agents that is trained in the run, and with the plant's own `f` in its place, to compare.
//!
//! The outer weights of networks are scaled by the plant's largest rate until samples end, which the simulator knows.

use std::error::Error;
use std::f64::consts::TAU;
use std::fmt::Write as _;

use host_sim::engine::traces::Traces;
use host_sim::engine::{RunError, RunOptions, Silent, run};
use host_sim::flow::{PlanError, Trajectory, plant_course};
use host_sim::scenario::Scenario;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

/// Requested error, a fraction of the state's standard deviation.
const ERROR: f64 = 0.014;
/// Features of the network.
const FEATURES: usize = 12;
/// Steps between two rows of the traces.
const STRIDE: u32 = 5;
const STEP: f64 = 1e-3;
/// When samples are taken, and when errors and broadcasts are evaluated. \[s\]
const COLLECTED: [f64; 2] = [5.0, 15.0];
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
    /// They have `1.05 f` and a bias in place of a network, to compare. The bias is a wave over the state, with an
    /// amplitude of 5 % of the state's standard deviation, per second.
    Nearly,
    /// They have the plant's own `f` in place of a network, to compare.
    Plant,
}

/// What a plant's motion is like, in each component, shape `[n]`.
struct Scales {
    /// Largest rates until samples end. \[state unit/s\]
    rates: Vec<f64>,
    /// Standard deviations. \[state unit\]
    deviations: Vec<f64>,
}

/// Returns the plant with a derivative that is off by 5 %, and for each component what a disturbance has to
/// add to make up for it.
fn off_by_some(plant: &Plant, seed: u64, deviations: &[f64]) -> (Vec<String>, Vec<String>) {
    // Geometry and disturbance stay those of the seed.
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    random.set_stream(1);
    let terms = plant.derivative.iter().enumerate().map(|(c, rate)| {
        let mut wave = format!("{:?}", 0.3 * c as f64);
        for (state, deviation) in (1..).zip(deviations) {
            let number = random.random_range(-1.7..1.7) / deviation;
            let _ = write!(wave, " + {number:?}*s{state}");
        }
        let bias = format!("{:?}*sin({wave})", 0.05 * deviations[c]);
        (format!("1.05*({rate}) + {bias}"), format!(" - 0.05*({rate}) - {bias}"))
    });
    terms.unzip()
}

/// Returns the scenario of a plant with agents, graph, outputs and disturbance that `seed` draws. The outer
/// weights are up to half of the largest rates.
fn scenario(
    plant: &Plant,
    seed: u64,
    knowledge: Knowledge,
    scales: &Scales,
) -> Result<Scenario, Failure> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let n = plant.initial_state.len();
    let states: Vec<String> = (1..=n).map(|state| format!("s{state}")).collect();
    let mut wave = |amplitude: &f64| {
        let (frequency, phase) = (random.random_range(1.0..4.0), random.random_range(0.0..TAU));
        format!("{amplitude:?}*sin({frequency:?}*t + {phase:?})")
    };
    let mut components: Vec<String> = plant.amplitudes.iter().map(&mut wave).collect();
    let mut derivative = plant.derivative.clone();
    if knowledge == Knowledge::Nearly {
        let corrections;
        (derivative, corrections) = off_by_some(plant, seed, &scales.deviations);
        components.iter_mut().zip(corrections).for_each(|(wave, correction)| *wave += &correction);
    }
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
        .map(|_| {
            scales.rates.iter().map(|largest| largest * random.random_range(-0.5..0.5)).collect()
        })
        .collect();
    let bound = 2.0 * outer.iter().flatten().map(|weight| weight * weight).sum::<f64>().sqrt();
    let (method, learning) = match knowledge {
        Knowledge::Nothing => ("observer", "network = false".to_owned()),
        Knowledge::Nearly | Knowledge::Plant => ("known-f", "hold = \"model\"".to_owned()),
        Knowledge::Trained => ("observer", learning()),
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
        derivative, plant.initial_state,
    );
    for rows in rows {
        let mut row = || (0..n).map(|_| random.random_range(-1.0..1.0)).collect::<Vec<f64>>();
        let rows: Vec<Vec<f64>> = (0..rows).map(|_| row()).collect();
        let _ = write!(text, "[[agents]]\noutput_matrix = {rows:?}\n");
    }
    Ok(Scenario::parse("random geometry", &text)?)
}

/// Returns the sections that train one network for all on the samples of the run.
fn learning() -> String {
    let [from, to] = COLLECTED;
    format!(
        "hold = \"model\"\n\
         [[learning]]\ncollect_from = {from:?}\ncollect_to = {to:?}\napply_at = {:?}\nrecipe = \"smoothed\"\n\
         shared = true\n\
         [recipes.smoothed]\nsmoothing_window = 0.05\ndecimation = 10\ninitial = {{ random = \"glorot\" }}\n\
         epochs = 80\ngoal = 0.0",
        to + 1.0,
    )
}

/// Returns the largest rates of the state until samples end, shape `[n]`. \[state unit/s\]
fn largest_rates(course: &Trajectory) -> Vec<f64> {
    let last = (COLLECTED[1] / course.step) as usize;
    let rate = |k: usize, c: usize| (course.state(k + 1)[c] - course.state(k)[c]) / course.step;
    let largest = |c| (0..last).map(|k| rate(k, c).abs()).fold(0.0, f64::max);
    (0..course.dimension).map(largest).collect()
}

/// Returns the worst agent's error in the evaluation window: the root mean square over time and components, each
/// in the plant's standard deviations over the whole run, which is what `observer.error` is a fraction of.
fn worst_error(traces: &Traces, deviations: &[f64]) -> f64 {
    let start = traces.time().partition_point(|&time| time < EVALUATED[0]);
    let count = ((traces.rows() - start) * deviations.len()) as f64;
    let of = |agent: usize| {
        let squared = |row: usize| {
            let errors = traces.estimate(row, agent).iter().zip(traces.truth(row));
            let scaled = errors.zip(deviations).map(|((&e, x), d)| (f64::from(e) - x) / d);
            scaled.map(|error| error * error).sum::<f64>()
        };
        ((start..traces.rows()).map(squared).sum::<f64>() / count).sqrt()
    };
    (0..traces.agents()).map(of).fold(0.0, f64::max)
}

/// What one geometry gave.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Found {
    /// No settings keep the requested error.
    Refused,
    /// The trained network explained too little, so agents went on without it.
    NotSwitchedIn,
    /// The worst agent's error in relation to the requested one, and broadcasts per agent per second.
    Ran { error: f64, broadcasts: f64 },
}

/// Runs the geometry that `seed` draws with each knowledge.
///
/// # Errors
/// A run fails for another reason than that it is refused.
pub(crate) fn geometry(plant: &Plant, seed: u64) -> Result<[(Knowledge, Found); 4], Failure> {
    let ones = vec![1.0; plant.initial_state.len()];
    let unknown = Scales { rates: ones.clone(), deviations: ones };
    let course = plant_course(&scenario(plant, seed, Knowledge::Nothing, &unknown)?)?;
    let scales = Scales { rates: largest_rates(&course), deviations: course.deviation() };
    let one = |knowledge: Knowledge| -> Result<(Knowledge, Found), Failure> {
        let scenario = scenario(plant, seed, knowledge, &scales)?;
        let options = RunOptions { seed, learning: true, bounds: false };
        let result = match run(&scenario, options, &Silent) {
            Err(RunError::Observer(PlanError::Gate(_))) => return Ok((knowledge, Found::Refused)),
            result => result?,
        };
        if !result.trainings.iter().all(|training| training.switched_in) {
            return Ok((knowledge, Found::NotSwitchedIn));
        }
        let broadcasts: u64 = result.agents.iter().map(|agent| agent.broadcasts_evaluated).sum();
        let seconds = (EVALUATED[1] - EVALUATED[0]) * result.agents.len() as f64;
        let error = worst_error(&result.traces, &scales.deviations) / ERROR;
        Ok((knowledge, Found::Ran { error, broadcasts: broadcasts as f64 / seconds }))
    };
    let [nothing, trained] = [one(Knowledge::Nothing)?, one(Knowledge::Trained)?];
    Ok([nothing, trained, one(Knowledge::Nearly)?, one(Knowledge::Plant)?])
}

/// Returns the median, of an even count the larger of both middle ones, and the largest of these numbers.
fn median_and_largest(mut numbers: Vec<f64>) -> (f64, f64) {
    numbers.sort_by(f64::total_cmp);
    let at = |index: usize| numbers.get(index).copied().unwrap_or(f64::NAN);
    (at(numbers.len() / 2), at(numbers.len().saturating_sub(1)))
}

fn main() -> Result<(), Failure> {
    let count = std::env::args().nth(1).map_or(Ok(25), |count| count.parse::<u64>())?.max(1);
    println!(
        "plant      knows    refused  not switched in  error/requested, median (worst)  \
         broadcasts, median (worst) [1/s]"
    );
    for plant in plants() {
        let runs = (1..=count).into_par_iter().map(|seed| geometry(&plant, seed));
        let runs: Vec<_> = runs.collect::<Result<_, _>>()?;
        for (index, (knowledge, _)) in runs[0].iter().enumerate() {
            let found = || runs.iter().map(|run| run[index].1);
            let ran = |pick: fn(f64, f64) -> f64| {
                let numbers = found().filter_map(|found| match found {
                    Found::Ran { error, broadcasts } => Some(pick(error, broadcasts)),
                    Found::Refused | Found::NotSwitchedIn => None,
                });
                median_and_largest(numbers.collect())
            };
            let ((error, worst), (often, most)) = (ran(|error, _| error), ran(|_, often| often));
            println!(
                "{:9}  {:7}  {:7}  {:15}  {error:23.2} ({worst:.2})  {often:25.1} ({most:.1})",
                plant.name,
                format!("{knowledge:?}").to_lowercase(),
                found().filter(|&found| found == Found::Refused).count(),
                found().filter(|&found| found == Found::NotSwitchedIn).count(),
            );
        }
    }
    Ok(())
}
