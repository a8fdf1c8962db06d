//! Offline training of the inner layers.
//!
//! To be replaced at the merge by the module of the same name: until then only the two types
//! that a scenario holds, with the same names, fields and variants.

/// Settings of the solver; the defaults are those of `trainlm`.
#[derive(Clone, Debug, PartialEq)]
pub struct LevenbergMarquardtSettings {
    /// Damping of the first step.
    pub damping_initial: f64,
    /// Factor on the damping after a step that was taken, in (0, 1).
    pub damping_decrease: f64,
    /// Factor on the damping after a step that was refused, above 1.
    pub damping_increase: f64,
    /// The damping never falls below.
    pub damping_min: f64,
    /// Training ends when the damping exceeds it.
    pub damping_max: f64,
    /// Training ends when the mean squared error is at most this.
    pub goal: f64,
    /// Training ends after so many epochs.
    pub epochs_max: usize,
    /// Training ends when the norm of the gradient is at most this.
    pub gradient_min: f64,
    /// Training ends after so many epochs in a row whose validation error is above the least.
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

/// The parameters that training starts from.
#[derive(Clone, Debug, PartialEq)]
pub enum InitialParameters {
    /// Every parameter has this value.
    Constant(f64),
    /// Random, active ranges spread evenly over the inputs.
    NguyenWidrow,
}
