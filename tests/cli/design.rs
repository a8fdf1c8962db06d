//! `design`: what it chooses is a scenario whose own run keeps Theorem 1.

use host_sim::engine::{RunOptions, Silent, run};
use host_sim::report::theorems::Checks;
use host_sim::scenario::Scenario;

use crate::cli::command_line::{Folder, object, short, texts};
use crate::cli::json_documented::assert_documented;

#[test]
fn a_designed_scenario_keeps_the_theorem_in_its_own_run() {
    let folder = Folder::new("design");
    let source = short().text().replace("kappa = 1.0", "kappa = 1.0  # to be chosen");
    folder.write("mine.toml", &source);
    let report = object(&folder.succeed("design mine.toml --out new.toml --format json"));
    let text = String::from_utf8(std::fs::read(folder.path("new.toml")).unwrap()).unwrap();
    let scenario = Scenario::parse("new.toml", &text).unwrap();
    let constants = &scenario.design;
    for (key, value) in [
        ("k2", constants.k2),
        ("kappa", constants.kappa),
        ("rho", constants.rho),
        ("delta", constants.delta),
        ("epsilon", constants.epsilon),
    ] {
        assert_eq!(report[key].as_f64(), Some(value), "{key}");
    }
    assert_eq!(report["gain"][1][1].as_f64(), Some(constants.gain[(1, 1)]));
    assert!(text.contains("  # to be chosen"), "{text}");
    // All other lines are those of the source.
    let changed = source.lines().zip(text.lines()).filter(|(old, new)| old != new).count();
    assert_eq!((source.lines().count(), changed), (text.lines().count(), 6), "{text}");
    let options = RunOptions { seed: 0, learning: true, bounds: true };
    let checks = Checks::new(&scenario, &run(&scenario, options, &Silent).unwrap());
    assert_eq!(checks.theorem1.status.as_str(), "kept", "{checks:?}");
    // A scenario may be replaced, another file not.
    folder.succeed("design mine.toml --out new.toml --radius 0.1");
    folder.write("notes.txt", "mine");
    let message = folder.fail("design mine.toml --out notes.txt", 2);
    assert!(message.contains("refusing to overwrite"), "{message}");
}

#[test]
fn the_radius_keeps_the_wanted_error_or_rate() {
    let folder = Folder::new("design-frontier");
    folder.write("mine.toml", &short().text());
    let design =
        |more: &str| object(&folder.succeed(&format!("design mine.toml --format json {more}")));
    let report = design("--max-rate 40");
    assert_documented(&report, &["frontier", "rate", "knee", "ultimate_bound_without_weights"]);
    let points = report["frontier"].as_array().unwrap();
    let chosen = points.iter().find(|point| point["radius"] == report["radius"]).unwrap();
    assert!(chosen["rate"].as_f64().unwrap() <= 40.0, "{report}");
    let error = 1.05 * chosen["error"].as_f64().unwrap();
    let report = design(&format!("--max-error {error}"));
    let points = report["frontier"].as_array().unwrap();
    let chosen = points.iter().find(|point| point["radius"] == report["radius"]).unwrap();
    assert!(chosen["error"].as_f64().unwrap() <= error, "{report}");
    let message = folder.fail("design mine.toml --max-error 1e-9", 1);
    assert!(message.contains("no useful radius gives an error of at most"), "{message}");
}

#[test]
fn a_rate_at_which_estimates_say_nothing_is_refused() {
    let folder = Folder::new("design-useless");
    // Without broadcasts, agents that do not measure a component know nothing of it.
    let message = folder.fail("design expressions --max-rate 1", 1);
    let expected = [
        "no useful radius gives at most 1 broadcasts per agent per second",
        "an estimate that never moves would hardly be worse",
        "allow more",
        "[observer]",
    ];
    assert!(expected.iter().all(|part| message.contains(part)), "{message}");
    // An error that large is not wanted, either: the largest useful radius is chosen.
    let report = object(&folder.succeed("design expressions --max-error 100 --format json"));
    let number = |key: &str| report[key].as_f64().unwrap();
    assert!(number("error") < 0.9 * number("state_deviation"), "{report}");
    assert!(number("rate") > 1.0, "{report}");
    // A radius that is asked for is used, with a warning.
    let output = folder.run("design expressions --radius 30 --format json");
    let report = object(&texts(&output).0);
    assert!(report["warnings"].as_array().unwrap().iter().any(|w| w["code"] == "useless-estimate"));
}

#[test]
fn without_a_solution_the_unseen_direction_is_named() {
    let folder = Folder::new("design-unseen");
    let mut blind = short();
    for (rows, _) in &mut blind.agents {
        *rows = vec![vec![1.0, 2.0]];
    }
    folder.write("blind.toml", &blind.text());
    let message = folder.fail("design blind.toml", 1);
    assert!(message.contains("no agent measures x1 - 0.5 x2"), "{message}");
}

#[test]
fn a_radius_that_agents_do_not_use_is_not_searched() {
    let folder = Folder::new("design-observer");
    folder.write("mine.toml", &(short().text() + "\n[observer]\nerror = 0.05\n"));
    for option in ["--max-error 0.1", "--max-rate 10"] {
        let message = folder.fail(&format!("design mine.toml {option}"), 2);
        assert!(message.contains("set observer.error or observer.radius"), "{message}");
    }
    let text = folder.succeed("design mine.toml");
    assert!(text.contains("agents use none of these numbers"), "{text}");
}
