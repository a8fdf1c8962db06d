//! Whole runs with and without lanes, for every set of instructions and on one and two threads: the same
//! bits, whatever happens to the agents.

use std::num::NonZeroU32;

use agent_core::health::{FallBack, HealthSettings};
use agent_core::math::activation::Activation;
use agent_core::observer::network::{Architecture, Layer};
use nalgebra::DMatrix;

use super::LaneMode;
use super::tests::instruction_sets;
use crate::analysis::TriggerConstants;
use crate::engine::{RunOptions, Silent, run_in_lanes};
use crate::graph::{Edge, Graph};
use crate::learning::trained;
use crate::scenario::{
    Downtime, LearningCycle, Network, PAPER, Record, Scenario, Window, built_in,
};

const AGENTS: usize = 70;

/// The paper's agents on a ring.
fn many(text: &str, duration: f64) -> Scenario {
    let mut scenario = Scenario::parse("paper.toml", text).unwrap();
    let edge = |first| Edge { first, second: (first + 1) % AGENTS, weight: 0.5 };
    scenario.graph = Graph::new(AGENTS, &(0..AGENTS).map(edge).collect::<Vec<_>>()).unwrap();
    scenario.agents = (0..AGENTS).map(|agent| scenario.agents[agent % 3].clone()).collect();
    scenario.design.epsilon *= AGENTS as f64 / 3.0;
    scenario.time.duration = duration;
    scenario.evaluation = Window { from: 0.5 * duration, to: duration };
    scenario.record = Record { trace_stride: None, events: true, samples: false };
    scenario.learning.clear();
    scenario
}

/// Everything that a run reports, with every digit, and its digest.
fn report(scenario: &Scenario, lanes: LaneMode, threads: usize, bounds: bool) -> (u64, String) {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    let options = RunOptions { seed: 3, learning: true, bounds };
    let result = pool.install(|| run_in_lanes(scenario, lanes, options, &Silent)).unwrap();
    let trainings: Vec<_> = result.trainings.iter().map(|training| &training.report).collect();
    let text = format!(
        "{:?} {trainings:?} {:?} {:?} {:?}",
        result.agents, result.missed, result.layers, result.bounds
    );
    (result.digest, text)
}

/// Checks that lanes change nothing; returns the report.
#[track_caller]
fn same_bits(scenario: &Scenario, bounds: bool) -> String {
    let expected = report(scenario, LaneMode::Off, 1, bounds);
    for threads in [1, 2] {
        for lanes in instruction_sets().into_iter().map(LaneMode::Only).chain([LaneMode::Longest]) {
            let found = report(scenario, lanes, threads, bounds);
            assert!(found == expected, "{lanes:?}, {threads} threads");
        }
    }
    assert_eq!(report(scenario, LaneMode::Off, 2, bounds), expected);
    expected.1
}

#[test]
fn the_papers_agents() {
    same_bits(&many(PAPER, 0.4), false);
    same_bits(&many(PAPER, 0.1), true);
}

#[test]
fn agents_that_learn_and_switch_networks() {
    let mut scenario = many(PAPER, 0.3);
    let paper = Scenario::parse("paper.toml", PAPER).unwrap();
    // One agent, enough agents for a block of networks that differ, and one network for several.
    for (agents, apply_at, is_shared) in
        [(vec![0], 0.11, false), ((32..40).collect(), 0.15, false), ((64..69).collect(), 0.2, true)]
    {
        let collect = Window { from: 0.02, to: 0.1 };
        let (recipe, cycle) = ("paper".to_owned(), paper.learning[0].clone());
        scenario.learning.push(LearningCycle {
            agents,
            collect,
            apply_at,
            recipe,
            is_shared,
            ..cycle
        });
    }
    for recipe in &mut scenario.recipes {
        *recipe.trainer.epochs_max_mut() = 2;
    }
    same_bits(&scenario, false);
}

#[test]
fn agents_with_different_architectures() {
    let mut scenario = many(PAPER, 0.2);
    let trigger = TriggerConstants::new(&scenario);
    let layer = |width, activation| Layer { width, activation };
    let layers = [layer(7, Activation::Logistic), layer(4, Activation::Gaussian)];
    let architecture = Architecture::new(3, &layers).unwrap();
    let inner: Vec<_> =
        (0..architecture.parameter_count()).map(|i| 0.3 - 0.01 * i as f32).collect();
    let first = scenario.network.clone().unwrap();
    let network = Network { architecture, outer: vec![0.1; 12], ..first };
    for agent in (1..AGENTS).step_by(3) {
        let package = trained::initial(&scenario, &trigger, &network, &inner, agent, 0).unwrap();
        scenario.agents[agent].package = Some(package);
    }
    same_bits(&scenario, false);
}

#[test]
fn agents_whose_sensors_clocks_links_and_lives_fail() {
    let mut scenario = many(built_in("deployment").unwrap(), 0.4);
    scenario.link.partitions.clear();
    scenario.life = vec![
        Downtime { agent: 5, window: Window { from: 0.1, to: 0.2 }, is_replaced: true },
        Downtime { agent: 40, window: Window { from: 0.15, to: 0.25 }, is_replaced: false },
        Downtime { agent: 41, window: Window { from: 0.0, to: 0.3 }, is_replaced: false },
    ];
    for agent in scenario.agents.iter_mut().step_by(4) {
        agent.clock.missed = 0.1;
    }
    let report = same_bits(&scenario, false);
    assert!(report.contains("Traffic"));
}

#[test]
fn agents_that_fall_back_and_restart() {
    let mut scenario = many(PAPER, 0.3);
    let fall_back = FallBack {
        after: NonZeroU32::MIN,
        return_after: NonZeroU32::new(7).unwrap(),
        outside_box: true,
        projection_active: true,
        diverged: true,
    };
    scenario.health = Some(HealthSettings {
        fall_back: Some(fall_back),
        restart_after: NonZeroU32::new(2),
        ..HealthSettings::RECOMMENDED
    });
    for agent in scenario.agents.iter_mut().step_by(5) {
        agent.sensor.outliers = Some(crate::scenario::Outliers { probability: 0.3, size: 1e37 });
    }
    let report = same_bits(&scenario, false);
    for counter in ["fall_backs", "returns", "restarts"] {
        let name = format!("{counter}: ");
        let mut counts = report.split(&name).skip(1);
        assert!(counts.any(|count| !count.starts_with('0')), "no {counter}");
    }
}

#[test]
fn agents_that_overflow_without_a_monitor_fail_alike() {
    let mut scenario = many(PAPER, 0.1);
    scenario.design.gain = DMatrix::identity(3, 3) * 1e5;
    let options = RunOptions { seed: 0, learning: false, bounds: false };
    let failures = [LaneMode::Off, LaneMode::Longest]
        .map(|lanes| run_in_lanes(&scenario, lanes, options, &Silent).unwrap_err().to_string());
    assert_eq!(failures[0], failures[1]);
}

#[test]
fn the_field_observer() {
    let tables = "[observer]\nhold = \"model\"\n[evaluation]";
    let observer = PAPER.replacen("[evaluation]", tables, 1);
    let mut scenario = many(&observer, 0.2);
    scenario.design.gain *= 0.2;
    same_bits(&scenario, false);
}
