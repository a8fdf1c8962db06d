//! The example `wscc9`: its swing equations against the trajectory that ANDES computed by solving the
//! equations of the whole network in every step.

use host_sim::plant::{Disturbance, Integrator, Stepper};
use host_sim::scenario::Scenario;

const SCENARIO: &str = include_str!("../../host-sim/examples/wscc9/wscc9.toml");

/// Columns `t`, `delta1`..`delta3` \[rad\], `w1`..`w3` \[rad/s\]; written by `wscc9.py` beside it.
const GOLDEN: &str = include_str!("../../host-sim/examples/wscc9/golden.csv");

// ANDES's trapezoidal rule with a step of 2^-11 s is the largest error: 2.8e-5 rad and 2.0e-4 rad/s,
// and four times as much with twice the step (`wscc9.py`). Runge-Kutta steps of 2^-7 s add 4.3e-6 rad
// and 4.0e-5 rad/s. A parameter with another third digit is off by 1.7e-3 rad/s or more (D1).
const ANGLE_TOLERANCE: f64 = 1e-4; // rad
const SPEED_TOLERANCE: f64 = 5e-4; // rad/s

/// The time and the scenario's state in each row: angles relative to that of machine 1, and speeds.
fn golden() -> Vec<(f64, [f64; 5])> {
    let row = |line: &str| {
        let cells: Vec<f64> = line.split(',').map(|cell| cell.parse().unwrap()).collect();
        let [t, delta1, delta2, delta3, w1, w2, w3]: [f64; 7] = cells.try_into().unwrap();
        (t, [delta2 - delta1, delta3 - delta1, w1, w2, w3])
    };
    GOLDEN.lines().skip(1).map(row).collect()
}

/// The largest differences of angles \[rad\] and speeds \[rad/s\] between the plant of `text`, without
/// disturbance, and all rows.
fn differences(text: &str) -> (f64, f64) {
    let scenario = Scenario::parse("wscc9.toml", text).unwrap_or_else(|error| panic!("{error}"));
    let rows = golden();
    let (mut time, mut x) = rows[0];
    assert_eq!(scenario.initial_state, x);
    let (mut stepper, mut angle, mut speed) = (Stepper::new(Integrator::Rk4), 0.0_f64, 0.0_f64);
    for (next, expected) in &rows[1..] {
        stepper.step(&scenario.plant, &Disturbance::None, time, next - time, &mut x);
        time = *next;
        for (k, (found, expected)) in x.iter().zip(expected).enumerate() {
            let difference = (found - expected).abs();
            assert!(difference.is_finite(), "t = {time}: {x:?}");
            let largest = if k < 2 { &mut angle } else { &mut speed };
            *largest = largest.max(difference);
        }
    }
    (angle, speed)
}

#[test]
fn swing_equations_follow_andes() {
    let rows = golden();
    assert_eq!((rows.len(), rows[0].0, rows[640].0), (641, 0.0, 5.0));
    // The machines swing in it.
    let span = |k: usize| {
        let column: Vec<f64> = rows.iter().map(|(_, state)| state[k]).collect();
        column.iter().fold(f64::MIN, |a, b| a.max(*b))
            - column.iter().fold(f64::MAX, |a, b| a.min(*b))
    };
    assert!(span(0) > 1.0 && span(3) > 5.0);
    let (angle, speed) = differences(SCENARIO);
    assert!(angle < ANGLE_TOLERANCE && speed < SPEED_TOLERANCE, "{angle} rad, {speed} rad/s");
}

#[test]
fn another_third_digit_is_noticed() {
    for (line, changed) in [
        ("D1 = 9.456\n", "D1 = 9.466\n"),
        ("M3 = 6.02\n", "M3 = 6.03\n"),
        ("P2 = 1.630000179\n", "P2 = 1.640000179\n"),
        ("G33 = 0.268735049\n", "G33 = 0.269735049\n"),
    ] {
        assert!(SCENARIO.contains(line), "{line}");
        let (angle, speed) = differences(&SCENARIO.replace(line, changed));
        let noticed = angle > ANGLE_TOLERANCE || speed > SPEED_TOLERANCE;
        assert!(noticed, "{changed}: {angle} rad, {speed} rad/s");
    }
}
