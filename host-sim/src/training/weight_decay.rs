//! Weight decay: a least-squares problem with a preference for small parameters.
//!
//! ```text
//! E_λ(θ) = E(θ) + λ ‖θ‖²,   JᵀJ/M + λ I,   Jᵀe/M + λ θ
//! ```
//!
//! Among the networks that explain the samples equally well it prefers the smoother one. The
//! samples of one collection window lie on a single curve in the state space, and the trained
//! network is used beside that curve; a smoother network errs less there. λ = 0 changes no bit.
//!
//! Reported errors are the plain mean squared ones; goal and progress are judged by E_λ.

use super::levenberg_marquardt::LeastSquares;

/// `problem` with the penalty λ‖θ‖².
#[derive(Clone, Debug)]
pub struct WeightDecay<P> {
    /// The problem without the penalty.
    pub problem: P,
    /// λ, 0 or above.
    pub weight_decay: f64,
}

impl<P> WeightDecay<P> {
    fn penalty(&self, parameters: &[f64]) -> f64 {
        self.weight_decay * parameters.iter().fold(0.0, |sum, p| sum + p * p)
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
        for (index, (gradient, parameter)) in gradient.iter_mut().zip(parameters).enumerate() {
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

    fn test_cost(&mut self, parameters: &[f64]) -> Option<f64> {
        self.problem.test_cost(parameters)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::training::{LevenbergMarquardtSettings, minimize};
    use std::ops::ControlFlow;

    /// One residual a parameter, `θ - 3`: with decay the minimum is at `3 / (1 + λ M)`.
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
    fn the_minimum_moves_as_the_formula_says() {
        for (weight_decay, expected) in [(0.0, 3.0), (0.5, 1.5), (1.0, 1.0)] {
            let mut problem = WeightDecay { problem: Shifted, weight_decay };
            let settings = LevenbergMarquardtSettings::default();
            let (solution, _) = minimize(&mut problem, vec![-1.0, 7.0], &settings, &mut |_| {
                ControlFlow::Continue(())
            })
            .unwrap();
            for parameter in solution {
                assert!((parameter - expected).abs() <= 1e-6 * expected, "{parameter}");
            }
        }
    }
}
