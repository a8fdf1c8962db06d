//! Compares agents with the field observer with the study that it comes from: `tests/golden/study.json`,
//! created by the script next to it with the study's own engine.
//!
//! A trigger that is decided one tick later in single precision shifts those after it, so broadcasts are
//! compared by their number, and errors by their RMS.

use std::ops::Range;
use std::path::Path;

use agent_core::agent::inbox::Inbox;
use agent_core::agent::{AgentParams, AgentState};
use agent_core::math::symmetric::SymmetricMatrix;
use agent_core::observer::features::Features;
use agent_core::observer::feedback::{Neighbour, ObserverParams, OutputMatrix};
use agent_core::observer::field::disturbance::Model;
use agent_core::observer::field::{Coupling, Direction, HoldKind, Options};
use agent_core::observer::network::Scratch;
use agent_core::observer::outer_law::OuterLawParams;
use agent_core::observer::projection::ProjectionParams;
use agent_core::observer::trigger::TriggerParams;
use agent_core::{AgentId, Hold, StateVector};
use nalgebra::SMatrix;
use serde::Deserialize;

const STEP: f64 = 1e-3;

#[derive(Deserialize)]
struct Golden {
    early_steps: usize,
    steps: usize,
    from: usize,
    relay_share: f32,
    bias_kept: f32,
    cases: Vec<Case>,
}

/// A geometry of one of the study's plants. Shapes in brackets: N agents, n states.
#[derive(Deserialize)]
struct Case {
    plant: String,
    knowledge: String,
    hold: String,
    /// The initial state, of which every agent knows as much, [n].
    start: Vec<f64>,
    /// The disturbance of each component, a sine, [n] each.
    amplitudes: Vec<f64>,
    frequencies: Vec<f64>,
    phases: Vec<f64>,
    /// Standard deviation of each component, [n].
    deviations: Vec<f64>,
    /// Size and arguments of the error of a function that is nearly known, [1 + n, n]; then the limits
    /// between which its argument is kept, [2, n].
    distortion: Vec<Vec<f64>>,
    graph: Vec<Vec<usize>>,
    outputs: Vec<Vec<Vec<f64>>>,
    /// Row and scale where an agent measures a direction, [N, n].
    roots: Vec<Vec<Option<(u8, f32)>>>,
    parents: Vec<Vec<i64>>,
    announced: Vec<Vec<bool>>,
    transform: Vec<Vec<f32>>,
    inverse: Vec<Vec<f32>>,
    radii: Vec<f32>,
    tree_gains: Vec<f32>,
    root_gains: Vec<f32>,
    bandwidths: Vec<f32>,
    clips: Vec<f32>,
    /// The outcome from the start to `Golden::early_steps`.
    early: Outcome,
    /// From `Golden::from` to `Golden::steps`.
    late: Outcome,
}

#[derive(Debug, Deserialize)]
struct Outcome {
    /// Of each agent, [N].
    broadcasts: Vec<u32>,
    /// RMS error of each agent, over all components in units of their deviation, [N].
    errors: Vec<f64>,
}

impl Outcome {
    /// Checks that this is the study's outcome but for a fraction, and a broadcast or two.
    fn check(&self, study: &Self, fraction: f64, name: &str) {
        let agents = self.broadcasts.iter().zip(&study.broadcasts).enumerate();
        for (i, (&found, &expected)) in agents {
            let (found, expected) = (f64::from(found), f64::from(expected));
            let is_close = (found - expected).abs() <= 2.0 + fraction * expected;
            assert!(is_close, "{name}, agent {}: {found} broadcasts in place of {expected}", i + 1);
        }
        for (i, (found, expected)) in self.errors.iter().zip(&study.errors).enumerate() {
            let is_close = (found / expected - 1.0).abs() <= fraction;
            assert!(is_close, "{name}, agent {}: error {found} in place of {expected}", i + 1);
        }
    }
}

impl Case {
    /// Returns the plant's drift at `x`.
    fn drift(&self, x: &[f64]) -> Vec<f64> {
        let n = x.len();
        let chain = |stiffness: fn(f64, f64) -> f64, damping: f64, coupling: f64| {
            let mut rates = vec![0.0; n];
            for q in 0..3 {
                let angle = |q: usize| x[2 * q];
                let mut torque = -stiffness(q as f64, angle(q)) - damping * x[2 * q + 1];
                if q > 0 {
                    torque += coupling * (angle(q - 1) - angle(q));
                }
                if q < 2 {
                    torque += coupling * (angle(q + 1) - angle(q));
                }
                rates[2 * q] = x[2 * q + 1];
                rates[2 * q + 1] = torque;
            }
            rates
        };
        match self.plant.as_str() {
            "lorenz" => vec![
                10.0 * (x[1] - x[0]),
                x[0] * (28.0 - x[2]) - x[1],
                x[0] * x[1] - 8.0 / 3.0 * x[2],
            ],
            "duffing" => {
                let cube = |x: f64| x * x * x;
                vec![
                    x[1],
                    -0.2 * x[1] - x[0] - cube(x[0]) + 0.5 * (x[2] - x[0]),
                    x[3],
                    -0.3 * x[3] - 0.8 * x[2] - 0.7 * cube(x[2]) + 0.5 * (x[0] - x[2]),
                ]
            }
            "pendulums" => chain(|q, angle| (4.0 + q) * libm::sin(angle), 0.15, 1.5),
            "linear" => chain(|q, angle| (2.0 + 3.0 * q) * angle, 0.04, 1.0),
            "lorenz96" => (0..n)
                .map(|c| (x[(c + 1) % n] - x[(c + n - 2) % n]) * x[(c + n - 1) % n] - x[c] + 8.0)
                .collect(),
            plant => panic!("no plant {plant}"),
        }
    }

    /// Returns the state one Euler step after `x` at the time `t`.
    fn moved(&self, x: &[f64], t: f64) -> Vec<f64> {
        let drift = self.drift(x);
        let disturbance =
            |c: usize| self.amplitudes[c] * libm::sin(t * self.frequencies[c] + self.phases[c]);
        (0..x.len()).map(|c| x[c] + STEP * (drift[c] + disturbance(c))).collect()
    }
}

/// What agents know of the drift: a feature for each component, which outer weights of one pass on.
struct Known<'a>(&'a Case);

impl Features for Known<'_> {
    fn inputs(&self) -> usize {
        self.0.start.len()
    }

    fn count(&self) -> usize {
        self.0.start.len()
    }

    fn adapts(&self) -> bool {
        false
    }

    fn features<'s>(&'s self, x: &[f32], scratch: &'s mut Scratch) -> Option<&'s [f32]> {
        let x: Vec<f64> = x.iter().map(|&x| f64::from(x)).collect();
        let mut drift = self.0.drift(&x);
        if self.0.knowledge == "near" {
            for (c, drift) in drift.iter_mut().enumerate() {
                let argument = (0.3 * c as f64)
                    + self.0.distortion[1 + c].iter().zip(&x).fold(0.0, |sum, (k, x)| sum + k * x);
                *drift = 1.05 * *drift + self.0.distortion[0][c] * libm::sin(argument);
            }
        }
        let features = scratch.outputs().get_mut(..drift.len())?;
        features.iter_mut().zip(drift).for_each(|(feature, drift)| *feature = drift as f32);
        Some(features)
    }
}

/// Returns the words of agent `i`'s field observer.
fn field<const N: usize>(
    golden: &Golden,
    case: &Case,
    i: usize,
    neighbours: &[Neighbour],
) -> Vec<f32> {
    let hold = ["zero-order", "rate", "model"].iter().position(|&hold| hold == case.hold);
    let options = Options {
        digest: 7,
        hold: HoldKind::ALL[hold.unwrap()],
        coupling: Coupling::Trees,
        uses_network: case.knowledge != "none",
        adapts: false,
        has_harmonics: false,
        is_half: false,
        timeout: 0,
        bias_kept: golden.bias_kept,
        relay_share: golden.relay_share,
    };
    let mut words = options.words().to_vec();
    for matrix in [&case.transform, &case.inverse] {
        words.extend(matrix.iter().flatten());
    }
    for limits in &case.distortion[N + 1..] {
        words.extend(limits.iter().map(|&limit| limit as f32));
    }
    for c in 0..N {
        let parent = neighbours.iter().position(|n| i64::from(n.id) == case.parents[i][c] + 1);
        let direction = Direction {
            output: case.roots[i][c].map(|(row, _)| row),
            parent: parent.map(|place| place as u8),
            spare: None,
            is_announced: case.announced[i][c],
            scale: case.roots[i][c].map_or(0.0, |(_, scale)| scale),
            root_gain: case.root_gains[c],
            tree_gain: case.tree_gains[c],
            radius: case.radii[c],
            model: Model {
                bias_gain: case.bandwidths[c] * case.bandwidths[c],
                cosine_gain: 0.0,
                sine_gain: 0.0,
                rotation_cosine: 1.0,
                rotation_sine: 0.0,
                clip: case.clips[c],
            },
        };
        words.extend(direction.words());
    }
    words
}

/// Returns what the agents do between two steps.
fn outcome<const N: usize>(golden: &Golden, case: &Case, within: Range<usize>) -> Outcome {
    let agents = case.graph.len();
    let neighbours: Vec<Vec<Neighbour>> = case
        .graph
        .iter()
        .map(|all| all.iter().map(|&j| Neighbour { id: j as AgentId + 1, weight: 1.0 }).collect())
        .collect();
    let start: Vec<f32> = case.start.iter().map(|&x| x as f32).collect();
    let identity: Vec<f32> = (0..N * N).map(|k| if k % (N + 1) == 0 { 1.0 } else { 0.0 }).collect();
    // An agent that measures nothing has a row of zeros.
    let outputs: Vec<Vec<Vec<f64>>> = case
        .outputs
        .iter()
        .map(|rows| if rows.is_empty() { vec![vec![0.0; N]] } else { rows.clone() })
        .collect();
    let mut members: Vec<_> = (0..agents)
        .map(|i| {
            let rows: Vec<_> = outputs[i]
                .iter()
                .map(|row| StateVector::<N>::from_iterator(row.iter().map(|&entry| entry as f32)))
                .collect();
            let observer = ObserverParams {
                output_matrix: OutputMatrix::new(&rows).unwrap(),
                gain: SMatrix::from_diagonal_element(1.0),
                neighbours: &neighbours[i],
            };
            let projection = ProjectionParams {
                radius: 99.0,
                boundary_layer: 1.0,
                smoothing: 0.1,
                smoothness: 1,
            };
            let outer_law = OuterLawParams { gain: SymmetricMatrix::Scalar(1.0), projection };
            let trigger =
                TriggerParams { hold_error_weight: 1.0, consensus_weight: 0.0, threshold: 1.0 };
            let id = i as AgentId + 1;
            let params = AgentParams::new(id, STEP as f32, observer, outer_law, trigger).unwrap();
            let places: Vec<Option<Hold<N>>> = vec![None; neighbours[i].len()];
            let start = StateVector::from_column_slice(&start);
            let mut state =
                AgentState::<N, N, _>::new(&params, start, &identity, places.clone()).unwrap();
            state.set_field(&params, &field::<N>(golden, case, i, &neighbours[i])).unwrap();
            (params, state, Inbox::new(places))
        })
        .collect();
    let known = Known(case);
    let network = (case.knowledge != "none").then_some(&known);
    let mut x = case.start.clone();
    let (mut broadcasts, mut squares) = (vec![0; agents], vec![0.0; agents]);
    for tick in 0..within.end {
        let mut sent = vec![];
        for (i, (params, state, inbox)) in members.iter_mut().enumerate() {
            let measured: Vec<f32> = outputs[i]
                .iter()
                .map(|row| row.iter().zip(&x).fold(0.0, |sum, (entry, x)| sum + entry * x) as f32)
                .collect();
            if within.contains(&tick) {
                for ((&estimate, x), deviation) in
                    state.estimate().iter().zip(&x).zip(&case.deviations)
                {
                    let error = (f64::from(estimate) - x) / deviation;
                    squares[i] += error * error;
                }
            }
            let output = state.step(params, network, tick as u64, &measured, inbox).unwrap();
            if let Some(frame) = output.broadcast {
                // A frame decided on after this step is the study's of the next one.
                broadcasts[i] += u32::from(within.contains(&(tick + 1)));
                sent.push(frame);
            }
        }
        for frame in sent {
            for (params, _, inbox) in &mut members {
                if params.neighbours().iter().any(|n| n.id == frame.sender) {
                    inbox.accept(params.neighbours(), &frame.encode()).unwrap();
                }
            }
        }
        x = case.moved(&x, STEP * tick as f64);
    }
    let samples = (within.len() * N) as f64;
    let errors = squares.iter().map(|sum| libm::sqrt(sum / samples)).collect();
    Outcome { broadcasts, errors }
}

#[test]
fn agents_broadcast_and_err_as_in_the_study() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("golden/study.json");
    let golden: Golden = serde_json::from_str(&std::fs::read_to_string(file).unwrap()).unwrap();
    for case in &golden.cases {
        let between = |within: Range<usize>| match case.start.len() {
            3 => outcome::<3>(&golden, case, within),
            4 => outcome::<4>(&golden, case, within),
            _ => outcome::<6>(&golden, case, within),
        };
        let name = format!("{}, {} of f known, {} hold", case.plant, case.knowledge, case.hold);
        let mut early = between(0..golden.early_steps);
        for (found, announced) in early.broadcasts.iter_mut().zip(&case.announced) {
            // The study's agents do not say their first word if no neighbour follows them.
            *found -= u32::from(!announced.contains(&true));
        }
        // The study's first rates are of a tick before.
        let knows = case.knowledge != "none";
        let limit = if knows && case.hold == "rate" { 0.15 } else { 0.02 };
        early.check(&case.early, limit, &format!("{name}, early"));
        let late = between(golden.from..golden.steps);
        late.check(&case.late, if knows { 0.15 } else { 0.02 }, &format!("{name}, late"));
        let total = |outcome: &Outcome| f64::from(outcome.broadcasts.iter().sum::<u32>());
        let ratio = total(&late) / total(&case.late);
        assert!((ratio - 1.0).abs() < 0.06, "{name}: {ratio} times the broadcasts");
    }
}
