//! The engine on the paper's network, without recording: agent-steps per second on one thread.

use divan::Bencher;
use divan::counter::ItemsCount;
use host_sim::engine::{RunOptions, Silent, run};
use host_sim::scenario::{PAPER, Record, Scenario};

fn main() {
    divan::main();
}

/// The paper's network, without learning, over `duration` \[s\].
#[divan::bench(args = [40.0], sample_count = 20)]
fn agent_steps(bencher: Bencher, duration: f64) {
    let mut scenario = Scenario::parse("paper.toml", PAPER).expect("the built-in scenario");
    scenario.record = Record { trace_stride: None, events: false, samples: false };
    scenario.time.duration = duration;
    let options = RunOptions { seed: 0, learning: false, bounds: false };
    let steps = scenario.steps() * scenario.agents.len() as u64;
    bencher
        .counter(ItemsCount::new(steps))
        .bench(|| run(divan::black_box(&scenario), options, &Silent).expect("the run succeeds"));
}
