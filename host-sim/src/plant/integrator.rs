//! Integration of the plant over one step.
//!
//! Euler: `x(t + h) = x(t) + h F(t, x)` with `F = f + d`. Runge–Kutta: the classical four stages of
//! order 4. The error of one step is `O(h^2)` and `O(h^5)`, the cost one and four evaluations of
//! `F`.

use super::{DIMENSION_MAX, Disturbance, Plant, RateFault};

/// How the plant is integrated.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Integrator {
    /// The explicit Euler method, as in the paper.
    Euler,
    /// The classical Runge–Kutta method of order 4.
    Rk4,
}

type State = [f64; DIMENSION_MAX];

/// Takes steps; owns the buffers they need.
#[derive(Clone, Debug)]
pub struct Stepper {
    integrator: Integrator,
    rates: [State; 4],
    stage: State,
    disturbance: State,
}

impl Stepper {
    /// Creates a stepper for any plant.
    #[must_use]
    pub fn new(integrator: Integrator) -> Self {
        let zeros = [0.0; DIMENSION_MAX];
        Self { integrator, rates: [zeros; 4], stage: zeros, disturbance: zeros }
    }

    /// Advances `x`, shape `[n]`, from `time` \[s\] by `step_size` \[s\].
    ///
    /// # Panics
    /// If `x` does not have the plant's dimension, or that is above [`DIMENSION_MAX`].
    #[inline]
    pub fn step(
        &mut self,
        plant: &Plant,
        disturbance: &Disturbance,
        time: f64,
        step_size: f64,
        x: &mut [f64],
    ) {
        if let Plant::Recording(recorded) = plant {
            return recorded.reference_at(time + step_size, x);
        }
        self.advance(plant, disturbance, time, step_size, x, |_, _| {});
    }

    /// Returns why a step from the finite state `x` leads to a non-finite one: the first expression
    /// without a finite value, or `None` if the state merely grows too large.
    ///
    /// # Panics
    /// Same as [`Self::step`].
    #[must_use]
    pub fn fault(
        &mut self,
        plant: &Plant,
        disturbance: &Disturbance,
        time: f64,
        step_size: f64,
        x: &[f64],
    ) -> Option<RateFault> {
        let (mut x, mut found) = (x.to_vec(), None);
        self.advance(plant, disturbance, time, step_size, &mut x, |time, x| {
            if found.is_none() {
                found = RateFault::find(plant, disturbance, time, x);
            }
        });
        found
    }

    /// Takes the step; `meets` is called with every time and state at which the rate is evaluated.
    #[inline]
    fn advance(
        &mut self,
        plant: &Plant,
        disturbance: &Disturbance,
        time: f64,
        step_size: f64,
        x: &mut [f64],
        mut meets: impl FnMut(f64, &[f64]),
    ) {
        assert_eq!(x.len(), plant.dimension(), "the state has the plant's dimension");
        let n = x.len();
        let Self { integrator, rates: [first, second, third, fourth], stage, disturbance: d } =
            self;
        let [first, second, third, fourth, stage, d] =
            [first, second, third, fourth, stage, d].map(|part| &mut part[..n]);
        let mut rate = |time: f64, x: &[f64], result: &mut [f64]| {
            meets(time, x);
            plant.derivative(time, x, result);
            disturbance.evaluate(time, x, d);
            for (result, d) in result.iter_mut().zip(&*d) {
                *result += d;
            }
        };
        rate(time, x, first);
        match integrator {
            Integrator::Euler => add_scaled(x, step_size, first),
            Integrator::Rk4 => {
                let half = 0.5 * step_size;
                stage.copy_from_slice(x);
                add_scaled(stage, half, first);
                rate(time + half, stage, second);
                stage.copy_from_slice(x);
                add_scaled(stage, half, second);
                rate(time + half, stage, third);
                stage.copy_from_slice(x);
                add_scaled(stage, step_size, third);
                rate(time + step_size, stage, fourth);
                for i in 0..n {
                    let sum = first[i] + 2.0 * (second[i] + third[i]) + fourth[i];
                    x[i] += step_size / 6.0 * sum;
                }
            }
        }
    }
}

/// `target += factor * source`.
#[inline]
fn add_scaled(target: &mut [f64], factor: f64, source: &[f64]) {
    for (target, source) in target.iter_mut().zip(source) {
        *target += factor * source;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plant::{Harmonic, Wave};
    use nalgebra::dmatrix;

    /// Returns the error at t = 1 of `x' = -x + 2 cos(t) ...` compared with `x = sin t + cos t`.
    fn error_after_one_second(integrator: Integrator, steps: u32) -> f64 {
        let plant = Plant::Linear(dmatrix![-1.0]);
        let drive = Harmonic {
            component: 0,
            function: Wave::Cos,
            amplitude: 2.0,
            angular_frequency: 1.0,
            phase: 0.0,
            offset: 0.0,
        };
        let disturbance = Disturbance::Harmonic(vec![drive]);
        let step_size = 1.0 / f64::from(steps);
        let (mut stepper, mut x) = (Stepper::new(integrator), [1.0]);
        for step in 0..steps {
            stepper.step(&plant, &disturbance, f64::from(step) * step_size, step_size, &mut x);
        }
        (x[0] - (libm::sin(1.0) + libm::cos(1.0))).abs()
    }

    #[test]
    fn error_decreases_with_the_order_of_the_method() {
        for (integrator, order) in [(Integrator::Euler, 1.0), (Integrator::Rk4, 4.0)] {
            let (coarse, fine) =
                (error_after_one_second(integrator, 16), error_after_one_second(integrator, 32));
            let measured = libm::log2(coarse / fine);
            assert!((measured - order).abs() < 0.2, "{integrator:?}: order {measured}");
        }
    }

    #[test]
    fn euler_step_matches_hand_calculation() {
        let plant = Plant::Linear(dmatrix![0.0, 1.0; -4.0, 0.0]);
        let (mut stepper, mut x) = (Stepper::new(Integrator::Euler), [1.0, 2.0]);
        stepper.step(&plant, &Disturbance::None, 0.0, 0.25, &mut x);
        assert_eq!(x, [1.5, 1.0]);
    }
}
