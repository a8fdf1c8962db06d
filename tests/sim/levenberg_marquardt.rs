//! The Levenberg-Marquardt solver against SciPy on classical problems.
//!
//! Expected values: `golden/levenberg_marquardt.json`, created by the script next to it.

use host_sim::training::{LeastSquares, LevenbergMarquardtSettings, StopReason, minimize};
use serde_json::Value;
use std::ops::ControlFlow;

/// A residual and its derivatives with respect to the parameters.
type Row = (f64, Vec<f64>);

/// A problem given by all its rows at a point.
struct Rows<F> {
    parameters: usize,
    rows: F,
}

impl<F: Fn(&[f64]) -> Vec<Row>> LeastSquares for Rows<F> {
    fn parameter_count(&self) -> usize {
        self.parameters
    }

    fn cost(&mut self, x: &[f64]) -> f64 {
        let rows = (self.rows)(x);
        rows.iter().map(|(e, _)| e * e).sum::<f64>() / rows.len() as f64
    }

    fn normal_equations(&mut self, x: &[f64], hessian: &mut [f64], gradient: &mut [f64]) -> f64 {
        let rows = (self.rows)(x);
        let (n, count) = (self.parameters, rows.len() as f64);
        for i in 0..n {
            gradient[i] = rows.iter().map(|(e, d)| e * d[i]).sum::<f64>() / count;
            for j in 0..n {
                hessian[i * n + j] = rows.iter().map(|(_, d)| d[i] * d[j]).sum::<f64>() / count;
            }
        }
        self.cost(x)
    }
}

fn rosenbrock(x: &[f64]) -> Vec<Row> {
    vec![(10.0 * (x[1] - x[0] * x[0]), vec![-20.0 * x[0], 10.0]), (1.0 - x[0], vec![-1.0, 0.0])]
}

fn powell_singular(x: &[f64]) -> Vec<Row> {
    let (a, b) = (x[1] - 2.0 * x[2], x[0] - x[3]);
    let (root_5, root_10) = (5f64.sqrt(), 10f64.sqrt());
    vec![
        (x[0] + 10.0 * x[1], vec![1.0, 10.0, 0.0, 0.0]),
        (root_5 * (x[2] - x[3]), vec![0.0, 0.0, root_5, -root_5]),
        (a * a, vec![0.0, 2.0 * a, -4.0 * a, 0.0]),
        (root_10 * b * b, vec![2.0 * root_10 * b, 0.0, 0.0, -2.0 * root_10 * b]),
    ]
}

fn helical_valley(x: &[f64]) -> Vec<Row> {
    let turn = 2.0 * std::f64::consts::PI;
    let angle = libm::atan(x[1] / x[0]) / turn + if x[0] < 0.0 { 0.5 } else { 0.0 };
    let squared = x[0] * x[0] + x[1] * x[1];
    let radius = squared.sqrt();
    vec![
        (
            10.0 * (x[2] - 10.0 * angle),
            vec![100.0 * x[1] / (turn * squared), -100.0 * x[0] / (turn * squared), 10.0],
        ),
        (10.0 * (radius - 1.0), vec![10.0 * x[0] / radius, 10.0 * x[1] / radius, 0.0]),
        (x[2], vec![0.0, 0.0, 1.0]),
    ]
}

fn freudenstein_roth(x: &[f64]) -> Vec<Row> {
    let y = x[1];
    vec![
        (-13.0 + x[0] + ((5.0 - y) * y - 2.0) * y, vec![1.0, (10.0 - 3.0 * y) * y - 2.0]),
        (-29.0 + x[0] + ((y + 1.0) * y - 14.0) * y, vec![1.0, (3.0 * y + 2.0) * y - 14.0]),
    ]
}

fn brown_dennis(x: &[f64]) -> Vec<Row> {
    let row = |i: u32| {
        let t = f64::from(i) / 5.0;
        let sine = libm::sin(t);
        let a = x[0] + t * x[1] - libm::exp(t);
        let b = x[2] + x[3] * sine - libm::cos(t);
        (a * a + b * b, vec![2.0 * a, 2.0 * a * t, 2.0 * b, 2.0 * b * sine])
    };
    (1..=20).map(row).collect()
}

fn osborne_1(x: &[f64], y: &[f64]) -> Vec<Row> {
    let row = |(i, y): (usize, &f64)| {
        let t = 10.0 * i as f64;
        let (a, b) = (libm::exp(-t * x[3]), libm::exp(-t * x[4]));
        let derivatives = vec![-1.0, -a, -b, x[1] * t * a, x[2] * t * b];
        (y - (x[0] + x[1] * a + x[2] * b), derivatives)
    };
    y.iter().enumerate().map(row).collect()
}

fn misra1a(x: &[f64], abscissae: &[f64], y: &[f64]) -> Vec<Row> {
    let row = |(t, y): (&f64, &f64)| {
        let decay = libm::exp(-x[1] * t);
        (y - x[0] * (1.0 - decay), vec![decay - 1.0, -x[0] * t * decay])
    };
    abscissae.iter().zip(y).map(row).collect()
}

fn numbers(value: &Value) -> Vec<f64> {
    let values = value.as_array().expect("an array");
    values.iter().map(|v| v.as_f64().expect("a number")).collect()
}

/// Asserts |found - expected| <= atol + rtol |expected|.
#[track_caller]
fn assert_close(what: &str, found: f64, expected: f64, rtol: f64, atol: f64) {
    let allowed = atol + rtol * expected.abs();
    let error = (found - expected).abs();
    assert!(error <= allowed, "{what}: {found:e}, expected {expected:e} to {allowed:e}");
}

#[test]
fn solves_classical_problems_like_scipy() {
    let golden: Value = serde_json::from_str(include_str!("../golden/levenberg_marquardt.json"))
        .expect("valid JSON");
    let problems = golden["problems"].as_array().expect("an array");
    assert_eq!(problems.len(), 7);
    for problem in problems {
        let name = problem["name"].as_str().expect("a name");
        let (x_data, y_data) = (&problem["data"]["x"], &problem["data"]["y"]);
        let rows = |x: &[f64]| match name {
            "rosenbrock" => rosenbrock(x),
            "powell_singular" => powell_singular(x),
            "helical_valley" => helical_valley(x),
            "freudenstein_roth" => freudenstein_roth(x),
            "brown_dennis" => brown_dennis(x),
            "osborne_1" => osborne_1(x, &numbers(y_data)),
            "misra1a" => misra1a(x, &numbers(x_data), &numbers(y_data)),
            _ => panic!("no residuals for {name}"),
        };
        let expected = numbers(&problem["solution"]);
        let settings = LevenbergMarquardtSettings { gradient_min: 1e-13, ..Default::default() };
        let (solution, report) = minimize(
            &mut Rows { parameters: expected.len(), rows },
            numbers(&problem["start"]),
            &settings,
            &mut |_| ControlFlow::Continue(()),
        )
        .expect("valid settings");
        let last = report.epochs.last().expect("the start at least");
        println!("{name}: {:?} after {} epochs, {last:?}", report.stop, last.epoch);
        assert!(
            matches!(report.stop, StopReason::Gradient | StopReason::DampingMax),
            "{name}: {:?} is not a stationary point",
            report.stop
        );
        let residuals = problem["residuals"].as_f64().expect("a number");
        let expected_cost = problem["sum_of_squares"].as_f64().expect("a number") / residuals;
        assert_close(name, last.train, expected_cost, 1e-10, 1e-14);
        // A minimum with vanishing second derivative is accurate to a root of the rounding error.
        let (rtol, atol) = if name == "powell_singular" { (0.0, 1e-3) } else { (1e-5, 1e-9) };
        for (found, expected) in solution.iter().zip(&expected) {
            assert_close(name, *found, *expected, rtol, atol);
        }
    }
}

#[test]
fn misra1a_matches_the_values_certified_by_nist() {
    let golden: Value = serde_json::from_str(include_str!("../golden/levenberg_marquardt.json"))
        .expect("valid JSON");
    let problems = golden["problems"].as_array().expect("an array");
    let problem = problems.iter().find(|problem| problem["name"] == "misra1a").expect("there");
    let (x, y) = (numbers(&problem["data"]["x"]), numbers(&problem["data"]["y"]));
    // NIST Statistical Reference Datasets, Misra1a: both starts lead to the certified values.
    for start in [[500.0, 0.0001], [250.0, 0.0005]] {
        let rows = |b: &[f64]| misra1a(b, &x, &y);
        let settings = LevenbergMarquardtSettings { gradient_min: 1e-13, ..Default::default() };
        let mut problem = Rows { parameters: 2, rows };
        let (b, report) =
            minimize(&mut problem, start.to_vec(), &settings, &mut |_| ControlFlow::Continue(()))
                .expect("valid settings");
        assert_close("b1", b[0], 2.389_421_291_8e2, 1e-9, 0.0);
        assert_close("b2", b[1], 5.501_564_318_1e-4, 1e-9, 0.0);
        let sum_of_squares = report.best().expect("an epoch").train * y.len() as f64;
        assert_close("sum of squares", sum_of_squares, 1.245_513_889_4e-1, 1e-9, 0.0);
    }
}
