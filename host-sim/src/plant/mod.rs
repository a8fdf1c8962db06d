//! The plant `d/dt x_0 = f(x_0) + d` (equation `plant dynamics`): drift, disturbance and
//! integrators, in f64.
//!
//! `f` and `d` are known to the simulator only, not to the agents.
//!
//! Cost of one Euler step for the paper's plant and disturbance: about 20 operations and three
//! sines, below 80 ns. Nothing here allocates after construction.
//!
//! Invariant: the same arguments give the same bits on every machine. Transcendental functions are
//! those of the `libm` crate, called by path; integer powers are products in a fixed order; no
//! multiplication is fused with an addition.

mod disturbance;
pub mod expression;
mod function;
mod integrator;
mod random_disturbance;
mod recorded;

pub use disturbance::{Disturbance, Harmonic, Wave};
pub use expression::{ExpressionFault, ExpressionSystem};
pub use function::{FunctionPlant, Rate};
pub use integrator::{Integrator, Stepper};
pub use random_disturbance::RandomDisturbance;
pub use recorded::{Between, Recorded};

use std::sync::Arc;

use nalgebra::DMatrix;

/// Largest state dimension: the most inputs that an agent's network can have.
pub const DIMENSION_MAX: usize = agent_core::INPUTS_MAX;

/// `f`, the drift.
#[derive(Clone, Debug, PartialEq)]
pub enum Plant {
    /// The paper's oscillator (equation `VanderPol`) with a third, decaying state:
    /// `x' = mu (x - x^3/3 - y)`, `y' = x/mu`, `z' = -mu z`.
    VanDerPol {
        /// `mu`, not 0.
        mu: f64,
    },
    /// The Lorenz convection model:
    /// `x' = sigma (y - x)`, `y' = x (rho - z) - y`, `z' = x y - beta z`.
    Lorenz {
        /// Prandtl number. \[1/s\]
        sigma: f64,
        /// Relative Rayleigh number.
        rho: f64,
        /// Geometry factor. \[1/s\]
        beta: f64,
    },
    /// The Duffing oscillator: `x' = v`, `v' = -damping v - stiffness x - cubic_stiffness x^3`. A
    /// disturbance drives it.
    Duffing {
        /// \[1/s\]
        damping: f64,
        /// Linear stiffness per mass; negative for two wells. \[1/s^2\]
        stiffness: f64,
        /// Cubic stiffness per mass. \[1/(s^2 squared state unit)\]
        cubic_stiffness: f64,
    },
    /// A pendulum with viscous friction:
    /// `angle' = rate`, `rate' = -(gravity/length) sin(angle) - damping rate`.
    DampedPendulum {
        /// \[m/s^2\]
        gravity: f64,
        /// \[m\], not 0.
        length: f64,
        /// \[1/s\]
        damping: f64,
    },
    /// `x' = A x`, `A` of shape `[n, n]`. \[1/s\]
    Linear(DMatrix<f64>),
    /// User-defined expressions.
    Expressions(ExpressionSystem),
    /// A function of the program that uses this library.
    Function(FunctionPlant),
    /// A recorded experiment, whose `f` and `d` are not known.
    Recording(Arc<Recorded>),
}

impl Plant {
    /// Returns `n`, the dimension of the state.
    #[must_use]
    pub fn dimension(&self) -> usize {
        match self {
            Self::VanDerPol { .. } | Self::Lorenz { .. } => 3,
            Self::Duffing { .. } | Self::DampedPendulum { .. } => 2,
            Self::Linear(matrix) => matrix.nrows(),
            Self::Expressions(system) => system.dimension(),
            Self::Function(function) => function.state_names().len(),
            Self::Recording(recorded) => recorded.states.len(),
        }
    }

    /// Returns the names of the state's components in expressions and tables, shape `[n]`.
    #[must_use]
    pub fn state_names(&self) -> Vec<String> {
        let fixed = |names: &[&str]| names.iter().map(|&name| name.to_owned()).collect();
        match self {
            Self::VanDerPol { .. } | Self::Lorenz { .. } => fixed(&["x", "y", "z"]),
            Self::Duffing { .. } => fixed(&["x", "v"]),
            Self::DampedPendulum { .. } => fixed(&["angle", "rate"]),
            Self::Linear(matrix) => (1..=matrix.nrows()).map(|i| format!("x{i}")).collect(),
            Self::Expressions(system) => system.state_names().to_vec(),
            Self::Function(function) => function.state_names().to_vec(),
            Self::Recording(recorded) => recorded.states.clone(),
        }
    }

    /// Returns the names of the known inputs, shape `[p]`: functions of time that every agent knows, and
    /// that networks take in addition to the state.
    #[must_use]
    pub fn input_names(&self) -> Vec<String> {
        match self {
            Self::Expressions(system) => {
                system.inputs().map_or(Vec::new(), |inputs| inputs.state_names().to_vec())
            }
            Self::Recording(recorded) => {
                recorded.inputs.iter().map(|&column| recorded.names[column].clone()).collect()
            }
            _ => Vec::new(),
        }
    }

    /// Returns the known inputs at `time` \[s\], shape `[p]`.
    #[must_use]
    pub fn known_inputs(&self, time: f64) -> KnownInputs {
        let mut known = KnownInputs { values: [0.0; DIMENSION_MAX], count: 0 };
        match self {
            Self::Expressions(system) => {
                if let Some(inputs) = system.inputs() {
                    known.count = inputs.dimension();
                    inputs.evaluate(time, &[], &mut known.values[..known.count]);
                }
            }
            Self::Recording(recorded) => {
                known.count = recorded.inputs.len();
                recorded.inputs_at(time, &mut known.values[..known.count]);
            }
            _ => {}
        }
        known
    }

    /// Returns the recording in place of equations, if the plant is one.
    #[must_use]
    pub fn recording(&self) -> Option<&Recorded> {
        match self {
            Self::Recording(recorded) => Some(recorded),
            _ => None,
        }
    }

    /// Whether the true state is known.
    #[must_use]
    pub fn is_known(&self) -> bool {
        self.recording().is_none_or(Recorded::has_reference)
    }

    /// Writes `f` at `time` \[s\] and state `x`, shape `[n]`, to `dx`, shape `[n]`. Only
    /// expressions and functions may depend on time; a recording has the slope of its reference; `dx` is not finite where one is undefined.
    ///
    /// # Panics
    /// If `x` or `dx` is shorter than the dimension.
    #[inline]
    pub fn derivative(&self, time: f64, x: &[f64], dx: &mut [f64]) {
        match self {
            Self::VanDerPol { mu } => {
                let ([x, y, z], [dx, dy, dz]) = (first(x), first_mut(dx));
                *dx = mu * (x - x * x * x / 3.0 - y);
                *dy = x / mu;
                *dz = -mu * z;
            }
            Self::Lorenz { sigma, rho, beta } => {
                let ([x, y, z], [dx, dy, dz]) = (first(x), first_mut(dx));
                *dx = sigma * (y - x);
                *dy = x * (rho - z) - y;
                *dz = x * y - beta * z;
            }
            Self::Duffing { damping, stiffness, cubic_stiffness } => {
                let ([x, v], [dx, dv]) = (first(x), first_mut(dx));
                *dx = *v;
                *dv = -damping * v - stiffness * x - cubic_stiffness * (x * x * x);
            }
            Self::DampedPendulum { gravity, length, damping } => {
                let ([angle, rate], [d_angle, d_rate]) = (first(x), first_mut(dx));
                *d_angle = *rate;
                *d_rate = -(gravity / length) * libm::sin(*angle) - damping * rate;
            }
            Self::Linear(matrix) => {
                for (row, dx) in dx[..matrix.nrows()].iter_mut().enumerate() {
                    *dx = (0..matrix.ncols()).fold(0.0, |sum, j| sum + matrix[(row, j)] * x[j]);
                }
            }
            Self::Expressions(system) => system.evaluate(time, x, dx),
            Self::Function(function) => function.rate().evaluate(time, x, dx),
            Self::Recording(recorded) => recorded.slope_at(time, dx),
        }
    }
}

/// Values of the known inputs at a time, shape `[p]`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KnownInputs {
    values: [f64; DIMENSION_MAX],
    count: usize,
}

impl std::ops::Deref for KnownInputs {
    type Target = [f64];

    #[inline]
    fn deref(&self) -> &[f64] {
        &self.values[..self.count]
    }
}

/// An expression of the drift or the disturbance without a finite value, and why.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RateFault {
    /// An expression of a known input.
    #[error("plant.inputs, {0}")]
    Input(ExpressionFault),
    /// An expression of the drift.
    #[error("plant.derivative, {0}")]
    Drift(ExpressionFault),
    /// An expression of the disturbance.
    #[error("disturbance.components, {0}")]
    Disturbance(ExpressionFault),
}

impl RateFault {
    /// Returns what is wrong with `plant` or `disturbance` at `time` \[s\] and the finite state
    /// `x`, shape `[n]`; `None` if both are defined.
    #[must_use]
    pub fn find(plant: &Plant, disturbance: &Disturbance, time: f64, x: &[f64]) -> Option<Self> {
        let drift = match plant {
            Plant::Expressions(system) => {
                Self::of_inputs(plant, time).or_else(|| system.fault(time, x).map(Self::Drift))
            }
            _ => None,
        };
        drift.or_else(|| disturbance.fault(time, x).map(Self::Disturbance))
    }

    /// Returns what is wrong with a known input at `time` \[s\].
    #[must_use]
    pub fn of_inputs(plant: &Plant, time: f64) -> Option<Self> {
        let Plant::Expressions(system) = plant else { return None };
        system.inputs().and_then(|inputs| inputs.fault(time, &[])).map(Self::Input)
    }

    /// Returns the expression.
    #[must_use]
    pub fn expression(&self) -> &ExpressionFault {
        match self {
            Self::Input(fault) | Self::Drift(fault) | Self::Disturbance(fault) => fault,
        }
    }
}

/// Returns the first `N` components.
#[inline]
fn first<const N: usize>(x: &[f64]) -> &[f64; N] {
    x.first_chunk().expect("the state has the plant's dimension")
}

/// Returns the first `N` components.
#[inline]
fn first_mut<const N: usize>(dx: &mut [f64]) -> &mut [f64; N] {
    dx.first_chunk_mut().expect("the derivative has the plant's dimension")
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::dmatrix;

    fn derivative(plant: &Plant, x: &[f64]) -> Vec<f64> {
        let mut dx = vec![f64::NAN; plant.dimension()];
        plant.derivative(0.0, x, &mut dx);
        dx
    }

    #[test]
    fn built_in_plants_match_hand_calculation() {
        // Exact binary numbers, so that a calculation by hand gives the same bits.
        let van_der_pol = Plant::VanDerPol { mu: 0.5 };
        assert_eq!(
            derivative(&van_der_pol, &[3.0, 2.0, 4.0]),
            [0.5 * (3.0 - 9.0 - 2.0), 6.0, -2.0]
        );
        let lorenz = Plant::Lorenz { sigma: 10.0, rho: 28.0, beta: 2.5 };
        assert_eq!(derivative(&lorenz, &[1.0, 2.0, 4.0]), [10.0, 22.0, -8.0]);
        let duffing = Plant::Duffing { damping: 0.25, stiffness: -1.0, cubic_stiffness: 0.5 };
        assert_eq!(derivative(&duffing, &[2.0, 4.0]), [4.0, -1.0 + 2.0 - 4.0]);
        let pendulum = Plant::DampedPendulum { gravity: 10.0, length: 2.0, damping: 0.5 };
        assert_eq!(derivative(&pendulum, &[0.0, 3.0]), [3.0, -1.5]);
        let down = derivative(&pendulum, &[core::f64::consts::FRAC_PI_2, 0.0]);
        assert_eq!(down, [0.0, -5.0]);
        let linear = Plant::Linear(dmatrix![0.0, 1.0; -2.0, -3.0]);
        assert_eq!(derivative(&linear, &[1.0, 2.0]), [2.0, -8.0]);
    }

    #[test]
    fn expressions_reproduce_the_papers_plant_bit_for_bit() {
        let names = ["x", "y", "z"].map(str::to_owned);
        let parameters = [("mu".to_owned(), 0.3)];
        let texts = ["mu*(x - x^3/3 - y)", "x/mu", "-mu*z"];
        let system = ExpressionSystem::parse(&texts, &names, &parameters).unwrap();
        let (built_in, written) = (Plant::VanDerPol { mu: 0.3 }, Plant::Expressions(system));
        for x in [[5.0, 7.0, 8.0], [-0.1, 1e-9, 3.3], [1.7, -2.9, 0.0]] {
            assert_eq!(derivative(&built_in, &x), derivative(&written, &x));
        }
        assert_eq!(written.state_names(), built_in.state_names());
    }

    #[test]
    fn every_plant_has_state_names() {
        let plants = [
            Plant::VanDerPol { mu: 1.0 },
            Plant::Lorenz { sigma: 1.0, rho: 1.0, beta: 1.0 },
            Plant::Duffing { damping: 0.0, stiffness: 1.0, cubic_stiffness: 0.0 },
            Plant::DampedPendulum { gravity: 1.0, length: 1.0, damping: 0.0 },
            Plant::Linear(dmatrix![1.0]),
        ];
        for plant in plants {
            assert_eq!(plant.state_names().len(), plant.dimension());
        }
    }
}
