//! The engine without recording: agent-steps per second on one thread, for the paper's network, for the
//! same network over layers that do nothing, and for many agents on a sparse graph.
//!
//! `RAYON_NUM_THREADS` sets the number of threads.

use divan::Bencher;
use divan::counter::ItemsCount;
use host_sim::engine::link::Layered;
use host_sim::engine::{RunOptions, Silent, run, run_over};
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

/// The paper's agents on a ring in which each hears the six nearest on both sides, with the trigger's
/// share per agent and a gain that is stable there.
fn sparse(agents: usize, duration: f64) -> Scenario {
    let mut scenario = paper(duration);
    let edges = (0..agents).flat_map(|first| {
        (1..=6).map(move |distance| Edge {
            first,
            second: (first + distance) % agents,
            weight: 1.0 / 6.0,
        })
    });
    scenario.graph = Graph::new(agents, &edges.collect::<Vec<_>>()).expect("a connected graph");
    scenario.agents = (0..agents).map(|agent| scenario.agents[agent % 3].clone()).collect();
    scenario.design.epsilon *= agents as f64 / 3.0;
    scenario
}

/// 3, and 10,000 agents with 12 neighbours each.
#[divan::bench(sample_count = 3)]
fn ten_thousand_agents(bencher: Bencher) {
    let scenario = sparse(10_000, 0.5);
    bencher
        .counter(agent_steps(&scenario))
        .bench(|| run(divan::black_box(&scenario), OPTIONS, &Silent).expect("the run succeeds"));
}
