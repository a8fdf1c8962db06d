//! Levenberg–Marquardt with the damping schedule of the toolbox that the paper used.
//!
//! ```text
//! E(θ) = (1/M) Σ e_m(θ)²                       mean squared error over M residuals
//! (JᵀJ/M + μ I) Δ = −Jᵀe/M                     one step, J = ∂e/∂θ
//! E(θ + Δ) < E(θ):  θ ← θ + Δ, μ ← max(0.1 μ, μ_min)     else  μ ← 10 μ, try again
//! ```
//!
//! Both sides of the step contain 1/M, as in that toolbox's `trainlm` (Hagan and Menhaj, "Training
//! feedforward networks with the Marquardt algorithm", IEEE Transactions on Neural Networks 5(6),
//! 1994, omit it): μ is relative to the *mean* of the squared derivatives, so its meaning does not
//! change with the number of samples. The gradient norm reported and compared is ‖∇E‖ = 2 ‖Jᵀe/M‖.
//!
//! Cost per epoch: one evaluation of the normal equations; for every damping tried, one Cholesky
//! factorisation (n³/6 multiplications) and one evaluation of E.
//!
//! Invariants: E never rises from one epoch to the next; a step is taken only if E falls. With a
//! validation set, the parameters returned are those with the smallest validation error of all
//! epochs, otherwise those of the last epoch.

use super::Trainer;
use crate::training::cholesky::Cholesky;
use std::ops::ControlFlow;

/// A nonlinear least-squares problem.
pub trait LeastSquares {
    /// Returns n, the number of parameters.
    fn parameter_count(&self) -> usize;

    /// Returns E, the mean of the squared residuals. It may be infinite or NaN where the problem is
    /// undefined; such points are never accepted.
    fn cost(&mut self, parameters: &[f64]) -> f64;

    /// Writes the upper triangle of JᵀJ/M to `hessian` (row-major, shape `[n][n]`; its lower
    /// triangle is unspecified afterwards) and Jᵀe/M to `gradient` (shape `[n]`), and returns E.
    fn normal_equations(
        &mut self,
        parameters: &[f64],
        hessian: &mut [f64],
        gradient: &mut [f64],
    ) -> f64;

    /// Returns the mean squared error that is part of a cost of `cost` at `parameters`, if the cost
    /// has other parts as well. For reporting only.
    fn error_of_cost(&self, _parameters: &[f64], cost: f64) -> f64 {
        cost
    }

    /// Returns the mean squared error on the validation set, if there is one.
    fn validation_cost(&mut self, _parameters: &[f64]) -> Option<f64> {
        None
    }

    /// Whether training must end at once. From then on, the results of the other methods are
    /// unspecified, and no step is based on them.
    fn stopped(&self) -> bool {
        false
    }

    /// Returns the mean squared error on the test set, if there is one. For reporting only.
    fn test_cost(&mut self, _parameters: &[f64]) -> Option<f64> {
        None
    }
}

/// Solver settings; the defaults are those of `trainlm`.
#[derive(Clone, Debug, PartialEq)]
pub struct LevenbergMarquardtSettings {
    /// μ of the first step. Default 1e-3.
    pub damping_initial: f64,
    /// Factor on μ after an accepted step, in (0, 1). Default 0.1.
    pub damping_decrease: f64,
    /// Factor on μ after a rejected step, above 1. Default 10.
    pub damping_increase: f64,
    /// Lower limit of μ. Default 1e-20; the paper uses 1e-3.
    pub damping_min: f64,
    /// Training ends when μ exceeds this. Default 1e10.
    pub damping_max: f64,
    /// Training ends when E is at most this. Default 0.
    pub goal: f64,
    /// Training ends after this many epochs. Default 1000; the paper uses 25.
    pub epochs_max: usize,
    /// Training ends when ‖∇E‖ is at most this. Default 1e-7.
    pub gradient_min: f64,
    /// Training ends after this many epochs in a row with a validation error above the smallest.
    /// Default 6.
    pub validation_failures_max: usize,
}

impl Default for LevenbergMarquardtSettings {
    fn default() -> Self {
        Self {
            damping_initial: 1e-3,
            damping_decrease: 0.1,
            damping_increase: 10.0,
            damping_min: 1e-20,
            damping_max: 1e10,
            goal: 0.0,
            epochs_max: 1000,
            gradient_min: 1e-7,
            validation_failures_max: 6,
        }
    }
}

/// A setting is out of range.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error("{name} is {value}, expected {expected}")]
pub struct SettingError {
    /// Name of the field.
    pub name: &'static str,
    /// Its value.
    pub value: f64,
    /// The valid values.
    pub expected: &'static str,
}

impl LevenbergMarquardtSettings {
    /// Checks every field.
    ///
    /// # Errors
    /// Returns the first field that is out of range.
    pub fn validate(&self) -> Result<(), SettingError> {
        let positive = |v: f64| v > 0.0 && v.is_finite();
        let not_negative = |v: f64| v >= 0.0 && v.is_finite();
        let above_one = |v: f64| v > 1.0 && v.is_finite();
        let below_one = |v: f64| v > 0.0 && v < 1.0;
        let range = "a finite number above 0";
        let from_zero = "a finite number >= 0";
        let checks: [(_, _, &dyn Fn(f64) -> bool, _); 7] = [
            ("damping_initial", self.damping_initial, &positive, range),
            ("damping_decrease", self.damping_decrease, &below_one, "a number between 0 and 1"),
            ("damping_increase", self.damping_increase, &above_one, "a finite number above 1"),
            ("damping_min", self.damping_min, &not_negative, from_zero),
            ("damping_max", self.damping_max, &positive, range),
            ("goal", self.goal, &not_negative, from_zero),
            ("gradient_min", self.gradient_min, &not_negative, from_zero),
        ];
        for (name, value, valid, expected) in checks {
            if !valid(value) {
                return Err(SettingError { name, value, expected });
            }
        }
        if self.validation_failures_max == 0 {
            let name = "validation_failures_max";
            return Err(SettingError { name, value: 0.0, expected: "at least 1" });
        }
        Ok(())
    }
}

/// Why training ended. None of these is an error.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum StopReason {
    /// The mean squared error reached the goal.
    Goal,
    /// The maximum number of epochs was reached.
    Epochs,
    /// The gradient vanished: a stationary point.
    Gradient,
    /// No damping value up to the maximum reduces the error: a minimum to within rounding error.
    DampingMax,
    /// The validation error was above its minimum for too many epochs in a row.
    Validation,
    /// The progress callback or [`LeastSquares::stopped`] requested it.
    Callback,
    /// The initial error is infinite or NaN.
    NotFinite,
}

/// State of an epoch; epoch 0 is the start.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EpochReport {
    /// Steps taken so far.
    pub epoch: usize,
    /// Mean squared error on the training set.
    pub train: f64,
    /// Mean squared error on the validation set.
    pub validation: Option<f64>,
    /// Mean squared error on the test set.
    pub test: Option<f64>,
    /// The first μ to try for the next step.
    pub damping: f64,
    /// ‖∇E‖.
    pub gradient_norm: f64,
    /// Epochs in a row with a validation error above the smallest.
    pub validation_failures: usize,
}

/// Result of a training.
#[derive(Clone, Debug, PartialEq)]
pub struct TrainingReport {
    /// Why training ended.
    pub stop: StopReason,
    /// All epochs from the start on; empty if training was stopped before the start was evaluated.
    pub epochs: Vec<EpochReport>,
    /// The epoch of the returned parameters.
    pub best_epoch: usize,
}

impl TrainingReport {
    /// Returns the epoch of the returned parameters.
    #[must_use]
    pub fn best(&self) -> Option<&EpochReport> {
        self.epochs.get(self.best_epoch)
    }
}

impl Trainer for LevenbergMarquardtSettings {
    fn epochs_max(&self) -> usize {
        self.epochs_max
    }

    fn minimize(
        &self,
        problem: &mut dyn LeastSquares,
        start: Vec<f64>,
        progress: &mut dyn FnMut(&EpochReport) -> ControlFlow<()>,
    ) -> Result<(Vec<f64>, TrainingReport), SettingError> {
        minimize(problem, start, self, progress)
    }
}

/// The parameters with the smallest validation error so far.
struct Best {
    epoch: usize,
    cost: f64,
    parameters: Vec<f64>,
}

/// Minimises the mean squared error of `problem`, starting from `start`.
///
/// `progress` is called for every epoch, including the start, and may end the training.
///
/// # Errors
/// If a setting is out of range.
///
/// # Panics
/// If `start` has the wrong length.
pub fn minimize<P: LeastSquares + ?Sized>(
    problem: &mut P,
    start: Vec<f64>,
    settings: &LevenbergMarquardtSettings,
    progress: &mut dyn FnMut(&EpochReport) -> ControlFlow<()>,
) -> Result<(Vec<f64>, TrainingReport), SettingError> {
    settings.validate()?;
    let count = problem.parameter_count();
    assert_eq!(start.len(), count, "length of the start");
    let mut step = Step::new(count);
    let mut parameters = start;
    let mut damping = settings.damping_initial.max(settings.damping_min);
    let mut epochs: Vec<EpochReport> = Vec::new();
    let mut best: Option<Best> = None;
    let mut failures = 0;

    let stop = loop {
        let epoch = epochs.len();
        let train = problem.normal_equations(&parameters, &mut step.hessian, &mut step.gradient);
        let validation = problem.validation_cost(&parameters);
        let test = problem.test_cost(&parameters);
        if problem.stopped() {
            if epoch > 0 {
                // Return to the last epoch reported.
                core::mem::swap(&mut parameters, &mut step.candidate);
            }
            break StopReason::Callback;
        }
        if let Some(cost) = validation {
            match &best {
                Some(best) if cost == best.cost => {}
                // A NaN cost counts as a failure.
                Some(best) if cost > best.cost || cost.is_nan() => failures += 1,
                _ => {
                    failures = 0;
                    best = Some(Best { epoch, cost, parameters: parameters.clone() });
                }
            }
        }
        let report = EpochReport {
            epoch,
            train: problem.error_of_cost(&parameters, train),
            validation,
            test,
            damping,
            gradient_norm: step.gradient_norm(),
            validation_failures: failures,
        };
        epochs.push(report);
        let asked_to_stop = progress(&report).is_break();
        if !train.is_finite() {
            break StopReason::NotFinite;
        } else if asked_to_stop {
            break StopReason::Callback;
        } else if train <= settings.goal {
            break StopReason::Goal;
        } else if epoch >= settings.epochs_max {
            break StopReason::Epochs;
        } else if report.gradient_norm <= settings.gradient_min {
            break StopReason::Gradient;
        } else if failures >= settings.validation_failures_max {
            break StopReason::Validation;
        }
        let taken = loop {
            if damping > settings.damping_max {
                break false;
            }
            let solved = step.attempt_unless(&parameters, damping, &|| problem.stopped());
            if solved && problem.cost(&step.candidate) < train && !problem.stopped() {
                break true;
            }
            if problem.stopped() {
                break false;
            }
            damping *= settings.damping_increase;
        };
        if !taken && problem.stopped() {
            break StopReason::Callback;
        } else if !taken {
            break StopReason::DampingMax;
        }
        core::mem::swap(&mut parameters, &mut step.candidate);
        // A damping of 0 could never rise again.
        let damping_min = settings.damping_min.max(f64::MIN_POSITIVE);
        damping = (damping * settings.damping_decrease).max(damping_min);
    };
    let last = epochs.len().saturating_sub(1);
    let (parameters, best_epoch) = match best {
        Some(best) => (best.parameters, best.epoch),
        None => (parameters, last),
    };
    Ok((parameters, TrainingReport { stop, epochs, best_epoch }))
}

/// The normal equations at a point, and the result of a damped step from there.
#[derive(Clone, Debug)]
pub struct Step {
    /// JᵀJ/M, upper triangle, row-major, shape `[n][n]`.
    pub hessian: Vec<f64>,
    /// Jᵀe/M, shape `[n]`.
    pub gradient: Vec<f64>,
    /// θ + Δ of the last [`Step::attempt`], shape `[n]`.
    pub candidate: Vec<f64>,
    cholesky: Cholesky,
}

impl Step {
    /// Allocates a step for n parameters: about 16 n² bytes.
    #[must_use]
    pub fn new(parameter_count: usize) -> Self {
        Self {
            hessian: vec![0.0; parameter_count * parameter_count],
            gradient: vec![0.0; parameter_count],
            candidate: vec![0.0; parameter_count],
            cholesky: Cholesky::new(parameter_count, pulp::Arch::new()),
        }
    }

    /// Computes the candidate from `parameters` with damping μ. Returns `false` if the damped
    /// matrix is not positive definite to within rounding error, in which case the step must be
    /// rejected.
    ///
    /// # Panics
    /// If `parameters` does not have length n.
    pub fn attempt(&mut self, parameters: &[f64], damping: f64) -> bool {
        self.attempt_unless(parameters, damping, &|| false)
    }

    /// Like [`Self::attempt`], but also returns `false` soon after `stopped` becomes true.
    fn attempt_unless(
        &mut self,
        parameters: &[f64],
        damping: f64,
        stopped: &dyn Fn() -> bool,
    ) -> bool {
        self.candidate.copy_from_slice(&self.gradient);
        let solved = self.cholesky.solve(&self.hessian, damping, &mut self.candidate, stopped);
        for (candidate, &parameter) in self.candidate.iter_mut().zip(parameters) {
            *candidate = parameter - *candidate;
        }
        assert_eq!(parameters.len(), self.candidate.len(), "number of parameters");
        solved
    }

    /// Returns ‖∇E‖ = 2 ‖Jᵀe/M‖.
    #[must_use]
    pub fn gradient_norm(&self) -> f64 {
        let squared = self.gradient.iter().fold(0.0, |sum, g| sum + g * g);
        2.0 * f64::sqrt(squared)
    }
}
