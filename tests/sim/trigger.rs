//! Triggers other than the paper's: agents follow them, the theorems do not claim to cover them, and
//! no package leaves the simulation with them.

use host_sim::cosim::{CosimError, prepared};
use host_sim::engine::{RunOptions, RunResult, Silent, run};
use host_sim::report::theorems::{Checks, Status};
use host_sim::scenario::Scenario;
use serde_json::Value;

use crate::cli::command_line::{Folder, object, short};

const OPTIONS: RunOptions = RunOptions { seed: 0, learning: true, bounds: true };

/// The short scenario with another table `[trigger]`.
fn with_trigger(keys: &str) -> String {
    format!("{}\n[trigger]\n{keys}\n", short().text())
}

fn periodic(every: u32) -> String {
    with_trigger(&format!("kind = \"periodic\"\nevery = {every}"))
}

fn simulate(text: &str) -> (Scenario, RunResult) {
    let scenario = Scenario::parse("mine.toml", text).unwrap_or_else(|error| panic!("{error}"));
    let result = run(&scenario, OPTIONS, &Silent).unwrap();
    (scenario, result)
}

#[test]
fn a_periodic_trigger_broadcasts_at_every_so_many_ticks() {
    for every in [1, 10, 799, 801] {
        let (scenario, result) = simulate(&periodic(every));
        assert_eq!(scenario.steps(), 800);
        let expected: Vec<u64> = (0..800).step_by(every as usize).collect();
        for agent in &result.agents {
            // A broadcast at the end of the last step is received by no step.
            let events: Vec<u64> = agent.events.iter().copied().filter(|&t| t < 800).collect();
            assert_eq!(events, expected, "every {every}");
        }
    }
}

#[test]
fn the_event_trigger_is_the_default() {
    let (_, result) = simulate(&short().text());
    let (_, named) = simulate(&with_trigger("kind = \"event\""));
    assert_eq!(result.digest, named.digest);
    let (_, other) = simulate(&periodic(10));
    assert_ne!(result.digest, other.digest);
}

#[test]
fn the_theorems_do_not_apply_to_a_periodic_trigger() {
    // Theorem 2 says something about this scenario with the event trigger.
    let (scenario, result) = simulate(&short().text());
    let checks = Checks::new(&scenario, &result);
    assert!(checks.theorem1.share.is_some());
    assert!(checks.theorem2.iter().all(|agent| agent.interval_bound.is_some()));

    let (scenario, result) = simulate(&periodic(10));
    let checks = Checks::new(&scenario, &result);
    let premise =
        "agents broadcast every 10 steps, not by the event trigger that the theorem assumes";
    let expected = Status::NotApplicable(premise.to_owned());
    assert_eq!(checks.theorem1.status, expected);
    assert!(checks.theorem1.share.is_none());
    assert!(checks.design.ultimate_bound.is_none());
    for agent in &checks.theorem2 {
        assert_eq!((&agent.status, agent.interval_bound), (&expected, None));
    }
}

#[test]
fn health_expects_no_interval_from_a_periodic_trigger() {
    let health = "\n[health]\nfall_back_after = 0\n";
    let (_, trained) = simulate(&(short().text() + health));
    let interval =
        |result: &RunResult| result.trainings[0].package.package().broadcast_interval_min;
    assert!(interval(&trained) > 0.002, "{}", interval(&trained));
    // The package's interval is that of the event trigger; this one broadcasts more often.
    let mut scenario = Scenario::parse("mine.toml", &(periodic(1) + health)).unwrap();
    for (agent, training) in scenario.agents.iter_mut().zip(&trained.trainings) {
        agent.package = Some(training.package.clone());
    }
    scenario.learning.clear();
    let result = run(&scenario, OPTIONS, &Silent).unwrap();
    for agent in &result.agents {
        assert_eq!(agent.health.unwrap().early_broadcasts, 0);
    }
    // What is trained in such a run is not said to broadcast by the event trigger.
    let (_, trained) = simulate(&(periodic(10) + health));
    assert_eq!(interval(&trained), 0.0);
}

#[test]
fn no_package_for_a_node_comes_from_a_scenario_with_a_periodic_trigger() {
    let folder = Folder::new("periodic");
    let text = periodic(10).replace("\nevents = ", "\nsamples = true\nevents = ");
    folder.write("mine.toml", &text);
    let report = object(&folder.succeed("run mine.toml --out out --format json"));
    assert!(folder.path("out/agent1_cycle1_samples.csv").exists());
    assert!(!folder.path("out/agent1_cycle1.weights").exists());
    let warning = &report["warnings"][0];
    assert_eq!(warning["code"], "simulation-only");
    assert!(warning["text"].as_str().unwrap().contains("trigger.kind"), "{warning}");
    for key in ["phi1", "phi2", "trigger_radius", "ultimate_bound"] {
        assert_eq!(report["checks"][key], Value::Null, "{key}");
    }
    let check = folder.succeed("check mine.toml");
    assert!(check.contains("agents broadcast every 10 steps, so Theorems 1 and 2"), "{check}");

    folder.write("event.toml", &short().text());
    folder.succeed("run event.toml --out event");
    folder.succeed("weights export event/agent1_cycle1.weights --out net.npz");
    let samples = "out/agent1_cycle1_samples.csv";
    for command in [
        &format!("train {samples} --scenario mine.toml --agent 1 --out a.weights"),
        "weights import net.npz --scenario mine.toml --agent 1 --out a.weights",
    ] {
        let error = folder.fail(command, 2);
        assert!(error.contains("broadcasting every 10 steps is for simulation only"), "{error}");
        assert!(!folder.path("a.weights").exists());
        folder.succeed(&command.replace("mine.toml", "event.toml"));
        std::fs::remove_file(folder.path("a.weights")).unwrap();
    }
    let scenario = Scenario::parse("mine.toml", &text).unwrap();
    assert!(matches!(prepared(&scenario), Err(CosimError::Trigger(_))));
}
