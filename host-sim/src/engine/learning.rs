//! Learning cycles: collecting samples, training inner networks, switching them in.
//!
//! A cycle collects `(x_hat, d/dt x_hat)` of its agents over a window, copies the outer weights at
//! the end of the window, and switches the trained network in at the configured time. Training
//! takes no simulated time. All jobs that are ready run in parallel, each with its own seed, so the
//! result does not depend on the number of threads.

use std::ops::ControlFlow;

use agent_core::Tick;
use agent_core::agent::capture::{Sample, is_due};
use agent_core::package::Serial;
use rayon::prelude::*;

use super::run_observer::Switch;
use super::{Progress, RunError, TrainingRecord};
use crate::learning::trained::{INITIAL_VERSION, TrainedError, TrainingTask};
use crate::packages::recording::Observed;
use crate::packages::{PackageBytes, Recording, Timing};
use crate::scenario::{LearningCycle, Scenario};
use crate::training::{Dataset, EpochReport};
use crate::warning::Warning;

/// The samples and the state of one agent in one cycle.
struct Job {
    cycle: usize,
    agent: usize,
    collect_from: Tick,
    collect_to: Tick,
    apply_at: Tick,
    inputs: Vec<f64>,
    targets: Vec<f64>,
    /// Number of samples before each gap, and in it.
    gaps: Vec<(usize, u64)>,
    /// When the last sample was taken.
    last: Option<Tick>,
    /// When the first one was.
    first: Option<Tick>,
    outer_weights: Option<Vec<f32>>,
    observation: Observation,
    trained: bool,
    /// The trained network, if accepted.
    package: Option<PackageBytes>,
}

/// What an agent did in steps of the last half of a window; sums in the order of the steps.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Observation {
    /// Sum of the squares of `e_3`.
    pub(super) squares: f64,
    /// Number of those squares.
    pub(super) outputs: u64,
    /// Number of broadcasts.
    pub(super) broadcasts: u64,
    /// Number of steps.
    pub(super) steps: u64,
}

impl Observation {
    fn add(&mut self, step: Self) {
        self.squares += step.squares;
        self.outputs += step.outputs;
        self.broadcasts += step.broadcasts;
        self.steps += step.steps;
    }

    /// Returns RMS and rate, for steps of this length \[s\]; `None` without a step.
    fn observed(&self, step_size: f64) -> Option<Observed> {
        (self.steps > 0 && self.outputs > 0).then(|| Observed {
            innovation_rms: (self.squares / self.outputs as f64).sqrt(),
            broadcasts_per_second: self.broadcasts as f64 / (self.steps as f64 * step_size),
        })
    }
}

/// All cycles of a run.
pub(super) struct Learning<'s> {
    scenario: &'s Scenario,
    seed: u64,
    jobs: Vec<Job>,
}

impl<'s> Learning<'s> {
    pub(super) fn new(scenario: &'s Scenario, seed: u64) -> Self {
        let time = &scenario.time;
        let job = |cycle: usize, description: &LearningCycle, agent: usize| Job {
            cycle,
            agent,
            collect_from: time.tick(description.collect.from),
            collect_to: time.tick(description.collect.to),
            apply_at: time.tick(description.apply_at),
            inputs: Vec::new(),
            targets: Vec::new(),
            gaps: Vec::new(),
            last: None,
            first: None,
            outer_weights: None,
            observation: Observation::default(),
            trained: false,
            package: None,
        };
        let jobs = scenario.learning.iter().enumerate();
        let jobs = jobs.flat_map(|(cycle, description)| {
            description.agents.iter().map(move |&agent| job(cycle, description, agent))
        });
        Self { scenario, seed, jobs: jobs.collect() }
    }

    /// Returns the packages to switch in before the step at `tick`. When one is due, trains all
    /// jobs whose samples are complete.
    pub(super) fn switches_due(
        &mut self,
        tick: Tick,
        progress: &dyn Progress,
    ) -> Result<(Vec<Switch>, Vec<TrainingRecord>), RunError> {
        let mut records = Vec::new();
        if self.jobs.iter().any(|job| job.apply_at == tick && !job.trained) {
            // An agent that was down while samples were collected has none.
            let ready = |job: &&mut Job| {
                job.outer_weights.is_some() && !job.trained && !job.inputs.is_empty()
            };
            let (scenario, seed) = (self.scenario, self.seed);
            let jobs: Vec<&mut Job> = self.jobs.iter_mut().filter(ready).collect();
            records = jobs
                .into_par_iter()
                .map(|job| train(scenario, seed, job, progress))
                // Collect all results, so that the error of the first job is reported.
                .collect::<Vec<_>>()
                .into_iter()
                .collect::<Result<_, _>>()?;
        }
        let due = self.jobs.iter().filter(|job| job.apply_at == tick);
        let switches = due.filter_map(|job| {
            Some(Switch { agent: job.agent, package: job.package.clone()?, back: false })
        });
        Ok((switches.collect(), records))
    }

    /// Returns agent, from 0, and cycle, from 0, of the jobs due at `tick` without any sample.
    pub(super) fn without_samples(&self, tick: Tick) -> impl Iterator<Item = (usize, usize)> + '_ {
        let without = move |job: &&Job| job.apply_at == tick && !job.trained;
        self.jobs.iter().filter(without).map(|job| (job.agent, job.cycle))
    }

    /// Collects `sample(i)` of each learning agent `i` in the step at `tick` and, at the end of a
    /// window, its outer weights.
    pub(super) fn collect<const N: usize>(
        &mut self,
        tick: Tick,
        sample: impl Fn(usize) -> Option<Sample<N>>,
        outer_weights: impl Fn(usize) -> Vec<f32>,
        observation: impl Fn(usize) -> Observation,
    ) {
        for job in &mut self.jobs {
            if !(job.collect_from..job.collect_to).contains(&tick) {
                continue;
            }
            let middle = job.collect_from + (job.collect_to - job.collect_from) / 2;
            if tick >= middle {
                job.observation.add(observation(job.agent));
            }
            let stride = self.scenario.learning[job.cycle].stride;
            if is_due(tick, stride)
                && let Some(sample) = sample(job.agent)
            {
                let distance = job.last.replace(tick).map_or(0, |last| tick - last);
                let missing = (distance / Tick::from(stride.get())).saturating_sub(1);
                if missing > 0 {
                    job.gaps.push((job.inputs.len() / sample.estimate.len(), missing));
                }
                job.first.get_or_insert(tick);
                job.inputs.extend(sample.estimate.iter().map(|&x| f64::from(x)));
                job.targets.extend(sample.derivative.iter().map(|&x| f64::from(x)));
            }
            if tick + 1 == job.collect_to {
                job.outer_weights = Some(outer_weights(job.agent));
            }
        }
    }
}

/// Trains one job's network and packs it.
fn train(
    scenario: &Scenario,
    seed: u64,
    job: &mut Job,
    progress: &dyn Progress,
) -> Result<TrainingRecord, RunError> {
    let (cycle, agent) = (job.cycle, job.agent);
    let failed =
        |error: TrainedError| RunError::Training { agent: agent + 1, cycle: cycle + 1, error };
    let description = &scenario.learning[cycle];
    let recipe = scenario
        .recipe(&description.recipe)
        .ok_or_else(|| RunError::Recipe { cycle: cycle + 1, recipe: description.recipe.clone() })?;
    let network = scenario.network.as_ref().ok_or(RunError::NoNetwork { cycle: cycle + 1 })?;
    let inputs = std::mem::take(&mut job.inputs);
    let targets = std::mem::take(&mut job.targets);
    let samples = Dataset::new(scenario.dimension(), inputs, targets)
        .map_err(|error| failed(error.into()))?;
    let stride = Tick::from(description.stride.get());
    let first = job.first.unwrap_or_else(|| job.collect_from.next_multiple_of(stride));
    let (gaps, missing) = std::mem::take(&mut job.gaps).into_iter().unzip();
    let recording = Recording {
        samples,
        gaps,
        start: scenario.time.at(first),
        interval: scenario.time.step_size * f64::from(description.stride.get()),
        timing: Timing { missing, ..Timing::default() },
        outer_weights: job.outer_weights.clone(),
        observed: job.observation.observed(scenario.time.step_size),
    };
    let before = scenario.agents[agent].package.as_ref();
    let initial = Serial { epoch: 0, version: INITIAL_VERSION };
    let before = before.map_or(initial, |package| package.package().serial());
    // Above the package before, in the next epoch if there are no versions left.
    let count = u32::try_from(cycle + 1).unwrap_or(u32::MAX);
    let Serial { epoch, version } = match before.version.checked_add(count) {
        Some(version) => Serial { version, ..before },
        None => Serial { epoch: before.epoch.saturating_add(1), version: count },
    };
    let task = TrainingTask { scenario, network, recipe, agent, cycle, seed, epoch, version };
    let mut report_epoch = |epoch: &EpochReport| {
        progress.epoch(agent + 1, cycle + 1, epoch);
        ControlFlow::Continue(())
    };
    let trained = task.carry_out(&recording, &mut report_epoch).map_err(failed)?;
    job.trained = true;
    job.package = trained.accepted.then(|| trained.package.clone());
    let of_this = |warning: Warning| {
        let text = format!("agent {}, cycle {}: {}", agent + 1, cycle + 1, warning.text);
        Warning::new(warning.code, text)
    };
    Ok(TrainingRecord {
        agent: agent + 1,
        cycle: cycle + 1,
        samples: trained.samples,
        report: trained.report,
        quality: trained.quality,
        switched_in: trained.accepted,
        warnings: trained.warnings.into_iter().map(of_this).collect(),
        package: trained.package,
        recording: scenario.record.samples.then_some(recording),
    })
}
