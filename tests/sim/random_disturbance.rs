//! A disturbance that is drawn with the run's seed.

use host_sim::engine::{RunOptions, RunResult, Silent, run};
use host_sim::scenario::{Scenario, built_in};

use crate::cli::command_line::{Folder, object};

fn scenario(model: &str) -> Scenario {
    let harmonic = "model = \"expressions\"\ncomponents = [\"0.5*sin(3*t)\", \"0.75*cos(t)\", \"cos(3.75*t)\"]";
    let text = built_in("expressions")
        .unwrap()
        .replacen(harmonic, model, 1)
        .replace("duration = 40.0", "duration = 4.0");
    assert!(text.contains(model));
    Scenario::parse("random.toml", &text).unwrap_or_else(|error| panic!("{error}"))
}

fn result(scenario: &Scenario, seed: u64) -> RunResult {
    let options = RunOptions { seed, learning: true, bounds: true };
    run(scenario, options, &Silent).unwrap_or_else(|error| panic!("{error}"))
}

const RANDOM: &str =
    "model = \"ornstein-uhlenbeck\"\ndeviation = [0.35, 0.53, 0.71]\ncorrelation_time = 0.5";

#[test]
fn each_seed_has_its_own_disturbance_and_always_the_same() {
    let random = scenario(RANDOM);
    let [first, again, other] = [3, 3, 4].map(|seed| result(&random, seed).digest);
    assert_eq!(first, again);
    assert_ne!(first, other);
    // Without it, nothing in this scenario is drawn.
    let still = scenario("model = \"none\"");
    assert_eq!(result(&still, 3).digest, result(&still, 4).digest);
}

#[test]
fn without_deviation_there_is_no_disturbance() {
    let none = RANDOM.replace("[0.35, 0.53, 0.71]", "0.0");
    assert_eq!(result(&scenario(&none), 3).digest, result(&scenario("model = \"none\""), 3).digest);
}

/// The field observer's settings come from the plant's course, which depends on the disturbance.
#[test]
fn training_and_certificates_use_the_disturbance_of_their_seed() {
    let folder = Folder::new("random-disturbance");
    let example = include_str!("../../host-sim/examples/field-observer/random-disturbance.toml");
    folder.write("random.toml", example);
    let short = "--set time.duration=21 --set evaluation.to=21 --set recipes.better.epochs=2 \
                 --set record.samples=true";
    folder.succeed(&format!("run random.toml {short} --baselines none --out out"));
    folder.succeed(
        "train out/agent1_cycle1_samples.csv --scenario random.toml --agent 1 --out one.weights",
    );
    let disturbance = "{model=\"ornstein-uhlenbeck\",deviation=30,correlation_time=3}";
    let bounds = |seeds: &str| -> Vec<(u64, f64)> {
        let report = object(&folder.succeed(&format!(
            "frontier expressions --set time.duration=3 --set evaluation.from=1 --set evaluation.to=3 \
             --set disturbance={disturbance} --set design.gain=500 --set design.epsilon=30 \
             --forms paper --initial-states 1 {seeds} --target 100 --format json --out frontier"
        )));
        let points = report["points"].as_array().unwrap().iter();
        points.map(|p| (p["seed"].as_u64().unwrap(), p["bound"].as_f64().unwrap())).collect()
    };
    let (alone, together) = (bounds("--seed 1 --seeds 1"), bounds("--seed 0 --seeds 2"));
    let second: Vec<_> = together.iter().copied().filter(|(seed, _)| *seed == 1).collect();
    assert!(!alone.is_empty() && alone == second, "{alone:?} {second:?}");
    let first: Vec<f64> = together.iter().filter(|p| p.0 == 0).map(|p| p.1).collect();
    assert_ne!(first, alone.iter().map(|p| p.1).collect::<Vec<_>>());
}
