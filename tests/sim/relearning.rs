//! Learning cycles that start by themselves.

use host_sim::engine::{RunOptions, RunResult, Silent, run};
use host_sim::scenario::Scenario;

use crate::cli::command_line::{Folder, object};

const SCENARIO: &str = include_str!("../../host-sim/examples/relearning/relearning.toml");

fn result(text: &str) -> RunResult {
    let scenario =
        Scenario::parse("relearning.toml", text).unwrap_or_else(|error| panic!("{error}"));
    let options = RunOptions { seed: 0, learning: true, bounds: false };
    run(&scenario, options, &Silent).unwrap_or_else(|error| panic!("{error}"))
}

fn without() -> String {
    let (before, rest) = SCENARIO.split_once("[relearning]").unwrap();
    let (_, after) = rest.split_once("[recipes").unwrap();
    format!("{before}[recipes{after}")
}

/// Broadcasts of all agents in a time. \[s\]
fn broadcasts(result: &RunResult, from: f64, to: f64) -> usize {
    let ticks = result.agents.iter().flat_map(|agent| &agent.events);
    ticks.filter(|&&tick| (from..to).contains(&(tick as f64 * 0.002))).count()
}

#[test]
fn a_changed_plant_is_learned_again() {
    let (again, once) = (result(SCENARIO), result(&without()));
    let starts: Vec<_> = again.trainings.iter().map(|t| (t.cycle, t.agent, t.started_at)).collect();
    let [(1, 1, None), (1, 2, None), (2, 1, Some(first)), (2, 2, Some(second))] = starts[..] else {
        panic!("{starts:?}");
    };
    // Two windows of 3 s after the change at 30 s, at which one begins.
    assert!(first == second && (36.0..=40.0).contains(&first), "{first}");
    assert_eq!(again.cycles.len(), 2);
    assert_eq!(again.cycles[1].apply_at, first + 10.0);
    // Until then nothing differs; afterwards the new network saves broadcasts.
    assert_eq!(broadcasts(&again, 0.0, first), broadcasts(&once, 0.0, first));
    let [before, changed] = [(18.0, 30.0), (33.0, 45.0)].map(|(a, b)| broadcasts(&once, a, b));
    assert!(changed > 3 * before, "{before}, {changed}");
    let [with, never] = [&again, &once].map(|result| broadcasts(result, first + 12.0, 70.0));
    assert!(2 * with < never + never / 10, "{with}, {never}");
    // The package of the second cycle has a version of its own.
    let version = |place: usize| again.trainings[place].package.package().version;
    assert!(version(2) > version(0));
}

#[test]
fn a_plant_that_stays_is_not_learned_again() {
    let text = SCENARIO.replace("(1.75 + 0.75*sign(t - 30))", "1.0");
    assert_eq!(result(&text).cycles.len(), 1);
}

#[test]
fn the_pause_bounds_how_often_cycles_start() {
    // The stiffness changes all the time, and any change in the rate starts a cycle.
    let text = SCENARIO
        .replace("(1.75 + 0.75*sign(t - 30))", "(2 + 1.5*sin(0.05*t^2))")
        .replace("rate = 2.0", "rate = 1.01")
        .replace("window = 3.0", "window = 0.5")
        .replace("pause = 15.0", "pause = 17.0")
        .replace("collect_to = 12.0\napply_at = 12.0", "collect_to = 4.0\napply_at = 4.0");
    let cycles = result(&text).cycles;
    assert!(cycles.len() > 2, "{}", cycles.len());
    for pair in cycles[1..].windows(2) {
        assert!(pair[1].collect.from - pair[0].collect.from >= 17.0, "{pair:?}");
    }
}

#[test]
fn a_cycle_that_cannot_end_does_not_start() {
    let text = SCENARIO.replace("duration = 70.0", "duration = 42.0");
    let text = text.replace("from = 55.0\nto = 70.0", "from = 35.0\nto = 42.0");
    assert_eq!(result(&text).cycles.len(), 1);
}

#[test]
fn a_run_says_when_a_cycle_started() {
    let folder = Folder::new("relearning");
    folder.write("again.toml", SCENARIO);
    let text = folder.succeed("run again.toml --out out --baselines none");
    assert!(text.contains("cycle 2 (started by the rate of broadcasts at t = 36"), "{text}");
    assert!(folder.path("out/agent2_cycle2.weights").exists());
    let report = object(&folder.succeed("run again.toml --out out --baselines none --format json"));
    let started: Vec<_> =
        report["trainings"].as_array().unwrap().iter().map(|t| t["started_at"].as_f64()).collect();
    assert!(
        started[..2] == [None, None] && started[2..].iter().all(Option::is_some),
        "{started:?}"
    );
}
