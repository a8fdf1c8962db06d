//! A disturbance that is drawn with the run's seed.

use host_sim::engine::{RunOptions, RunResult, Silent, run};
use host_sim::scenario::{Scenario, built_in};

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
