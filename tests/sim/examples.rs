//! The examples of host-sim: the functions whose results their `main` prints.

use host_sim::engine::{RunOptions, Silent, run};
use host_sim::packages::PackageBytes;
use host_sim::scenario::{PAPER, Scenario};

use crate::cli::command_line::Folder;

#[allow(dead_code, reason = "its main is not called here")]
#[path = "../../host-sim/examples/choose_network.rs"]
mod choose_network;
#[allow(dead_code, reason = "its main is not called here")]
#[path = "../../host-sim/examples/compare_triggers.rs"]
mod compare_triggers;
#[allow(dead_code, reason = "its main is not called here")]
#[path = "../../host-sim/examples/paths.rs"]
mod paths;
#[allow(dead_code, reason = "its main is not called here")]
#[path = "../../host-sim/examples/radio_outages.rs"]
mod radio_outages;
#[allow(dead_code, reason = "its main is not called here")]
#[path = "../../host-sim/examples/random_geometries.rs"]
mod random_geometries;

/// The first five seconds of the paper's experiment, evaluated from the second on.
fn short() -> Scenario {
    let mut scenario = Scenario::parse("paper", PAPER).unwrap();
    scenario.learning.clear();
    scenario.time.duration = 5.0;
    (scenario.evaluation.from, scenario.evaluation.to) = (2.0, 5.0);
    scenario
}

#[test]
fn triggers_are_compared_by_errors_and_broadcasts() {
    let table = compare_triggers::table(&short()).unwrap();
    let lines: Vec<&str> = table.lines().collect();
    assert_eq!(lines.len(), 7, "{table}");
    // Pairs of error and broadcasts, for each agent.
    let figures = |start: &str| -> Vec<(f64, u64)> {
        let line = lines.iter().find_map(|line| line.strip_prefix(start)).expect(start);
        let words: Vec<&str> = line.split([' ', '/']).filter(|word| !word.is_empty()).collect();
        words.chunks(2).map(|pair| (pair[0].parse().unwrap(), pair[1].parse().unwrap())).collect()
    };
    // The broadcast at t = 0, and those of 5,000 steps.
    assert!(figures("every 1 steps").iter().all(|(_, broadcasts)| *broadcasts == 5_001));
    assert!(table.contains("every 16 steps           agent 3 diverges at t = 0.29 s\n"), "{table}");
    let paper = run(&short(), RunOptions { seed: 0, learning: false, bounds: false }, &Silent);
    for (agent, (error, broadcasts)) in
        paper.unwrap().agents.iter().zip(figures("event, epsilon = 3000 "))
    {
        assert_eq!(broadcasts, agent.broadcasts());
        assert!((error - agent.rmse().unwrap()).abs() <= 0.5e-4, "{error}: rounded to 4 digits");
    }
    // A higher threshold: fewer broadcasts, larger errors.
    let rare = figures("event, epsilon = 48000");
    for (often, rare) in figures("event, epsilon = 3000 ").iter().zip(&rare) {
        assert!(rare.1 < often.1 && rare.0 > often.0, "{table}");
    }
}

#[test]
fn the_error_grows_with_the_latency_of_a_path() {
    let [[first, last], [_, sooner]] =
        [1e-3, 5e-4].map(|step| paths::errors(16, step, true).unwrap());
    // docs/field-observer.md has 0.59, 0.82 and 0.71.
    assert!(first < 0.65 && first < last && last < 0.9, "{first} {last}");
    assert!(sooner < 0.95 * last, "{sooner} {last}");
}

#[test]
fn random_geometries_run_with_derived_settings() {
    // Lorenz and the linear chain.
    for (plant, seed) in random_geometries::plants().iter().step_by(3).zip(1..) {
        let found = random_geometries::geometry(plant, seed).unwrap();
        let broadcasts = found.map(|(knowledge, found)| match found {
            // docs/field-observer.md has at most 1.24 over 25 geometries.
            random_geometries::Found::Ran { error, broadcasts } if error < 1.24 => broadcasts,
            found => panic!("{}, {knowledge:?}: {found:?}", plant.name),
        });
        // The better agents know the plant, the less they have to say.
        let [nothing, trained, nearly, known] = broadcasts;
        let is_ordered = trained < nothing && nearly < trained && known < trained;
        assert!(is_ordered, "{}: {broadcasts:?}", plant.name);
    }
}

#[test]
fn a_link_of_ones_own_loses_what_deaf_radios_do_not_hear() {
    let scenario = short();
    let options = RunOptions { seed: 0, learning: false, bounds: false };
    let lossless = run(&scenario, options, &Silent).unwrap();
    assert_eq!(radio_outages::result(&scenario, 0.0).unwrap().digest, lossless.digest);
    let half = radio_outages::result(&scenario, 0.5).unwrap();
    assert_eq!(radio_outages::result(&scenario, 0.5).unwrap().digest, half.digest);
    let errors = |result: &host_sim::engine::RunResult| {
        result.agents.iter().map(|a| a.rmse().unwrap()).sum::<f64>()
    };
    assert!(errors(&half) > 1.2 * errors(&lossless), "{} {}", errors(&half), errors(&lossless));
}

#[test]
fn the_network_that_explains_most_is_written_and_helps() {
    let folder = Folder::new("example-choose-network");
    folder.succeed("run paper --out first --baselines none");
    let (samples, out) =
        (folder.path("first/agent1_cycle1_samples.csv"), folder.path("best.weights"));
    let mut scenario = Scenario::parse("paper", PAPER).unwrap();
    scenario.learning.clear();
    let text = choose_network::choose(&scenario, &[2, 8], &samples, &out).unwrap();
    let lines: Vec<Vec<&str>> =
        text.lines().map(|line| line.split_whitespace().collect()).collect();
    let number = |line: usize| -> f64 { lines[line].last().unwrap().parse().unwrap() };
    // [3, 2, 2, 2, 5] and [3, 8, 8, 8, 5], each layer with its biases.
    assert_eq!(
        (lines[1][..2].to_vec(), lines[2][..2].to_vec()),
        (vec!["2", "35"], vec!["8", "221"])
    );
    assert!(number(2) < number(1), "{text}");
    let package = PackageBytes::load(&out).unwrap();
    assert_eq!(package.architecture().layers()[0].width, 8);
    // From "untrained" to "trained".
    assert!(number(4) < 0.9 * number(3), "{text}");
}
