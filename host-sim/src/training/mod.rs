//! Offline training of the inner layers by Levenberg–Marquardt, in f64.
//!
//! ```text
//! minimise over θ   E(θ) = (1/(S n)) Σ_s ‖Wᵀ σ(Φ̂(x̂_s; θ)) − ẋ̂_s‖²
//! ```
//!
//! over S recorded samples of an agent's own estimate x̂ and its derivative, with fixed outer
//! weights W (the paper's section "Simulation": Levenberg–Marquardt, mean squared error, 70/15/15 %
//! of the samples for training, validation and test).
//!
//! | module | purpose |
//! | --- | --- |
//! | [`data`] | samples and their split |
//! | [`averaging`] | chooses the averaging window |
//! | [`smoothing`] | removes chatter from recorded samples |
//! | [`initial`] | initial parameters |
//! | [`scaling`] | scales the data, so that units do not matter |
//! | [`network_problem`] | the training as a least-squares problem |
//! | [`weight_decay`] | penalty on large weights |
//! | [`trainer`] | solvers, for any least-squares problem |
//! | `activation` | values, slopes and ranges of the activations |
//! | `propagation`, `normal_matrix` | forward and backward pass; JᵀJ exploiting its structure |
//! | `panel_product`, `cholesky`, `elementary` | the kernels |
//!
//! Cost for the paper's network (425 parameters, 4,200 training samples): about 0.35 billion
//! multiplications and additions per epoch, nearly all of them in JᵀJ. Single-threaded; agents can
//! be trained in parallel.
//!
//! Invariants: the same arguments give the same bits on every machine and with every vector width:
//! every sum has a fixed order, no multiplication is fused with an addition, and no function of the
//! platform's libm is called.

mod activation;
pub mod averaging;
pub(crate) mod cholesky;
pub mod data;
mod elementary;
pub mod initial;
pub mod network_problem;
#[cfg(test)]
mod network_tests;
mod normal_matrix;
mod panel_product;
mod propagation;
pub mod scaling;
pub mod smoothing;
#[cfg(test)]
mod solver_tests;
#[cfg(test)]
mod testing;
pub mod trainer;
pub mod weight_decay;

pub use averaging::Averaging;
pub use data::{DataError, Dataset, Division};
pub use initial::{InitialError, InitialParameters};
pub use network_problem::{NetworkProblem, ProblemError};
pub use scaling::Scaling;
pub use smoothing::{Smoothed, Smoothing, SmoothingError};
pub use trainer::levenberg_marquardt::{
    EpochReport, LeastSquares, LevenbergMarquardtSettings, SettingError, StopReason,
    TrainingReport, minimize,
};
pub use trainer::{Trainer, TrainerSettings};
pub use weight_decay::WeightDecay;

use agent_core::observer::network::Architecture;
use std::ops::ControlFlow;
use std::sync::atomic::AtomicBool;

/// Settings for training an inner network.
#[derive(Clone, Debug, PartialEq)]
pub struct TrainingSettings {
    /// Solver.
    pub trainer: TrainerSettings,
    /// Proportions of training, validation and test samples. Default 0.7, 0.15, 0.15 (paper).
    pub split: [f64; 3],
    /// Initial parameters. Default [`InitialParameters::NguyenWidrow`].
    pub initial: InitialParameters,
    /// λ of the penalty λ‖w‖² added to the mean squared error; w are the weights without the
    /// biases. Default 0.
    pub weight_decay: f64,
    /// Whether to train on normalised data ([`Scaling`]): errors, goal, damping and decay are then
    /// relative to the targets' variance. Default true.
    pub normalise: bool,
}

impl Default for TrainingSettings {
    fn default() -> Self {
        Self {
            trainer: TrainerSettings::default(),
            split: [0.7, 0.15, 0.15],
            initial: InitialParameters::NguyenWidrow,
            weight_decay: 0.0,
            normalise: true,
        }
    }
}

/// Why a network cannot be trained.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum TrainingError {
    /// The samples cannot be split.
    #[error(transparent)]
    Data(#[from] DataError),
    /// The initial parameters are invalid.
    #[error(transparent)]
    Initial(#[from] InitialError),
    /// Network and data do not match.
    #[error(transparent)]
    Problem(#[from] ProblemError),
    /// A setting of the solver is out of range.
    #[error(transparent)]
    Setting(#[from] SettingError),
}

/// Splits the data, draws the initial parameters and trains.
///
/// `outer_weights` is W, row-major, shape `[L][n]`. `seed` determines both the split and the
/// initial parameters, as two independent streams. Returns the flat inner parameters in the order
/// of the core's networks, and the report.
///
/// # Errors
/// If data, network and settings do not match; see [`TrainingError`]. The reason why training ended
/// is part of the report, not an error.
pub fn train_inner_network(
    architecture: &Architecture,
    outer_weights: &[f64],
    dataset: &Dataset,
    settings: &TrainingSettings,
    seed: u64,
    progress: &mut dyn FnMut(&EpochReport) -> ControlFlow<()>,
) -> Result<(Vec<f64>, TrainingReport), TrainingError> {
    train_inner_network_until(architecture, outer_weights, dataset, settings, seed, progress, None)
}

/// Like [`train_inner_network`]; once `stop` is true, training ends within tens of milliseconds,
/// even in the middle of an epoch, and returns the best epoch so far.
///
/// # Errors
/// Same as [`train_inner_network`].
pub fn train_inner_network_until(
    architecture: &Architecture,
    outer_weights: &[f64],
    dataset: &Dataset,
    settings: &TrainingSettings,
    seed: u64,
    progress: &mut dyn FnMut(&EpochReport) -> ControlFlow<()>,
    stop: Option<&'static AtomicBool>,
) -> Result<(Vec<f64>, TrainingReport), TrainingError> {
    let mut division = dataset.divide(settings.split, seed)?;
    let scaling = settings.normalise.then(|| Scaling::of(&division.train));
    let mut outer_weights = outer_weights.to_vec();
    if let Some(scaling) = &scaling {
        division = division.map(|part| scaling.apply(part));
        outer_weights = scaling.outer_weights(&outer_weights);
    }
    let Division { train, validation, test } = &division;
    let (validation, test) = (validation.as_ref(), test.as_ref());
    let problem = NetworkProblem::new(architecture, &outer_weights, train, validation, test)?;
    let problem = problem.until(stop);
    let is_bias = weight_decay::biases(architecture);
    let mut problem = WeightDecay { problem, weight_decay: settings.weight_decay, is_bias };
    let mut start = settings.initial.draw(architecture, train, seed ^ START_STREAM)?;
    if let (Some(scaling), InitialParameters::Given(_)) = (&scaling, &settings.initial) {
        scaling.unfold(architecture, &mut start);
    }
    let trainer = settings.trainer.trainer();
    let (mut parameters, report) = trainer.minimize(&mut problem, start, progress)?;
    if let Some(scaling) = &scaling {
        scaling.fold(architecture, &mut parameters);
    }
    Ok((parameters, report))
}

/// An arbitrary constant that separates the random numbers of the initial parameters from those of
/// the split: the first digits of π in hexadecimal.
const START_STREAM: u64 = 0x243f_6a88_85a3_08d3;
