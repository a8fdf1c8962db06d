//! The engine without recording: agent-steps per second on one thread, for the paper's network, for the
//! same network over layers that do nothing, and for many agents on sparse graphs, with and without lanes.
//!
//! `RAYON_NUM_THREADS` sets the number of threads.

use divan::Bencher;
use divan::counter::ItemsCount;
use host_sim::engine::link::Layered;
use host_sim::engine::{LaneMode, RunOptions, Silent, run, run_in_lanes, run_over};
use host_sim::graph::{Edge, Graph};
use host_sim::scenario::{ClockSettings, PAPER, Record, Scenario, SensorSettings, Window};

fn main() {
    divan::main();
}

const OPTIONS: RunOptions = RunOptions { seed: 0, learning: false, bounds: false };

fn paper(duration: f64) -> Scenario {
    let mut scenario = Scenario::parse("paper.toml", PAPER).expect("the built-in scenario");
    scenario.record = Record { trace_stride: None, events: false, samples: false };
    scenario.time.duration = duration;
    scenario.evaluation = Window { from: 0.5 * duration, to: duration };
    scenario.learning.clear();
    scenario
}

fn agent_steps(scenario: &Scenario) -> ItemsCount {
    ItemsCount::new(scenario.steps() * scenario.agents.len() as u64)
}

/// The paper's network, without learning.
#[divan::bench(sample_count = 20)]
fn papers_network(bencher: Bencher) {
    let scenario = paper(40.0);
    bencher
        .counter(agent_steps(&scenario))
        .bench(|| run(divan::black_box(&scenario), OPTIONS, &Silent).expect("the run succeeds"));
}

/// The same over a link with every layer, with sensors and clocks that have models, all of which do
/// nothing.
#[divan::bench(sample_count = 20)]
fn neutral_layers(bencher: Bencher) {
    let mut scenario = paper(40.0);
    for agent in &mut scenario.agents {
        agent.sensor = SensorSettings { range: Some([-1e9, 1e9]), ..SensorSettings::default() };
        agent.clock = ClockSettings { offset: 1e-9, ..ClockSettings::default() };
    }
    bencher.counter(agent_steps(&scenario)).bench(|| {
        let link = Layered::new(&scenario, 0);
        run_over(divan::black_box(&scenario), link, OPTIONS, &Silent).expect("the run succeeds")
    });
}

/// The paper's agents on a ring in which each hears so many on both sides, with the trigger's share per
/// agent and a gain that is stable there.
fn ring(agents: usize, on_each_side: usize, weight: f64, duration: f64) -> Scenario {
    let mut scenario = paper(duration);
    let edges = (0..agents).flat_map(|first| {
        (1..=on_each_side).map(move |distance| Edge {
            first,
            second: (first + distance) % agents,
            weight,
        })
    });
    scenario.graph = Graph::new(agents, &edges.collect::<Vec<_>>()).expect("a connected graph");
    scenario.agents = (0..agents).map(|agent| scenario.agents[agent % 3].clone()).collect();
    scenario.design.epsilon *= agents as f64 / 3.0;
    scenario
}

/// With and without lanes.
const MODES: [Mode; 2] = [Mode(LaneMode::Longest), Mode(LaneMode::Off)];

#[derive(Clone, Copy)]
struct Mode(LaneMode);

impl std::fmt::Display for Mode {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.0 {
            LaneMode::Only(pulp::Arch::Scalar) => write!(f, "vectors of four"),
            mode => write!(f, "{mode:?}"),
        }
    }
}

/// Agents on a ring with two neighbours each, whose weights add up to the mean of the paper's agents.
fn on_a_ring(bencher: Bencher, agents: usize, duration: f64, mode: Mode) {
    let scenario = ring(agents, 1, 2.0 / 3.0, duration);
    bencher.counter(agent_steps(&scenario)).bench(|| {
        run_in_lanes(divan::black_box(&scenario), mode.0, OPTIONS, &Silent)
            .expect("the run succeeds")
    });
}

#[divan::bench(sample_count = 10, args = MODES)]
fn eight_agents(bencher: Bencher, mode: Mode) {
    on_a_ring(bencher, 8, 40.0, mode);
}

/// The same for every set of instructions of this machine.
fn modes() -> Vec<Mode> {
    let mut modes = MODES.to_vec();
    #[cfg(target_arch = "x86_64")]
    modes.extend(pulp::x86::V3::try_new().map(|v3| Mode(LaneMode::Only(pulp::Arch::V3(v3)))));
    modes.push(Mode(LaneMode::Only(pulp::Arch::Scalar)));
    modes
}

#[divan::bench(sample_count = 10, args = modes())]
fn sixty_four_agents(bencher: Bencher, mode: Mode) {
    on_a_ring(bencher, 64, 40.0, mode);
}

#[divan::bench(sample_count = 5, args = MODES)]
fn thousand_agents(bencher: Bencher, mode: Mode) {
    on_a_ring(bencher, 1_000, 4.0, mode);
}

/// 10,000 agents with 12 neighbours each.
#[divan::bench(sample_count = 3, args = MODES)]
fn ten_thousand_agents(bencher: Bencher, mode: Mode) {
    let scenario = ring(10_000, 6, 1.0 / 6.0, 0.5);
    bencher.counter(agent_steps(&scenario)).bench(|| {
        run_in_lanes(divan::black_box(&scenario), mode.0, OPTIONS, &Silent)
            .expect("the run succeeds")
    });
}
