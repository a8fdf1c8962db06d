//! Training on recordings, outside a run: what the command `train` and the Python module do.
//!
//! One network is trained for one agent or several on the recordings of one or several, and packed for
//! each. Everything is checked before the training begins.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use agent_core::package::Serial;

use crate::analysis::TriggerConstants;
use crate::engine::RunError;
use crate::error::{ErrorCode, ErrorReport};
use crate::flow::{FleetSamples, Plan, fleet_packages};
use crate::learning::agent_config::{agent_config, agent_id};
use crate::learning::trained::{INITIAL_VERSION, Trained, TrainedError, TrainingTask};
use crate::packages::recording_source::{RecordingSource, SourceScenario};
use crate::packages::{PackageBytes, Recording};
use crate::scenario::{Network, Recipe, Scenario};
use crate::training::{EpochReport, StopReason};
use crate::warning::{Warning, WarningCode};

/// What to train.
#[derive(Clone, Copy, Debug)]
pub struct OfflineTask<'t> {
    /// The scenario that describes agents, network and recipe.
    pub scenario: &'t Scenario,
    /// The agents that get the network, from 0; the first one's parameters and recipe count.
    pub agents: &'t [usize],
    /// The recipe; `None` for that of the first agent's first learning cycle, or the only one.
    pub recipe: Option<&'t str>,
    /// Random seed.
    pub seed: u64,
    /// The package in use and its name in errors: it provides outer weights where recordings have none.
    pub base: Option<(&'t PackageBytes, &'t Path)>,
}

/// Recordings with their names and origins; the three lists have the same length.
#[derive(Clone, Debug, Default)]
pub struct Samples {
    /// The files, or names for them in errors.
    pub paths: Vec<PathBuf>,
    /// The agents that recorded them, from 0.
    pub agents: Vec<usize>,
    /// The samples.
    pub recordings: Vec<Recording>,
}

/// Follows a training.
pub trait Follower {
    /// Receives warnings about the samples before the training, and about the network after it.
    fn warn(&mut self, warning: &Warning);

    /// Receives the report of an epoch; the number of epochs is at most `most`. `Break` ends the training with
    /// the best network so far.
    fn epoch(&mut self, report: &EpochReport, most: usize) -> ControlFlow<()>;
}

/// A trained network for one or several agents.
#[derive(Clone, Debug)]
pub struct OfflineTraining<'t> {
    /// The recipe.
    pub recipe: &'t Recipe,
    /// The training, with all warnings.
    pub trained: Trained,
    /// A package for each agent.
    pub packages: Vec<PackageBytes>,
}

impl OfflineTraining<'_> {
    /// Whether the follower ended the training.
    #[must_use]
    pub fn is_interrupted(&self) -> bool {
        self.trained.report.stop == StopReason::Callback
    }
}

impl<'t> OfflineTask<'t> {
    /// Returns the recipe and the learning cycle, from 0, that it belongs to.
    ///
    /// # Errors
    /// If there is none, or the choice is not clear.
    pub fn recipe(&self) -> Result<(&'t Recipe, usize), ErrorReport> {
        let scenario = self.scenario;
        let index = self.agents[0];
        let own = scenario.learning.iter().position(|cycle| cycle.agents.contains(&index));
        let only = match &scenario.recipes[..] {
            [only] => Some(only.name.as_str()),
            _ => None,
        };
        let name =
            self.recipe.or(own.map(|cycle| scenario.learning[cycle].recipe.as_str())).or(only);
        let found = name.and_then(|name| scenario.recipe(name));
        let recipe = found.ok_or_else(|| {
            let names: Vec<_> =
                scenario.recipes.iter().map(|recipe| recipe.name.as_str()).collect();
            ErrorReport::usage(match names[..] {
                [] => format!("scenario {} has no recipe; add [recipes.NAME]", scenario.name),
                _ => format!("choose a recipe with --recipe: {}", names.join(", ")),
            })
        })?;
        Ok((recipe, own.unwrap_or(0)))
    }

    /// Checks that the package in use is one of an agent that is trained for.
    ///
    /// # Errors
    /// If it is not.
    pub fn check_base(&self) -> Result<(), ErrorReport> {
        let Some((base, path)) = self.base else { return Ok(()) };
        let trigger = TriggerConstants::new(self.scenario);
        let agents = self.agents;
        let own = agents.iter().find(|&&index| base.package().node.agent == agent_id(index));
        let index = *own.unwrap_or(&agents[0]);
        let node = agent_config(self.scenario, &trigger, index);
        let Some(parameter) = node.first_difference(&base.package().node) else { return Ok(()) };
        let (problem, number) =
            (format!("{}: its {parameter} differs from that of", path.display()), index + 1);
        Err(ErrorReport::usage(format!(
            "{problem} agent {number} in the scenario; give a package of this agent as --base"
        ))
        .about(path))
    }

    /// Reads recordings from files; returns them with warnings about their origin.
    ///
    /// # Errors
    /// If one cannot be read, or if the file says that it is from an agent that gets no network, or has a different
    /// step.
    pub fn load(&self, paths: &[PathBuf]) -> Result<(Samples, Vec<Warning>), ErrorReport> {
        let features = network_of(self.scenario)?.architecture.features();
        let (mut samples, mut warnings) = (Samples::default(), Vec::new());
        for path in paths {
            let (agent, warning) = self.check_source(path)?;
            warnings.extend(warning);
            samples.agents.push(agent);
        }
        for path in paths {
            let recording = Recording::load(path, self.scenario.dimension(), features)
                .map_err(|error| ErrorReport::of(&error))?;
            samples.paths.push(path.clone());
            samples.recordings.push(recording);
        }
        Ok((samples, warnings))
    }

    /// Returns which agent, from 0, recorded a file, and a warning about it.
    fn check_source(&self, path: &Path) -> Result<(usize, Option<Warning>), ErrorReport> {
        // Errors are reported when the samples are read.
        let source = RecordingSource::read(path).unwrap_or_default();
        let said = source.agent.and_then(|own| usize::try_from(own).ok());
        let known = said.filter(|own| self.agents.iter().any(|agent| agent + 1 == *own));
        let number = known.unwrap_or(self.agents[0] + 1);
        let Scenario { name, hash, time, .. } = self.scenario;
        let scenario = SourceScenario { name, hash: *hash, step: time.step_size };
        let warning =
            source.check(path, number, &scenario).map_err(|error| ErrorReport::of(&error))?;
        Ok((number - 1, warning))
    }

    /// Trains on `samples` and packs the network for each agent with the serial in `serials`. `warnings` are those
    /// there are already; `stop` ends the training within an epoch.
    ///
    /// # Errors
    /// If samples or network are not usable, or if the trained network explains no more than a constant; then
    /// `out` is the path of the package that is not written.
    pub fn carry_out(
        &self,
        samples: &mut Samples,
        serials: &[Serial],
        warnings: Vec<Warning>,
        follower: &mut dyn Follower,
        (out, stop): (&Path, Option<&'static AtomicBool>),
    ) -> Result<OfflineTraining<'t>, ErrorReport> {
        let scenario = self.scenario;
        let network = network_of(scenario)?;
        let (recipe, cycle) = self.recipe()?;
        if let Some((base, _)) = self.base {
            for recording in &mut samples.recordings {
                let weights = || base.package().outer_weights.to_vec();
                recording.outer_weights.get_or_insert_with(weights);
            }
        }
        let Samples { paths, agents, recordings } = &*samples;
        check_intervals(paths, recordings)?;
        let drawn = scenario.drawn(self.seed);
        let plan = plan(&drawn, cycle)?;
        let joined = FleetSamples::new(plan.as_ref(), agents, recordings)
            .ok_or_else(|| ErrorReport::usage("no samples; give at least one recording"))?;
        let FleetSamples { recording, harmonics } = &joined;
        let Serial { epoch, version } = serials[0];
        let (agent, seed) = (self.agents[0], self.seed);
        let task = TrainingTask { scenario, network, recipe, agent, cycle, seed, epoch, version };
        let with_file = |error: TrainedError| match error {
            // The result is wrong, not the samples.
            TrainedError::NotFinite { .. } | TrainedError::Size { .. } | TrainedError::Draft(_) => {
                ErrorReport::of(&error)
            }
            _ => {
                let names: Vec<_> = paths.iter().map(|path| path.display().to_string()).collect();
                ErrorReport::usage(format!("{}: {error}", names.join(", "))).about(&paths[0])
            }
        };
        let mut prepared = task.prepare(recording).map_err(with_file)?;
        let dense = paths.iter().zip(recordings);
        let dense = dense.filter_map(|(path, recording)| dense_samples(path, scenario, recording));
        prepared.warnings.extend(warnings.into_iter().chain(dense));
        let told = prepared.warnings.len();
        prepared.warnings.iter().for_each(|warning| follower.warn(warning));
        let most = recipe.trainer.trainer().epochs_max();
        let mut trained = prepared
            .carry_out_until(&mut |report| follower.epoch(report, most), stop)
            .map_err(with_file)?;
        // An interrupted training packs the best network so far, even if it explains little; the other
        // warnings report that.
        let interrupted = trained.report.stop == StopReason::Callback;
        if interrupted {
            trained.warnings.retain(|warning| warning.code != WarningCode::NotSwitchedIn);
        }
        trained.warnings[told..].iter().for_each(|warning| follower.warn(warning));
        if !trained.accepted && !interrupted {
            let problem = "not written, because the network explains no more than a constant; see the \
                           warnings above";
            let text = format!("{}: {problem}", out.display());
            return Err(ErrorReport::new(ErrorCode::NotPacked, text).about(out));
        }
        let members: Vec<_> = self.agents.iter().copied().zip(serials.iter().copied()).collect();
        let packages =
            fleet_packages(scenario, plan.as_ref(), harmonics, &trained.package, &members)
                .map_err(|error| ErrorReport::of(&RunError::Observer(error)))?;
        Ok(OfflineTraining { recipe, trained, packages })
    }
}

/// Returns the serial after those of the existing packages; `chosen` is a version instead of the next.
///
/// # Errors
/// If the version is the largest one.
pub fn serial_after<'p>(
    before: impl IntoIterator<Item = (&'p PackageBytes, &'p Path)>,
    chosen: Option<u32>,
) -> Result<Serial, ErrorReport> {
    let before = before.into_iter().map(|(package, path)| (package.package().serial(), path)).max();
    let epoch = before.map_or(0, |(serial, _)| serial.epoch);
    let version = match (chosen, before) {
        (Some(version), _) => version,
        (None, Some((serial, path))) => version_after(serial, path)?,
        (None, None) => INITIAL_VERSION + 1,
    };
    Ok(Serial { epoch, version })
}

/// Returns the version after `serial`, of the same epoch.
///
/// # Errors
/// If the version is the largest one.
pub fn version_after(serial: Serial, of: &Path) -> Result<u32, ErrorReport> {
    serial.version.checked_add(1).ok_or_else(|| {
        let Serial { epoch, version } = serial;
        ErrorReport::usage(format!(
            "{}: version {version} is the largest possible, so there can be no newer version in this package epoch; \
             choose a version with --package-version and sign the package with --epoch {}",
            of.display(),
            epoch.saturating_add(1)
        ))
        .about(of)
    })
}

/// Converts the number of an agent, from 1, to an index, from 0.
///
/// # Errors
/// If the scenario has no such agent.
pub fn agent_index(scenario: &Scenario, number: usize) -> Result<usize, ErrorReport> {
    let agents = scenario.agents.len();
    number.checked_sub(1).filter(|&index| index < agents).ok_or_else(|| {
        let name = &scenario.name;
        ErrorReport::usage(format!("--agent {number}: scenario {name} has agents 1 to {agents}"))
    })
}

/// Returns the scenario's network, which a package requires.
///
/// # Errors
/// If it has none.
pub fn network_of(scenario: &Scenario) -> Result<&Network, ErrorReport> {
    scenario.network.as_ref().ok_or_else(|| {
        let name = &scenario.name;
        let problem = format!("scenario {name} has no network; add [network] and [outer_law]");
        ErrorReport::usage(problem)
    })
}

/// Returns the plan of the field observer, if nodes run it once this cycle's network is in use.
fn plan(scenario: &Scenario, cycle: usize) -> Result<Option<Plan<'_>>, ErrorReport> {
    let plan = Plan::new(scenario).map_err(|error| ErrorReport::of(&RunError::Observer(error)))?;
    let applied = scenario.learning.get(cycle).map(|cycle| scenario.time.tick(cycle.apply_at));
    Ok(plan.filter(|plan| applied.is_none_or(|tick| tick >= plan.starts_at())))
}

/// Warns if samples are closer together than a node could record them.
fn dense_samples(path: &Path, scenario: &Scenario, recording: &Recording) -> Option<Warning> {
    let (interval, step) = (recording.interval, scenario.time.step_size);
    (interval < 0.5 * step).then(|| {
        let text = format!(
            "{}: samples are {interval:e} s apart, but the scenario's step is {step:e} s; check the \
             time unit in the header",
            path.display(),
        );
        Warning::new(WarningCode::DenseSamples, text)
    })
}

/// Checks that all recordings have the same time between samples, because they are averaged over the same
/// windows.
fn check_intervals(paths: &[PathBuf], recordings: &[Recording]) -> Result<(), ErrorReport> {
    let (Some(first), Some(recording)) = (paths.first(), recordings.first()) else {
        return Ok(());
    };
    let interval = recording.interval;
    let differs = |other: f64| (other - interval).abs() > 1e-6 * interval;
    match paths.iter().zip(recordings).find(|(_, other)| differs(other.interval)) {
        None => Ok(()),
        Some((path, other)) => Err(ErrorReport::usage(format!(
            "{}: samples are {} s apart, and those of {} {interval} s; record them at the same interval, or \
             train on one of them",
            path.display(),
            other.interval,
            first.display(),
        ))
        .about(path)),
    }
}
