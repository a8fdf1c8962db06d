//! Trains a package on recorded samples, from a simulated agent's learning cycle or from a file.

use std::ops::ControlFlow;
use std::sync::atomic::AtomicBool;

use agent_core::package::{OnSwitch, TrainingErrors};

use super::agent_config::agent_config;
use super::cleaning::{Cleaned, Cleaning};
use super::judgement::{Samples, judgement};
use super::promise::trial_limits;
use super::quality::{Fit, LAST_SHARE, Quality, estimates, explained, mean_squared_error};
use crate::analysis::TriggerConstants;
use crate::basis::Polynomial;
use crate::packages::{Draft, DraftError, PackageBytes, Recording};
use crate::scenario::{Network, Recipe, Scenario, SwitchIn};
use crate::training::data::divide_at_random;
use crate::training::{
    self, DataError, Dataset, EpochReport, Scaling, SmoothingError, TrainingError, TrainingReport,
};
use crate::warning::Warning;

/// A training task.
#[derive(Clone, Copy, Debug)]
pub struct TrainingTask<'s> {
    /// The scenario that describes agent and network.
    pub scenario: &'s Scenario,
    /// Its network.
    pub network: &'s Network,
    /// How to train.
    pub recipe: &'s Recipe,
    /// The agent, from 0.
    pub agent: usize,
    /// The learning cycle, from 0, which contributes to the training's seed.
    pub cycle: usize,
    /// Seed of the run.
    pub seed: u64,
    /// Epoch of the package.
    pub epoch: u32,
    /// Version of the package.
    pub version: u32,
}

/// A task with its samples, ready for training.
#[derive(Debug)]
pub struct Prepared<'t, 's> {
    task: &'t TrainingTask<'s>,
    recording: &'t Recording,
    cleaned: Cleaned,
    /// `W_hat` that the network is trained for, row-major, shape `[L, n]`.
    outer_weights: Vec<f32>,
    /// Scaling derived from the training samples.
    scaling: Scaling,
    /// Warnings about the samples.
    pub warnings: Vec<Warning>,
}

/// A trained package and its training results.
#[derive(Clone, Debug)]
pub struct Trained {
    /// The package.
    pub package: PackageBytes,
    /// Number of samples after cleaning and decimation.
    pub samples: usize,
    /// Length of the averaging window, 0 for none. \[s\]
    pub smoothing_window: f64,
    /// Decimation: one in this many averages was used.
    pub decimation: usize,
    /// What cleaning skipped.
    pub cleaning: Cleaning,
    /// The course of the training.
    pub report: TrainingReport,
    /// How well the network in the package fits the samples.
    pub quality: Quality,
    /// Whether to use the network: it explains something ([`Quality::explains`]), or the recipe
    /// sets `switch_in = "always"`.
    pub accepted: bool,
    /// Warnings about samples and network.
    pub warnings: Vec<Warning>,
}

/// Why training failed.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum TrainedError {
    /// The samples cannot be cleaned.
    #[error("cannot smooth the samples: {0}; record more, or shorten smoothing_window")]
    Smoothing(#[from] SmoothingError),
    /// The network cannot be trained.
    #[error("{0}; change the samples or the recipe")]
    Training(#[from] TrainingError),
    /// The trained network cannot be packed.
    #[error("{0}")]
    Draft(#[from] DraftError),
    /// The trained network cannot be packed because of the samples' magnitude.
    #[error("{error}; the largest value in the samples is {largest:.0e}: {}", unit(*largest))]
    Size {
        /// Why it cannot be packed.
        error: DraftError,
        /// The largest magnitude in the samples.
        largest: f64,
    },
    /// Polynomials cannot be fitted.
    #[error("the samples do not determine the polynomials; record more, or more varied ones")]
    LeastSquares,
    /// The error of the trained network is not finite.
    #[error(
        "the mean squared error of the trained network is {error}, so it is unusable; the largest value \
         in the samples is {largest:.0e}: {}",
        unit(*largest)
    )]
    NotFinite {
        /// The error.
        error: f64,
        /// The largest magnitude in the samples.
        largest: f64,
    },
}

impl TrainedError {
    /// Returns the largest magnitude in the samples, if it is too large to train with.
    pub(crate) fn too_large(&self) -> Option<f64> {
        match *self {
            Self::Size { largest, .. } | Self::NotFinite { largest, .. } => {
                Some(largest).filter(|largest| largest > SIZES.end())
            }
            _ => None,
        }
    }
}

/// Magnitudes whose squares single precision can represent.
const SIZES: std::ops::RangeInclusive<f64> = 1e-15..=1e15;

/// Returns advice for samples of this largest magnitude.
fn unit(largest: f64) -> &'static str {
    if largest < *SIZES.start() {
        "use a smaller unit for the samples, so that values are about 1"
    } else if largest > *SIZES.end() {
        "use a larger unit for the samples, so that values are about 1"
    } else {
        "train with less noise, for fewer training epochs or with another seed"
    }
}

impl From<DataError> for TrainedError {
    fn from(error: DataError) -> Self {
        Self::Training(error.into())
    }
}

impl<'s> TrainingTask<'s> {
    /// Cleans and checks the samples. If the recording has no outer weights, those of the scenario
    /// are used.
    ///
    /// # Errors
    /// If the samples cannot be cleaned or divided.
    pub fn prepare<'t>(
        &'t self,
        recording: &'t Recording,
    ) -> Result<Prepared<'t, 's>, TrainedError> {
        let cleaned = Cleaned::new(recording, self.recipe)?;
        let outer_weights = match &recording.outer_weights {
            Some(recorded) => recorded.clone(),
            None => self.network.outer.iter().map(|&w| w as f32).collect(),
        };
        let train = cleaned.data.divide(self.recipe.split, self.task_seed())?.train;
        let scaling = Scaling::of(&train);
        let warnings = Samples {
            train: &train,
            scaling: &scaling,
            outer_weights: &outer_weights,
            input_names: &self.scenario.plant.input_names(),
            parameters: self.network.architecture.parameter_count(),
            window: cleaned.window,
            period: cleaned.period,
        }
        .warnings();
        Ok(Prepared { task: self, recording, cleaned, outer_weights, scaling, warnings })
    }

    /// Fits polynomials to the samples by least squares instead of training the network, and returns a
    /// package with the scenario's placeholder for them.
    ///
    /// # Errors
    /// If the samples cannot be cleaned, or the least squares have no solution.
    pub fn fit_polynomials(&self, recording: &Recording) -> Result<PackageBytes, TrainedError> {
        let cleaned = self.prepare(recording)?.cleaned;
        let (low, high) = limits(&recording.samples);
        let fitted = Polynomial::new(&low, &high).fit(&cleaned.data);
        let outer_weights = fitted.ok_or(TrainedError::LeastSquares)?;
        let trigger = TriggerConstants::new(self.scenario);
        let inner = vec![0.0; self.network.architecture.parameter_count()];
        let initial =
            initial(self.scenario, &trigger, self.network, &inner, self.agent, self.seed)?;
        let mut draft = Draft::copy(&initial.package());
        (draft.epoch, draft.version) = (self.epoch, self.version);
        (draft.on_switch, draft.outer_weights) = (OnSwitch::Replace, outer_weights);
        (draft.low, draft.high) = (low, high);
        draft.samples = u32::try_from(cleaned.data.len()).unwrap_or(u32::MAX);
        Ok(draft.seal()?)
    }

    /// Prepares the samples and trains.
    ///
    /// # Errors
    /// See [`TrainedError`].
    pub fn carry_out(
        &self,
        recording: &Recording,
        progress: &mut dyn FnMut(&EpochReport) -> ControlFlow<()>,
    ) -> Result<Trained, TrainedError> {
        self.prepare(recording)?.carry_out(progress)
    }

    /// Returns a distinct seed for every agent and cycle of a run: the run's seed mixed with both,
    /// so that neighbouring tasks get very different seeds.
    fn task_seed(&self) -> u64 {
        let place = (self.cycle as u64) << 32 | self.agent as u64;
        self.seed ^ place.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15)
    }
}

impl Prepared<'_, '_> {
    /// Trains and packs the network, and evaluates it as packed. `progress` can stop the training,
    /// which keeps the best network so far.
    ///
    /// # Errors
    /// See [`TrainedError`].
    pub fn carry_out(
        self,
        progress: &mut dyn FnMut(&EpochReport) -> ControlFlow<()>,
    ) -> Result<Trained, TrainedError> {
        self.carry_out_until(progress, None)
    }

    /// Like [`Self::carry_out`], but training also stops within an epoch once `stop` is true.
    ///
    /// # Errors
    /// See [`TrainedError`].
    pub fn carry_out_until(
        mut self,
        progress: &mut dyn FnMut(&EpochReport) -> ControlFlow<()>,
        stop: Option<&'static AtomicBool>,
    ) -> Result<Trained, TrainedError> {
        let task = self.task;
        let outer: Vec<f64> = self.outer_weights.iter().map(|&w| f64::from(w)).collect();
        let (parameters, report) = training::train_inner_network_until(
            &task.network.architecture,
            &outer,
            &self.cleaned.data,
            &task.recipe.settings(),
            task.task_seed(),
            progress,
            stop,
        )?;
        let (low, high) = limits(&self.recording.samples);
        let trigger = TriggerConstants::new(task.scenario);
        let interval_min = interval_bound(task.scenario, &trigger, self.recording);
        let mut draft = Draft {
            epoch: task.epoch,
            version: task.version,
            on_switch: OnSwitch::Keep,
            architecture: task.network.architecture.clone(),
            known_inputs: task.scenario.known_inputs_of(task.network),
            inner: parameters.iter().map(|&p| p as f32).collect(),
            outer_weights: std::mem::take(&mut self.outer_weights),
            node: agent_config(task.scenario, &trigger, task.agent),
            broadcast_interval_min: interval_min,
            low,
            high,
            trial: trial_limits(
                self.recording.observed.as_ref(),
                interval_min,
                task.scenario.time.step_size,
            ),
            scenario_hash: task.scenario.hash,
            recipe: task.recipe.name.clone(),
            seed: task.seed,
            samples: u32::try_from(self.cleaned.data.len()).unwrap_or(u32::MAX),
            errors: None,
        };
        // The reported quality is that of the packed network, in single precision.
        let quality = self.quality(&draft.seal().map_err(|error| self.packing_error(error))?)?;
        let held_out = quality.test.or(quality.validation);
        draft.errors = held_out.and_then(|held_out| {
            let (training, held_out) = (quality.training.error as f32, held_out.error as f32);
            let errors = TrainingErrors { training, held_out };
            errors.is_finite().then_some(errors)
        });
        let accepted = quality.explains() || task.recipe.switch_in == SwitchIn::Always;
        let mut warnings = self.warnings;
        warnings.extend(judgement(&quality, accepted, &task.recipe.name));
        Ok(Trained {
            package: draft.seal()?,
            samples: self.cleaned.data.len(),
            smoothing_window: self.cleaned.window,
            decimation: self.cleaned.stride,
            cleaning: self.cleaned.cleaning,
            report,
            quality,
            accepted,
            warnings,
        })
    }

    /// Converts the error of packing the trained network.
    fn packing_error(&self, error: DraftError) -> TrainedError {
        let largest = largest(&self.recording.samples);
        match error {
            _ if SIZES.contains(&largest) => TrainedError::Draft(error),
            error => TrainedError::Size { error, largest },
        }
    }

    /// Returns the quality of the network in `package` on its samples.
    fn quality(&self, package: &PackageBytes) -> Result<Quality, TrainedError> {
        let (data, judged) = (&self.cleaned.data, &self.cleaned.judged);
        let parts = divide_at_random(data.len(), self.task.recipe.split, self.task.task_seed())?;
        let fit = |part: &Vec<usize>| -> Option<Fit> {
            let samples = data.select(part)?;
            let error = mean_squared_error(&samples, &estimates(package, &samples));
            let mut chosen = vec![false; data.len()];
            part.iter().for_each(|&row| chosen[row] = true);
            let explained = self.cleaned.judged_in(&chosen).and_then(|samples| {
                explained(&samples, &estimates(package, &samples), &self.scaling)
            });
            Some(Fit { error, explained })
        };
        let [training, validation, test] = parts.each_ref().map(fit);
        let training = training.ok_or(DataError::TooFewSamples { found: 0, needed: 1 })?;
        if !training.error.is_finite() {
            let largest = largest(&self.recording.samples);
            return Err(TrainedError::NotFinite { error: training.error, largest });
        }
        let last = judged.select(&last_rows(judged.len()));
        let last = last
            .and_then(|samples| explained(&samples, &estimates(package, &samples), &self.scaling));
        Ok(Quality { training, validation, test, last })
    }
}

/// Returns the last [`LAST_SHARE`] of `count` rows, at least one.
#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "between 0 and count")]
fn last_rows(count: usize) -> Vec<usize> {
    let last = (count as f64 * LAST_SHARE).ceil() as usize;
    (count - last.clamp(1, count)..count).collect()
}

/// Returns the initial package of agent `index`, from 0: the scenario's untrained network, whose
/// trained box is unlimited.
///
/// # Errors
/// See [`DraftError`].
pub fn initial(
    scenario: &Scenario,
    trigger: &TriggerConstants,
    network: &Network,
    inner: &[f32],
    index: usize,
    seed: u64,
) -> Result<PackageBytes, DraftError> {
    let inputs = network.architecture.inputs();
    let draft = Draft {
        epoch: 0,
        version: INITIAL_VERSION,
        on_switch: OnSwitch::Keep,
        architecture: network.architecture.clone(),
        known_inputs: scenario.known_inputs_of(network),
        inner: inner.to_vec(),
        outer_weights: network.outer.iter().map(|&w| w as f32).collect(),
        node: agent_config(scenario, trigger, index),
        broadcast_interval_min: 0.0,
        low: vec![f32::MIN; inputs],
        high: vec![f32::MAX; inputs],
        trial: None,
        scenario_hash: scenario.hash,
        recipe: "initial".to_owned(),
        seed,
        samples: 0,
        errors: None,
    };
    draft.seal()
}

/// Version of an untrained package.
pub const INITIAL_VERSION: u32 = 1;

/// Returns the largest magnitude of all inputs and targets.
fn largest(samples: &Dataset) -> f64 {
    let values = samples.inputs().iter().chain(samples.targets());
    values.fold(0.0, |largest: f64, value| largest.max(value.abs()))
}

/// Returns the smallest and largest value of each input.
fn limits(samples: &Dataset) -> (Vec<f32>, Vec<f32>) {
    let n = samples.width();
    let column = |i: usize| samples.inputs().iter().skip(i).step_by(n);
    let low = |i| column(i).fold(f64::INFINITY, |low, &x| low.min(x)) as f32;
    let high = |i| column(i).fold(f64::NEG_INFINITY, |high, &x| high.max(x)) as f32;
    ((0..n).map(low).collect(), (0..n).map(high).collect())
}

/// Returns the bound of Theorem 2 on the recorded trajectory: the hold error grows from 0 to the
/// trigger's radius, no faster than the estimate moves. Returns 0 (not known) where the theorem
/// does not apply, or unless every step was recorded, because faster ones may be missing. \[s\]
fn interval_bound(scenario: &Scenario, trigger: &TriggerConstants, recording: &Recording) -> f32 {
    let every_step = recording.interval < 1.5 * scenario.time.step_size;
    let applies = scenario.trigger.departure().is_none() && scenario.departures().is_empty();
    let samples = &recording.samples;
    let rates = samples.targets().chunks_exact(samples.dimension());
    let rate_squared = rates
        .map(|rate| rate.iter().fold(0.0, |sum, r| sum + r * r))
        .fold(0.0, |largest: f64, rate| largest.max(rate));
    let bound = (trigger.radius() / rate_squared.sqrt()) as f32;
    if applies && every_step && bound.is_finite() { bound } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::packages::Timing;
    use crate::scenario::PAPER;

    #[test]
    fn samples_of_unsuitable_magnitude_are_reported() {
        let scenario = Scenario::parse("paper.toml", PAPER).unwrap();
        let network = scenario.network.as_ref().unwrap();
        let mut recipe = scenario.recipe("better").unwrap().clone();
        *recipe.trainer.epochs_max_mut() = 2;
        let task = TrainingTask {
            scenario: &scenario,
            network,
            recipe: &recipe,
            agent: 0,
            cycle: 0,
            seed: 0,
            epoch: 0,
            version: 2,
        };
        let values = |shift: f64| -> Vec<f64> {
            (0..3000).map(|s| 1e-42 * libm::sin(0.01 * f64::from(s) + shift)).collect()
        };
        let recording = Recording {
            samples: Dataset::new(3, values(0.0), values(1.0)).unwrap(),
            gaps: Vec::new(),
            start: 0.0,
            interval: 1e-3,
            timing: Timing::default(),
            outer_weights: None,
            observed: None,
        };
        let error = task.carry_out(&recording, &mut |_| ControlFlow::Continue(())).unwrap_err();
        let message = error.to_string();
        assert!(
            message
                .ends_with("1e-42: use a smaller unit for the samples, so that values are about 1"),
            "{message}"
        );
        assert!(unit(1e37).contains("a larger unit") && unit(1.0).contains("less noise"));
    }
}
