//! Baselines that run in place of the observer: what they know shows in their errors.

use host_sim::engine::{RunOptions, RunResult, Silent, run};
use host_sim::scenario::{Method, PAPER, Scenario};

fn scenario(method: Method) -> Scenario {
    let mut scenario = Scenario::parse("paper.toml", PAPER).unwrap();
    scenario.method = method;
    scenario.record.events = false;
    scenario.record.trace_stride = None;
    scenario
}

fn result(scenario: &Scenario) -> RunResult {
    let options = RunOptions { seed: 0, learning: true, bounds: false };
    run(scenario, options, &Silent).unwrap()
}

fn largest_error(result: &RunResult) -> f64 {
    result.agents.iter().map(|agent| agent.rmse().unwrap()).fold(0.0, f64::max)
}

fn without_disturbance(method: Method) -> Scenario {
    let mut scenario = scenario(method);
    scenario.disturbance = host_sim::plant::Disturbance::None;
    scenario
}

#[test]
fn the_plants_own_model_is_better_than_polynomials_and_those_than_no_network() {
    let [known, regression, none] = [Method::KnownModel, Method::Regression, Method::NoNetwork]
        .map(|method| largest_error(&result(&scenario(method))));
    assert!(known < regression && regression < 0.6 * none, "{known} {regression} {none}");
    // Without a disturbance there is nothing left but the broadcasts' errors.
    let known = result(&without_disturbance(Method::KnownModel));
    let none = result(&without_disturbance(Method::NoNetwork));
    assert!(largest_error(&known) < 0.3 * largest_error(&none));
}

#[test]
fn an_extended_kalman_filter_is_exact_where_its_model_is() {
    let mut scenario = without_disturbance(Method::ExtendedKalman);
    scenario.kalman.radius = Some(0.02);
    let extended = result(&scenario);
    // Its neighbours predict as it does, so there is next to nothing to broadcast.
    let broadcasts = broadcasts(&extended);
    assert!(broadcasts < 60, "{broadcasts}");
    assert!(largest_error(&extended) < 0.03, "{}", largest_error(&extended));
    // A linear one knows the plant near its mean state only.
    scenario.method = Method::Kalman;
    assert!(largest_error(&result(&scenario)) > 2.0 * largest_error(&extended));
}

#[test]
fn a_method_that_diverges_is_told_apart() {
    let mut scenario = scenario(Method::ExtendedKalman);
    (scenario.kalman.consensus_gain, scenario.time.duration) = (Some(1e4), 2.0);
    (scenario.evaluation.from, scenario.evaluation.to) = (1.0, 2.0);
    scenario.learning.clear();
    let options = RunOptions { seed: 0, learning: true, bounds: false };
    let error = run(&scenario, options, &Silent).unwrap_err().to_string();
    assert!(error.contains("kalman.consensus_gain"), "{error}");
    scenario.kalman.consensus_gain = None;
    assert_eq!(result(&scenario).excessive_error(), None);
}

#[test]
fn kalman_filters_do_not_depend_on_threads_and_feel_the_link() {
    let mut scenario = scenario(Method::ExtendedKalman);
    scenario.time.duration = 4.0;
    (scenario.evaluation.from, scenario.evaluation.to) = (2.0, 4.0);
    scenario.learning.clear();
    assert_eq!(result(&scenario).digest, result(&scenario).digest);
    let error = largest_error(&result(&scenario));
    scenario.link.edge.loss = 0.5;
    let lossy = result(&scenario);
    assert!(largest_error(&lossy) > 1.1 * error, "{} {error}", largest_error(&lossy));
    assert!(lossy.agents.iter().all(|agent| agent.traffic.unwrap().lost > 0));
}

fn field(method: Method) -> Scenario {
    let text = PAPER.replace(
        "[trigger]\nkind = \"event\"\n",
        "[observer]\npreset = \"field\"\nerror = 0.014\n",
    );
    // The trigger is the last table with this key.
    let mut scenario = Scenario::parse("field.toml", &text).unwrap();
    assert!(scenario.observer.is_some());
    (scenario.method, scenario.record.events) = (method, false);
    scenario.record.trace_stride = None;
    scenario
}

fn broadcasts(result: &RunResult) -> u64 {
    result.agents.iter().map(|agent| agent.broadcasts_evaluated).sum()
}

/// The paper's own form diverges with so few broadcasts at fixed times, and says so.
#[test]
fn broadcasts_at_fixed_times_are_as_many_as_those_at_events() {
    let events = broadcasts(&result(&field(Method::Observer))) as f64;
    let periodic = broadcasts(&result(&field(Method::Periodic))) as f64;
    assert!((periodic / events - 1.0).abs() < 0.05, "{periodic}, {events} at events");
    let options = RunOptions { seed: 0, learning: true, bounds: false };
    assert!(run(&scenario(Method::Periodic), options, &Silent).is_err());
}

#[test]
fn a_field_observer_with_the_plants_model_needs_fewer_broadcasts() {
    let [known, none] =
        [Method::KnownModel, Method::NoNetwork].map(|method| broadcasts(&result(&field(method))));
    assert!(known < none, "{known} {none}");
}
