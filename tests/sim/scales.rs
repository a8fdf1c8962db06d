//! From one agent with one measurement to a thousand on a ring: scenarios of every supported size
//! run and converge.

use agent_core::math::activation::Activation;
use host_sim::engine::{RunOptions, RunResult, Silent, run};
use host_sim::plant::DIMENSION_MAX;
use host_sim::scenario::Scenario;

use crate::sim::scenario_builder::{Described, SHORT_RECIPE, cycle, network, picks};

fn simulate(scenario: &Scenario) -> RunResult {
    simulate_with(scenario, true)
}

fn simulate_with(scenario: &Scenario, learning: bool) -> RunResult {
    run(scenario, RunOptions { seed: 0, learning, bounds: true }, &Silent).unwrap()
}

/// Returns the largest ratio of an agent's root-mean-square error over the second half to its initial
/// error; all agents must have broadcast and rejected nothing.
fn worst_remainder(scenario: &Scenario, result: &RunResult) -> f64 {
    let mut worst = 0.0f64;
    for (index, agent) in result.agents.iter().enumerate() {
        let initial = scenario.initial_state.iter().zip(&scenario.agents[index].initial_estimate);
        let initial = initial.map(|(truth, estimate)| (truth - estimate).powi(2)).sum::<f64>();
        let rmse = agent.rmse().expect("the second half is not empty");
        assert!(rmse.is_finite() && agent.max_error().is_some_and(f64::is_finite));
        assert_eq!(agent.frames_refused, 0, "agent {}", index + 1);
        assert!(agent.broadcasts() > 1, "agent {} fell silent", index + 1);
        assert_eq!(agent.events.len() as u64, agent.broadcasts());
        worst = worst.max(rmse / initial.sqrt());
    }
    assert_eq!(result.agents.len(), scenario.agents.len());
    let bounds = result.bounds.as_ref().expect("they were asked for");
    assert!(!bounds.growth.without_bound(true), "{:?}", bounds.growth);
    assert_eq!(bounds.states, scenario.steps() + 1);
    worst
}

/// Runs a scenario; every agent's error must fall below this fraction of its initial error.
fn check(what: &str, scenario_builder: &Described, largest_remainder: f64) -> RunResult {
    let scenario = scenario_builder.scenario();
    let result = simulate(&scenario);
    let worst = worst_remainder(&scenario, &result);
    let broadcasts: u64 = result.agents.iter().map(|agent| agent.broadcasts()).sum();
    println!("{what}: {:.2} % of the first error is left, {broadcasts} broadcasts", 100.0 * worst);
    assert!(worst < largest_remainder, "{what}: {worst}");
    result
}

#[test]
fn every_state_dimension_and_number_of_outputs() {
    // Above 12 with the feature `wide`.
    for n in (1..=12).chain([13, 24, 40]).filter(|&n| n <= DIMENSION_MAX) {
        let mut outputs = vec![1, n.div_ceil(2), n];
        outputs.dedup();
        for m in outputs {
            // Enough agents to measure all components together, and one more.
            let agents = n.div_ceil(m) + 1;
            let agents =
                (0..agents).map(|agent| (picks(n, (0..m).map(|k| (agent * m + k) % n)), 1));
            let scenario_builder = Described::linear(n, "complete", agents);
            check(&format!("n = {n}, m = {m}"), &scenario_builder, 0.15);
        }
    }
}

#[test]
fn one_agent_with_and_without_a_network() {
    for inner in [String::new(), network(&[(5, "tanh")], "2.0")] {
        let mut scenario_builder = Described::linear(3, "ring", [(picks(3, 0..3), 1)]);
        scenario_builder.graph.clear();
        // Without neighbours phi_1 is small, so the threshold must be small.
        scenario_builder.epsilon = 1e-3;
        scenario_builder.network = inner;
        let result = check("one agent", &scenario_builder, 0.05);
        // There are no receivers, but the trigger still applies.
        assert!(result.agents[0].broadcasts() < 3_000);
    }
}

#[test]
fn neighbours_provide_what_an_agent_cannot_measure() {
    let pair = Described::linear(2, "path", [(picks(2, [0]), 1), (picks(2, [1]), 1)]);
    let agents = check("two agents", &pair, 0.05).agents;
    let rmse_of_pair = agents.iter().filter_map(|agent| agent.rmse()).fold(0.0, f64::max);
    // Alone, each keeps most of its error in the component that it does not measure.
    for component in [0, 1] {
        let mut alone = pair.clone();
        alone.graph.clear();
        alone.agents = vec![(picks(2, [component]), 1)];
        let result = simulate(&alone.scenario());
        let rmse = result.agents[0].rmse().unwrap();
        println!("component {component} alone: {rmse:.4}");
        assert!(rmse > 5.0 * rmse_of_pair, "{rmse}");
    }
}

#[test]
fn a_hundred_agents_on_every_topology() {
    for (topology, gain, largest_remainder) in
        [("ring", 60.0, 0.1), ("star", 8.0, 0.5), ("complete", 8.0, 0.3)]
    {
        let agents = [(picks(2, [0]), 1), (picks(2, [1]), 1)].into_iter().cycle().take(100);
        let mut scenario_builder = Described::linear(2, topology, agents);
        scenario_builder.gain = gain;
        scenario_builder.trace_stride = 0;
        check(&format!("100 agents, {topology}"), &scenario_builder, largest_remainder);
    }
}

#[test]
fn a_thousand_agents_on_a_ring() {
    let agents = [(picks(2, [0]), 1), (picks(2, [1]), 1)].into_iter().cycle().take(1_000);
    let mut scenario_builder = Described::linear(2, "ring", agents);
    scenario_builder.duration = 0.6;
    scenario_builder.network = network(&[(4, "tanh"), (3, "tanh")], "2.0");
    scenario_builder.trace_stride = 100;
    scenario_builder.epsilon = 5_000.0;
    let result = check("1,000 agents", &scenario_builder, 0.1);
    assert_eq!((result.traces.rows(), result.traces.agents()), (7, 1_000));
}

#[test]
fn the_deepest_and_widest_network() {
    let mut scenario_builder = Described::linear(12, "path", [(picks(12, 0..12), 2)]);
    scenario_builder.duration = 1.0;
    scenario_builder.network = network(&[(64, "tanh"); 8], "1.0");
    let scenario = scenario_builder.scenario();
    let parameters = scenario.network.as_ref().unwrap().architecture.parameter_count();
    assert_eq!(parameters, 12 * 64 + 7 * 64 * 64 + 8 * 64);
    let result = check("8 layers of 64 nodes", &scenario_builder, 0.05);
    // The outer weights moved, within their bound.
    assert!(result.agents.iter().all(|agent| {
        agent.outer_weights_norm_max > 1e-3 && agent.outer_weights_norm_max <= 20.0
    }));
}

#[test]
fn every_activation_and_kind_of_outer_gain() {
    let full = "[[2.0, 0.5, 0.0], [0.5, 3.0, -0.25], [0.0, -0.25, 1.0]]";
    let mut digests = Vec::new();
    for (activation, _) in Activation::NAMES {
        for gain in ["2.0", "[2.0, 3.0, 1.0]", full, "[2.0, 2.0, 2.0]"] {
            let mut scenario_builder =
                Described::linear(3, "ring", [(picks(3, [0, 1]), 2), (picks(3, [1, 2]), 2)]);
            scenario_builder.network = network(&[(7, "tanh"), (3, activation)], gain);
            let result = check(&format!("{activation}, gain {gain}"), &scenario_builder, 0.05);
            digests.push(result.digest);
        }
        // A diagonal of equal numbers equals the scalar; the other forms differ.
        let [scalar, diagonal, full, equal] = digests[digests.len() - 4..] else { unreachable!() };
        assert_eq!(scalar, equal);
        assert!(scalar != diagonal && scalar != full && diagonal != full);
    }
    digests.sort_unstable();
    digests.dedup();
    assert_eq!(digests.len(), 9);
}

#[test]
fn agents_with_very_different_measurements() {
    // They measure the whole state, a sum, two weighted differences, and one component.
    let rows = [
        picks(4, 0..4),
        vec![vec![1.0, 1.0, 1.0, 1.0]],
        vec![vec![0.5, -1.0, 0.0, 0.0], vec![0.0, 0.0, 2.0, -0.25]],
        picks(4, [3]),
    ];
    let scenario_builder = Described::linear(4, "path", rows.map(|rows| (rows, 1)));
    check("different outputs", &scenario_builder, 0.05);
}

#[test]
fn runge_kutta_applies_to_the_plant_only() {
    let mut scenario_builder =
        Described::linear(2, "path", [(picks(2, [0]), 1), (picks(2, [1]), 1)]);
    let euler = check("Euler", &scenario_builder, 0.05);
    scenario_builder.integrator = "rk4";
    let runge_kutta = check("RK4", &scenario_builder, 0.05);
    let last = euler.traces.rows() - 1;
    assert_eq!(last, 3_000);
    // x' = A x from (1, 1) rotates at 0.3 rad/s and decays at 0.02/s.
    let (sin, cos) = (0.3f64 * 3.0).sin_cos();
    let decay = (-0.02f64 * 3.0).exp();
    let exact = [decay * (cos - sin), decay * (sin + cos)];
    let error = |result: &RunResult| {
        let truth = result.traces.truth(last);
        exact.iter().zip(truth).map(|(exact, x)| (exact - x).abs()).fold(0.0, f64::max)
    };
    println!(
        "largest error of the plant: Euler {:e}, RK4 {:e}",
        error(&euler),
        error(&runge_kutta)
    );
    assert!(error(&runge_kutta) < 1e-12);
    assert!(error(&euler) > 1e-5 && error(&euler) < 1e-3);
}

#[test]
fn consecutive_and_overlapping_learning_cycles() {
    let mut scenario_builder =
        Described::linear(2, "path", [(picks(2, [0]), 1), (picks(2, 0..2), 1), (picks(2, [1]), 1)]);
    scenario_builder.duration = 4.0;
    // Fast enough to give the network something to learn.
    scenario_builder.plant = scenario_builder.plant.replace("0.3", "2.0");
    scenario_builder.network = network(&[(6, "tanh"), (5, "tanh")], "20.0");
    scenario_builder.learning = cycle(&[3, 1], 0.5, 1.2, 1.5)
        + &cycle(&[2], 0.8, 1.0, 1.0)
        + &cycle(&[2], 1.0, 1.4, 1.5)
        + &cycle(&[1], 1.5, 2.5, 2.6)
        + &cycle(&[2], 2.0, 3.0, 3.9)
        + SHORT_RECIPE;
    let scenario = scenario_builder.scenario();
    let result = check("five cycles", &scenario_builder, 0.2);
    let trained: Vec<_> = result.trainings.iter().map(|t| (t.cycle, t.agent, t.samples)).collect();
    println!("(cycle, agent, samples): {trained:?}");
    let order: Vec<_> = trained.iter().map(|&(cycle, agent, _)| (cycle, agent)).collect();
    // In the order of cycles and agents.
    assert_eq!(order, [(1, 1), (1, 3), (2, 2), (3, 2), (4, 1), (5, 2)]);
    for training in &result.trainings {
        let report = &training.report;
        let (first, best) = (&report.epochs[0], report.best().unwrap());
        assert!(best.train < first.train, "{training:?}");
        assert!(training.samples > 10);
    }
    // The run equals the one without learning until the first switch, and differs after it.
    let without = simulate_with(&scenario, false);
    assert_ne!(result.digest, without.digest);
    for (agent, first_switch) in [(0, 1_500), (1, 1_000), (2, 1_500)] {
        let row = |result: &RunResult, row| {
            let estimate = result.traces.estimate(row, agent);
            estimate.iter().map(|x| x.to_bits()).collect::<Vec<_>>()
        };
        assert!((0..=1_000).all(|tick| row(&result, tick) == row(&without, tick)));
        assert_ne!(row(&result, first_switch + 1), row(&without, first_switch + 1));
    }
}
