//! The equations of the Kalman filters, in double precision.
//!
//! ```text
//! K = P C' (C P C' + r^2 I)^-1,  x += K (y - C x),  P = (I - K C) P (I - K C)' + r^2 K K'
//! x += dt c P / |P| sum_j a_ij (x_j - x)                            |P|: Frobenius
//! x = x + dt f(t, x),            P = F P F' + dt Q,  F = I + dt df/dx
//! ```
//!
//! The consensus term is that of Olfati-Saber's Kalman consensus filter (2007). It does not enter the
//! covariance, as there; a covariance that has grown beyond [`Model::covariance_max`] is scaled down
//! to it, because a direction that an agent cannot observe would otherwise grow for ever.
//!
//! Derivatives are central differences. All sums have a fixed order.

use nalgebra::{Cholesky, DMatrix, DVector};

use crate::plant::{Disturbance, Plant, Stepper};
use crate::scenario::Time;

/// Step of the central differences relative to the state's size.
const DIFFERENCE: f64 = 1e-6;

/// A state, `f` and its derivative there.
type Linear = (DVector<f64>, DVector<f64>, DMatrix<f64>);

/// What the filter knows of the plant.
pub(super) struct Model<'s> {
    plant: &'s Plant,
    stepper: Stepper,
    time: Time,
    /// Mean state, `f` and its derivative there, for the linear filter.
    linear: Option<Linear>,
    /// `Q`, the diagonal. \[squared state unit/s\]
    pub(super) noise: DVector<f64>,
    /// Standard deviation of each component.
    pub(super) deviation: Vec<f64>,
}

impl<'s> Model<'s> {
    pub(super) fn new(
        plant: &'s Plant,
        time: Time,
        deviation: Vec<f64>,
        noise: DVector<f64>,
    ) -> Self {
        let stepper = Stepper::new(time.integrator);
        Self { plant, stepper, time, linear: None, noise, deviation }
    }

    /// Uses the linearisation at `mean` from now on.
    pub(super) fn linearise_at(&mut self, mean: &[f64]) {
        self.linear = Some(self.linearised(0.0, DVector::from_column_slice(mean)));
    }

    /// Linearises again at `time` \[s\], if the filter is linear and the plant may depend on time.
    pub(super) fn linearise(&mut self, time: f64) {
        if let (Some((mean, ..)), Plant::Expressions(_) | Plant::Function(_)) =
            (&self.linear, self.plant)
        {
            self.linear = Some(self.linearised(time, mean.clone()));
        }
    }

    fn linearised(&self, time: f64, mean: DVector<f64>) -> Linear {
        let mut rate = DVector::zeros(mean.len());
        self.plant.derivative(time, mean.as_slice(), rate.as_mut_slice());
        let jacobian = self.jacobian(time, mean.as_slice());
        (mean, rate, jacobian)
    }

    /// Returns `df/dx`, shape `[n, n]`. \[1/s\]
    fn jacobian(&self, time: f64, x: &[f64]) -> DMatrix<f64> {
        let n = x.len();
        let mut jacobian = DMatrix::zeros(n, n);
        let (mut above, mut below) = (vec![0.0; n], vec![0.0; n]);
        for c in 0..n {
            let h = DIFFERENCE * self.deviation[c].max(x[c].abs()).max(DIFFERENCE);
            let mut shifted = x.to_vec();
            shifted[c] = x[c] + h;
            self.plant.derivative(time, &shifted, &mut above);
            shifted[c] = x[c] - h;
            self.plant.derivative(time, &shifted, &mut below);
            for row in 0..n {
                jacobian[(row, c)] = (above[row] - below[row]) / (2.0 * h);
            }
        }
        jacobian
    }

    /// Advances a state by one step from `time` \[s\].
    pub(super) fn advance(&mut self, time: f64, x: &mut DVector<f64>) {
        let step = self.time.step_size;
        match &self.linear {
            Some((mean, rate, jacobian)) => {
                let rate = rate + jacobian * (&*x - mean);
                *x += rate * step;
            }
            None => {
                self.stepper.step(self.plant, &Disturbance::None, time, step, x.as_mut_slice());
            }
        }
    }

    /// Returns `F = I + dt df/dx`.
    fn transition(&self, time: f64, x: &DVector<f64>) -> DMatrix<f64> {
        let jacobian = match &self.linear {
            Some((_, _, jacobian)) => jacobian.clone(),
            None => self.jacobian(time, x.as_slice()),
        };
        DMatrix::identity(x.len(), x.len()) + jacobian * self.time.step_size
    }

    /// Largest trace of a covariance: that of a state known only to move within ten standard deviations.
    fn covariance_max(&self) -> f64 {
        100.0 * self.deviation.iter().fold(0.0, |sum, deviation| sum + deviation * deviation)
    }
}

/// The filter of one agent.
#[derive(Clone, Debug)]
pub(super) struct Filter {
    /// `x`, shape `[n]`.
    pub(super) estimate: DVector<f64>,
    /// `P`, shape `[n, n]`.
    pub(super) covariance: DMatrix<f64>,
}

impl Filter {
    /// Takes in a measurement `y = C x` with this variance in each output.
    pub(super) fn correct(&mut self, output_matrix: &DMatrix<f64>, variance: f64, y: &[f32]) {
        let projected = &self.covariance * output_matrix.transpose();
        let mut expected = output_matrix * &projected;
        for i in 0..expected.nrows() {
            expected[(i, i)] += variance;
        }
        let Some(factor) = Cholesky::new(expected) else { return };
        // K' = S^-1 C P.
        let gain = factor.solve(&projected.transpose()).transpose();
        let measured = DVector::from_iterator(y.len(), y.iter().map(|&y| f64::from(y)));
        let innovation = measured - output_matrix * &self.estimate;
        self.estimate += &gain * innovation;
        let n = self.estimate.len();
        let kept = DMatrix::identity(n, n) - &gain * output_matrix;
        self.covariance =
            &kept * &self.covariance * kept.transpose() + &gain * gain.transpose() * variance;
    }

    /// Adds the consensus term for `sum_j a_ij (x_j - x)`; `gain` is `dt c`.
    pub(super) fn agree(&mut self, gain: f64, sum: &DVector<f64>) {
        let size = self.covariance.norm();
        if size > 0.0 {
            self.estimate += &self.covariance * sum * (gain / size);
        }
    }

    /// Predicts estimate and covariance one step from `time` \[s\].
    pub(super) fn predict(&mut self, model: &mut Model<'_>, time: f64) {
        let transition = model.transition(time, &self.estimate);
        model.advance(time, &mut self.estimate);
        let mut covariance = &transition * &self.covariance * transition.transpose();
        for (c, noise) in model.noise.iter().enumerate() {
            covariance[(c, c)] += model.time.step_size * noise;
        }
        let (trace, largest) = (covariance.trace(), model.covariance_max());
        if trace > largest {
            covariance *= largest / trace;
        }
        self.covariance = (&covariance + covariance.transpose()) * 0.5;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plant::Integrator;
    use nalgebra::dmatrix;

    /// The covariance of a scalar random walk has a closed form in steady state: P = P' after
    /// correction and prediction, with P^2 - dt q P - dt q r^2 = 0 before the correction.
    #[test]
    fn the_covariance_of_a_random_walk_is_that_of_the_riccati_equation() {
        let plant = Plant::Linear(dmatrix![0.0]);
        let time = Time { duration: 1.0, step_size: 0.01, integrator: Integrator::Euler };
        let (q, variance) = (2.0, 0.25);
        let mut model = Model::new(&plant, time, vec![1.0], DVector::from_element(1, q));
        let mut filter = Filter {
            estimate: DVector::from_element(1, 0.0),
            covariance: DMatrix::from_element(1, 1, 1.0),
        };
        for _ in 0..2_000 {
            filter.correct(&dmatrix![1.0], variance, &[1.0]);
            filter.predict(&mut model, 0.0);
        }
        let dq = 0.01 * q;
        let expected = 0.5 * (dq + (dq * dq + 4.0 * dq * variance).sqrt());
        assert!((filter.covariance[(0, 0)] - expected).abs() < 1e-12);
        assert!((filter.estimate[0] - 1.0).abs() < 1e-9);
    }

    #[test]
    fn derivatives_of_the_van_der_pol_oscillator() {
        let plant = Plant::VanDerPol { mu: 0.3 };
        let time = Time { duration: 1.0, step_size: 0.01, integrator: Integrator::Euler };
        let model = Model::new(&plant, time, vec![1.0; 3], DVector::zeros(3));
        let found = model.jacobian(0.0, &[2.0, 1.0, 3.0]);
        let expected = dmatrix![0.3 * (1.0 - 4.0), -0.3, 0.0; 1.0 / 0.3, 0.0, 0.0; 0.0, 0.0, -0.3];
        assert!((found - expected).norm() < 1e-6);
    }
}
