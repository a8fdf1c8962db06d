//! Compares the network problem with its definition: central differences, a dense Jacobian, plain
//! loops.

use super::data::Dataset;
use super::network_problem::{NetworkProblem, ProblemError};
use super::testing::{architecture, assert_close, instruction_sets, random_data, random_values};
use super::trainer::levenberg_marquardt::LeastSquares;
use agent_core::INPUTS_MAX;
use agent_core::math::activation::Activation::{self, Gaussian, Logistic, Tanh};
use agent_core::observer::network::Architecture;
use proptest::prelude::*;

/// Computes f̂(x) as in the equations, with libm's functions.
fn naive_estimate(
    architecture: &Architecture,
    outer: &[f64],
    parameters: &[f64],
    x: &[f64],
) -> Vec<f64> {
    let mut values = x.to_vec();
    let mut offset = 0;
    for (inputs, layer) in architecture.shapes() {
        let width = usize::from(layer.width);
        let next = (0..width).map(|p| {
            let weight = |i: usize| parameters[offset + (i + 1) * width + p];
            let bias = parameters[offset + p];
            let z = (0..inputs).fold(bias, |sum, i| sum + weight(i) * values[i]);
            match layer.activation {
                Tanh => libm::tanh(z),
                Logistic => 1.0 / (1.0 + libm::exp(-z)),
                Gaussian => libm::exp(-z * z),
            }
        });
        let next: Vec<f64> = next.collect();
        values = next;
        offset += (inputs + 1) * width;
    }
    let outputs = outer.len() / values.len();
    let estimate = |o| values.iter().enumerate().map(|(p, a)| a * outer[p * outputs + o]).sum();
    (0..outputs).map(estimate).collect()
}

fn naive_residuals(
    architecture: &Architecture,
    outer: &[f64],
    parameters: &[f64],
    data: &Dataset,
) -> Vec<f64> {
    let n = data.dimension();
    let rows = data.inputs().chunks_exact(n).zip(data.targets().chunks_exact(n));
    rows.flat_map(|(x, y)| {
        let estimate = naive_estimate(architecture, outer, parameters, x);
        estimate.into_iter().zip(y.to_vec()).map(|(f, y)| f - y).collect::<Vec<_>>()
    })
    .collect()
}

/// Computes J by fourth-order central differences, one column per parameter.
fn naive_jacobian(
    architecture: &Architecture,
    outer: &[f64],
    parameters: &[f64],
    data: &Dataset,
) -> Vec<Vec<f64>> {
    const STEP: f64 = 1e-3;
    let shifted = |j: usize, multiple: f64| {
        let mut parameters = parameters.to_vec();
        parameters[j] += multiple * STEP;
        naive_residuals(architecture, outer, &parameters, data)
    };
    let column = |j| {
        let [a, b, c, d] = [-2.0, -1.0, 1.0, 2.0].map(|multiple| shifted(j, multiple));
        (0..a.len()).map(|m| (a[m] - 8.0 * b[m] + 8.0 * c[m] - d[m]) / (12.0 * STEP)).collect()
    };
    (0..parameters.len()).map(column).collect()
}

/// Returns the upper triangle of the normal matrix (the rest 0), gradient and cost.
fn normal_equations(problem: &mut NetworkProblem, parameters: &[f64]) -> (Vec<f64>, Vec<f64>, f64) {
    let n = parameters.len();
    let (mut hessian, mut gradient) = (vec![f64::NAN; n * n], vec![f64::NAN; n]);
    let cost = problem.normal_equations(parameters, &mut hessian, &mut gradient);
    for row in 0..n {
        hessian[row * n..][..row].fill(0.0);
    }
    (hessian, gradient, cost)
}

fn check_against_definitions(architecture: &Architecture, samples: usize, seed: u64) {
    let dimension = architecture.inputs();
    let data = random_data(dimension, samples, seed);
    let outer = random_values(architecture.features() * dimension, seed + 2);
    let count = architecture.parameter_count();
    let parameters = random_values(count, seed + 3);
    let residuals = naive_residuals(architecture, &outer, &parameters, &data);
    let columns = naive_jacobian(architecture, &outer, &parameters, &data);
    let mean = |a: &[f64], b: &[f64]| {
        a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>() / residuals.len() as f64
    };
    let mut expected = vec![0.0; count * count];
    for i in 0..count {
        for j in i..count {
            expected[i * count + j] = mean(&columns[i], &columns[j]);
        }
    }
    let expected_gradient: Vec<f64> = columns.iter().map(|c| mean(c, &residuals)).collect();

    let mut problem =
        NetworkProblem::new(architecture, &outer, &data, Some(&data), None).expect("fits");
    let (hessian, gradient, cost) = normal_equations(&mut problem, &parameters);
    assert_close(&[cost], &[mean(&residuals, &residuals)], 1e-13, 0.0);
    assert_eq!(problem.cost(&parameters).to_bits(), cost.to_bits());
    assert_eq!(problem.validation_cost(&parameters).map(f64::to_bits), Some(cost.to_bits()));
    assert_eq!(problem.test_cost(&parameters), None);
    // Fourth-order differences with step 1e-3 are accurate to about 1e-10.
    assert_close(&gradient, &expected_gradient, 1e-8, 1e-9);
    assert_close(&hessian, &expected, 1e-8, 1e-9);

    let (data, results) = ([Some(&data), None, None], (hessian, gradient, cost));
    for arch in instruction_sets() {
        let mut problem =
            NetworkProblem::with_arch(architecture, &outer, data, arch).expect("fits");
        assert_eq!(normal_equations(&mut problem, &parameters), results, "bits");
    }
}

#[test]
fn paper_network_matches_definition() {
    let architecture = architecture(3, &[(12, Tanh), (12, Tanh), (12, Tanh), (5, Tanh)]);
    assert_eq!(architecture.parameter_count(), 425);
    check_against_definitions(&architecture, 70, 11);
}

#[test]
fn extreme_shapes_match_definition() {
    check_against_definitions(&architecture(1, &[(1, Tanh)]), 1, 1);
    check_against_definitions(&architecture(INPUTS_MAX, &[(9, Logistic), (1, Gaussian)]), 65, 2);
    check_against_definitions(&architecture(2, &[(2, Gaussian); 8]), 128, 3);
    check_against_definitions(&architecture(1, &[(64, Tanh), (2, Logistic)]), 10, 4);
    check_against_definitions(&architecture(2, &[(2, Logistic), (64, Gaussian)]), 10, 5);
}

#[test]
fn widest_layers_match_definition() {
    let architecture = architecture(2, &[(64, Tanh), (64, Logistic)]);
    let (data, outer) = (random_data(2, 100, 1), random_values(128, 2));
    let parameters = random_values(architecture.parameter_count(), 3);
    let direction = random_values(parameters.len(), 4);
    let mut problem = NetworkProblem::new(&architecture, &outer, &data, None, None).expect("fits");
    let (_, gradient, _) = normal_equations(&mut problem, &parameters);
    let mut cost = |distance: f64| {
        let pairs = parameters.iter().zip(&direction);
        let moved: Vec<f64> = pairs.map(|(p, d)| p + distance * d).collect();
        problem.cost(&moved)
    };
    let slope = (cost(1e-5) - cost(-1e-5)) / 2e-5;
    // The gradient of the mean squared error is twice that of the normal equations.
    let expected = 2.0 * gradient.iter().zip(&direction).map(|(g, d)| g * d).sum::<f64>();
    assert_close(&[slope], &[expected], 1e-6, 1e-8);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn random_networks_match_definition(
        inputs in 1usize..5,
        layers in prop::collection::vec(
            (1u8..10, prop::sample::select(&Activation::ALL[..])), 1..5),
        samples in 1usize..140,
        seed in 0u64..1 << 40,
    ) {
        check_against_definitions(&architecture(inputs, &layers), samples, seed);
    }
}

#[test]
fn saturated_networks_stay_finite() {
    for activation in Activation::ALL {
        let architecture = architecture(2, &[(3, activation), (3, activation)]);
        let (data, outer) = (random_data(2, 10, 1), random_values(6, 2));
        let parameters: Vec<f64> =
            random_values(architecture.parameter_count(), 3).iter().map(|p| 1e6 * p).collect();
        let mut problem =
            NetworkProblem::new(&architecture, &outer, &data, None, None).expect("fits");
        let (hessian, gradient, cost) = normal_equations(&mut problem, &parameters);
        assert!(cost.is_finite() && hessian.iter().chain(&gradient).all(|v| v.is_finite()));
        assert!(problem.cost(&vec![f64::NAN; parameters.len()]).is_nan());
    }
}

#[test]
fn rejects_mismatched_shapes() {
    let small = architecture(2, &[(3, Tanh)]);
    let create = |architecture, outer: &[f64], dimension| {
        let data = random_data(dimension, 3, 1);
        NetworkProblem::new(architecture, outer, &data, None, None).map(|_| ())
    };
    assert_eq!(create(&small, &[1.0; 6], 2), Ok(()));
    let error = ProblemError::Inputs { expected: 2, found: 3 };
    assert_eq!(create(&small, &[1.0; 9], 3), Err(error));
    let error = ProblemError::OuterWeightCount { found: 5, features: 3, dimension: 2 };
    assert_eq!(create(&small, &[1.0; 5], 2), Err(error));
    let weights = [1.0, f64::INFINITY, 1.0, 1.0, 1.0, 1.0];
    assert_eq!(create(&small, &weights, 2), Err(ProblemError::OuterWeightNotFinite { index: 1 }));
    let large = architecture(2, &[(64, Tanh); 4]);
    let error = ProblemError::ParameterCount { found: 192 + 3 * 4160 };
    assert_eq!(create(&large, &[1.0; 128], 2), Err(error));
}
