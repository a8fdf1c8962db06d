//! Cost of one step of the plant.

use divan::{Bencher, black_box};
use host_sim::plant::{Integrator, Stepper};
use host_sim::scenario::{Scenario, built_in};

fn main() {
    divan::main();
}

/// Steps per sample: enough to hide the cost of reading the clock.
const STEPS: u32 = 1000;

fn run(bencher: Bencher, name: &str, integrator: Integrator) {
    let text = built_in(name).expect("a built-in scenario");
    let scenario = Scenario::parse(name, text).expect("built-in scenarios are valid");
    let step_size = scenario.time.step_size;
    bencher.counter(divan::counter::ItemsCount::new(STEPS)).bench_local(|| {
        let (mut stepper, mut x) = (Stepper::new(integrator), scenario.initial_state.clone());
        for step in 0..STEPS {
            let time = f64::from(step) * step_size;
            let (plant, disturbance) = (&scenario.plant, &scenario.disturbance);
            stepper.step(black_box(plant), black_box(disturbance), time, step_size, &mut x);
        }
        x
    });
}

/// Nanoseconds per step equal microseconds per sample.
#[divan::bench(args = ["paper", "lorenz", "pendulum", "duffing", "expressions"])]
fn euler_1000_steps(bencher: Bencher, name: &str) {
    run(bencher, name, Integrator::Euler);
}

#[divan::bench(args = ["paper", "lorenz", "pendulum", "duffing", "expressions"])]
fn rk4_1000_steps(bencher: Bencher, name: &str) {
    run(bencher, name, Integrator::Rk4);
}
