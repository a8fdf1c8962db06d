//! The field observer of a scenario: settings, from its `[observer]` or derived, as the words of
//! packages.
//!
//! What the scenario leaves open follows from the plant's trajectory without agents, as the simulator
//! knows it, and from the network in the package.

use agent_core::observer::features::Features;
use agent_core::observer::field::disturbance::Model;
use agent_core::observer::field::{Coupling, Direction, HoldKind, Options};
use agent_core::observer::network::Scratch;
use agent_core::observer::trigger::TriggerParams;
use agent_core::package::{OnSwitch, TrialLimits};
use agent_core::wire::crc::crc32;
use agent_core::wire::words::WORDS_MAX;

use super::{
    DirectionSettings, Gate, Geometry, NotCovered, Statistics, Trajectory, Trees, Wanted, gains,
    settings,
};
use crate::analysis::{adjacency_norm, laplacian_norm};
use crate::basis::substitute;
use crate::learning::harmonic::Harmonic;
use crate::number::seconds;
use crate::packages::{
    Draft, DraftError, PackageBytes, Recording, with_dimension, with_node_dimension,
};
use crate::plant::{RateFault, Stepper};
use crate::scenario::{DisturbanceModel, Method, ObserverSettings, Scenario};

/// Standard deviations around the mean to which the network's inputs are limited.
const LIMIT: f64 = 5.0;

/// The field observer of a scenario, before it is known which network is used.
#[derive(Debug)]
pub struct Plan<'s> {
    scenario: &'s Scenario,
    observer: &'s ObserverSettings,
    geometry: Geometry,
    trees: Trees,
    trajectory: Trajectory,
    /// Limits of the network's inputs.
    low: Vec<f32>,
    high: Vec<f32>,
}

/// Why a scenario has no field observer.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PlanError {
    /// The agents do not measure the whole state.
    #[error(transparent)]
    NotCovered(#[from] NotCovered),
    /// The rules do not hold.
    #[error(transparent)]
    Gate(#[from] Gate),
    /// The package cannot be made.
    #[error("{0}")]
    Draft(#[from] DraftError),
    /// A neighbour is too far down the list.
    #[error(
        "agent {agent} has more than 250 neighbours, so [observer] cannot name its parent; use a \
         sparser graph"
    )]
    Neighbours {
        /// The agent, from 1.
        agent: usize,
    },
    /// The plant is a recording without the state.
    #[error(
        "the recording has no reference for the state, from which settings could be derived; add plant.reference"
    )]
    NoReference,
    /// An expression of the plant has no value.
    #[error(transparent)]
    Expression(Box<RateFault>),
    /// The plant has no finite trajectory.
    #[error(
        "the plant's state without agents is not finite at t = {}, so no settings can be derived from it; \
         lower time.step or change the plant",
        seconds(*time)
    )]
    Plant {
        /// The time. \[s\]
        time: f64,
    },
}

/// What the package of one agent needs besides its network.
struct Derived {
    directions: Vec<DirectionSettings>,
    bias_decay: f64,
    model_hold: bool,
}

impl<'s> Plan<'s> {
    /// Prepares the observer of a scenario; `None` for the paper's.
    ///
    /// # Errors
    /// If the agents do not measure the whole state, or the plant diverges.
    pub fn new(scenario: &'s Scenario) -> Result<Option<Self>, PlanError> {
        let Some(observer) = &scenario.observer else { return Ok(None) };
        let trajectory = plant_course(scenario)?;
        let matrices: Vec<_> = scenario.agents.iter().map(|agent| &agent.output_matrix).collect();
        let geometry = if observer.is_in_state_units() {
            Geometry::in_state_units(&matrices)?
        } else {
            Geometry::scaled(&matrices, &trajectory)?
        };
        let trees = Trees::new(&scenario.graph, &geometry);
        let (mean, deviation) = (trajectory.mean(), trajectory.deviation());
        let n = scenario.dimension();
        let extreme = |c: usize, pick: fn(f64, f64) -> f64, start: f64| {
            trajectory.states.iter().skip(c).step_by(n).fold(start, |so_far, &x| pick(so_far, x))
        };
        let low = |c: usize| (mean[c] - LIMIT * deviation[c]).min(extreme(c, f64::min, mean[c]));
        let high = |c: usize| (mean[c] + LIMIT * deviation[c]).max(extreme(c, f64::max, mean[c]));
        let [low, high] =
            [(0..n).map(|c| low(c) as f32).collect(), (0..n).map(|c| high(c) as f32).collect()];
        Ok(Some(Self { scenario, observer, geometry, trees, trajectory, low, high }))
    }

    /// Returns the first step of the observer.
    #[must_use]
    pub fn starts_at(&self) -> u64 {
        self.scenario.time.tick(self.observer.from)
    }

    /// Returns the package after `package`: the same network with the observer's parameters.
    ///
    /// # Errors
    /// See [`PlanError`].
    pub fn next(&self, package: &PackageBytes, index: usize) -> Result<PackageBytes, PlanError> {
        let mut draft = Draft::copy(&self.equip(package, index, &[])?.package());
        draft.version = draft.version.saturating_add(1);
        Ok(draft.seal()?)
    }

    /// Returns the harmonic in each direction, from the recording of an agent that measures it: of the frequency
    /// that the scenario gives, or one that is found. None unless disturbances are modelled as harmonic.
    #[must_use]
    pub fn harmonics(&self, agents: &[usize], recordings: &[Recording]) -> Vec<Option<Harmonic>> {
        let DisturbanceModel::Harmonic { frequencies, .. } = &self.observer.disturbance else {
            return Vec::new();
        };
        (0..self.scenario.dimension())
            .map(|c| {
                let root = agents.iter().position(|&i| self.geometry.roots[i][c].is_some())?;
                let row: Vec<f64> = self.geometry.transform.row(c).iter().copied().collect();
                match frequencies {
                    None => Harmonic::find(&recordings[root], &row),
                    Some(given) if given[c] > 0.0 => {
                        Harmonic::of_frequency(&recordings[root], &row, given[c])
                    }
                    Some(_) => None,
                }
            })
            .collect()
    }

    /// Returns the recordings without these harmonics; `None` if there are none.
    #[must_use]
    pub fn without(
        &self,
        harmonics: &[Option<Harmonic>],
        recordings: &[Recording],
    ) -> Option<Vec<Recording>> {
        if harmonics.iter().all(Option::is_none) {
            return None;
        }
        let mut without = recordings.to_vec();
        for (c, harmonic) in harmonics.iter().enumerate() {
            let Some(harmonic) = harmonic else { continue };
            let column: Vec<f64> = self.geometry.inverse.column(c).iter().copied().collect();
            for recording in &mut without {
                *recording = harmonic.taken_from(recording, &column)?;
            }
        }
        Some(without)
    }

    /// Returns coordinates and roots.
    #[must_use]
    pub fn geometry(&self) -> &Geometry {
        &self.geometry
    }

    /// Returns who follows whom.
    #[must_use]
    pub fn trees(&self) -> &Trees {
        &self.trees
    }

    /// Returns the package of agent `index` with the observer's parameters. A network that is not
    /// trained is left out of the observer.
    ///
    /// # Errors
    /// See [`PlanError`].
    pub fn equip(
        &self,
        package: &PackageBytes,
        index: usize,
        harmonics: &[Option<Harmonic>],
    ) -> Result<PackageBytes, PlanError> {
        let mut draft = Draft::copy(&package.package());
        let knows = draft.samples > 0 || self.scenario.method == Method::KnownModel;
        let uses_network = self.observer.network && knows;
        draft.node.field = self.words(package, index, uses_network, harmonics)?;
        if let Some(exchange) = self.observer.exchange {
            draft.node.exchange = exchange;
        }
        if self.observer.coupling != Coupling::Trees {
            draft.node.trigger = self.trigger();
        }
        // All agents predict samples with the same outer weights.
        draft.on_switch = OnSwitch::Replace;
        if self.starts_at() > 0 {
            // Before that time it is the rate of the paper's observer, which broadcasts far more often.
            draft.trial =
                draft.trial.map(|limits| TrialLimits { broadcasts_per_second: None, ..limits });
            draft.trial = draft.trial.filter(|limits| *limits != TrialLimits::NONE);
        }
        Ok(draft.seal()?)
    }

    fn words(
        &self,
        package: &PackageBytes,
        index: usize,
        uses_network: bool,
        harmonics: &[Option<Harmonic>],
    ) -> Result<Vec<f32>, PlanError> {
        let Self { scenario, observer, geometry, .. } = self;
        let step = scenario.time.step_size;
        let derived = self.derive(package, uses_network)?;
        let frequencies: Vec<Option<f64>> = match &observer.disturbance {
            DisturbanceModel::Harmonic { frequencies: Some(given), .. } => {
                given.iter().map(|&frequency| Some(frequency).filter(|&w| w > 0.0)).collect()
            }
            DisturbanceModel::Harmonic { frequencies: None, .. } => {
                let found = |c: usize| harmonics.get(c).copied().flatten();
                (0..scenario.dimension()).map(|c| Some(found(c)?.frequency)).collect()
            }
            _ => vec![None; scenario.dimension()],
        };
        let has_harmonics = frequencies.iter().any(Option::is_some);
        let directions: Vec<_> = (0..scenario.dimension())
            .map(|c| self.direction(index, c, &derived.directions[c], frequencies[c]))
            .collect::<Result<_, _>>()?;
        let derived_hold = if derived.model_hold { HoldKind::Model } else { HoldKind::Rate };
        let options = Options {
            digest: self.digest(package, &directions),
            hold: observer.hold.unwrap_or(derived_hold),
            coupling: observer.coupling,
            uses_network,
            adapts: observer.adapts && uses_network,
            has_harmonics,
            is_half: observer.is_half || self.is_too_long(&directions, has_harmonics),
            timeout: (observer.timeout / step).round() as u32,
            bias_kept: (1.0 - step * derived.bias_decay).max(0.0) as f32,
            relay_share: observer.relay_share as f32,
        };
        let rows = |matrix: &nalgebra::DMatrix<f64>| -> Vec<f32> {
            matrix.transpose().iter().map(|&entry| entry as f32).collect()
        };
        let mut words = options.words().to_vec();
        words.extend(rows(&geometry.transform));
        words.extend(rows(&geometry.inverse));
        words.extend(&self.low);
        words.extend(&self.high);
        words.extend(directions.iter().flat_map(Direction::words));
        Ok(words)
    }

    /// Returns the paper's trigger for this coupling and radius: with the agent's own current
    /// estimate, `phi_1` has the adjacency matrix in place of the Laplacian.
    fn trigger(&self) -> TriggerParams {
        let Self { scenario, observer, .. } = self;
        let laplacian = laplacian_norm(&scenario.graph);
        let coupling = match observer.coupling {
            Coupling::Current => adjacency_norm(&scenario.graph),
            _ => laplacian,
        };
        let largest = |gains: &Option<Vec<f64>>| {
            gains.iter().flatten().fold(0.0, |largest: f64, &gain| largest.max(gain))
        };
        let gain = largest(&observer.tree_gain);
        let design = &scenario.design;
        let (share, size) = (coupling / laplacian, coupling * gain);
        let phi1 = 0.5 * design.k2 * share * share + 0.5 * design.kappa * size * size;
        let radius = observer.radius.iter().flatten().copied().fold(f64::INFINITY, f64::min);
        let threshold = match radius.is_finite() {
            true => phi1 * radius * radius,
            false => design.epsilon / scenario.agents.len() as f64,
        };
        TriggerParams {
            hold_error_weight: phi1 as f32,
            consensus_weight: (0.25 * design.k2 / (laplacian * laplacian)) as f32,
            threshold: threshold as f32,
        }
    }

    /// Whether a frame with numbers of 32 bits and rates would be too long.
    fn is_too_long(&self, directions: &[Direction], has_harmonics: bool) -> bool {
        let announced =
            |direction: &&Direction| direction.is_announced && direction.model.clip > 0.0;
        let states = if has_harmonics { 3 } else { 1 };
        let rates = match self.observer.hold {
            Some(HoldKind::ZeroOrder) => 0,
            _ => directions.len(),
        };
        let disturbances = states * directions.iter().filter(announced).count();
        1 + directions.len() + rates + disturbances > WORDS_MAX
    }

    /// Returns what the scenario sets, and what the rules say where it does not.
    fn derive(&self, package: &PackageBytes, uses_network: bool) -> Result<Derived, PlanError> {
        let Self { scenario, observer, geometry, trajectory, .. } = self;
        let n = scenario.dimension();
        let evaluate = |time: f64, x: &[f64], f: &mut [f64]| self.model(package, time, x, f);
        let model: Option<&super::statistics::Model<'_>> =
            if uses_network { Some(&evaluate) } else { None };
        let mut derived = if observer.is_complete() {
            let unset = DirectionSettings {
                radius: 0.0,
                bandwidth: 0.0,
                root_gain: 0.0,
                bias_gain: 0.0,
                tree_gain: 0.0,
                clip: 0.0,
            };
            let mut directions = vec![unset; n];
            self.give(&mut directions);
            Derived { directions, bias_decay: 1.0, model_hold: uses_network }
        } else {
            let statistics = Statistics::new(trajectory, geometry, model);
            let wanted = Wanted {
                error: observer.error,
                noise: self.noise(),
                hop_delay: scenario.link.longest_delay() + scenario.time.step_size,
                step: scenario.time.step_size,
            };
            let mut settings = settings(geometry, &statistics, &wanted)?;
            self.give(&mut settings.directions);
            settings.check(&statistics, &wanted)?;
            Derived {
                directions: settings.directions,
                bias_decay: settings.bias_decay,
                model_hold: settings.model_hold,
            }
        };
        if let Some(decay) = observer.bias_decay {
            derived.bias_decay = decay;
        }
        Ok(derived)
    }

    /// Puts what the scenario gives in place of what is derived.
    fn give(&self, directions: &mut [DirectionSettings]) {
        let observer = self.observer;
        for (c, direction) in directions.iter_mut().enumerate() {
            for (place, given) in [
                (&mut direction.radius, &observer.radius),
                (&mut direction.root_gain, &observer.root_gain),
                (&mut direction.tree_gain, &observer.tree_gain),
                (&mut direction.clip, &observer.clip),
            ] {
                if let Some(given) = given {
                    *place = given[c];
                }
            }
        }
    }

    fn direction(
        &self,
        agent: usize,
        c: usize,
        derived: &DirectionSettings,
        frequency: Option<f64>,
    ) -> Result<Direction, PlanError> {
        let Self { scenario, observer, geometry, trees, .. } = self;
        let step = scenario.time.step_size;
        let root = geometry.roots[agent][c];
        let (rotation_sine, rotation_cosine) = match frequency {
            Some(frequency) => (libm::sin(frequency * step), libm::cos(frequency * step)),
            None => (0.0, 1.0),
        };
        let found = match &observer.disturbance {
            DisturbanceModel::None => None,
            DisturbanceModel::Bias { bandwidth: None } => {
                Some((derived.root_gain, derived.bias_gain, 0.0, 0.0))
            }
            DisturbanceModel::Bias { bandwidth: Some(bandwidth) } => {
                let gains = gains(None, 0.0, *bandwidth, 0.0, step);
                Some((gains.state, gains.bias, 0.0, 0.0))
            }
            DisturbanceModel::Harmonic { bandwidth, harmonic_bandwidth, process, .. } => {
                let gains =
                    gains(frequency, process * process, *bandwidth, *harmonic_bandwidth, step);
                Some((gains.state, gains.bias, gains.cosine, gains.sine))
            }
        };
        let (root_gain, bias_gain, cosine_gain, sine_gain) =
            found.unwrap_or((derived.root_gain, 0.0, 0.0, 0.0));
        let root_gain = observer.root_gain.as_ref().map_or(root_gain, |given| given[c]);
        let place = |parent: Option<usize>| -> Result<Option<u8>, PlanError> {
            let Some(parent) = parent else { return Ok(None) };
            let neighbours = scenario.graph.neighbours(agent);
            let place = neighbours.iter().position(|edge| edge.agent == parent);
            let place = place.and_then(|place| u8::try_from(place).ok()).filter(|&p| p < 250);
            place.map(Some).ok_or(PlanError::Neighbours { agent: agent + 1 })
        };
        let is_tree = observer.coupling == Coupling::Trees;
        let parent = trees.parent[agent][c].filter(|_| is_tree && root.is_none());
        Ok(Direction {
            output: root.map(|root| root.output as u8),
            parent: place(parent)?,
            spare: place(self.spare(agent, c))?,
            is_announced: !is_tree || trees.announces(agent, c) || self.is_spare(agent, c),
            scale: root.map_or(1.0, |root| root.scale) as f32,
            root_gain: root_gain as f32,
            tree_gain: derived.tree_gain as f32,
            radius: derived.radius as f32,
            model: Model {
                bias_gain: bias_gain as f32,
                cosine_gain: cosine_gain as f32,
                sine_gain: sine_gain as f32,
                rotation_cosine: rotation_cosine as f32,
                rotation_sine: rotation_sine as f32,
                clip: if found.is_some() { derived.clip as f32 } else { 0.0 },
            },
        })
    }

    /// Returns the agent that `agent` follows in direction `c` if its parent is silent: the neighbour with the
    /// lowest number whose own path to a root avoids both.
    fn spare(&self, agent: usize, c: usize) -> Option<usize> {
        let Self { scenario, observer, geometry, trees, .. } = self;
        let is_tree = observer.timeout > 0.0 && observer.coupling == Coupling::Trees;
        let parent = trees.parent[agent][c].filter(|_| is_tree)?;
        let avoids = |start: usize| {
            let mut path = std::iter::successors(Some(start), |&at| trees.parent[at][c]);
            path.all(|at| at != agent && at != parent)
        };
        let leads = |&j: &usize| geometry.is_root(j, c) || trees.parent[j][c].is_some();
        let neighbours = scenario.graph.neighbours(agent).iter().map(|edge| edge.agent);
        neighbours.filter(leads).filter(|&j| avoids(j)).min()
    }

    /// Whether a neighbour follows `agent` in direction `c` if its parent is silent.
    fn is_spare(&self, agent: usize, c: usize) -> bool {
        let neighbours = self.scenario.graph.neighbours(agent).iter();
        neighbours.into_iter().any(|edge| self.spare(edge.agent, c) == Some(agent))
    }

    /// Returns the standard deviation of the noise in each direction, if any sensor has some.
    fn noise(&self) -> Option<Vec<f64>> {
        let n = self.scenario.dimension();
        let mut noise = vec![0.0_f64; n];
        for (agent, roots) in self.scenario.agents.iter().zip(&self.geometry.roots) {
            for (place, root) in noise.iter_mut().zip(roots) {
                if let Some(root) = root {
                    *place = place.max(root.scale.abs() * agent.sensor.deviation());
                }
            }
        }
        noise.iter().any(|&sigma| sigma > 0.0).then_some(noise)
    }

    /// Writes `f_hat(x)` of a package's network at a time of the run. \[s\]
    fn model(&self, package: &PackageBytes, time: f64, x: &[f64], f: &mut [f64]) {
        let n = x.len();
        let limits = x.iter().zip(self.low.iter().zip(&self.high));
        let mut x: Vec<f32> =
            limits.map(|(&x, (&low, &high))| (x as f32).clamp(low, high)).collect();
        f.fill(0.0);
        if let Some(mut basis) = substitute(self.scenario, &package.package()) {
            basis.set_time(time);
            x.extend(self.known_inputs(basis.inputs() - n, time));
            return basis.combine(package.package().outer_weights, &x, f);
        }
        x.extend(self.known_inputs(package.package().known_inputs, time));
        let output = with_node_dimension!(n, output(package, &x), else Vec::new());
        for (f, output) in f.iter_mut().zip(output) {
            *f = f64::from(output);
        }
    }

    /// Returns the known inputs at a time \[s\], if a network takes any.
    fn known_inputs(&self, count: usize, time: f64) -> Vec<f32> {
        let known = self.scenario.plant.known_inputs(time);
        known.iter().take(count).map(|&u| u as f32).collect()
    }

    /// Returns a digest of all that samples are predicted with; never 0.
    fn digest(&self, package: &PackageBytes, directions: &[Direction]) -> u16 {
        let package = package.package();
        let transform: Vec<f64> = self.geometry.transform.iter().copied().collect();
        let models = directions.iter().flat_map(|direction| {
            [direction.model.rotation_cosine, direction.model.rotation_sine, direction.model.clip]
        });
        let models: Vec<f32> = models.collect();
        let hash = crc32(&[
            bytemuck::cast_slice(package.network.parameters()),
            bytemuck::cast_slice(package.outer_weights),
            bytemuck::cast_slice(&transform),
            bytemuck::cast_slice(&self.low),
            bytemuck::cast_slice(&self.high),
            bytemuck::cast_slice(&models),
        ]);
        ((hash ^ hash >> 16) as u16).max(1)
    }
}

fn output<const N: usize>(package: &PackageBytes, x: &[f32]) -> Vec<f32> {
    let mut scratch = Scratch::NEW;
    let output = package.package().evaluate::<N>(x, &mut scratch).map(|(_, output)| output);
    output.map_or_else(Vec::new, |output| output.as_slice().to_vec())
}

/// Most steps of a [`plant_course`]: 100 MB with three components.
const COURSE_STEPS_MAX: u64 = 1 << 22;

/// Returns the trajectory of the plant without agents and without process noise, over the scenario's whole
/// duration however many steps are run, but at most over the first 2^22 steps.
///
/// # Errors
/// If it is not finite.
pub fn plant_course(scenario: &Scenario) -> Result<Trajectory, PlanError> {
    let (n, time) = (scenario.dimension(), scenario.time);
    if !scenario.plant.is_known() {
        return Err(PlanError::NoReference);
    }
    let mut states = scenario.initial_state.clone();
    with_dimension!(n, plant_states(scenario, &mut states), else Ok(()))?;
    Ok(Trajectory { dimension: n, step: time.step_size, states })
}

fn plant_states<const N: usize>(
    scenario: &Scenario,
    states: &mut Vec<f64>,
) -> Result<(), PlanError> {
    let time = scenario.time;
    let mut state: [f64; N] = std::array::from_fn(|c| scenario.initial_state[c]);
    let mut plant = Stepper::new(time.integrator);
    for tick in 0..time.steps().min(COURSE_STEPS_MAX) {
        let (plant_model, disturbance) = (&scenario.plant, &scenario.disturbance);
        let before = state;
        plant.step(plant_model, disturbance, time.at(tick), time.step_size, &mut state);
        if !state.iter().all(|&x| (x as f32).is_finite()) {
            let fault =
                plant.fault(plant_model, disturbance, time.at(tick), time.step_size, &before);
            return Err(match fault {
                Some(fault) if !fault.expression().overflow => {
                    PlanError::Expression(Box::new(fault))
                }
                _ => PlanError::Plant { time: time.at(tick) },
            });
        }
        states.extend(state);
    }
    Ok(())
}
