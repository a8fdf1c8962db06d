//! From recorded samples to a package: the same way for a simulated agent's learning cycle and
//! for a file of samples from anywhere.

use std::ops::ControlFlow;

use agent_core::package::{OnSwitch, TrainingErrors};

use super::{Draft, DraftError, NodeContent, PackageBytes, Recording};
use crate::analysis::TriggerConstants;
use crate::scenario::{Network, Recipe, Scenario};
use crate::training::{
    self, DataError, Dataset, EpochReport, SmoothingError, TrainingError, TrainingReport,
};

/// What is trained for whom.
#[derive(Clone, Copy, Debug)]
pub struct TrainingTask<'s> {
    /// The scenario that describes agent and network.
    pub scenario: &'s Scenario,
    /// Its network.
    pub network: &'s Network,
    /// How.
    pub recipe: &'s Recipe,
    /// The agent, from 0.
    pub agent: usize,
    /// The learning cycle, from 0: a part of the training's seed.
    pub cycle: usize,
    /// Seed of the run.
    pub seed: u64,
    /// Version of the package.
    pub version: u32,
}

/// A trained package and how it came about.
#[derive(Clone, Debug)]
pub struct Trained {
    /// The package.
    pub package: PackageBytes,
    /// Samples that were left after cleaning and decimation.
    pub samples: usize,
    /// How training went.
    pub report: TrainingReport,
}

/// Why there is no trained package.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum TrainedError {
    /// The samples cannot be cleaned.
    #[error("the samples cannot be smoothed: {0}; record more, or shorten smoothing_window")]
    Smoothing(#[from] SmoothingError),
    /// The network cannot be trained.
    #[error("{0}; change samples or recipe")]
    Training(#[from] TrainingError),
    /// The trained network does not become a package.
    #[error("{0}")]
    Draft(#[from] DraftError),
}

impl From<DataError> for TrainedError {
    fn from(error: DataError) -> Self {
        Self::Training(error.into())
    }
}

impl TrainingTask<'_> {
    /// Smoothed and decimated samples; what is shorter than the smoothing window between two gaps
    /// is left out.
    fn cleaned(&self, recording: &Recording) -> Result<Dataset, TrainedError> {
        let smoothing = self.recipe.smoothing();
        let (mut inputs, mut targets, mut refused) = (Vec::new(), Vec::new(), None);
        for piece in recording.pieces() {
            match smoothing.apply(&piece, recording.interval) {
                Ok(data) => {
                    inputs.extend_from_slice(data.inputs());
                    targets.extend_from_slice(data.targets());
                }
                Err(error) => refused = Some(error),
            }
        }
        match refused {
            Some(error) if inputs.is_empty() => Err(error.into()),
            _ => Ok(Dataset::new(recording.samples.dimension(), inputs, targets)?),
        }
    }

    /// Cleans the samples, trains and packs; outer weights that the recording does not tell are the
    /// scenario's. `progress` can end the training with the best
    /// network so far.
    ///
    /// # Errors
    /// See [`TrainedError`].
    pub fn carry_out(
        &self,
        recording: &Recording,
        progress: &mut dyn FnMut(&EpochReport) -> ControlFlow<()>,
    ) -> Result<Trained, TrainedError> {
        let data = self.cleaned(recording)?;
        let outer_weights = match &recording.outer_weights {
            Some(recorded) => recorded.clone(),
            None => self.network.outer.iter().map(|&w| w as f32).collect(),
        };
        let outer: Vec<f64> = outer_weights.iter().map(|&w| f64::from(w)).collect();
        let (parameters, report) = training::train_inner_network(
            &self.network.architecture,
            &outer,
            &data,
            &self.recipe.settings(),
            task_seed(self.seed, self.cycle, self.agent),
            progress,
        )?;
        let errors = report.best().and_then(|best| {
            let held_out = best.test.or(best.validation)? as f32;
            let errors = TrainingErrors { training: best.train as f32, held_out };
            errors.is_finite().then_some(errors)
        });
        let (low, high) = limits(&recording.samples);
        let trigger = TriggerConstants::new(self.scenario);
        let draft = Draft {
            version: self.version,
            replaces: None,
            on_switch: OnSwitch::Keep,
            architecture: self.network.architecture.clone(),
            inner: parameters.iter().map(|&p| p as f32).collect(),
            outer_weights,
            node: NodeContent::new(self.scenario, &trigger, self.agent),
            broadcast_interval_min: interval_bound(self.scenario, &trigger, recording),
            low,
            high,
            scenario_hash: self.scenario.hash,
            recipe: self.recipe.name.clone(),
            seed: self.seed,
            samples: u32::try_from(data.len()).unwrap_or(u32::MAX),
            errors,
        };
        Ok(Trained { package: draft.seal()?, samples: data.len(), report })
    }
}

/// The package that agent `index` (from 0) starts with: the scenario's own network, not trained
/// on anything, and so without limits to what it may be asked.
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
    let n = scenario.dimension();
    let draft = Draft {
        version: INITIAL_VERSION,
        replaces: None,
        on_switch: OnSwitch::Keep,
        architecture: network.architecture.clone(),
        inner: inner.to_vec(),
        outer_weights: network.outer.iter().map(|&w| w as f32).collect(),
        node: NodeContent::new(scenario, trigger, index),
        broadcast_interval_min: 0.0,
        low: vec![f32::MIN; n],
        high: vec![f32::MAX; n],
        scenario_hash: scenario.hash,
        recipe: "initial".to_owned(),
        seed,
        samples: 0,
        errors: None,
    };
    draft.seal()
}

/// Version of a package that was not trained.
pub const INITIAL_VERSION: u32 = 1;

/// A seed of its own for every agent in every cycle of a run: the run's seed and the place of
/// the task, mixed so that neighbouring tasks start far apart.
fn task_seed(seed: u64, cycle: usize, agent: usize) -> u64 {
    let place = (cycle as u64) << 32 | agent as u64;
    seed ^ place.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15)
}

/// Least and largest value of each input.
fn limits(samples: &Dataset) -> (Vec<f32>, Vec<f32>) {
    let n = samples.dimension();
    let column = |i: usize| samples.inputs().iter().skip(i).step_by(n);
    let low = |i| column(i).fold(f64::INFINITY, |low, &x| low.min(x)) as f32;
    let high = |i| column(i).fold(f64::NEG_INFINITY, |high, &x| high.max(x)) as f32;
    ((0..n).map(low).collect(), (0..n).map(high).collect())
}

/// Theorem 2 on the recorded trajectory: the hold error has to grow from 0 to the trigger's
/// radius, and grows no faster than the estimate moves. 0, for not known, if not every step was
/// recorded: a faster one may lie in between. \[s\]
fn interval_bound(scenario: &Scenario, trigger: &TriggerConstants, recording: &Recording) -> f32 {
    let every_step = recording.interval < 1.5 * scenario.time.step_size;
    let samples = &recording.samples;
    let rates = samples.targets().chunks_exact(samples.dimension());
    let rate_squared = rates
        .map(|rate| rate.iter().fold(0.0, |sum, r| sum + r * r))
        .fold(0.0, |largest: f64, rate| largest.max(rate));
    let bound = (trigger.radius() / rate_squared.sqrt()) as f32;
    if every_step && bound.is_finite() { bound } else { 0.0 }
}
