//! Compares agents with the field observer with an independent implementation in double precision:
//! `tests/golden/field.json`, created by the script next to it.
//!
//! The script's runs have no trigger that is so close to its radius that single precision could decide
//! otherwise, so every broadcast must be the same.

use std::path::Path;

use agent_core::agent::inbox::Inbox;
use agent_core::agent::{AgentParams, AgentState};
use agent_core::math::activation::Activation;
use agent_core::math::symmetric::SymmetricMatrix;
use agent_core::observer::feedback::{Neighbour, ObserverParams, OutputMatrix};
use agent_core::observer::field::disturbance::Model;
use agent_core::observer::field::{Coupling, Direction, HoldKind, Options};
use agent_core::observer::network::{Architecture, InnerNetwork, Layer};
use agent_core::observer::outer_law::OuterLawParams;
use agent_core::observer::projection::ProjectionParams;
use agent_core::observer::trigger::TriggerParams;
use agent_core::{AgentId, Hold, StateVector};
use nalgebra::SMatrix;
use serde_json::Value;
use test_support::close;

const STEP: f64 = 1e-3;
const FEATURES: usize = 4;

type Places = Vec<Option<Hold<3>>>;

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect()
}

fn singles(value: &Value) -> Vec<f32> {
    numbers(value).iter().map(|&x| x as f32).collect()
}

fn rows(value: &Value) -> Vec<Vec<f64>> {
    value.as_array().unwrap().iter().map(numbers).collect()
}

fn single(value: &Value) -> f32 {
    value.as_f64().unwrap() as f32
}

/// Returns the words of agent `i`'s field observer.
fn field(golden: &Value, case: &Value, i: usize, neighbours: &[Neighbour]) -> Vec<f32> {
    let kind = ["zero-order", "rate", "model"].iter().position(|&kind| kind == case["hold"]);
    let gains = singles(&case["gains"]);
    let options = Options {
        digest: u16::try_from(case["digests"][i].as_u64().unwrap()).unwrap(),
        hold: HoldKind::ALL[kind.unwrap()],
        coupling: Coupling::Trees,
        uses_network: case["network"].as_bool().unwrap(),
        adapts: false,
        has_harmonics: gains[2] != 0.0,
        is_half: false,
        timeout: 0,
        bias_kept: single(&case["bias_kept"]),
        relay_share: single(&case["relay_share"]),
    };
    let angle = case["frequency"].as_f64().unwrap() * f64::from(STEP as f32);
    let model = Model {
        bias_gain: gains[1],
        cosine_gain: gains[2],
        sine_gain: gains[3],
        rotation_cosine: libm::cos(angle) as f32,
        rotation_sine: libm::sin(angle) as f32,
        clip: single(&case["clip"]),
    };
    let mut words = options.words().to_vec();
    for name in ["transform", "inverse"] {
        words.extend(singles(&golden[name]));
    }
    for name in ["low", "high"] {
        words.extend(singles(&case[name]));
    }
    for c in 0..3 {
        let parent = golden["parents"][i][c].as_i64().unwrap();
        let parent = neighbours.iter().position(|n| i64::from(n.id) == parent + 1);
        let direction = Direction {
            output: parent.is_none().then_some(0),
            parent: parent.map(|place| place as u8),
            spare: None,
            is_announced: golden["announced"][i][c].as_bool().unwrap(),
            scale: singles(&golden["scale"])[c],
            root_gain: gains[0],
            tree_gain: single(&case["tree_gain"]),
            radius: single(&case["radius"]),
            model,
        };
        words.extend(direction.words());
    }
    words
}

struct Member<'a> {
    params: AgentParams<'a, 3>,
    state: AgentState<3, FEATURES, Places>,
    inbox: Inbox<3, Places>,
    /// Ticks at which it has to broadcast from now on.
    broadcasts: &'a [u64],
}

fn member<'a>(
    golden: &Value,
    case: &Value,
    i: usize,
    neighbours: &'a [Neighbour],
    broadcasts: &'a [u64],
) -> Member<'a> {
    let row = singles(&golden["outputs"][i]);
    let observer = ObserverParams {
        output_matrix: OutputMatrix::new(&[StateVector::from_column_slice(&row)]).unwrap(),
        gain: SMatrix::from_diagonal_element(1.0),
        neighbours,
    };
    let projection =
        ProjectionParams { radius: 99.0, boundary_layer: 1.0, smoothing: 0.1, smoothness: 1 };
    let outer_law = OuterLawParams { gain: SymmetricMatrix::Scalar(1.0), projection };
    let trigger = TriggerParams { hold_error_weight: 1.0, consensus_weight: 0.0, threshold: 1.0 };
    let id = i as AgentId + 1;
    let params = AgentParams::new(id, STEP as f32, observer, outer_law, trigger).unwrap();
    let places = vec![None; neighbours.len()];
    let start = StateVector::from_column_slice(&singles(&case["start"])[3 * i..3 * i + 3]);
    let outer = singles(&golden["outer"]);
    let mut state = AgentState::new(&params, start, &outer, places.clone()).unwrap();
    state.set_field(&params, &field(golden, case, i, neighbours)).unwrap();
    Member { params, state, inbox: Inbox::new(places), broadcasts }
}

/// The paper's plant after an Euler step.
fn plant(x: [f64; 3], t: f64) -> [f64; 3] {
    let d = [0.5 * libm::sin(3.0 * t), 0.75 * libm::cos(t), libm::cos(3.75 * t)];
    let f = [0.3 * (x[0] - x[0] * x[0] * x[0] / 3.0 - x[1]), x[0] / 0.3, -0.3 * x[2]];
    std::array::from_fn(|c| x[c] + STEP * (f[c] + d[c]))
}

#[test]
fn agents_agree_with_the_oracle_in_every_broadcast() {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("golden/field.json");
    let golden: Value = serde_json::from_str(&std::fs::read_to_string(file).unwrap()).unwrap();
    let layers: Vec<_> = numbers(&golden["widths"])
        .iter()
        .map(|&width| Layer { width: width as u8, activation: Activation::Tanh })
        .collect();
    let architecture = Architecture::new(3, &layers).unwrap();
    let network = InnerNetwork::new(architecture, singles(&golden["inner"])).unwrap();
    let neighbours: Vec<Vec<Neighbour>> = rows(&golden["neighbours"])
        .iter()
        .map(|all| all.iter().map(|&j| Neighbour { id: j as AgentId + 1, weight: 1.0 }).collect())
        .collect();
    let (steps, every) = (golden["steps"].as_u64().unwrap(), golden["every"].as_u64().unwrap());
    let outputs = rows(&golden["outputs"]);
    for (name, case) in golden["cases"].as_object().unwrap() {
        let ticks = rows(&case["broadcasts"]);
        let ticks: Vec<Vec<u64>> =
            ticks.iter().map(|ticks| ticks.iter().map(|&tick| tick as u64).collect()).collect();
        let mut members: Vec<_> =
            (0..3).map(|i| member(&golden, case, i, &neighbours[i], &ticks[i])).collect();
        let mut x = [5.0, 7.0, 8.0];
        let expected = rows(&case["estimates"]);
        for tick in 0..steps {
            if tick > 0 && tick % every == 0 {
                let row = &expected[(tick / every - 1) as usize];
                for (i, member) in members.iter().enumerate() {
                    for (c, &found) in member.state.estimate().iter().enumerate() {
                        let expected = row[3 * i + c];
                        assert!(
                            close(f64::from(found), expected, 1e-5, 2e-5),
                            "{name}, tick {tick}, agent {}: {found} in place of {expected}",
                            i + 1
                        );
                    }
                }
            }
            let mut sent = vec![];
            for (i, member) in members.iter_mut().enumerate() {
                let y = outputs[i].iter().zip(x).fold(0.0, |sum, (entry, x)| sum + entry * x);
                let Member { params, state, inbox, broadcasts } = member;
                let is_due = broadcasts.first() == Some(&(tick + 1));
                let used = case["network"].as_bool().unwrap().then_some(&network);
                let output = state.step(params, used, tick, &[y as f32], inbox).unwrap();
                assert_eq!(
                    output.broadcast.is_some(),
                    is_due,
                    "{name}, tick {tick}, agent {}",
                    i + 1
                );
                if let Some(frame) = output.broadcast {
                    assert_eq!(frame.tick, tick + 1);
                    *broadcasts = &broadcasts[1..];
                    sent.push(frame);
                }
            }
            for frame in sent {
                for member in &mut members {
                    if member.params.neighbours().iter().any(|n| n.id == frame.sender) {
                        member.inbox.accept(member.params.neighbours(), &frame.encode()).unwrap();
                    }
                }
            }
            x = plant(x, STEP * tick as f64);
        }
        assert!(members.iter().all(|member| member.broadcasts.is_empty()));
    }
}
