//! The Lorenz-96 plant beside DAPPER's: `host-sim/examples/lorenz96`.

use host_sim::plant::{DIMENSION_MAX, Stepper};

use super::scenario_builder::{Described, picks};

/// DAPPER's states, one row for each quarter of a time unit.
const GOLDEN: [(usize, &str); 2] = [
    (12, include_str!("../../host-sim/examples/lorenz96/golden-12.csv")),
    (40, include_str!("../../host-sim/examples/lorenz96/golden-40.csv")),
];

/// The plant's tables for `n` states.
fn plant(n: usize) -> String {
    let name = |i: usize| format!("x{}", i % n + 1);
    let states: Vec<_> = (0..n).map(|i| format!("\"{}\"", name(i))).collect();
    let derivative: Vec<_> = (0..n)
        .map(|i| {
            let [next, before, last, own] = [i + 1, i + n - 2, i + n - 1, i].map(name);
            format!("\"({next} - {before})*{last} - {own} + F\"")
        })
        .collect();
    format!(
        "[plant]\nmodel = \"expressions\"\nstates = [{}]\nparameters = {{ F = 8.0 }}\n\
         derivative = [{}]\ninitial_state = [1.0{}]\n",
        states.join(", "),
        derivative.join(", "),
        ", 0.0".repeat(n - 1),
    )
}

#[test]
fn the_plant_moves_as_dappers_does() {
    for (n, golden) in GOLDEN.into_iter().filter(|&(n, _)| n <= DIMENSION_MAX) {
        let all = picks(n, 0..n);
        let scenario = Described {
            plant: plant(n),
            integrator: "rk4",
            ..Described::linear(n, "path", [(all, 1)])
        }
        .scenario();
        let mut stepper = Stepper::new(scenario.time.integrator);
        let mut state = scenario.initial_state.clone();
        let mut step = 0;
        for line in golden.lines().skip(1) {
            let row: Vec<f64> = line.split(',').map(|number| number.parse().unwrap()).collect();
            // DAPPER's step.
            while f64::from(step) + 0.5 < row[0] / 0.05 {
                let time = f64::from(step) * 0.05;
                stepper.step(&scenario.plant, &scenario.disturbance, time, 0.05, &mut state);
                step += 1;
            }
            // Both take the same four stages of Runge and Kutta. Sums in another order differ by rounding,
            // which grows by e^1.7 in a time unit: by 5000 until the end.
            for (ours, theirs) in state.iter().zip(&row[1..]) {
                assert!((ours - theirs).abs() < 1e-9, "n = {n}, t = {}: {ours}, {theirs}", row[0]);
            }
        }
        assert_eq!(step, 100);
    }
}
