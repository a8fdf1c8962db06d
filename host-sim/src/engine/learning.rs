//! Learning cycles: collecting samples, training inner networks, switching them in.
//!
//! A cycle collects `(x_hat, d/dt x_hat)` of its agents over a window, copies the outer weights at
//! the end of the window, and switches the trained network in at the configured time. Training
//! takes no simulated time. Further cycles start by themselves if the scenario says so, when agents broadcast far more
//! often than after the last switch. All jobs that are ready run in parallel, each with its own seed, so the
//! result does not depend on the number of threads.

use std::ops::ControlFlow;

use agent_core::Tick;
use agent_core::agent::capture::{Sample, is_due};
use agent_core::package::Serial;
use rayon::prelude::*;

use super::failure::training_error;
use super::run_observer::Switch;
use super::{Progress, RunError, TrainingRecord};
use crate::flow::{FleetSamples, Plan, fleet_packages};
use crate::learning::trained::{INITIAL_VERSION, TrainedError, TrainingTask};
use crate::packages::recording::Observed;
use crate::packages::{PackageBytes, Recording, Timing};
use crate::scenario::{LearningCycle, Method, Relearning, Scenario, Time, Window};
use crate::training::{DataError, Dataset, EpochReport, StopReason};
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
    plan: Option<&'s Plan<'s>>,
    seed: u64,
    /// The scenario's cycles, and those that started by themselves.
    cycles: Vec<LearningCycle>,
    jobs: Vec<Job>,
    watch: Option<RateWatch>,
}

/// Compares the rate of broadcasts with that after the last switch.
struct RateWatch {
    rate: f64,
    /// Length of a window. \[steps\]
    window: Tick,
    /// Least time between two starts. \[steps\]
    pause: Tick,
    /// When the last cycle started by itself.
    started: Option<Tick>,
    /// First tick of the window.
    since: Tick,
    /// Broadcasts in it.
    count: u64,
    /// Windows since the last switch.
    windows: u32,
    /// Broadcasts in the [`Relearning::REFERENCES`] windows after the first one after the last switch.
    reference: u64,
    /// The least number of broadcasts in a window to compare with: one of each agent.
    least: u64,
    /// Windows above the rate, up to the last one.
    above: u32,
}

impl RateWatch {
    fn new(relearning: &Relearning, time: &Time, agents: usize) -> Self {
        Self {
            rate: relearning.rate,
            window: time.tick(relearning.window).max(1),
            pause: time.tick(relearning.pause),
            started: None,
            since: 0,
            count: 0,
            windows: 0,
            reference: 0,
            least: agents as u64,
            above: 0,
        }
    }

    /// Begins a window at `tick`.
    fn restart(&mut self, tick: Tick) {
        (self.since, self.count, self.above) = (tick, 0, 0);
    }

    /// Measures the reference again, with a new network.
    fn renew(&mut self) {
        (self.windows, self.reference) = (0, 0);
    }

    /// Counts broadcasts of the step at `tick`; returns whether a cycle is due.
    fn note(&mut self, tick: Tick, broadcasts: u64) -> bool {
        self.count += broadcasts;
        if tick + 1 < self.since.saturating_add(self.window) {
            return false;
        }
        let count = std::mem::take(&mut self.count);
        (self.since, self.windows) = (tick + 1, self.windows.saturating_add(1));
        match self.windows - 1 {
            // The observer settles.
            0 => {}
            1..=Relearning::REFERENCES => self.reference += count,
            _ => {
                let reference = self.reference as f64 / f64::from(Relearning::REFERENCES);
                let most = self.rate * reference.max(self.least as f64);
                self.above = if count as f64 > most { self.above + 1 } else { 0 };
            }
        }
        let rests = self.started.is_some_and(|start| tick + 1 < start.saturating_add(self.pause));
        self.above >= Relearning::ABOVE && !rests
    }
}

impl<'s> Learning<'s> {
    pub(super) fn new(scenario: &'s Scenario, plan: Option<&'s Plan<'s>>, seed: u64) -> Self {
        let cycles = scenario.learning.clone();
        let jobs = cycles.iter().enumerate();
        let jobs = jobs.flat_map(|(number, cycle)| jobs_of(number, cycle, &scenario.time));
        let jobs = jobs.collect();
        let watch = scenario.relearning.as_ref().filter(|_| !cycles.is_empty());
        let watch = watch
            .map(|relearning| RateWatch::new(relearning, &scenario.time, scenario.agents.len()));
        Self { scenario, plan, seed, cycles, jobs, watch }
    }

    /// Returns the scenario's cycles, and those that started by themselves.
    pub(super) fn into_cycles(self) -> Vec<LearningCycle> {
        self.cycles
    }

    /// Whether the rate of broadcasts can start a cycle.
    pub(super) fn watches_rate(&self) -> bool {
        self.watch.is_some()
    }

    /// Notes how many agents broadcast in the step at `tick`; this may start another learning cycle.
    pub(super) fn note_broadcasts(&mut self, tick: Tick, broadcasts: u64) {
        let Some(watch) = &mut self.watch else { return };
        let is_before_field = self.plan.is_some_and(|plan| tick < plan.starts_at());
        if is_before_field || self.jobs.iter().any(|job| job.apply_at > tick) {
            return watch.restart(tick + 1);
        }
        if !watch.note(tick, broadcasts) {
            return;
        }
        let (time, Some(last)) = (&self.scenario.time, self.cycles.last()) else { return };
        let from = time.at(tick + 1);
        let to = from + (last.collect.to - last.collect.from);
        let apply_at = to + (last.apply_at - last.collect.to);
        let cycle = LearningCycle { collect: Window { from, to }, apply_at, ..last.clone() };
        if time.tick(apply_at) >= self.scenario.steps() {
            return;
        }
        watch.started = Some(tick + 1);
        self.jobs.extend(jobs_of(self.cycles.len(), &cycle, time));
        self.cycles.push(cycle);
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
            let Self { scenario, plan, seed, cycles, jobs, .. } = self;
            let jobs: Vec<&mut Job> = jobs.iter_mut().filter(ready).collect();
            let context = Context { scenario, plan: *plan, cycles, seed: *seed, progress };
            records = groups(cycles, jobs)
                .into_par_iter()
                .map(|group| train(&context, group))
                // Collect all results, so that the error of the first job is reported.
                .collect::<Vec<_>>()
                .into_iter()
                .collect::<Result<Vec<_>, _>>()?
                .concat();
        }
        let due = self.jobs.iter().filter(|job| job.apply_at == tick);
        let switches = due.filter_map(|job| {
            Some(Switch { agent: job.agent, package: job.package.clone()?, back: false })
        });
        let switches: Vec<Switch> = switches.collect();
        if let Some(watch) = self.watch.as_mut().filter(|_| !switches.is_empty()) {
            watch.renew();
        }
        Ok((switches, records))
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
        sample: impl Fn(usize) -> Option<(Tick, Sample<N>)>,
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
            let stride = self.cycles[job.cycle].stride;
            if is_due(tick, stride)
                && let Some((own_tick, sample)) = sample(job.agent)
            {
                let distance = job.last.replace(tick).map_or(0, |last| tick - last);
                let missing = (distance / Tick::from(stride.get())).saturating_sub(1);
                if missing > 0 {
                    job.gaps.push((job.targets.len() / N, missing));
                }
                job.first.get_or_insert(tick);
                job.inputs.extend(sample.estimate.iter().map(|&x| f64::from(x)));
                // The agent's network took them by its own clock.
                let known = self.scenario.plant.known_inputs(self.scenario.time.at(own_tick));
                job.inputs.extend(known.iter().map(|&u| f64::from(u as f32)));
                job.targets.extend(sample.derivative.iter().map(|&x| f64::from(x)));
            }
            if tick + 1 == job.collect_to {
                job.outer_weights = Some(outer_weights(job.agent));
            }
        }
    }
}

/// Returns the jobs of a cycle with this number, from 0.
fn jobs_of<'c>(
    number: usize,
    cycle: &'c LearningCycle,
    time: &Time,
) -> impl Iterator<Item = Job> + use<'c> {
    let [collect_from, collect_to, apply_at] =
        [cycle.collect.from, cycle.collect.to, cycle.apply_at].map(|at| time.tick(at));
    cycle.agents.iter().map(move |&agent| Job {
        cycle: number,
        agent,
        collect_from,
        collect_to,
        apply_at,
        inputs: Vec::new(),
        targets: Vec::new(),
        gaps: Vec::new(),
        last: None,
        first: None,
        outer_weights: None,
        observation: Observation::default(),
        trained: false,
        package: None,
    })
}

/// What training a job needs besides the job.
struct Context<'c> {
    scenario: &'c Scenario,
    plan: Option<&'c Plan<'c>>,
    cycles: &'c [LearningCycle],
    seed: u64,
    progress: &'c dyn Progress,
}

/// Returns the jobs that are trained together: those of a shared cycle, and every other one alone.
fn groups<'j>(cycles: &[LearningCycle], jobs: Vec<&'j mut Job>) -> Vec<Vec<&'j mut Job>> {
    let mut groups: Vec<Vec<&mut Job>> = Vec::new();
    for job in jobs {
        let is_shared = cycles[job.cycle].is_shared;
        match groups.last_mut().filter(|group| is_shared && group[0].cycle == job.cycle) {
            Some(group) => group.push(job),
            None => groups.push(vec![job]),
        }
    }
    groups
}

/// Trains one network for a group of jobs and packs it for each.
fn train(context: &Context<'_>, mut group: Vec<&mut Job>) -> Result<Vec<TrainingRecord>, RunError> {
    let Context { scenario, plan, cycles, seed, progress } = *context;
    let (cycle, agent) = (group[0].cycle, group[0].agent);
    let failed = |error: TrainedError| training_error(scenario, agent + 1, cycle + 1, error);
    let description = &cycles[cycle];
    let recipe = scenario
        .recipe(&description.recipe)
        .ok_or_else(|| RunError::Recipe { cycle: cycle + 1, recipe: description.recipe.clone() })?;
    let network = scenario.network.as_ref().ok_or(RunError::NoNetwork { cycle: cycle + 1 })?;
    let recordings: Vec<Recording> = group
        .iter_mut()
        .map(|job| recording(scenario, description, job))
        .collect::<Result<_, _>>()
        .map_err(failed)?;
    let serial_plan = plan;
    let plan = plan.filter(|plan| scenario.time.tick(description.apply_at) >= plan.starts_at());
    let agents: Vec<usize> = group.iter().map(|job| job.agent).collect();
    let samples = FleetSamples::new(plan, &agents, &recordings)
        .ok_or_else(|| failed(DataError::TooFewSamples { found: 0, needed: 1 }.into()))?;
    let FleetSamples { recording, harmonics } = &samples;
    let members: Vec<_> = agents
        .iter()
        .map(|&agent| (agent, serial(scenario, serial_plan, agent, (cycle, description))))
        .collect();
    let packages = |trained: &PackageBytes| {
        fleet_packages(scenario, plan, harmonics, trained, &members).map_err(RunError::Observer)
    };
    let Serial { epoch, version } = serial(scenario, serial_plan, agent, (cycle, description));
    let task = TrainingTask { scenario, network, recipe, agent, cycle, seed, epoch, version };
    if scenario.method == Method::Regression {
        let fitted = task.fit_polynomials(recording).map_err(failed)?;
        for (job, package) in group.into_iter().zip(packages(&fitted)?) {
            job.trained = true;
            job.package = Some(package);
        }
        return Ok(Vec::new());
    }
    let mut report_epoch = |epoch: &EpochReport| {
        progress.epoch(agent + 1, cycle + 1, epoch);
        if progress.is_stopped() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    };
    let trained = task.carry_out(recording, &mut report_epoch).map_err(failed)?;
    if trained.report.stop == StopReason::Callback {
        return Err(RunError::Interrupted);
    }
    let mut records = Vec::with_capacity(group.len());
    let packages = packages(&trained.package)?;
    let parts = group.into_iter().zip(recordings).zip(packages);
    for (place, ((job, recording), package)) in parts.enumerate() {
        job.trained = true;
        job.package = trained.accepted.then(|| package.clone());
        let of_this = |warning: &Warning| {
            let text = format!("agent {}, cycle {}: {}", job.agent + 1, cycle + 1, warning.text);
            Warning::new(warning.code, text)
        };
        // Warnings about a shared network are given once.
        let warnings = if place == 0 { &trained.warnings[..] } else { &[] };
        records.push(TrainingRecord {
            agent: job.agent + 1,
            cycle: cycle + 1,
            started_at: (cycle >= scenario.learning.len()).then_some(description.collect.from),
            samples: trained.samples,
            harmonics: harmonics.clone(),
            report: trained.report.clone(),
            quality: trained.quality,
            switched_in: trained.accepted,
            warnings: warnings.iter().map(of_this).collect(),
            package,
            recording: scenario.record.samples.then_some(recording),
        });
    }
    Ok(records)
}

/// Takes a job's samples.
fn recording(
    scenario: &Scenario,
    description: &LearningCycle,
    job: &mut Job,
) -> Result<Recording, TrainedError> {
    let inputs = std::mem::take(&mut job.inputs);
    let targets = std::mem::take(&mut job.targets);
    let known = scenario.plant.input_names().len();
    let samples = Dataset::with_known_inputs(scenario.dimension(), known, inputs, targets)?;
    let stride = Tick::from(description.stride.get());
    let first = job.first.unwrap_or_else(|| job.collect_from.next_multiple_of(stride));
    let (gaps, missing) = std::mem::take(&mut job.gaps).into_iter().unzip();
    Ok(Recording {
        samples,
        gaps,
        start: scenario.time.at(first),
        interval: scenario.time.step_size * stride as f64,
        timing: Timing { missing, ..Timing::default() },
        outer_weights: job.outer_weights.clone(),
        observed: job.observation.observed(scenario.time.step_size),
    })
}

/// Returns the serial of an agent's package of a cycle: above the package before, in the next epoch if
/// there are no versions left.
fn serial(
    scenario: &Scenario,
    plan: Option<&Plan<'_>>,
    agent: usize,
    (cycle, description): (usize, &LearningCycle),
) -> Serial {
    let before = scenario.agents[agent].package.as_ref();
    let initial = Serial { epoch: 0, version: INITIAL_VERSION };
    let before = before.map_or(initial, |package| package.package().serial());
    // The switch to the field observer may have taken one.
    let apply_at = scenario.time.tick(description.apply_at);
    let is_after = plan.is_some_and(|plan| (1..apply_at).contains(&plan.starts_at()));
    let count = u32::try_from(cycle + 1 + usize::from(is_after)).unwrap_or(u32::MAX);
    match before.version.checked_add(count) {
        Some(version) => Serial { version, ..before },
        None => Serial { epoch: before.epoch.saturating_add(1), version: count },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plant::Integrator;

    /// Returns the windows, from 1, at whose end a cycle is due.
    fn due(counts: &[u64], pause: f64) -> Vec<usize> {
        let time = Time { duration: 100.0, step_size: 0.5, integrator: Integrator::Euler };
        let relearning = Relearning { rate: 2.0, window: 1.0, pause };
        let mut watch = RateWatch::new(&relearning, &time, 2);
        let mut found = Vec::new();
        for (window, &count) in counts.iter().enumerate() {
            for (step, broadcasts) in [count / 2, count - count / 2].into_iter().enumerate() {
                let tick = (2 * window + step) as Tick;
                if watch.note(tick, broadcasts) {
                    watch.started = Some(tick + 1);
                    found.push(window + 1);
                }
            }
        }
        found
    }

    #[test]
    fn a_cycle_is_due_after_two_windows_above_the_rate() {
        // The first window does not count; 10 in each of the next three.
        assert_eq!(due(&[99, 9, 10, 11, 21, 20, 21, 22, 9], 1.0), [8]);
        // Twice as many are not more.
        assert!(due(&[0, 10, 10, 10, 20, 20, 20, 20], 1.0).is_empty());
        // Both agents may broadcast once in a window.
        assert_eq!(due(&[0, 0, 0, 0, 4, 4, 4, 5, 5], 1.0), [9]);
    }

    #[test]
    fn a_pause_delays_the_next_cycle() {
        let counts = [0, 1, 1, 1, 9, 9, 9, 9, 9, 9, 9];
        assert_eq!(due(&counts, 0.5), [6, 7, 8, 9, 10, 11]);
        assert_eq!(due(&counts, 3.0), [6, 9]);
    }
}
