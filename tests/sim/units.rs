//! The paper's experiment in other units: learning must be independent of them.
//!
//! `cargo test -p integration-tests units -- --nocapture` prints the figures.

use host_sim::engine::{RunOptions, RunResult, Silent, run};
use host_sim::scenario::{PAPER, Scenario};
use host_sim::training::InitialParameters;
use host_sim::warning::WarningCode;
use rayon::prelude::*;

const SEEDS: std::ops::Range<u64> = 0..10;

/// Allowed relative difference between the median error and that in the paper's units.
const TOLERANCE: f64 = 0.05;

/// The paper's scenario with the state `scale * (x + offset)`, and every constant that has a unit
/// changed with it; also layer 1 of the untrained network, so that its output is the same.
fn paper_in(scale: f64, offset: [f64; 3]) -> Scenario {
    let expressions = format!(
        r#"[plant]
model = "expressions"
states = ["X", "Y", "Z"]
parameters = {{ mu = 0.3, s = {scale:?}, a = {:?}, b = {:?}, c = {:?} }}
derivative = [
    "s*mu*((X/s-a) - (X/s-a)^3/3 - (Y/s-b))",
    "s*(X/s-a)/mu",
    "-s*mu*(Z/s-c)",
]
initial_state = [{:?}, {:?}, {:?}]

[disturbance]
model = "expressions"
components = ["{scale:?}*0.5*sin(3*t)", "{scale:?}*0.75*cos(t)", "{scale:?}*cos(3.75*t)"]

[time]"#,
        offset[0],
        offset[1],
        offset[2],
        scale * (5.0 + offset[0]),
        scale * (7.0 + offset[1]),
        scale * (8.0 + offset[2]),
    );
    let start = PAPER.find("[plant]").expect("a plant");
    let end = PAPER.find("[time]").expect("a time");
    let text = [&PAPER[..start], &expressions, &PAPER[end + "[time]".len()..]].concat();
    let mut scenario = Scenario::parse("units.toml", &text).unwrap_or_else(|e| panic!("{e}"));
    scenario.record.samples = false;
    scenario.record.events = false;
    scenario.record.trace_stride = None;
    let design = &mut scenario.design;
    design.rho *= scale;
    design.delta *= scale * scale;
    design.epsilon *= scale * scale;
    for agent in &mut scenario.agents {
        for (estimate, offset) in agent.initial_estimate.iter_mut().zip(offset) {
            *estimate = scale * (*estimate + offset);
        }
    }
    let network = scenario.network.as_mut().expect("a network");
    network.outer.iter_mut().for_each(|weight| *weight *= scale);
    network.outer_law.bound *= scale;
    network.outer_law.boundary_layer *= scale;
    let mut inner = vec![0.1; network.architecture.parameter_count()];
    inner[..12].fill(0.1 - 0.1 * offset.iter().sum::<f64>());
    inner[12..48].fill(0.1 / scale);
    network.inner = InitialParameters::Given(inner);
    scenario
}

/// Returns each agent's root-mean-square error in units of `scale`, the median of all seeds.
fn median_errors(scale: f64, offset: [f64; 3]) -> [f64; 3] {
    let scenario = paper_in(scale, offset);
    let errors = |seed| {
        let result = simulate(&scenario, seed);
        result.trainings.iter().for_each(|training| assert!(training.switched_in));
        [0, 1, 2].map(|agent| result.agents[agent].rmse().expect("evaluated") / scale)
    };
    let errors: Vec<[f64; 3]> = SEEDS.into_par_iter().map(errors).collect();
    [0, 1, 2].map(|agent| {
        let mut column: Vec<f64> = errors.iter().map(|three| three[agent]).collect();
        column.sort_by(f64::total_cmp);
        0.5 * (column[4] + column[5])
    })
}

fn simulate(scenario: &Scenario, seed: u64) -> RunResult {
    run(scenario, RunOptions { seed, learning: true, bounds: false }, &Silent).unwrap()
}

#[test]
fn learning_is_independent_of_units() {
    let reference = median_errors(1.0, [0.0; 3]);
    println!("in the paper's units: {reference:.5?}");
    // The largest component moves by 8: 1,000 amplitudes.
    let cases = [
        (1e-6, [0.0; 3]),
        (1e6, [0.0; 3]),
        (1.0, [0.0, 0.0, 293.0]),
        (1.0, [100.0; 3]),
        (1.0, [8e3, -8e3, 200.0]),
    ];
    for (scale, offset) in cases {
        let found = median_errors(scale, offset);
        println!("scale {scale:e}, offset {offset:?}: {found:.5?}");
        for (found, reference) in found.iter().zip(reference) {
            let change = found / reference - 1.0;
            assert!(change.abs() <= TOLERANCE, "scale {scale:e}, offset {offset:?}: {change}");
        }
    }
}

#[test]
fn warns_of_an_offset_beyond_single_precision() {
    let warned = |offset| {
        let result = simulate(&paper_in(1.0, offset), 0);
        let codes = result.trainings.iter().flat_map(|training| &training.warnings);
        codes.filter(|warning| warning.code == WarningCode::InputResolution).count()
    };
    assert_eq!(warned([100.0; 3]), 0);
    assert_eq!(warned([5e4, 0.0, 0.0]), 3);
}
