use host_sim::engine::{RunOptions, Silent, run};
use host_sim::graph::{Edge, Graph};
use host_sim::scenario::{PAPER, Record, Scenario, Window};
use std::time::Instant;
fn main() {
    let n: usize = std::env::args().nth(1).unwrap().parse().unwrap();
    let d: f64 = std::env::args().nth(2).unwrap().parse().unwrap();
    let mut s = Scenario::parse("p", PAPER).unwrap();
    s.record = Record { trace_stride: None, events: false, samples: false };
    s.time.duration = d;
    s.evaluation = Window { from: 0.5 * d, to: d };
    s.learning.clear();
    let edges: Vec<_> = (0..n)
        .flat_map(|first| {
            (1..=6).map(move |k| Edge { first, second: (first + k) % n, weight: 1.0 / 6.0 })
        })
        .collect();
    s.graph = Graph::new(n, &edges).unwrap();
    s.agents = (0..n).map(|a| s.agents[a % 3].clone()).collect();
    s.design.epsilon *= n as f64 / 3.0;
    let t = Instant::now();
    let c = host_sim::analysis::TriggerConstants::new(&s);
    println!("constants {:.3} s phi1 {}", t.elapsed().as_secs_f64(), c.phi1);
    let t = Instant::now();
    let g = host_sim::analysis::GainCertificate::new(&s);
    println!("gain {:.3} s {}", t.elapsed().as_secs_f64(), g.eigenvalue_min);
    let t = Instant::now();
    let r = run(&s, RunOptions { seed: 0, learning: false, bounds: false }, &Silent).unwrap();
    let e = t.elapsed().as_secs_f64();
    println!(
        "run {e:.3} s, broadcasts per agent-step {}",
        r.agents.iter().map(|a| a.broadcasts()).sum::<u64>() as f64 / (n as f64 * s.steps() as f64)
    );
    let rss = std::fs::read_to_string("/proc/self/status").unwrap();
    println!("{}", rss.lines().find(|l| l.starts_with("VmHWM")).unwrap());
}
