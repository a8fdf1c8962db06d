//! The library inside another program, such as a notebook: agents that it steps, a plant that it computes, runs
//! that it ends.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use agent_core::wire::frame::FrameBytes;
use host_sim::agent::{Agent, COUNTING};
use host_sim::engine::{Progress, RunError, RunOptions, RunResult, Silent, run, start_package};
use host_sim::plant::{FunctionPlant, Plant, Rate};
use host_sim::scenario::{PAPER, Scenario, Window};

const OPTIONS: RunOptions = RunOptions { seed: 0, learning: true, bounds: false };

fn paper(seconds: f64) -> Scenario {
    let mut scenario = Scenario::parse("paper", PAPER).unwrap();
    scenario.time.duration = seconds;
    scenario.evaluation = Window { from: 0.5 * seconds, to: seconds };
    scenario.learning.clear();
    scenario
}

fn simulate(scenario: &Scenario) -> RunResult {
    run(scenario, OPTIONS, &Silent).unwrap()
}

#[test]
fn agents_stepped_by_hand_have_the_bits_of_the_simulated_ones() {
    let scenario = paper(2.0);
    let traces = simulate(&scenario).traces;
    let mut agents: Vec<Agent> = (0..3)
        .map(|index| {
            let package = start_package(&scenario, index, 0).unwrap().unwrap();
            let estimate: Vec<f32> =
                scenario.agents[index].initial_estimate.iter().map(|&x| x as f32).collect();
            Agent::new(&package, Some(&estimate), &COUNTING).unwrap()
        })
        .collect();
    let mut frames: Vec<Option<FrameBytes>> =
        agents.iter().map(|agent| Some(agent.announcement())).collect();
    for tick in 0..scenario.steps() {
        let row = usize::try_from(tick).unwrap();
        let truth = traces.truth(row);
        let mut next = Vec::with_capacity(agents.len());
        for (index, agent) in agents.iter_mut().enumerate() {
            let expected = traces.estimate(row, index);
            assert_eq!(agent.estimate(), expected, "agent {} at tick {tick}", index + 1);
            for neighbour in scenario.graph.neighbours(index) {
                if let Some(frame) = &frames[neighbour.agent] {
                    agent.receive(frame).unwrap();
                }
            }
            // Each agent of the paper measures the state of its number.
            next.push(agent.step(tick, Some(&[truth[index] as f32])).unwrap());
        }
        frames = next;
    }
    assert!(agents.iter().all(Agent::network_in_use));
    assert_eq!(agents[0].health().restarts, 0);
}

/// The paper's plant, computed elsewhere.
struct Elsewhere(Plant);

impl Rate for Elsewhere {
    fn evaluate(&self, time: f64, x: &[f64], dx: &mut [f64]) {
        self.0.derivative(time, x, dx);
    }
}

#[test]
fn a_function_as_the_plant_changes_no_bit() {
    let mut scenario = paper(2.0);
    let expected = simulate(&scenario);
    let names = scenario.plant.state_names();
    let function = FunctionPlant::new(names, Arc::new(Elsewhere(scenario.plant.clone())));
    scenario.plant = Plant::Function(function);
    let found = simulate(&scenario);
    assert_eq!((found.digest, &found.traces), (expected.digest, &expected.traces));
    assert_eq!(scenario.plant, scenario.plant.clone());
}

/// Ends a run after the second report of its steps.
#[derive(Default)]
struct Ended(AtomicU64);

impl Progress for Ended {
    fn step(&self, _tick: u64, _steps: u64) {
        self.0.fetch_add(1, Ordering::Relaxed);
    }

    fn is_stopped(&self) -> bool {
        self.0.load(Ordering::Relaxed) >= 2
    }
}

#[test]
fn a_run_ends_on_request_and_says_so() {
    for method in ["observer", "kalman"] {
        let text = format!("method = \"{method}\"\n{PAPER}");
        let scenario = Scenario::parse("paper", &text).unwrap();
        let ended = Ended::default();
        let error = run(&scenario, OPTIONS, &ended).unwrap_err();
        assert!(matches!(error, RunError::Interrupted), "{method}: {error}");
        assert_eq!(ended.0.into_inner(), 2);
    }
}
