//! The same scenario and seed give the same bits: repeatedly, on any number of threads, whatever is
//! recorded, and on every machine and at every level of optimisation.

use host_sim::engine::{RunOptions, RunResult, Silent, run};
use host_sim::scenario::Scenario;

use crate::sim::reproduce::paper;
use crate::sim::scenario_builder::{Described, SHORT_RECIPE, cycle, network, picks};

/// Digest of the paper's run without learning.
///
/// This and the next constant change only with the computation itself: the core, the plant, the
/// trigger's constants, or training. After an intended change, take the values that the
/// failing test prints, from a dev and a release build, which must agree; then say in the
/// changelog that results differ in their last digits.
const DIGEST_WITHOUT_LEARNING: u64 = 0x15d8_ff27_1d2b_e5e7;
/// Digest of the paper's run with learning, recipe `better`, seed 0.
const DIGEST_WITH_LEARNING: u64 = 0x15e5_5a93_add3_9bb0;

fn simulate(scenario: &Scenario, seed: u64, learning: bool, bounds: bool) -> RunResult {
    run(scenario, RunOptions { seed, learning, bounds }, &Silent).unwrap()
}

/// All results of a run, as bits.
#[derive(Debug, PartialEq)]
struct RunBits {
    digest: u64,
    /// Errors, intervals and bounds of each agent.
    statistics: Vec<[Option<u64>; 6]>,
    broadcasts: Vec<(u64, u64, Vec<u64>)>,
    traces: Vec<u64>,
    /// As text, which has every digit.
    bounds: Option<String>,
    /// Training, validation and test error and damping of each epoch.
    epochs: Vec<(usize, usize, usize, [Option<u64>; 4])>,
}

fn run_bits(scenario: &Scenario, result: &RunResult) -> RunBits {
    let time = &scenario.time;
    let statistics = result.agents.iter().map(|agent| {
        let (rate, weights) = (agent.hold_error_rate_max, agent.outer_weights_norm_max);
        let errors = [agent.rmse(), agent.max_error()];
        let intervals = [agent.mean_interval(time), agent.min_interval(time)];
        let numbers = [errors[0], errors[1], intervals[0], intervals[1], Some(rate), Some(weights)];
        numbers.map(|number| number.map(f64::to_bits))
    });
    let traces = &result.traces;
    let row = |row: usize| {
        let doubles = traces.truth(row).iter().chain([&traces.time()[row]]).map(|x| x.to_bits());
        let estimates = (0..traces.agents()).flat_map(move |agent| traces.estimate(row, agent));
        doubles.chain(estimates.map(|x| u64::from(x.to_bits())))
    };
    let epochs = result.trainings.iter().flat_map(|training| {
        training.report.epochs.iter().map(|epoch| {
            let numbers = [Some(epoch.train), epoch.validation, epoch.test, Some(epoch.damping)];
            let bits = numbers.map(|number| number.map(f64::to_bits));
            (training.agent, training.cycle, epoch.epoch, bits)
        })
    });
    RunBits {
        digest: result.digest,
        statistics: statistics.collect(),
        broadcasts: result
            .agents
            .iter()
            .map(|agent| (agent.broadcasts(), agent.frames_refused, agent.events.clone()))
            .collect(),
        traces: (0..traces.rows()).flat_map(row).collect(),
        bounds: result.bounds.as_ref().map(|bounds| format!("{bounds:?}")),
        epochs: epochs.collect(),
    }
}

/// Runs a scenario on a separate thread pool.
fn on_threads(threads: usize, scenario: &Scenario, seed: u64) -> RunBits {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
    pool.install(|| run_bits(scenario, &simulate(scenario, seed, true, true)))
}

/// Creates `agents` agents with random networks on a ring, some of which learn at different times;
/// half of them measure one component, half the other.
fn learning_ring(agents: usize) -> Scenario {
    let mut scenario_builder = Described::linear(
        2,
        "ring",
        [(picks(2, [0]), agents / 2), (picks(2, [1]), agents - agents / 2)],
    );
    scenario_builder.duration = 0.8;
    scenario_builder.network = network(&[(6, "tanh"), (4, "logistic")], "2.0");
    scenario_builder.trace_stride = 10;
    let last = agents.min(70);
    scenario_builder.learning = cycle(&[1, 2, last], 0.1, 0.4, 0.5)
        + &cycle(&[3], 0.2, 0.45, 0.5)
        + &cycle(&[2], 0.5, 0.65, 0.7)
        + SHORT_RECIPE;
    scenario_builder.scenario()
}

#[test]
fn a_run_repeats_itself() {
    let scenario = learning_ring(5);
    let [first, again] = [(); 2].map(|()| run_bits(&scenario, &simulate(&scenario, 3, true, true)));
    assert_eq!(first, again);
    // The results are not empty.
    assert_eq!(first.statistics.len(), 5);
    assert!(first.bounds.is_some());
    assert_eq!(first.traces.len(), 81 * (1 + 2 + 5 * 2));
    assert!(first.broadcasts.iter().all(|(count, refused, _)| *count > 5 && *refused == 0));
    let mut trained: Vec<_> = first.epochs.iter().map(|epoch| (epoch.1, epoch.0)).collect();
    trained.dedup();
    assert_eq!(trained, [(1, 1), (1, 2), (1, 5), (2, 3), (3, 2)]);
}

#[test]
fn bits_are_independent_of_the_number_of_threads() {
    let scenario = paper("better");
    let expected = on_threads(1, &scenario, 1);
    for threads in [2, 3] {
        assert!(on_threads(threads, &scenario, 1) == expected, "{threads} threads");
    }
}

#[test]
fn agents_stepped_in_parallel_give_the_same_bits() {
    // More than 64 agents are shared among threads.
    let scenario = learning_ring(80);
    let expected = on_threads(1, &scenario, 1);
    for threads in [2, 3] {
        assert!(on_threads(threads, &scenario, 1) == expected, "{threads} threads");
    }
}

#[test]
fn different_seeds_differ_where_something_is_random() {
    let digest =
        |scenario: &Scenario, seed, learning| simulate(scenario, seed, learning, false).digest;
    // Random initial inner parameters.
    let scenario = learning_ring(5);
    assert_ne!(digest(&scenario, 0, false), digest(&scenario, 1, false));
    // Inner parameters of 0.1 until training starts from random ones.
    let scenario = short_paper();
    assert_eq!(digest(&scenario, 0, false), digest(&scenario, 1, false));
    assert_ne!(digest(&scenario, 0, true), digest(&scenario, 1, true));
}

/// Returns the paper's scenario, shortened to three seconds.
fn short_paper() -> Scenario {
    let mut scenario = paper("better");
    scenario.time.duration = 3.0;
    scenario.learning[0].collect = host_sim::scenario::Window { from: 0.5, to: 2.0 };
    scenario.learning[0].apply_at = 2.5;
    scenario.evaluation = host_sim::scenario::Window { from: 1.5, to: 3.0 };
    scenario
}

#[test]
fn recording_does_not_change_the_bits() {
    let scenario = short_paper();
    let full = simulate(&scenario, 0, true, true);
    assert!(full.traces.rows() == 3_001 && full.agents.iter().all(|a| !a.events.is_empty()));
    let mut silent = scenario.clone();
    silent.record =
        host_sim::scenario::Record { trace_stride: None, events: false, samples: false };
    let bare = simulate(&silent, 0, true, false);
    assert!(bare.traces.rows() == 0 && bare.bounds.is_none());
    assert!(bare.agents.iter().all(|agent| agent.events.is_empty()));
    let mut strided = scenario.clone();
    strided.record.trace_stride = std::num::NonZeroU32::new(7);
    let strided = simulate(&strided, 0, true, false);
    assert_eq!(strided.traces.rows(), 3_000 / 7 + 1);
    for other in [&bare, &strided] {
        assert_eq!(other.digest, full.digest);
        for (other, full) in other.agents.iter().zip(&full.agents) {
            assert_eq!(other.rmse().map(f64::to_bits), full.rmse().map(f64::to_bits));
            assert_eq!(other.broadcasts(), full.broadcasts());
            assert_eq!(other.min_interval(&scenario.time), full.min_interval(&scenario.time));
        }
    }
}

#[test]
fn the_papers_run_has_the_same_bits_everywhere() {
    let scenario = paper("better");
    let (without, with) = rayon::join(
        || simulate(&scenario, 0, false, false).digest,
        || simulate(&scenario, 0, true, false).digest,
    );
    println!("digests: without learning {without:#018x}, with learning {with:#018x}");
    assert_eq!(without, DIGEST_WITHOUT_LEARNING, "{without:#018x}");
    assert_eq!(with, DIGEST_WITH_LEARNING, "{with:#018x}");
}
