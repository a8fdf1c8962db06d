//! Weight decay: a penalty on large weights for any least-squares problem.
//!
//! ```text
//! E_λ(θ) = E(θ) + λ ‖w‖²,   JᵀJ/M + λ D,   Jᵀe/M + λ D θ
//! ```
//!
//! where w are the weights in θ without the biases, and D is diagonal, 1 for a weight and 0 for a
//! bias: a bias determines where a node is active, not how steep it is, and depends on the inputs'
//! offset.
//!
//! Of networks that explain the samples equally well, it prefers the smoother one. The samples of a
//! collection window lie on a single curve in the state space, but the trained network is also used
//! away from it, where a smoother network has smaller errors. λ = 0 does not change a bit.
//!
//! Reported errors are mean squared errors without the penalty; goal and progress use E_λ.

use super::trainer::levenberg_marquardt::LeastSquares;
use agent_core::observer::network::Architecture;

/// `problem` with the penalty λ‖θ‖².
#[derive(Clone, Debug)]
pub struct WeightDecay<P> {
    /// The problem without the penalty.
    pub problem: P,
    /// λ, at least 0.
    pub weight_decay: f64,
    /// Whether each parameter is a bias, which is not penalised.
    pub is_bias: Vec<bool>,
}

/// Returns whether each of the flat inner parameters is a bias.
#[must_use]
pub fn biases(architecture: &Architecture) -> Vec<bool> {
    let layer = |(inputs, layer): (usize, agent_core::observer::network::Layer)| {
        let width = usize::from(layer.width);
        let part = |is_bias: bool, count| std::iter::repeat_n(is_bias, count);
        part(true, width).chain(part(false, inputs * width))
    };
    architecture.shapes().flat_map(layer).collect()
}

impl<P> WeightDecay<P> {
    fn penalty(&self, parameters: &[f64]) -> f64 {
        let weights = parameters.iter().zip(&self.is_bias).filter(|(_, is_bias)| !**is_bias);
        self.weight_decay * weights.fold(0.0, |sum, (w, _)| sum + w * w)
    }
}

impl<P: LeastSquares> LeastSquares for WeightDecay<P> {
    fn parameter_count(&self) -> usize {
        self.problem.parameter_count()
    }

    fn cost(&mut self, parameters: &[f64]) -> f64 {
        self.problem.cost(parameters) + self.penalty(parameters)
    }

    fn normal_equations(
        &mut self,
        parameters: &[f64],
        hessian: &mut [f64],
        gradient: &mut [f64],
    ) -> f64 {
        let cost = self.problem.normal_equations(parameters, hessian, gradient);
        let count = parameters.len();
        let places = gradient.iter_mut().zip(parameters).zip(&self.is_bias).enumerate();
        for (index, ((gradient, parameter), _)) in places.filter(|(_, (_, is_bias))| !**is_bias) {
            hessian[index * count + index] += self.weight_decay;
            *gradient += self.weight_decay * parameter;
        }
        cost + self.penalty(parameters)
    }

    fn error_of_cost(&self, parameters: &[f64], cost: f64) -> f64 {
        self.problem.error_of_cost(parameters, cost - self.penalty(parameters))
    }

    fn validation_cost(&mut self, parameters: &[f64]) -> Option<f64> {
        self.problem.validation_cost(parameters)
    }

    fn stopped(&self) -> bool {
        self.problem.stopped()
    }

    fn test_cost(&mut self, parameters: &[f64]) -> Option<f64> {
        self.problem.test_cost(parameters)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::training::testing::assert_close;
    use crate::training::{LevenbergMarquardtSettings, minimize};
    use std::ops::ControlFlow;

    /// One residual `θ - 3` per parameter: with decay, the minimum of a weight is at `3 / (1 + λ
    /// M)`; that of a bias does not move.
    struct Shifted;

    impl LeastSquares for Shifted {
        fn parameter_count(&self) -> usize {
            2
        }

        fn cost(&mut self, parameters: &[f64]) -> f64 {
            parameters.iter().map(|p| (p - 3.0) * (p - 3.0)).sum::<f64>() / 2.0
        }

        fn normal_equations(
            &mut self,
            p: &[f64],
            hessian: &mut [f64],
            gradient: &mut [f64],
        ) -> f64 {
            hessian.copy_from_slice(&[0.5, 0.0, 0.0, 0.5]);
            gradient.copy_from_slice(&[(p[0] - 3.0) / 2.0, (p[1] - 3.0) / 2.0]);
            self.cost(p)
        }
    }

    #[test]
    fn minimum_moves_as_predicted() {
        for (weight_decay, expected) in [(0.0, 3.0), (0.5, 1.5), (1.0, 1.0)] {
            let is_bias = vec![false, true];
            let mut problem = WeightDecay { problem: Shifted, weight_decay, is_bias };
            let settings = LevenbergMarquardtSettings::default();
            let (solution, _) = minimize(&mut problem, vec![-1.0, 7.0], &settings, &mut |_| {
                ControlFlow::Continue(())
            })
            .unwrap();
            assert_close(&solution, &[expected, 3.0], 1e-6, 0.0);
        }
    }
}
