//! Trainers: problem in, parameters and report out. One file per trainer.
//!
//! A new trainer is a file here, a variant of [`TrainerSettings`], and the keys that
//! `scenario/sections/trainer.rs` reads for it.

pub mod levenberg_marquardt;

use std::fmt;
use std::ops::ControlFlow;

use levenberg_marquardt::{
    EpochReport, LeastSquares, LevenbergMarquardtSettings, SettingError, TrainingReport,
};

/// Minimises least-squares problems.
///
/// The same problem and start give the same bits on every machine.
pub trait Trainer: fmt::Debug {
    /// Most epochs that it takes.
    fn epochs_max(&self) -> usize;

    /// Minimises the mean squared error of `problem` from `start`. Returns the parameters and
    /// what happened.
    ///
    /// `progress` hears of every epoch, the start included, and may end the training. A problem
    /// that is [`LeastSquares::stopped`] ends it, too.
    ///
    /// # Errors
    /// A setting out of its range.
    ///
    /// # Panics
    /// If `start` does not have as many entries as the problem has parameters.
    fn minimize(
        &self,
        problem: &mut dyn LeastSquares,
        start: Vec<f64>,
        progress: &mut dyn FnMut(&EpochReport) -> ControlFlow<()>,
    ) -> Result<(Vec<f64>, TrainingReport), SettingError>;
}

/// A trainer and its settings.
#[derive(Clone, Debug, PartialEq)]
pub enum TrainerSettings {
    /// See [`levenberg_marquardt`].
    LevenbergMarquardt(LevenbergMarquardtSettings),
}

impl TrainerSettings {
    /// The trainer with these settings.
    #[must_use]
    pub fn trainer(&self) -> &dyn Trainer {
        match self {
            Self::LevenbergMarquardt(settings) => settings,
        }
    }

    /// Most epochs.
    pub fn epochs_max_mut(&mut self) -> &mut usize {
        match self {
            Self::LevenbergMarquardt(settings) => &mut settings.epochs_max,
        }
    }
}

impl Default for TrainerSettings {
    fn default() -> Self {
        Self::LevenbergMarquardt(LevenbergMarquardtSettings::default())
    }
}

impl From<LevenbergMarquardtSettings> for TrainerSettings {
    fn from(settings: LevenbergMarquardtSettings) -> Self {
        Self::LevenbergMarquardt(settings)
    }
}
