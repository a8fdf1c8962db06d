//! Compares every step of every agent of a random network with the oracle: each part of each
//! equation must be within the bound that [`rounding`](crate::core::oracle::rounding) derives for
//! single precision, and the trigger's decision must match wherever single precision can make it.
//!
//! A network first runs on its own, so that its own and its neighbours' held estimates and its
//! outer weights have changed; before each step the oracle is given the core's state, which is
//! exact in double precision.

use agent_core::agent::StepOutput;
use agent_core::observer::network::Layer;
use nalgebra::{DMatrix, DVector};
use test_support::close;

use crate::core::oracle::inner_network::{self, InnerNetwork};
use crate::core::oracle::projection::Projection;
use crate::core::oracle::rounding::{Bounds, trigger_band};
use crate::core::oracle::{Agent, Network, Rates, State, vectorised};
use crate::core::random_network::{Draw, DrawnAgent, DrawnNetwork, Gain, Member, step_all};

/// Steps of each network, all of which are compared.
const STEPS: u64 = 6;

fn oracle_layers(inputs: usize, layers: &[Layer], parameters: &[f32]) -> InnerNetwork {
    let (mut inputs, mut rest) = (inputs, parameters);
    let layers = layers.iter().map(|layer| {
        let width = usize::from(layer.width);
        let (biases, after) = rest.split_at(width);
        let (weights, after) = after.split_at(width * inputs);
        let layer = inner_network::Layer {
            weights: DMatrix::from_row_slice(inputs, width, weights).map(f64::from),
            biases: DVector::from_column_slice(biases).map(f64::from),
            activation: layer.activation,
        };
        (inputs, rest) = (width, after);
        layer
    });
    InnerNetwork { layers: layers.collect() }
}

fn oracle_agent<const N: usize>(drawn: &DrawnAgent<N>) -> Agent {
    let (outputs, features) = (drawn.output_rows.len(), drawn.features());
    Agent {
        output_matrix: DMatrix::from_fn(outputs, N, |r, c| f64::from(drawn.output_rows[r][c])),
        inner_network: oracle_layers(N, &drawn.layers, &drawn.inner_parameters),
        outer_gain: match &drawn.outer_gain {
            Gain::Scalar(gain) => DMatrix::identity(features, features) * f64::from(*gain),
            Gain::Diagonal(diagonal) => {
                DMatrix::from_diagonal(&DVector::from_column_slice(diagonal).map(f64::from))
            }
            Gain::Full(entries) => {
                DMatrix::from_row_slice(features, features, entries).map(f64::from)
            }
        },
        projection: Projection {
            radius: f64::from(drawn.projection.radius),
            layer: f64::from(drawn.projection.boundary_layer),
            smoothing: f64::from(drawn.projection.smoothing),
            order: drawn.projection.smoothness,
        },
    }
}

fn oracle_network<const N: usize>(drawn: &DrawnNetwork<N>) -> Network {
    let gain = DMatrix::from_fn(N, N, |r, c| f64::from(drawn.gain[(r, c)]));
    let agents = drawn.agents.iter().map(oracle_agent).collect();
    Network::new(agents, &drawn.adjacency.map(f64::from), &gain)
}

/// Single-precision numbers as a vector in double precision.
fn stacked<'f>(values: impl Iterator<Item = &'f f32>) -> DVector<f64> {
    DVector::from_vec(values.copied().map(f64::from).collect())
}

fn oracle_state<const N: usize>(members: &[Member<'_, N>]) -> State {
    let weights = |member: &Member<'_, N>| {
        let rows = member.state.outer_weights().rows();
        DMatrix::from_fn(rows.len(), N, |r, c| f64::from(rows[r][c]))
    };
    State {
        estimates: stacked(members.iter().flat_map(|m| m.state.estimate().iter())),
        held: stacked(members.iter().flat_map(|m| m.state.own_hold().estimate().iter())),
        outer_weights: members.iter().map(weights).collect(),
    }
}

/// The compared parts, stacked over the agents, in the order of [`NAMES`].
type Parts = [DVector<f64>; 5];

const NAMES: [&str; 5] = ["z", "e_3", "d/dt x_hat", "x_hat after the step", "d/dt W_hat"];

fn concatenated(blocks: &[DVector<f64>]) -> DVector<f64> {
    DVector::from_vec(blocks.iter().flat_map(|block| block.iter().copied()).collect())
}

fn oracle_parts(state: &State, rates: &Rates, step_size: f64) -> Parts {
    [
        rates.consensus.clone(),
        rates.output_errors.clone(),
        rates.estimates.clone(),
        &state.estimates + step_size * &rates.estimates,
        concatenated(&rates.outer_weights),
    ]
}

fn bound_parts(bounds: &Bounds) -> Parts {
    [
        bounds.consensus.clone(),
        bounds.output_errors.clone(),
        bounds.estimates.clone(),
        bounds.next_estimates.clone(),
        concatenated(&bounds.outer_weights),
    ]
}

/// Returns the core's results for the step that started in the state `before`.
fn core_parts<const N: usize>(
    before: &State,
    members: &[Member<'_, N>],
    outputs: &[StepOutput<N>],
    step_size: f64,
) -> Parts {
    let after = oracle_state(members);
    let change = after.outer_weights.iter().zip(&before.outer_weights);
    let change: Vec<_> = change.map(|(a, b)| vectorised(&((a - b) / step_size))).collect();
    [
        stacked(members.iter().flat_map(|m| m.state.consensus_term().iter())),
        stacked(members.iter().flat_map(|m| m.state.output_error(&m.params))),
        stacked(outputs.iter().flat_map(|output| output.sample.derivative.iter())),
        after.estimates,
        concatenated(&change),
    ]
}

/// Results over many networks.
#[derive(Default)]
struct Report {
    /// The largest deviation of each part, as a fraction of its bound.
    worst: [f64; 5],
    /// The bounds' 2-norms relative to those of the values, for each part.
    relative_bounds: [Vec<f64>; 5],
    decisions: usize,
    broadcasts: usize,
    in_band: usize,
    weights_in_layer: usize,
    moved_holds: usize,
}

impl Report {
    fn compare(&mut self, what: &str, found: &Parts, expected: &Parts, bounds: &Parts) {
        for (part, name) in NAMES.iter().enumerate() {
            let (found, expected, bound) = (&found[part], &expected[part], &bounds[part]);
            assert_eq!(found.len(), expected.len());
            assert_eq!(found.len(), bound.len());
            for index in 0..found.len() {
                let (found, expected, bound) = (found[index], expected[index], bound[index]);
                assert!(
                    close(found, expected, 0.0, bound),
                    "{name}[{index}] of {what}: core {found:e}, oracle {expected:e}, bound {bound:e}",
                );
                if bound > 0.0 {
                    let share = (found - expected).abs() / bound;
                    self.worst[part] = self.worst[part].max(share);
                }
            }
            if expected.norm() > 0.0 {
                self.relative_bounds[part].push(bound.norm() / expected.norm());
            }
        }
    }

    fn print(&mut self) {
        for (part, name) in NAMES.iter().enumerate() {
            println!(
                "{name}: at most {:.3} of the bound, which is {:.1e} of the value (median)",
                self.worst[part],
                median(&mut self.relative_bounds[part]),
            );
        }
        println!(
            "{} decisions, {} broadcasts, {} too close to call; weights in the boundary layer in \
             {}, own hold apart from the estimate in {}",
            self.decisions, self.broadcasts, self.in_band, self.weights_in_layer, self.moved_holds,
        );
    }
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Runs the network of one seed alongside the oracle; `observe` gets the oracle's network, the state
/// before a step, the measurement, and the core's results with their bounds.
fn run<const N: usize>(
    seed: u64,
    report: &mut Report,
    mut observe: impl FnMut(&DrawnNetwork<N>, &Network, &State, &DVector<f64>, &Parts, &Parts),
) {
    let mut draw = Draw::new(seed);
    let drawn = draw.network::<N>();
    let network = oracle_network(&drawn);
    let mut members = drawn.members();
    let step_size = f64::from(drawn.step_size);
    for tick in 0..STEPS {
        let measurements = draw.measurements(&drawn);
        let measurement = stacked(measurements.iter().flatten());
        let state = oracle_state(&members);
        let order = draw.order(members.len());
        let outputs = step_all(&mut members, &order, tick, &measurements);

        let rates = network.rates(&state, &measurement);
        let bounds = Bounds::new(&network, &state, &measurement, &rates, step_size);
        let found = core_parts(&state, &members, &outputs, step_size);
        let limits = bound_parts(&bounds);
        let what = format!("seed {seed}, n = {N}, tick {tick}");
        report.compare(&what, &found, &oracle_parts(&state, &rates, step_size), &limits);
        observe(&drawn, &network, &state, &measurement, &found, &limits);

        for (index, (agent, weights)) in network.agents.iter().zip(&state.outer_weights).enumerate()
        {
            let block = |vector: &DVector<f64>| vector.rows(index * N, N).into_owned();
            report.moved_holds += usize::from(block(&state.held) != block(&state.estimates));
            report.weights_in_layer +=
                usize::from(agent.projection.excess(&vectorised(weights)) > 0.0);
            // The trigger uses the new estimate, and `z` as it was during the step.
            let estimate = stacked(members[index].state.estimate().iter());
            let (hold_error, consensus) = (block(&state.held) - estimate, block(&rates.consensus));
            let margin = drawn.trigger.margin(&hold_error, &consensus);
            let band =
                trigger_band(&drawn.trigger, &hold_error, &consensus, &block(&bounds.consensus));
            let fired = outputs[index].broadcast.is_some();
            report.decisions += 1;
            report.broadcasts += usize::from(fired);
            if margin.abs() <= band {
                report.in_band += 1;
            } else {
                let id = drawn.agents[index].id;
                assert_eq!(
                    fired,
                    margin >= 0.0,
                    "{what}, agent {id}: margin {margin:e}, band {band:e}"
                );
            }
        }
    }
}

/// Calls a function with each of the tested state dimensions.
macro_rules! each_dimension {
    ($call:ident, $($argument:expr),*) => {
        $call::<1>($($argument),*);
        $call::<2>($($argument),*);
        $call::<3>($($argument),*);
        $call::<5>($($argument),*);
        $call::<12>($($argument),*);
    };
}

#[test]
fn every_equation_agrees_with_the_oracle_to_single_precision() {
    fn one<const N: usize>(seed: u64, report: &mut Report) {
        run::<N>(seed, report, |_, _, _, _, _, _| ());
    }
    let mut report = Report::default();
    for seed in 0..200 {
        each_dimension!(one, seed, &mut report);
    }
    report.print();
    // The networks cover the intended cases.
    assert!(report.broadcasts * 10 > report.decisions);
    assert!(report.broadcasts * 10 < report.decisions * 9);
    assert!(report.weights_in_layer * 10 > report.decisions * 3);
    assert!(report.moved_holds * 10 > report.decisions * 3);
    // Single precision could have decided the others.
    assert!(report.in_band * 1000 < report.decisions, "{} too close to call", report.in_band);
}

#[test]
fn the_bounds_are_narrow_enough_to_see_a_wrong_equation() {
    /// The changed constant, the least number of the 50 networks in which it must be noticed, and
    /// the change.
    type Change = (&'static str, usize, fn(&mut Network));
    const CHANGES: [Change; 8] = [
        ("K_1", 50, |network| network.gain *= 1.001),
        ("L", 50, |network| network.coupling *= 1.001),
        ("C", 50, |network| network.output_matrix *= 1.001),
        ("Gamma", 45, |network| network.outer_gain *= 1.001),
        ("first weights", 45, |network| {
            for agent in &mut network.agents {
                agent.inner_network.layers[0].weights *= 1.001;
            }
        }),
        ("last biases", 45, |network| {
            for agent in &mut network.agents {
                agent.inner_network.layers.last_mut().unwrap().biases *= 1.001;
            }
        }),
        // These two act only in the boundary layer, where not every network has an agent.
        ("beta", 45, |network| {
            for agent in &mut network.agents {
                agent.projection.layer *= 1.01;
            }
        }),
        ("delta", 45, |network| {
            for agent in &mut network.agents {
                agent.projection.smoothing *= 2.0;
            }
        }),
    ];
    fn one<const N: usize>(seed: u64, seen: &mut [usize; CHANGES.len()]) {
        let mut noticed = [false; CHANGES.len()];
        run::<N>(
            seed,
            &mut Report::default(),
            |drawn, network, state, measurement, found, bounds| {
                for ((_, _, change), noticed) in CHANGES.iter().zip(&mut noticed) {
                    let mut wrong = network.clone();
                    change(&mut wrong);
                    let rates = wrong.rates(state, measurement);
                    let parts = oracle_parts(state, &rates, f64::from(drawn.step_size));
                    let differs = |part: usize| {
                        (0..found[part].len()).any(|index| {
                            !close(found[part][index], parts[part][index], 0.0, bounds[part][index])
                        })
                    };
                    *noticed |= (0..NAMES.len()).any(differs);
                }
            },
        );
        for (seen, noticed) in seen.iter_mut().zip(noticed) {
            *seen += usize::from(noticed);
        }
    }
    let mut seen = [0; CHANGES.len()];
    for seed in 1000..1010 {
        each_dimension!(one, seed, &mut seen);
    }
    for ((name, least, _), seen) in CHANGES.iter().zip(seen) {
        println!("a wrong {name}: noticed in {seen} of 50 networks");
        assert!(seen >= *least, "{name}: {seen} of 50, expected at least {least}");
    }
}
