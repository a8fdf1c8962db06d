//! One Levenberg–Marquardt iteration on the paper's network, on one core; see `dense/dense_products.rs` for
//! a baseline.
//!
//! `cargo bench -p host-sim --bench levenberg_marquardt`

use agent_core::math::activation::Activation;
use agent_core::observer::network::{Architecture, Layer};
use divan::Bencher;
use host_sim::training::trainer::levenberg_marquardt::Step;
use host_sim::training::{
    Dataset, InitialParameters, LeastSquares, LevenbergMarquardtSettings, NetworkProblem,
    TrainingSettings, train_inner_network,
};
use std::ops::ControlFlow;

const PARAMETERS: usize = 425;

fn main() {
    divan::main();
}

fn architecture() -> Architecture {
    let layers = [12, 12, 12, 5].map(|width| Layer { width, activation: Activation::Tanh });
    Architecture::new(3, &layers).expect("valid")
}

fn outer_weights() -> Vec<f64> {
    (0..15).map(|i| 4.0 * libm::sin(1.7 * f64::from(i))).collect()
}

/// Samples of a smooth field.
fn dataset() -> Dataset {
    let inputs: Vec<f64> =
        (0..3 * 6000).map(|i| 2.0 * libm::sin(0.37 * f64::from(i) + 0.1)).collect();
    let field = |x: &[f64]| [x[1], (1.0 - x[0] * x[0]) * x[1] - x[0], x[0] - 0.5 * x[2]];
    let targets = inputs.chunks_exact(3).flat_map(field).collect();
    Dataset::new(3, inputs, targets).expect("valid")
}

fn problem() -> (NetworkProblem, Vec<f64>) {
    let division = dataset().divide([0.7, 0.15, 0.15], 1).expect("valid");
    let start =
        InitialParameters::NguyenWidrow.draw(&architecture(), &division.train, 1).expect("finite");
    let problem = NetworkProblem::new(
        &architecture(),
        &outer_weights(),
        &division.train,
        division.validation.as_ref(),
        division.test.as_ref(),
    )
    .expect("fits");
    (problem, start)
}

/// Normal equations, damped solution, and the error of the new point on all three sets.
#[divan::bench]
fn iteration(bencher: Bencher<'_, '_>) {
    let (mut problem, start) = problem();
    let mut step = Step::new(PARAMETERS);
    bencher.bench_local(|| {
        problem.normal_equations(&start, &mut step.hessian, &mut step.gradient);
        assert!(step.attempt(&start, 1e-3));
        let cost = problem.cost(&step.candidate);
        (cost, problem.validation_cost(&step.candidate), problem.test_cost(&step.candidate))
    });
}

#[divan::bench]
fn iteration_normal_equations(bencher: Bencher<'_, '_>) {
    let (mut problem, start) = problem();
    let mut step = Step::new(PARAMETERS);
    bencher.bench_local(|| problem.normal_equations(&start, &mut step.hessian, &mut step.gradient));
}

#[divan::bench]
fn iteration_solve(bencher: Bencher<'_, '_>) {
    let (mut problem, start) = problem();
    let mut step = Step::new(PARAMETERS);
    problem.normal_equations(&start, &mut step.hessian, &mut step.gradient);
    bencher.bench_local(|| assert!(step.attempt(&start, 1e-3)));
}

#[divan::bench]
fn iteration_cost_of_all_sets(bencher: Bencher<'_, '_>) {
    let (mut problem, start) = problem();
    bencher.bench_local(|| {
        (problem.cost(&start), problem.validation_cost(&start), problem.test_cost(&start))
    });
}

/// 25 epochs, including division and initial parameters.
#[divan::bench(sample_count = 5)]
fn training_of_25_epochs(bencher: Bencher<'_, '_>) {
    let dataset = dataset();
    let solver = LevenbergMarquardtSettings {
        epochs_max: 25,
        validation_failures_max: 25,
        ..LevenbergMarquardtSettings::default()
    };
    let settings = TrainingSettings { trainer: solver.into(), ..TrainingSettings::default() };
    bencher.bench_local(|| {
        train_inner_network(&architecture(), &outer_weights(), &dataset, &settings, 1, &mut |_| {
            ControlFlow::Continue(())
        })
    });
}
