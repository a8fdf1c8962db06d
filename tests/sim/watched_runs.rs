//! Health monitoring of simulated agents: without faults no bit changes, faults are counted as they
//! occur, and faults that end an unmonitored run do not end a monitored one.

use agent_core::Tick;
use agent_core::agent::StepError;
use agent_core::agent::region::StateBox;
use agent_core::health::{HealthCounters, HealthSettings};
use agent_core::wire::frame::Frame;
use host_sim::engine::link::{Link, Lossless};
use host_sim::engine::{RunError, RunOptions, RunResult, Silent, run, run_over};
use host_sim::packages::Draft;
use host_sim::scenario::{Scenario, Window};
use std::num::NonZeroU32;
use test_support::close;

use crate::core::health::{Ledger, SETTINGS};
use crate::sim::reproduce::paper;
use crate::sim::scenario_builder::{Described, SHORT_RECIPE, cycle, network};

/// Settings that only count.
const COUNTING: HealthSettings =
    HealthSettings { fall_back: None, restart_after: None, ..SETTINGS };

/// Step of the disturbance, and number of steps in the run.
const STRIKE: Tick = 1_000;
const STEPS: usize = 3_000;

fn simulate(scenario: &Scenario, learning: bool) -> Result<RunResult, RunError> {
    run(scenario, RunOptions { seed: 0, learning, bounds: false }, &Silent)
}

/// A circle, and a separate component that only `disturbance` moves. Of `count` agents each, one
/// kind measures `x`, one `v`, and one, agent 3 of three, twice `s`.
fn striking(disturbance: &str, count: usize) -> Described {
    let rows = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 2.0]];
    let agents = rows.map(|row| (vec![row.to_vec()], count));
    let mut scenario_builder = Described::linear(3, "ring", agents);
    scenario_builder.plant = format!(
        "[plant]\nmodel = \"expressions\"\nstates = [\"x\", \"v\", \"s\"]\n\
         derivative = [\"v\", \"-x\", \"0\"]\ninitial_state = [1.0, 1.0, 0.0]\n\n\
         [disturbance]\nmodel = \"expressions\"\ncomponents = [\"0\", \"0\", \"{disturbance}\"]\n"
    );
    scenario_builder.network = network(&[(6, "tanh"), (4, "tanh")], "2.0");
    scenario_builder
}

/// For one step `s` has this value and then 0 again, exactly.
fn spike(size: &str) -> String {
    format!("{size}*1000*0.5*(sign(t - 0.9985) - 2*sign(t - 0.9995) + sign(t - 1.0005))",)
}

/// Three agents, with packages whose trained box has this limit, if any.
fn three(disturbance: &str, limit: Option<f32>) -> Scenario {
    let mut scenario_builder = striking(disturbance, 1);
    scenario_builder.learning = cycle(&[1, 2, 3], 0.1, 0.4, 0.5) + SHORT_RECIPE;
    let mut scenario = scenario_builder.scenario();
    scenario.evaluation = Window { from: 2.0, to: 3.0 };
    if let Some(limit) = limit {
        let mut early = scenario.clone();
        early.time.duration = 0.6;
        for training in simulate(&early, true).unwrap().trainings {
            let draft = Draft {
                broadcast_interval_min: 0.0,
                low: vec![-limit; 3],
                high: vec![limit; 3],
                ..Draft::copy(&training.package.package())
            };
            scenario.agents[training.agent - 1].package = Some(draft.seal().unwrap());
        }
    }
    scenario.learning.clear();
    scenario
}

fn watched(scenario: &Scenario, settings: HealthSettings) -> Scenario {
    Scenario { health: Some(settings), ..scenario.clone() }
}

fn counters(result: &RunResult) -> Vec<HealthCounters> {
    result.agents.iter().map(|agent| agent.health.unwrap()).collect()
}

/// Whether every agent's error is the same as without a fault.
fn same_errors(found: &RunResult, expected: &RunResult) -> bool {
    let rmse = |result: &RunResult| -> Vec<f64> {
        result.agents.iter().map(|agent| agent.rmse().unwrap()).collect()
    };
    let (found, expected) = (rmse(found), rmse(expected));
    println!("{found:.5?}, undisturbed {expected:.5?}");
    found.iter().zip(&expected).all(|(&found, &expected)| close(found, expected, 0.2, 1e-3))
}

#[test]
fn monitoring_does_not_change_the_bits_without_faults() {
    let scenario = three("0", Some(6.0));
    let plain = simulate(&scenario, false).unwrap();
    assert!(plain.agents.iter().all(|agent| agent.health.is_none()));
    let found = simulate(&watched(&scenario, SETTINGS), false).unwrap();
    assert_eq!((found.digest, &found.traces), (plain.digest, &plain.traces));
    assert_eq!(counters(&found), [HealthCounters::default(); 3]);
}

#[test]
fn monitoring_does_not_change_the_papers_run() {
    let scenario = paper("better");
    let watched = watched(&scenario, HealthSettings { fall_back: None, ..SETTINGS });
    let (plain, found) =
        rayon::join(|| simulate(&scenario, true).unwrap(), || simulate(&watched, true).unwrap());
    assert_eq!(found.digest, plain.digest);
    for counters in counters(&found) {
        println!("{counters:?}");
        // From the switch on, the network has a box, which the plant leaves.
        assert!((1..20_000).contains(&counters.outside_box));
        let outside_box = counters.outside_box;
        let expected = HealthCounters {
            outside_box,
            early_broadcasts: counters.early_broadcasts,
            ..HealthCounters::default()
        };
        assert_eq!(counters, expected);
    }
}

/// Whether an estimate is outside the box with this limit.
fn outside(limit: f32, estimate: &[f32]) -> bool {
    !StateBox { low: &[-limit; 3], high: &[limit; 3] }.contains(estimate)
}

#[test]
fn counts_steps_outside_the_box_and_falls_back_and_returns() {
    // s goes to 8 within 0.2 s, stays, and comes back.
    let excursion = "20*(sign(t - 1) - sign(t - 1.2) - sign(t - 1.6) + sign(t - 1.8))";
    let scenario = three(excursion, Some(2.0));
    let plain = simulate(&scenario, false).unwrap();
    let counting = simulate(&watched(&scenario, COUNTING), false).unwrap();
    assert_eq!(counting.digest, plain.digest);
    let falling_back = simulate(&watched(&scenario, SETTINGS), false).unwrap();
    assert_ne!(falling_back.digest, plain.digest);
    for (result, falls_back) in [(&counting, false), (&falling_back, true)] {
        for (agent, counters) in counters(result).iter().enumerate() {
            let mut ledger = Ledger::default();
            let (mut fall_backs, mut returns) = (0, 0);
            for row in 1..=STEPS {
                let before = ledger.left_out;
                let in_use = ledger.enter(outside(2.0, result.traces.estimate(row, agent)));
                fall_backs += u32::from(falls_back && !before && !in_use);
                returns += u32::from(falls_back && before && in_use);
            }
            let steps = ledger.outside.iter().filter(|&&outside| outside).count();
            println!("agent {}: {steps} steps, {fall_backs}, {returns}", agent + 1);
            assert!((400..800).contains(&steps) && (returns > 0) == falls_back);
            let expected = HealthCounters {
                outside_box: steps as u32,
                fall_backs,
                returns,
                ..HealthCounters::default()
            };
            assert_eq!(*counters, expected);
        }
    }
}

#[test]
fn overflowing_measurement_ends_only_the_unmonitored_run() {
    let calm = simulate(&three("0", Some(6.0)), false).unwrap();
    for (size, expected_error) in [
        ("1e30", StepError::Diverged),
        // Twice that overflows single precision.
        ("3e38", StepError::MeasurementNotFinite { output: 0 }),
    ] {
        let scenario = three(&spike(size), Some(6.0));
        match simulate(&scenario, false).unwrap_err() {
            RunError::Step { agent: 3, error, time, .. } => {
                assert_eq!(error, expected_error);
                assert!(close(time, 1e-3 * STRIKE as f64, 1e-9, 0.0), "{time}");
            }
            other => panic!("{other}"),
        }
        let result = simulate(&watched(&scenario, SETTINGS), false).unwrap();
        assert!(same_errors(&result, &calm));
        let diverged = u32::from(expected_error == StepError::Diverged);
        let strange = HealthCounters {
            diverged,
            measurements_not_finite: 1 - diverged,
            ..HealthCounters::default()
        };
        let calm = HealthCounters::default();
        assert_eq!(counters(&result), [calm, calm, strange]);
    }
}

#[test]
fn diverging_agent_restarts() {
    let calm = simulate(&three("0", Some(6.0)), false).unwrap();
    let scenario = three(&spike("1e7"), Some(6.0));
    let result = simulate(&watched(&scenario, SETTINGS), false).unwrap();
    assert!(same_errors(&result, &calm));
    let expected =
        HealthCounters { outside_box: 1, implausible: 1, restarts: 1, ..HealthCounters::default() };
    let strange = counters(&result)[2];
    let projection_active = strange.projection_active;
    assert_eq!(strange, HealthCounters { projection_active, ..expected });
    let others = counters(&result);
    assert_eq!(others[..2], [HealthCounters::default(); 2]);
}

/// Puts a huge estimate into every frame of agent 1 for a while.
struct Forging(Lossless);

impl Link for Forging {
    fn send(&mut self, sender: usize, tick: Tick, bytes: &[u8]) {
        self.0.send(sender, tick, bytes);
    }

    fn deliver(&self, receiver: usize, tick: Tick, accept: &mut dyn FnMut(&[u8])) {
        self.0.deliver(receiver, tick, &mut |bytes| match Frame::<3>::decode(bytes) {
            Ok(frame) if frame.sender == 1 && (STRIKE..STRIKE + 200).contains(&tick) => {
                accept(&Frame { estimate: [1e30; 3].into(), ..frame }.encode());
            }
            _ => accept(bytes),
        });
    }
}

#[test]
fn forged_estimates_end_only_the_unmonitored_run() {
    let over = |scenario: &Scenario| {
        let options = RunOptions { seed: 0, learning: false, bounds: false };
        run_over(scenario, Forging(Lossless::new(&scenario.graph)), options, &Silent)
    };
    let settings = HealthSettings { fall_back: None, ..SETTINGS };
    let run_both = |limit| {
        let scenario = three("0", limit);
        let calm = simulate(&scenario, false).unwrap();
        let error = over(&scenario).unwrap_err();
        assert!(matches!(error, RunError::Step { error: StepError::Diverged, .. }), "{error}");
        (over(&watched(&scenario, settings)).unwrap(), calm)
    };
    let (result, calm) = run_both(Some(6.0));
    assert!(same_errors(&result, &calm));
    for (agent, counters) in result.agents.iter().zip(counters(&result)) {
        let frames_implausible = counters.frames_implausible;
        assert_eq!(counters, HealthCounters { frames_implausible, ..HealthCounters::default() });
        assert_eq!(agent.frames_refused, u64::from(frames_implausible));
    }
    let heard: Vec<_> = counters(&result).iter().map(|c| c.frames_implausible > 0).collect();
    assert_eq!(heard, [false, true, true]);
    // An untrained network has no box, but samples that no step survives are refused all the same.
    let (result, calm) = run_both(None);
    let diverged: u32 = counters(&result).iter().map(|counters| counters.diverged).sum();
    println!("{diverged} steps diverged, the same errors: {}", same_errors(&result, &calm));
    assert!(counters(&result).iter().all(|counters| counters.restarts == 0));
    assert!(diverged == 0 && same_errors(&result, &calm));
}

#[test]
fn monitoring_is_deterministic_on_any_number_of_threads() {
    // More than 64 agents are shared among threads.
    let mut scenario_builder = striking(&spike("1e30"), 27);
    (scenario_builder.duration, scenario_builder.trace_stride) = (1.2, 20);
    let settings = HealthSettings { restart_after: NonZeroU32::new(1), ..SETTINGS };
    let scenario = watched(&scenario_builder.scenario(), settings);
    let on_threads = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| simulate(&scenario, false).unwrap())
    };
    let expected = on_threads(1);
    assert_eq!(counters(&expected).iter().filter(|counters| counters.restarts > 0).count(), 27);
    let found = on_threads(2);
    assert_eq!((found.digest, &found.traces), (expected.digest, &expected.traces));
    assert_eq!(counters(&found), counters(&expected));
}
