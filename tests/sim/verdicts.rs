//! Verdicts, warnings and exit codes for scenarios and runs.

use host_sim::analysis::StepCheck;
use host_sim::engine::{RunError, RunOptions, Silent, run};
use host_sim::report::theorems::{Checks, DesignChecks, Status};
use host_sim::scenario::{PAPER, Scenario};
use nalgebra::DMatrix;
use serde_json::Value;
use test_support::close;

use crate::cli::command_line::Folder;
use crate::sim::scenario_builder::{Described, picks};

const OPTIONS: RunOptions = RunOptions { seed: 0, learning: true, bounds: true };

/// Returns the object printed by a command, successful or not, and its exit code.
fn object(folder: &Folder, arguments: &str) -> (Value, Option<i32>) {
    let output = folder.run(arguments);
    let text = String::from_utf8(output.stdout).unwrap();
    let value = serde_json::from_str(&text).unwrap_or_else(|e| panic!("{arguments}: {e}: {text}"));
    (value, output.status.code())
}

fn codes(value: &Value) -> Vec<&str> {
    let warnings = value["warnings"].as_array().unwrap();
    assert!(warnings.iter().all(|w| w["text"].as_str().is_some_and(|text| text.len() > 20)));
    warnings.iter().map(|warning| warning["code"].as_str().unwrap()).collect()
}

/// Two agents on a path, each of which measures one of two components.
fn pair() -> Described {
    Described::linear(2, "path", [(picks(2, [0]), 1), (picks(2, [1]), 1)])
}

#[test]
fn check_reports_on_a_scenario_without_running_it() {
    let folder = Folder::new("check");
    let text = folder.succeed("check paper");
    for expected in ["lambda_min = 36.1356 1/s", "a solution", "is below 0.00233 s", "47.61"] {
        assert!(text.contains(expected), "{expected}: {text}");
    }
    let (value, code) = object(&folder, "check paper --format json");
    assert_eq!((code, codes(&value)), (Some(0), vec![]));
    let checks = &value["checks"];
    let number = |key: &str| checks[key].as_f64().unwrap_or_else(|| panic!("{key}: {checks}"));
    assert!(close(number("eigenvalue_min"), 36.135_628_091, 1e-9, 0.0), "{checks}");
    assert!(number("eigenvalue_uncertainty") < 1e-9);
    assert!(close(number("k1"), 70.0 / 3.0, 1e-12, 0.0));
    assert!(close(number("phi1"), 311_810.148, 1e-8, 0.0));
    assert!(close(number("phi2"), 0.277_778, 1e-5, 0.0));
    assert!(close(number("largest_stable_step"), 2.0 / 854.702_441, 1e-8, 0.0), "{checks}");
    assert_eq!((&checks["solution"], &checks["gain_factor"]), (&true.into(), &Value::Null));
    // Nothing was written.
    assert!(!folder.path("out").exists());
}

#[test]
fn warns_of_a_long_step_before_and_after_the_run() {
    let folder = Folder::new("unstable");
    let mut scenario_builder = pair();
    // The largest eigenvalue of 60 (C^T C + L) on this path is 60 (3 + sqrt(5))/2.
    let limit = 2.0 / (30.0 * (3.0 + 5f64.sqrt()));
    scenario_builder.trace_stride = 1;
    let text = scenario_builder.text().replace("step = 0.001", "step = 0.02");
    folder.write("long.toml", &text.replace("duration = 3.0", "duration = 1.0"));
    let (value, code) = object(&folder, "check long.toml --format json");
    assert_eq!((code, codes(&value)), (Some(1), vec!["unstable-step"]));
    let largest = value["checks"]["largest_stable_step"].as_f64().unwrap();
    assert!(close(largest, limit, 1e-9, 0.0), "{largest}, {limit}");

    let (value, code) = object(&folder, "run long.toml --format json --out results");
    let found = codes(&value);
    assert_eq!(code, Some(1));
    assert!(found.starts_with(&["unstable-step", "unstable-run"]), "{found:?}");
    assert!(value["warnings"][0]["text"].as_str().unwrap().contains("below 0.0127 s"), "{value}");
    // The results so far were written.
    assert!(
        folder.path("results/agents.csv").exists() && folder.path("results/traces.csv").exists()
    );
    let output = folder.run("run long.toml --out results");
    let (text, error) =
        (String::from_utf8(output.stdout).unwrap(), String::from_utf8(output.stderr).unwrap());
    assert_eq!(output.status.code(), Some(1));
    assert!(text.contains("Checks against the theory") && text.contains("without bound"), "{text}");
    assert!(error.starts_with("warning: time.step = 0.02 s is too long"), "{error}");
    assert!(error.contains("\nerror: the error grew without bound"), "{error}");
}

#[test]
fn errors_grow_above_the_largest_stable_step() {
    let full =
        DMatrix::from_row_slice(3, 3, &[60.0, 25.0, 0.0, 25.0, 40.0, -10.0, 0.0, -10.0, 80.0]);
    for (topology, agents) in [("path", 3), ("ring", 6), ("star", 5), ("complete", 4)] {
        let scenario_builder = Described::linear(
            3,
            topology,
            (0..agents).map(|agent| (picks(3, [agent % 3, (agent + 1) % 3]), 1)),
        );
        let mut scenario = scenario_builder.scenario();
        scenario.design.gain.copy_from(&full);
        scenario.design.epsilon = 1e-3;
        // All different, to excite every mode of the error.
        for (index, agent) in scenario.agents.iter_mut().enumerate() {
            let part = |c: usize| 0.3 * ((5 * index + 3 * c) % 7) as f64;
            agent.initial_estimate = (0..3).map(part).collect();
        }
        let limit = StepCheck::new(&scenario).largest_stable_step.unwrap();
        for (share, stable) in [(0.97, true), (1.03, false)] {
            scenario.time.step_size = share * limit;
            scenario.time.duration = 400.0 * scenario.time.step_size;
            let step = StepCheck::new(&scenario);
            assert_eq!(step.is_stable(), stable, "{topology}: {step:?}");
            let result = run(&scenario, OPTIONS, &Silent).unwrap();
            let checks = Checks::new(&scenario, &result);
            assert_eq!(checks.unbounded(), !stable, "{topology}, {share}: {:?}", checks.growth);
        }
    }
}

#[test]
fn theorem_with_valid_premises_is_kept() {
    let scenario = pair().scenario();
    let result = run(&scenario, OPTIONS, &Silent).unwrap();
    let checks = Checks::new(&scenario, &result);
    // |f| of the oscillator is at most about 0.3 sqrt(2), for each of two agents; no disturbance.
    let lumped = checks.theorem1.lumped.unwrap();
    assert!(close(lumped.estimate, 0.3 * 2.0, 0.02, 0.0), "{lumped:?}");
    assert_eq!((lumped.at_least, lumped.disturbance), (lumped.estimate, 0.0));
    assert_eq!(checks.theorem1.status, Status::Kept, "{checks:?}");
    let share = checks.theorem1.share.unwrap();
    // Without a network the bound equals the error at t = 0, so the comparison is trivial.
    assert!(share.largest < 1.0 && share.largest_at > 0.0, "{share:?}");

    // Each premise in turn.
    let mut scenario = scenario;
    scenario.design.rho = 0.5;
    let checks = Checks::new(&scenario, &result);
    assert!(checks.theorem1.status.premise().unwrap().contains("chi_bar_max"), "{checks:?}");
    scenario.design.rho = 1.0;
    scenario.design.k2 = 500.0;
    let checks = Checks::new(&scenario, &result);
    let premise = "K1 is not a solution of the matrix inequality";
    assert_eq!(checks.theorem1.status.premise(), Some(premise));
    let unmeasured = run(&scenario, RunOptions { bounds: false, ..OPTIONS }, &Silent).unwrap();
    let checks = Checks::new(&scenario, &unmeasured);
    assert!(checks.theorem1.status.premise().unwrap().contains("measured"), "{checks:?}");
}

/// With a known network and constant features, the best `W_0` can be computed by hand.
#[test]
fn rho_is_compared_with_the_best_ideal_weights() {
    // x' = 3 with one agent that measures x and a network of one constant feature, tanh(0 x + b):
    // W_0 = 3/tanh(b) makes chi_bar zero if it is inside the ball.
    let scenario = |bound: f64| {
        let text = format!(
            "name = \"constant\"\n[plant]\nmodel = \"expressions\"\nstates = [\"x\"]\n\
             derivative = [\"3\"]\ninitial_state = [0.0]\n[time]\nduration = 1.0\nstep = 0.001\n\
             [design]\ngain = 50.0\nk2 = 5.0\nkappa = 1.0\nrho = 1.0\ndelta = 0.5\nepsilon = 1.0\n\
             [network]\nlayers = [{{ nodes = 1, activation = \"gaussian\" }}]\n\
             inner = {{ fill = 0.0 }}\nouter = {{ fill = 1.0 }}\n[outer_law]\ngain = 1.0\n\
             bound = {bound:?}\nboundary_layer = 0.5\n[[agents]]\noutput_matrix = [[1.0]]\n"
        );
        Scenario::parse("constant.toml", &text).unwrap()
    };
    // The gaussian of 0 is 1.
    for (bound, expected) in [(20.0, 0.0), (2.5, 1.0)] {
        let scenario = scenario(bound);
        let result = run(&scenario, OPTIONS, &Silent).unwrap();
        let lumped = Checks::new(&scenario, &result).theorem1.lumped.unwrap();
        assert!(close(lumped.estimate, expected, 0.02, 1e-3), "{bound}: {lumped:?}");
        assert!(lumped.at_least <= lumped.estimate, "{lumped:?}");
    }
}

#[test]
fn json_contains_checks_and_warnings() {
    let folder = Folder::new("checks-json");
    folder.write("mine.toml", &pair().text());
    let (value, code) = object(&folder, "run mine.toml --format json");
    assert_eq!((code, codes(&value)), (Some(0), vec![]));
    let checks = &value["checks"];
    assert_eq!(checks["solution"], true);
    for key in ["eigenvalue_min", "eigenvalue_uncertainty", "k1", "phi1", "phi2"] {
        assert!(checks[key].is_number(), "{key}: {checks}");
    }
    let theorem = &checks["theorem1"];
    assert_eq!((&theorem["status"], &theorem["premise"]), (&"kept".into(), &Value::Null));
    assert!(theorem["chi_bar_max"].as_f64().unwrap() < theorem["rho"].as_f64().unwrap());
    assert_eq!(checks["theorem2"]["agents"].as_array().unwrap().len(), 2);
    let status = checks["theorem2"]["status"].as_str().unwrap();
    assert!(["kept", "not_applicable"].contains(&status), "{checks}");

    // With one agent less, a component is not measured.
    let mut blind = pair();
    blind.agents[1].0 = picks(2, [0]);
    folder.write("blind.toml", &blind.text());
    let (value, code) = object(&folder, "run blind.toml --format json");
    assert_eq!((code, codes(&value)[0]), (Some(0), "state-not-covered"));
    assert_eq!(value["checks"]["solution"], false);
    let premise = value["checks"]["theorem1"]["premise"].as_str().unwrap();
    assert!(premise.contains("not a solution"), "{premise}");

    let mut often = pair();
    often.epsilon = 1e-6;
    folder.write("often.toml", &often.text());
    let (value, _) = object(&folder, "run often.toml --format json");
    assert_eq!(codes(&value), ["frequent-broadcasts"]);
}

#[test]
fn advice_on_the_gain_is_consistent_and_works() {
    let folder = Folder::new("advice");
    let mut weak = pair();
    weak.gain = 2.0;
    folder.write("weak.toml", &weak.text());
    let output = folder.run("run weak.toml");
    let (text, error) =
        (String::from_utf8(output.stdout).unwrap(), String::from_utf8(output.stderr).unwrap());
    let advice = DesignChecks::new(&weak.scenario()).gain_in_words();
    assert!(text.contains(&advice) && error.contains(&advice), "{advice}\n{text}\n{error}");
    let factor = advice.split("multiply design.gain by ").nth(1).unwrap();
    let factor: f64 = factor.split(',').next().unwrap().trim().parse().unwrap();
    weak.gain *= factor;
    assert!(DesignChecks::new(&weak.scenario()).gain.holds(), "{factor}");
    weak.gain *= 0.99;
    assert!(!DesignChecks::new(&weak.scenario()).gain.holds(), "{factor}");
}

/// One agent that measures `x`; the drift or the disturbance is this expression.
fn with_expression(text: &str, as_disturbance: bool, integrator: &str) -> Scenario {
    let (drift, disturbance) = if as_disturbance { ("0", text) } else { (text, "0") };
    let text = format!(
        "name = \"expression\"\n[plant]\nmodel = \"expressions\"\nstates = [\"x\"]\n\
         derivative = [\"{drift}\"]\ninitial_state = [2.0]\n\
         [disturbance]\nmodel = \"expressions\"\ncomponents = [\"{disturbance}\"]\n\
         [time]\nduration = 1.0\nstep = 0.01\nplant_integrator = \"{integrator}\"\n\
         [design]\ngain = 20.0\nk2 = 5.0\nkappa = 1.0\nrho = 1.0\ndelta = 0.5\nepsilon = 1.0\n\
         [[agents]]\noutput_matrix = [[1.0]]\n"
    );
    Scenario::parse("expression.toml", &text).unwrap()
}

#[test]
fn errors_name_undefined_expressions() {
    // Time of the fault, and its message.
    let cases = [
        ("sqrt(x-10)", "0 with x = 2.0"),
        ("max(sqrt(x-10), 0)", "0 with x = 2.0"),
        ("1/0", "0;"),
        ("1/(1/(x-2))", "0 with x = 2.0"),
        ("0*exp(-1/(x-2))", "0 with x = 2.0"),
        // From the middle of the run.
        ("0*sqrt(0.495-t)", "0.5;"),
        ("min(ln(0.495-t), 0)*0", "0.5;"),
    ];
    for (text, met) in cases {
        for as_disturbance in [false, true] {
            for integrator in ["euler", "rk4"] {
                let scenario = with_expression(text, as_disturbance, integrator);
                let error = run(&scenario, OPTIONS, &Silent).unwrap_err();
                assert!(matches!(error, RunError::Expression(_)), "{text}: {error}");
                let message = error.to_string();
                let key =
                    if as_disturbance { "disturbance.components" } else { "plant.derivative" };
                let expected = format!("{key}, expression 1 for x, `{text}`: ");
                assert!(message.starts_with(&expected), "{message}");
                // The last stage of a Runge-Kutta step evaluates its end.
                let early = met.replace("0.5;", "0.495;");
                let here = |met: &str| message.contains(&format!("at t = {met}"));
                assert!(here(met) || (integrator == "rk4" && here(&early)), "{message}, {met}");
                assert!(!message.contains("diverged"), "{message}");
            }
        }
    }
}

#[test]
fn overflowing_plant_is_reported_as_diverged() {
    for text in ["x^3", "x^9", "exp(x)", "x^3*(1 + exp(x))^0 + x^5"] {
        for integrator in ["euler", "rk4"] {
            let mut scenario = with_expression(text, false, integrator);
            scenario.time.duration = 10.0;
            let error = run(&scenario, OPTIONS, &Silent).unwrap_err();
            // With exp an overflow can come first; the error then has the state at that time.
            let named =
                matches!(&error, RunError::Expression(fault) if fault.expression().overflow);
            let diverged = matches!(error, RunError::PlantDiverged { .. });
            assert!(diverged || (named && text.contains("exp")), "{text}: {error}");
        }
    }
}

#[test]
fn check_finds_an_expression_undefined_at_the_start() {
    let folder = Folder::new("check-expression");
    let text = PAPER.replacen("model = \"van-der-pol\"", "model = \"expressions\"", 1).replacen(
        "parameters = { mu = 0.3 }",
        "states = [\"x\", \"y\", \"z\"]\nderivative = [\"y\", \"ln(x-5)\", \"0\"]",
        1,
    );
    folder.write("mine.toml", &text);
    let output = folder.run("check mine.toml");
    let error = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1), "{error}");
    assert!(error.contains("expression 2 for y, `ln(x-5)`: ln(0.0) is infinite"), "{error}");
}
