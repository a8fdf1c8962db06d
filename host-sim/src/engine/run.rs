//! The main loop of a run.

use std::ops::ControlFlow;
use std::sync::Arc;

use agent_core::Tick;
use agent_core::math::parameter::ParameterError;

use super::agents::{ParamBuffers, SimulatedAgent, Surroundings};
use super::bounds::BoundsMeter;
use super::clock::Clock;
use super::failure::{plant_error, remedy};
use super::kalman;
use super::lanes::{LaneMode, Lanes};
use super::learning::Learning;
use super::link::{Link, RunLink};
use super::method;
use super::networks::Networks;
use super::norms::GainNorms;
use super::run_observer::{AgentStart, RunObserver, Switch};
use super::sensor::Sensor;
use super::sent::Sent;
use super::simulated_plant::SimulatedPlant;
use super::state_size::StateSize;
use super::stepping;
use super::traces::{Traces, squared_error};
use super::{Progress, RunError, RunOptions, RunResult, TrainingRecord};
use crate::analysis::{StepCheck, TriggerConstants, spectral_norm};
use crate::files::fnv::Fnv;
use crate::flow::Plan;
use crate::learning::{agent_config, trained};
use crate::packages::{OwnedAgentConfig, PackageBytes, with_dimension};
use crate::plant::{DIMENSION_MAX, RateFault};
use crate::scenario::{Downtime, LearningCycle, Method, Network, Scenario};
use crate::training::{Dataset, TrainingError};

/// Steps between progress reports.
const PROGRESS_STRIDE: Tick = 512;
/// Steps between checks for a request to stop: few, because a plant may take milliseconds a step.
const STOP_STRIDE: Tick = 8;

/// Runs `scenario` over the link it describes.
///
/// # Errors
/// If the core refuses a parameter or a network, a training fails, or the plant or an agent
/// diverges.
pub fn run(
    scenario: &Scenario,
    options: RunOptions,
    progress: &dyn Progress,
) -> Result<RunResult, RunError> {
    let link = RunLink::new(scenario, options.seed);
    run_any(scenario, link, None, LaneMode::Longest, options, progress)
}

/// Runs `scenario` over the link it describes, and reports every step to `run_observer`.
///
/// # Errors
/// Same as [`run`], and those of the observer.
///
/// # Panics
/// Same as [`run_over`].
pub fn run_observed(
    scenario: &Scenario,
    run_observer: &mut dyn RunObserver,
    options: RunOptions,
    progress: &dyn Progress,
) -> Result<RunResult, RunError> {
    let link = RunLink::new(scenario, options.seed);
    run_any(scenario, link, Some(run_observer), LaneMode::Longest, options, progress)
}

/// Runs `scenario` as [`run`] does, but evaluates the networks of many agents as `lanes` says, to compare.
///
/// # Errors
/// Same as [`run`].
pub fn run_in_lanes(
    scenario: &Scenario,
    lanes: LaneMode,
    options: RunOptions,
    progress: &dyn Progress,
) -> Result<RunResult, RunError> {
    let link = RunLink::new(scenario, options.seed);
    run_any(scenario, link, None, lanes, options, progress)
}

/// Runs `scenario` over `link`.
///
/// # Errors
/// Same as [`run`].
///
/// # Panics
/// If the state dimension is not one that this build simulates, which a loaded scenario guarantees.
pub fn run_over(
    scenario: &Scenario,
    link: impl Link,
    options: RunOptions,
    progress: &dyn Progress,
) -> Result<RunResult, RunError> {
    run_any(scenario, RunLink::Custom(Box::new(link)), None, LaneMode::Longest, options, progress)
}

/// Returns the package that an agent, from 0, starts a run of this seed with: the one given in the scenario, or
/// one with the scenario's initial network. `None` without a network.
///
/// # Errors
/// As [`run`], about packages and networks.
///
/// # Panics
/// If there is no such agent.
pub fn start_package(
    scenario: &Scenario,
    agent: usize,
    seed: u64,
) -> Result<Option<PackageBytes>, RunError> {
    let scenario = &*scenario.drawn(seed);
    let trigger = TriggerConstants::new(scenario);
    let plan = Plan::new(scenario).map_err(RunError::Observer)?;
    let options = RunOptions { seed, learning: true, bounds: false };
    let starts = Starts::new(scenario, &trigger, options, plan.as_ref())?;
    starts.package(agent, &agent_config(scenario, &trigger, agent))
}

fn run_any<'c>(
    scenario: &Scenario,
    link: RunLink<'c>,
    run_observer: Option<&'c mut dyn RunObserver>,
    lanes: LaneMode,
    options: RunOptions,
    progress: &dyn Progress,
) -> Result<RunResult, RunError> {
    let n = scenario.dimension();
    let drawn = scenario.drawn(options.seed);
    let observe =
        |scenario: &Scenario| run(scenario, RunOptions { bounds: false, ..options }, progress);
    let prepared = method::prepared(&drawn, observe)?;
    let scenario = prepared.as_ref();
    if scenario.method.is_kalman() {
        return kalman::run(scenario, link, options, progress);
    }
    with_dimension!(
        n,
        run_fixed(scenario, link, run_observer, lanes, options, progress),
        else panic!("{n} state components, expected 1 to {DIMENSION_MAX}")
    )
}

fn run_fixed<'c, const N: usize>(
    scenario: &Scenario,
    link: RunLink<'c>,
    run_observer: Option<&'c mut dyn RunObserver>,
    lanes: LaneMode,
    options: RunOptions,
    progress: &dyn Progress,
) -> Result<RunResult, RunError> {
    let trigger = TriggerConstants::new(scenario);
    let content = |index| agent_config(scenario, &trigger, index);
    let plan = Plan::new(scenario).map_err(RunError::Observer)?.map(Arc::new);
    let starts = Starts::new(scenario, &trigger, options, plan.as_deref())?;
    let mut places: Vec<_> =
        (0..scenario.agents.len()).map(|index| ParamBuffers::new(&content(index).node())).collect();
    let mut networks = Networks::default();
    let mut agents = Vec::with_capacity(places.len());
    // Only an observer needs packages after their agents have taken what they need.
    let mut packages = Vec::new();
    let later = plan.as_ref().filter(|plan| plan.starts_at() > 0);
    let mut current = Vec::new();
    for (index, places) in places.iter_mut().enumerate() {
        let content = content(index);
        let package = starts.package(index, &content)?;
        let mut agent =
            build_agent::<N>(scenario, index, &content, package.as_ref(), places, options)
                .map_err(|error| RunError::Parameter { agent: index + 1, error })?;
        if let Some(package) = package {
            agent
                .load(&package, &mut networks)
                .map_err(|refusal| RunError::Refused { agent: index + 1, refusal })?;
            current.extend(later.is_some().then(|| package.clone()));
            packages.extend(run_observer.is_some().then_some(package));
        }
        agents.push(agent);
    }
    let mut simulation = Simulation {
        scenario,
        plan,
        current,
        options,
        link,
        run_observer,
        sent: Sent::new(agents.len()),
        lanes: stepping::lanes(&agents, lanes),
        lane_mode: lanes,
        agents,
        networks,
        truth: initial_state(scenario),
        before: initial_state(scenario),
        evaluation: scenario.evaluation.ticks(&scenario.time),
        down: vec![false; scenario.agents.len()],
        cycles: Vec::new(),
        missed: Vec::new(),
        traces: Traces::of(scenario),
        state_size: StateSize::new(N),
        bounds: (options.bounds && scenario.plant.recording().is_none())
            .then(|| BoundsMeter::new(scenario)),
        digest: Fnv::default(),
    };
    simulation.update_life(0)?;
    simulation.begin(&packages)?;
    let trainings = simulation.all_steps(progress)?;
    Ok(simulation.finish(trainings))
}

fn initial_state<const N: usize>(scenario: &Scenario) -> [f64; N] {
    std::array::from_fn(|component| scenario.initial_state[component])
}

/// Creates agent `index`, which starts with the outer weights of `package`.
fn build_agent<'s, const N: usize>(
    scenario: &'s Scenario,
    index: usize,
    content: &OwnedAgentConfig,
    package: Option<&PackageBytes>,
    places: &'s mut ParamBuffers,
    options: RunOptions,
) -> Result<SimulatedAgent<'s, N>, ParameterError> {
    let (agent, gain) = (&scenario.agents[index], &scenario.design.gain);
    let norms = options.bounds.then(|| GainNorms {
        gain: spectral_norm(gain),
        gain_output: spectral_norm(&(gain * agent.output_matrix.transpose())),
    });
    let params = places.params::<N>(&content.node())?;
    let params = match scenario.trigger.simulated() {
        Some(trigger) => params.with_trigger(trigger)?,
        None => params,
    };
    let time = &scenario.time;
    let reboots = scenario.life.iter().any(|downtime| downtime.agent == index);
    let models = (
        Sensor::new(&agent.sensor, time, index, options.seed),
        Clock::new(&agent.clock, time, index, options.seed),
    );
    match package {
        Some(package) => {
            let (outer_weights, health) = (package.package().outer_weights, scenario.health);
            let description = (scenario, agent);
            SimulatedAgent::new(params, description, models, reboots, outer_weights, norms, health)
        }
        None => {
            let description = (scenario, agent);
            SimulatedAgent::new(params, description, models, reboots, &[0.0; N], norms, None)
        }
    }
}

/// What agents start with.
struct Starts<'s> {
    scenario: &'s Scenario,
    /// The field observer, if agents start with it.
    plan: Option<&'s Plan<'s>>,
    trigger: &'s TriggerConstants,
    options: RunOptions,
    /// The scenario's network and its initial inner parameters.
    network: Option<(&'s Network, Vec<f32>)>,
}

impl<'s> Starts<'s> {
    fn new(
        scenario: &'s Scenario,
        trigger: &'s TriggerConstants,
        options: RunOptions,
        plan: Option<&'s Plan<'s>>,
    ) -> Result<Self, RunError> {
        if plan.is_some() && scenario.network.is_none() {
            return Err(RunError::ObserverWithoutNetwork);
        }
        let plan = plan.filter(|plan| plan.starts_at() == 0);
        let network = match &scenario.network {
            Some(network) => Some((network, initial_parameters(scenario, network, options.seed)?)),
            None => None,
        };
        Ok(Self { scenario, plan, trigger, options, network })
    }

    /// Returns the package that agent `index` starts with: the one given in the scenario, or one
    /// created from the scenario's network. `None` without a network.
    fn package(
        &self,
        index: usize,
        content: &OwnedAgentConfig,
    ) -> Result<Option<PackageBytes>, RunError> {
        let Self { scenario, plan, trigger, options, network } = self;
        let given = &scenario.agents[index].package;
        let Some((network, inner)) = network else {
            return match given {
                Some(_) => Err(RunError::PackageWithoutNetwork { agent: index + 1 }),
                None => Ok(None),
            };
        };
        if let Some(package) = given {
            check_start(scenario, network, content, package, index, *options)?;
            return Ok(Some(package.clone()));
        }
        let package = trained::initial(scenario, trigger, network, inner, index, options.seed)
            .map_err(|error| RunError::Package { agent: index + 1, error })?;
        match plan {
            Some(plan) => plan.equip(&package, index, &[]).map(Some).map_err(RunError::Observer),
            None => Ok(Some(package)),
        }
    }
}

/// Checks that a given package is for this agent of this scenario.
fn check_start(
    scenario: &Scenario,
    network: &Network,
    content: &OwnedAgentConfig,
    package: &PackageBytes,
    index: usize,
    options: RunOptions,
) -> Result<(), RunError> {
    if let Some(parameter) = content.first_difference(&package.package().node) {
        return Err(RunError::PackageNode { agent: index + 1, parameter });
    }
    let learns = scenario.learning.iter().any(|cycle| cycle.agents.contains(&index));
    let (found, expected) = (package.package().known_inputs, scenario.plant.input_names().len());
    // A network without known inputs can be used, but not trained on.
    if found != expected && (found != 0 || options.learning && learns) {
        return Err(RunError::PackageInputs { agent: index + 1, found, expected });
    }
    if options.learning && learns && *package.architecture() != network.architecture {
        return Err(RunError::PackageLayers { agent: index + 1 });
    }
    Ok(())
}

/// Returns the initial inner parameters of every agent without a given package.
fn initial_parameters(
    scenario: &Scenario,
    network: &Network,
    seed: u64,
) -> Result<Vec<f32>, RunError> {
    // No samples are recorded yet, so assume that every input ranges over [-1, 1].
    let (n, known) = (scenario.dimension(), scenario.known_inputs_of(network));
    let corners = |count: usize| [vec![-1.0; count], vec![1.0; count]].concat();
    let parameters = Dataset::with_known_inputs(n, known, corners(n + known), corners(n))
        .map_err(TrainingError::from)
        .and_then(|data| Ok(network.inner.draw(&network.architecture, &data, seed)?))
        .map_err(RunError::InitialNetwork)?;
    Ok(parameters.iter().map(|&parameter| parameter as f32).collect())
}

struct Simulation<'s, 'c, const N: usize> {
    scenario: &'s Scenario,
    plan: Option<Arc<Plan<'s>>>,
    /// The packages in use, as long as agents have still to switch to the field observer.
    current: Vec<PackageBytes>,
    options: RunOptions,
    link: RunLink<'c>,
    run_observer: Option<&'c mut dyn RunObserver>,
    agents: Vec<SimulatedAgent<'s, N>>,
    networks: Networks,
    /// What the agents broadcast last.
    sent: Sent<N>,
    /// The networks of the agents, chunk by chunk.
    lanes: Vec<Lanes<N>>,
    lane_mode: LaneMode,
    /// `x_0` at this tick.
    truth: [f64; N],
    /// `x_0` at the tick before.
    before: [f64; N],
    /// Ticks of the evaluation window.
    evaluation: std::ops::Range<Tick>,
    /// Whether each agent is down.
    down: Vec<bool>,
    /// The learning cycles, at the end.
    cycles: Vec<LearningCycle>,
    /// What agents missed of the learning cycles.
    missed: Vec<String>,
    traces: Traces,
    state_size: StateSize,
    bounds: Option<BoundsMeter<'s>>,
    digest: Fnv,
}

impl<'s, const N: usize> Simulation<'s, '_, N> {
    fn begin(&mut self, packages: &[PackageBytes]) -> Result<(), RunError> {
        let Some(run_observer) = &mut self.run_observer else { return Ok(()) };
        let graph = &self.scenario.graph;
        let agents = self.agents.iter().enumerate().map(|(index, agent)| AgentStart {
            package: packages.get(index),
            estimate: agent.estimate(),
            announcement: agent.broadcast(),
            neighbours: graph.neighbours(index).iter().map(|n| n.agent).collect(),
        });
        run_observer.begin(&agents.collect::<Vec<_>>()).map_err(RunError::RunObserver)
    }

    /// Switches in the packages of learning cycles and of the observer before the step at `tick`.
    fn switch(
        &mut self,
        tick: Tick,
        mut switches: Vec<Switch>,
    ) -> Result<ControlFlow<()>, RunError> {
        if let Some(run_observer) = &mut self.run_observer
            && let ControlFlow::Break(()) =
                run_observer.before_step(tick, &mut switches).map_err(RunError::RunObserver)?
        {
            return Ok(ControlFlow::Break(()));
        }
        let is_any = !switches.is_empty();
        for Switch { agent: index, package, back } in switches {
            let agent = &mut self.agents[index];
            let networks = &mut self.networks;
            let switched = match back {
                true => agent.revert(&package, networks),
                false => agent.load(&package, networks),
            };
            switched.map_err(|refusal| RunError::Refused { agent: index + 1, refusal })?;
        }
        if is_any {
            self.lanes = stepping::lanes(&self.agents, self.lane_mode);
        }
        Ok(ControlFlow::Continue(()))
    }

    fn all_steps(&mut self, progress: &dyn Progress) -> Result<Vec<TrainingRecord>, RunError> {
        let scenario = self.scenario;
        let steps = scenario.steps();
        let plan = self.plan.clone();
        let mut learning = self
            .options
            .learning
            .then(|| Learning::new(scenario, plan.as_deref(), self.options.seed));
        let mut plant = SimulatedPlant::new(scenario, self.options.seed);
        let mut trainings = Vec::new();
        self.send_broadcasts(0);
        for tick in 0..steps {
            let mut switches = Vec::new();
            if let Some(learning) = &mut learning {
                let mut records;
                (switches, records) = learning.switches_due(tick, progress)?;
                trainings.append(&mut records);
                self.note_untrained(learning.without_samples(tick));
            }
            self.start_field(tick, &mut switches)?;
            self.leave_out_down(&mut switches);
            if let ControlFlow::Break(()) = self.switch(tick, switches)? {
                self.cycles = learning.map_or_else(Vec::new, Learning::into_cycles);
                return Ok(trainings);
            }
            self.note(tick, self.evaluation.contains(&tick));
            self.step_agents(tick)?;
            if scenario.plant.recording().is_some() && self.evaluation.contains(&tick) {
                self.note_innovations();
            }
            if self.is_traced(tick) {
                let innovations = self.agents.iter().map(SimulatedAgent::innovation);
                self.traces.push_innovations(innovations);
            }
            if let Some(learning) = &mut learning {
                let agents = &self.agents;
                learning.collect(
                    tick,
                    |agent| agents[agent].sample(),
                    |agent| agents[agent].outer_weights(),
                    |agent| agents[agent].observation(),
                );
                if learning.watches_rate() {
                    let broadcasts = agents.iter().filter(|agent| agent.outgoing.is_some());
                    learning.note_broadcasts(tick, broadcasts.count() as u64);
                }
            }
            if let Some(run_observer) = &mut self.run_observer {
                let steps: Vec<_> = self.agents.iter().map(SimulatedAgent::last_step).collect();
                run_observer.after_step(tick, &steps).map_err(RunError::RunObserver)?;
            }
            self.update_life(tick + 1)?;
            self.send_broadcasts(tick + 1);
            self.before = self.truth;
            plant.advance(tick, &mut self.truth);
            // Agents measure in single precision.
            let is_known = scenario.plant.is_known();
            if is_known && !self.truth.iter().all(|&x| (x as f32).is_finite()) {
                return Err(plant_error(scenario, plant.stepper(), tick, &self.before));
            }
            if tick.is_multiple_of(PROGRESS_STRIDE) {
                progress.step(tick, steps);
            }
            if tick.is_multiple_of(STOP_STRIDE) && progress.is_stopped() {
                return Err(RunError::Interrupted);
            }
        }
        self.note(steps, false);
        progress.step(steps, steps);
        self.cycles = learning.map_or_else(Vec::new, Learning::into_cycles);
        Ok(trainings)
    }

    /// Adds switches to the field observer for agents that have none at its start.
    fn start_field(&mut self, tick: Tick, switches: &mut Vec<Switch>) -> Result<(), RunError> {
        let Some(plan) = &self.plan else { return Ok(()) };
        if self.current.is_empty() {
            return Ok(());
        }
        // Agents that are down keep theirs.
        for switch in switches.iter().filter(|switch| !self.down[switch.agent]) {
            self.current[switch.agent] = switch.package.clone();
        }
        if tick < plan.starts_at() {
            return Ok(());
        }
        for (agent, package) in std::mem::take(&mut self.current).iter().enumerate() {
            if !switches.iter().any(|switch| switch.agent == agent) {
                let package = plan.next(package, agent).map_err(RunError::Observer)?;
                switches.push(Switch { agent, package, back: false });
            }
        }
        Ok(())
    }

    /// Notes the agents that have no samples to train with.
    fn note_untrained(&mut self, without_samples: impl Iterator<Item = (usize, usize)>) {
        let missed = without_samples.map(|(agent, cycle)| {
            format!(
                "agent {}, cycle {}: no samples, because it took no step in that time or had no \
                 measurement; it keeps its network",
                agent + 1,
                cycle + 1
            )
        });
        self.missed.extend(missed);
    }

    /// Leaves out the packages for agents that are down, and notes it.
    fn leave_out_down(&mut self, switches: &mut Vec<Switch>) {
        switches.retain(|switch| {
            let down = self.down[switch.agent];
            if down {
                let agent = switch.agent + 1;
                self.missed.push(format!(
                    "agent {agent} is down when its next package is switched in; it keeps the previous one"
                ));
            }
            !down
        });
    }

    /// Takes agents down and boots them again at `tick`, before its broadcasts.
    fn update_life(&mut self, tick: Tick) -> Result<(), RunError> {
        let scenario = self.scenario;
        if scenario.life.is_empty() {
            return Ok(());
        }
        let life = || {
            let ticks = |downtime: &'s Downtime| (downtime, downtime.window.ticks(&scenario.time));
            scenario.life.iter().map(ticks)
        };
        let last = scenario.steps();
        let mut has_booted = false;
        for (downtime, _) in life().filter(|(_, ticks)| ticks.end == tick && tick < last) {
            let index = downtime.agent;
            self.down[index] = false;
            has_booted = true;
            self.agents[index]
                .reboot(downtime.is_replaced, &mut self.networks)
                .map_err(|refusal| RunError::Refused { agent: index + 1, refusal })?;
        }
        if has_booted {
            self.lanes = stepping::lanes(&self.agents, self.lane_mode);
        }
        for (downtime, _) in life().filter(|(_, ticks)| ticks.start == tick) {
            self.down[downtime.agent] = true;
            self.agents[downtime.agent].rest();
        }
        Ok(())
    }

    /// Records errors and traces of `tick`, before its step.
    #[inline]
    fn note(&mut self, tick: Tick, evaluated: bool) {
        let truth = &self.truth;
        self.state_size.note(truth, evaluated);
        let is_known = self.scenario.plant.is_known();
        if evaluated || self.bounds.is_some() {
            let mut stacked = 0.0;
            for (index, agent) in self.agents.iter_mut().enumerate() {
                let squared = squared_error(agent.estimate(), truth);
                stacked += squared;
                if evaluated && is_known && !self.down[index] {
                    agent.statistics.error(squared);
                }
                if evaluated && self.scenario.method == Method::Regression && !self.down[index] {
                    agent.note_extrapolation();
                }
            }
            if let Some(bounds) = &mut self.bounds {
                bounds.note(tick, stacked, truth);
                if bounds.samples_lumped(tick) {
                    self.sample_lumped(tick);
                }
            }
        }
        if self.is_traced(tick) {
            let estimates = self.agents.iter().map(SimulatedAgent::estimate);
            self.traces.push(self.scenario.time.at(tick), &self.truth, estimates);
        }
    }

    /// Returns whether traces have a row for `tick`.
    fn is_traced(&self, tick: Tick) -> bool {
        let stride = self.scenario.record.trace_stride;
        stride.is_some_and(|stride| tick.is_multiple_of(u64::from(stride.get())))
    }

    /// Records the innovations of the last step, for their root mean square.
    fn note_innovations(&mut self) {
        for agent in &mut self.agents {
            let step = agent.observation();
            agent.statistics.innovation(step.squares, step.outputs);
        }
    }

    /// Takes samples for checking Theorem 1's premise on `rho`.
    #[inline(never)]
    fn sample_lumped(&mut self, tick: Tick) {
        let Some(bounds) = &mut self.bounds else { return };
        let time = self.scenario.time.at(tick);
        let (mut rate, mut disturbance) = ([0.0; N], [0.0; N]);
        self.scenario.plant.derivative(time, &self.truth, &mut rate);
        self.scenario.disturbance.evaluate(time, &self.truth, &mut disturbance);
        rate.iter_mut().zip(&disturbance).for_each(|(rate, d)| *rate += d);
        let samples = bounds.lumped();
        samples.disturbance(&disturbance);
        for (index, agent) in self.agents.iter_mut().enumerate() {
            agent.with_features(time, |network| samples.agent(index, &rate, network));
        }
    }

    #[inline]
    fn step_agents(&mut self, tick: Tick) -> Result<(), RunError> {
        let Self { link, sent, truth, before, down, agents, lanes, .. } = self;
        let around = Surroundings { tick, truth, before, link: &*link, sent };
        if !stepping::step(agents, lanes, down, &around) {
            return Ok(());
        }
        let failure = self.agents.iter().position(|agent| agent.failure.is_some());
        let time = self.scenario.time.at(tick);
        if let Some(index) = self.agents.iter().position(SimulatedAgent::lacks_input) {
            return Err(self.without_input(index, time));
        }
        match failure.and_then(|index| Some((index, self.agents[index].failure?))) {
            Some((index, error)) => Err(RunError::Step {
                agent: index + 1,
                time,
                plant_norm: self.truth.iter().fold(0.0, |sum, x| sum + x * x).sqrt(),
                step: StepCheck::new(self.scenario),
                remedy: remedy(self.scenario),
                error,
            }),
            None => Ok(()),
        }
    }

    /// Returns the error of an agent for which a known input has no usable value by its own clock.
    fn without_input(&self, index: usize, time: f64) -> RunError {
        let Scenario { plant, disturbance, time: clock, .. } = self.scenario;
        let own = self.agents[index].last_tick().map_or(time, |tick| clock.at(tick));
        if let Some(fault @ RateFault::Input(_)) =
            RateFault::find(plant, disturbance, own, &self.truth)
        {
            return RunError::Expression(Box::new(fault));
        }
        let known = plant.known_inputs(own);
        let input = known.iter().position(|&u| !(u as f32).is_finite()).unwrap_or(0);
        let name = plant.input_names().swap_remove(input);
        RunError::KnownInput { agent: index + 1, name, value: known[input], time: own }
    }

    /// Sends the broadcasts of `tick` over the link.
    #[inline]
    fn send_broadcasts(&mut self, tick: Tick) {
        let keep = self.scenario.record.events;
        let is_evaluated = self.evaluation.contains(&tick);
        for (index, agent) in self.agents.iter_mut().enumerate() {
            if let Some((frame, bytes)) = &agent.outgoing {
                agent.statistics.broadcast(tick, bytes.len(), keep, is_evaluated);
                self.digest.add(bytes);
                self.link.send(index, tick, bytes);
                self.sent.note(index, frame, bytes);
                agent.outgoing = None;
            }
        }
        self.link.advance(tick);
    }

    fn finish(mut self, mut trainings: Vec<TrainingRecord>) -> RunResult {
        // They are in time order, and the agents of a cycle may be listed in any order.
        trainings.sort_by_key(|training| (training.cycle, training.agent));
        for agent in &self.agents {
            for value in agent.estimate().iter().chain(&agent.outer_weights()) {
                self.digest.add(&value.to_le_bytes());
            }
        }
        for (index, agent) in self.agents.iter_mut().enumerate() {
            agent.statistics.traffic = self.link.traffic(index);
        }
        RunResult {
            cycles: self.cycles,
            layers: self.link.layer_counts(),
            missed: self.missed,
            agents: self.agents.into_iter().map(SimulatedAgent::finish).collect(),
            trainings,
            traces: self.traces,
            largest_state: self.state_size.largest(),
            state_deviation: self.state_size.deviation(),
            bounds: self.bounds.map(BoundsMeter::finish),
            digest: self.digest.finish(),
        }
    }
}
