//! A simulated agent: the core's parameters and state, its inbox, its sensor and clock, and its
//! statistics.

use agent_core::agent::capture::Sample;
use agent_core::agent::hold::Hold;
use agent_core::agent::inbox::Inbox;
use agent_core::agent::{AgentParams, AgentState, StepError};
use agent_core::health::{HealthSettings, WatchedStep};
use agent_core::math::parameter::ParameterError;
use agent_core::observer::features::Features;
use agent_core::observer::feedback::Neighbour;
use agent_core::observer::network::{LAYER_WIDTH_MAX, Scratch};
use agent_core::observer::trigger::Trigger;
use agent_core::package::{AgentConfig, Refusal, Requirements, Serial, accept};
use agent_core::service::Outcome;
use agent_core::wire::frame::{Frame, FrameBytes};
use agent_core::{StateVector, Tick};

use super::clock::Clock;
use super::lanes::{Ahead, Computed};
use super::learning::Observation;
use super::link::{Link, RunLink};
use super::networks::Networks;
use super::norms::{GainNorms, Norms};
use super::run_observer::AgentStep;
use super::sensor::Sensor;
use super::sent::Sent;
use super::statistics::AgentStatistics;
use super::watch::{Watch, is_recoverable};
use crate::basis::{Basis, Driven, SharedNetwork, substitute};
use crate::packages::PackageBytes;
use crate::plant::Recorded;
use crate::scenario::{self, Scenario};

#[inline]
fn encoded<const N: usize>(frame: Frame<N>) -> (Frame<N>, FrameBytes) {
    (frame, frame.encode())
}

type HeldPlaces<const N: usize> = Vec<Option<Hold<N>>>;

pub(super) type SimulatedState<const N: usize> = AgentState<N, LAYER_WIDTH_MAX, HeldPlaces<N>>;

pub(super) type SimulatedInbox<const N: usize> = Inbox<N, HeldPlaces<N>>;

/// Buffers that the core's parameters borrow; static on a node.
pub(super) struct ParamBuffers {
    neighbours: Vec<Neighbour>,
    outer_gain: Vec<f32>,
}

impl ParamBuffers {
    pub(super) fn new(node: &AgentConfig<'_>) -> Self {
        Self {
            neighbours: vec![Neighbour { id: 0, weight: 0.0 }; node.neighbours.len()],
            outer_gain: vec![0.0; node.outer_law.gain.entries().len()],
        }
    }

    /// Returns the core's parameters of this agent.
    pub(super) fn params<const N: usize>(
        &mut self,
        node: &AgentConfig<'_>,
    ) -> Result<AgentParams<'_, N>, ParameterError> {
        node.params(&mut self.neighbours, &mut self.outer_gain)
    }
}

/// What surrounds the agents in a step of the engine.
pub(super) struct Surroundings<'r, const N: usize> {
    /// The engine's tick.
    pub(super) tick: Tick,
    /// `x_0` at this tick.
    pub(super) truth: &'r [f64; N],
    /// `x_0` at the tick before.
    pub(super) before: &'r [f64; N],
    pub(super) link: &'r RunLink<'r>,
    /// What the agents broadcast last.
    pub(super) sent: &'r Sent<N>,
}

/// A simulated agent.
pub(super) struct SimulatedAgent<'s, const N: usize> {
    params: AgentParams<'s, N>,
    state: SimulatedState<N>,
    inbox: SimulatedInbox<N>,
    network: Option<Driven<'s>>,
    scenario: &'s Scenario,
    /// Epoch and version of the newest package so far, for the check against older ones.
    highest: Option<Serial>,
    /// `C_i` in double precision, `m` rows.
    output_matrix: Vec<[f64; N]>,
    /// Columns of the recording that it measures, if the plant is one.
    columns: Vec<usize>,
    /// The sensor model; `None` for an exact sensor.
    sensor: Option<Box<Sensor>>,
    /// The clock; `None` for the engine's.
    clock: Option<Box<Clock>>,
    measurement: [f32; N],
    /// Whether the last step had a measurement.
    is_measured: bool,
    /// The agent's tick of the last step of the engine; `None` if it did not step.
    tick: Option<Tick>,
    /// The estimate and the outer weights after a boot without a package.
    initial: (StateVector<N>, Vec<f32>),
    /// The packages that it had first, and that it has; `None` if it never boots again.
    packages: Option<(Option<PackageBytes>, Option<PackageBytes>)>,
    norms: Option<(GainNorms, Box<Scratch>)>,
    /// Health monitoring settings, if it is monitored.
    health: Option<HealthSettings>,
    /// Its health monitor, from the first package on.
    watch: Option<Watch<N>>,
    pub(super) statistics: AgentStatistics,
    /// Sample of the last step, if it is usable for training, as on a node.
    pub(super) last_sample: Option<Sample<N>>,
    /// Frame broadcast by the last step, and its bytes.
    pub(super) outgoing: Option<(Frame<N>, FrameBytes)>,
    pub(super) failure: Option<StepError>,
    /// Outcome of the last step, as reported by a node.
    outcome: Outcome,
}

impl<'s, const N: usize> SimulatedAgent<'s, N> {
    /// Creates an agent, which uses feedback and consensus only until a package is loaded.
    pub(super) fn new(
        params: AgentParams<'s, N>,
        (scenario, agent): (&'s Scenario, &scenario::Agent),
        (sensor, clock): (Option<Sensor>, Option<Clock>),
        reboots: bool,
        outer_weights: &[f32],
        norms: Option<GainNorms>,
        health: Option<HealthSettings>,
    ) -> Result<Self, ParameterError> {
        let places = vec![None; params.neighbours().len()];
        let estimate = StateVector::from_iterator(agent.initial_estimate.iter().map(|&x| x as f32));
        let state = AgentState::new(&params, estimate, outer_weights, places.clone())?;
        let output_matrix = agent
            .output_matrix
            .row_iter()
            .map(|row| std::array::from_fn(|column| row[column]))
            .collect();
        let outgoing = Some(encoded(state.announcement(&params)));
        Ok(Self {
            params,
            state,
            inbox: Inbox::new(places),
            network: None,
            scenario,
            highest: None,
            output_matrix,
            columns: agent.measured.clone(),
            sensor: sensor.map(Box::new),
            clock: clock.map(Box::new),
            measurement: [0.0; N],
            is_measured: true,
            tick: None,
            initial: (estimate, outer_weights.to_vec()),
            packages: reboots.then_some((None, None)),
            norms: norms.map(|norms| (norms, Box::new(Scratch::NEW))),
            health,
            watch: None,
            statistics: AgentStatistics::default(),
            last_sample: None,
            outgoing,
            failure: None,
            outcome: Outcome::Stepped,
        })
    }

    /// Receives frames, measures, and steps the core. A failure is stored for the engine, because
    /// agents are stepped in parallel. `computed` are the network's features, if they were computed ahead.
    #[inline]
    pub(super) fn step(
        &mut self,
        around: &Surroundings<'_, N>,
        index: usize,
        computed: Option<Computed<'_, N>>,
    ) {
        let tick = match &mut self.clock {
            None => Some(around.tick),
            Some(clock) => clock.step(around.tick),
        };
        self.tick = tick;
        match tick {
            Some(tick) => {
                self.measure(around);
                self.step_at(tick, around, index, computed);
            }
            None => {
                self.receive(around, index);
                self.rest();
            }
        }
    }

    /// Records how far a polynomial's inputs are outside the range of its samples.
    pub(super) fn note_extrapolation(&mut self) {
        let Some((polynomial, known)) = self.network.as_ref().and_then(Driven::polynomial) else {
            return;
        };
        let inputs = self.state.estimate().iter().chain(known).copied();
        self.statistics.extrapolation.note(polynomial.outside(inputs));
    }

    /// Records that the agent did nothing in a step of the engine.
    pub(super) fn rest(&mut self) {
        self.tick = None;
        self.outgoing = None;
        self.last_sample = None;
        self.failure = None;
    }

    /// Writes the measurement for this step.
    #[inline]
    fn measure(&mut self, around: &Surroundings<'_, N>) {
        let between: [f64; N];
        let truth = match &self.clock {
            None => around.truth,
            Some(clock) => {
                let late = clock.lateness(around.tick);
                between = std::array::from_fn(|k| {
                    let now = around.truth[k];
                    now + late * (now - around.before[k])
                });
                &between
            }
        };
        if let Some(recorded) = self.scenario.plant.recording() {
            return self.measure_recorded(recorded, around.tick, truth);
        }
        let exact = |row: &[f64; N]| row.iter().zip(truth).fold(0.0, |sum, (c, x)| sum + c * x);
        match &mut self.sensor {
            None => {
                for (measured, row) in self.measurement.iter_mut().zip(&self.output_matrix) {
                    *measured = exact(row) as f32;
                }
            }
            Some(sensor) => {
                let mut outputs = [0.0; N];
                for (output, row) in outputs.iter_mut().zip(&self.output_matrix) {
                    *output = exact(row);
                }
                let outputs = &outputs[..self.output_matrix.len()];
                self.is_measured = sensor.measure(around.tick, outputs, &mut self.measurement);
            }
        }
    }

    /// Writes what the recording has for this step, or outputs of its reference.
    fn measure_recorded(&mut self, recorded: &Recorded, tick: Tick, truth: &[f64; N]) {
        let time = &self.scenario.time;
        let mut outputs = [f64::NAN; N];
        for (place, (output, row)) in outputs.iter_mut().zip(&self.output_matrix).enumerate() {
            *output = match self.columns.get(place) {
                Some(&column) => {
                    recorded.measured(column, time.at(tick), time.step_size).unwrap_or(f64::NAN)
                }
                None => row.iter().zip(truth).fold(0.0, |sum, (c, x)| sum + c * x),
            };
        }
        let outputs = &outputs[..self.output_matrix.len()];
        let is_recorded = outputs.iter().all(|output| output.is_finite());
        self.is_measured = match &mut self.sensor {
            _ if !is_recorded => false,
            Some(sensor) => sensor.measure(tick, outputs, &mut self.measurement),
            None => {
                let values = self.measurement.iter_mut().zip(outputs);
                values.for_each(|(measured, &output)| *measured = output as f32);
                true
            }
        };
    }

    /// Keeps the frames that have arrived for the next step.
    fn receive(&mut self, around: &Surroundings<'_, N>, index: usize) {
        let Self { params, state, inbox, watch, statistics, .. } = self;
        let mut refused = 0;
        around.link.deliver(index, around.tick, &mut |bytes| {
            let kept = match watch {
                None => around.sent.accept(inbox, params.neighbours(), bytes),
                Some(watch) => around.sent.receive(&mut watch.agent(params, state, inbox).0, bytes),
            };
            refused += u64::from(kept.is_err());
        });
        statistics.frames_refused += refused;
    }

    #[inline]
    fn step_at(
        &mut self,
        tick: Tick,
        around: &Surroundings<'_, N>,
        index: usize,
        computed: Option<Computed<'_, N>>,
    ) {
        let Self { params, state, inbox, watch, network, norms, statistics, scenario, .. } = self;
        let measurement = self.is_measured.then_some(&self.measurement[..self.output_matrix.len()]);
        if let Some(network) = network {
            network.set_time(&scenario.plant, scenario.time.at(tick));
        }
        let network = network.as_ref().map(|source| Ahead { source, computed });
        let network = network.as_ref();
        let mut bounds = Norms::default();
        let mut refused = 0;
        let is_measured = self.is_measured;
        // By reference: moving a whole step takes as long as a broadcast.
        let mut report = |frame: Option<&Frame<N>>, sample: Option<&Sample<N>>| {
            self.outgoing = frame.copied().map(encoded);
            // Without a measurement the estimate says nothing new about the plant.
            self.last_sample = sample.filter(|_| is_measured).copied();
        };
        let outcome;
        match watch {
            // The paper's agent: without a trained box or restarts.
            None => {
                around.link.deliver(index, around.tick, &mut |bytes| {
                    refused +=
                        u64::from(around.sent.accept(inbox, params.neighbours(), bytes).is_err());
                });
                match &state.attempt(params, network, tick, measurement, inbox) {
                    Ok(output) => {
                        bounds = Norms::of(params, network, state, &output.sample, norms);
                        report(output.broadcast.as_ref(), Some(&output.sample));
                        (outcome, self.failure) = (Outcome::Stepped, None);
                    }
                    Err(error) => {
                        report(None, None);
                        (outcome, self.failure) = (Outcome::from(error), Some(*error));
                    }
                }
            }
            Some(watch) => {
                let network_in_use = watch.network_in_use();
                let (mut agent, outer_weights) = watch.agent(params, state, inbox);
                // Like a node, drop unusable frames and continue.
                around.link.deliver(index, around.tick, &mut |bytes| {
                    refused += u64::from(around.sent.receive(&mut agent, bytes).is_err());
                });
                let step = agent.attempt_observed(
                    network,
                    outer_weights,
                    tick,
                    measurement,
                    |state, output| {
                        let network = network.filter(|_| network_in_use);
                        bounds = Norms::of(params, network, state, &output.sample, norms);
                    },
                );
                report(step.broadcast(), step.sample());
                outcome = Outcome::from(&step);
                self.failure = match step {
                    WatchedStep::Refused(error) => Some(error).filter(|&e| !is_recoverable(e)),
                    WatchedStep::Taken(_) | WatchedStep::Restarted(_) => None,
                };
            }
        }
        statistics.frames_refused += refused;
        statistics.hold_error_rate_max = statistics.hold_error_rate_max.max(bounds.hold_error_rate);
        statistics.outer_weights_norm_max =
            statistics.outer_weights_norm_max.max(bounds.outer_weights_norm);
        self.outcome = match outcome {
            Outcome::Stepped if !is_measured => Outcome::NoMeasurement,
            outcome => outcome,
        };
        if self.lacks_input() {
            // No monitor recovers from it.
            self.failure = Some(StepError::Diverged);
        }
    }

    /// Boots again: what was in RAM is lost, the packages are kept. A node that `is_replaced` by
    /// another one has the package of the start.
    pub(super) fn reboot(
        &mut self,
        is_replaced: bool,
        networks: &mut Networks,
    ) -> Result<(), Refusal> {
        let (first, current) = self.packages.clone().unwrap_or_default();
        let package = if is_replaced { first } else { current };
        let (estimate, outer_weights) = &self.initial;
        let outer_weights = match &package {
            Some(package) => package.package().outer_weights,
            None => outer_weights,
        };
        self.state.begin(&self.params, *estimate, outer_weights)?;
        self.inbox.clear();
        if let Some(sensor) = &mut self.sensor {
            sensor.restart();
        }
        (self.watch, self.network) = (None, None);
        if let Some(package) = &package {
            self.load_after(package, None, networks)?;
        }
        self.outgoing = Some(encoded(self.state.announcement(&self.params)));
        Ok(())
    }

    /// Calls `use_features` with `sigma_i` at the estimate and `time` \[s\], shape `[L]`, and `W_hat_i`,
    /// row-major, shape `[L, N]`; with `None` if the agent does not use a network.
    pub(super) fn with_features(
        &mut self,
        time: f64,
        use_features: impl FnOnce(Option<(&[f32], &[f32])>),
    ) {
        let network_in_use = self.watch.as_ref().is_none_or(Watch::network_in_use);
        if let Some(network) = &mut self.network {
            network.set_time(&self.scenario.plant, time);
        }
        let network = self.network.as_ref().filter(|_| network_in_use);
        let (Some(network), Some((_, scratch))) = (network, &mut self.norms) else {
            return use_features(None);
        };
        let weights: Vec<f32> =
            self.state.outer_weights().rows().iter().flat_map(|row| row.iter().copied()).collect();
        match network.features(self.state.estimate().as_slice(), scratch) {
            Some(features) => use_features(Some((features, &weights))),
            None => use_features(None),
        }
    }

    /// Returns the network that its steps use, unless its monitor has fallen back.
    #[inline]
    pub(super) fn network(&self) -> Option<&SharedNetwork> {
        let is_used = self.state.field().is_none_or(|field| field.options.uses_network);
        self.network.as_ref().and_then(Driven::network).filter(|_| is_used)
    }

    /// Returns the input at which the next step evaluates the network.
    #[inline]
    pub(super) fn network_input(&self) -> [f32; N] {
        let estimate = self.state.estimate();
        match self.state.field() {
            Some(field) => field.limited(estimate).into(),
            None => (*estimate).into(),
        }
    }

    /// Returns the bytes that the last step broadcast.
    pub(super) fn broadcast(&self) -> Option<&[u8]> {
        self.outgoing.as_ref().map(|(_, bytes)| bytes.as_slice())
    }

    /// Returns `x_hat` at the tick after the last step.
    #[inline]
    pub(super) fn estimate(&self) -> &[f32] {
        self.state.estimate().as_slice()
    }

    /// Returns `W_hat`, row-major.
    pub(super) fn outer_weights(&self) -> Vec<f32> {
        self.state.outer_weights().rows().iter().flat_map(|row| row.iter().copied()).collect()
    }

    /// Whether a known input of the last step had no value that the network can take.
    pub(super) fn lacks_input(&self) -> bool {
        self.tick.is_some() && self.network.as_ref().is_some_and(Driven::lacks_input)
    }

    /// Returns the tick of its clock in the last step; `None` if it did not step.
    pub(super) fn last_tick(&self) -> Option<Tick> {
        self.tick
    }

    /// Returns the sample of the last step, if it is usable for training, with the tick of the agent's clock.
    pub(super) fn sample(&self) -> Option<(Tick, Sample<N>)> {
        self.tick.zip(self.last_sample)
    }

    /// Returns what the agent did in the last step.
    pub(super) fn observation(&self) -> Observation {
        if self.tick.is_none() {
            return Observation::default();
        }
        let errors = self.state.output_error(&self.params);
        Observation {
            squares: errors.iter().fold(0.0, |sum, &e| sum + f64::from(e) * f64::from(e)),
            outputs: if self.is_measured { errors.len() as u64 } else { 0 },
            broadcasts: u64::from(self.outgoing.is_some()),
            steps: 1,
        }
    }

    /// Returns `|e_3i|` of the last step; `None` without a step or a measurement. \[output unit\]
    pub(super) fn innovation(&self) -> Option<f32> {
        let step = self.observation();
        (step.outputs > 0).then(|| step.squares.sqrt() as f32)
    }

    /// Returns inputs and results of the last step; `None` if the agent did not take part in it.
    pub(super) fn last_step(&self) -> Option<AgentStep<'_>> {
        let measurement = &self.measurement[..self.output_matrix.len()];
        Some(AgentStep {
            tick: self.tick?,
            measurement: self.is_measured.then_some(measurement),
            outcome: self.outcome,
            estimate: self.estimate(),
            derivative: self.last_sample.as_ref().map(|sample| sample.derivative.as_slice()),
            outer_weights: self.outer_weights(),
            broadcast: self.broadcast(),
        })
    }

    /// Switches to a package between two steps, after the checks of a node. The agent's parameters
    /// are not changed: the caller has checked that those in the package are equal.
    pub(super) fn load(
        &mut self,
        bytes: &PackageBytes,
        networks: &mut Networks,
    ) -> Result<(), Refusal> {
        self.load_after(bytes, self.highest, networks)
    }

    /// Like [`Self::load`], but goes back to the previous package, as a node does when a trial fails.
    pub(super) fn revert(
        &mut self,
        bytes: &PackageBytes,
        networks: &mut Networks,
    ) -> Result<(), Refusal> {
        self.load_after(bytes, None, networks)
    }

    fn load_after(
        &mut self,
        bytes: &PackageBytes,
        highest: Option<Serial>,
        networks: &mut Networks,
    ) -> Result<(), Refusal> {
        let requirements = Requirements { highest, ..Requirements::ANY };
        let package = accept::<N>(bytes.as_bytes(), &requirements, &mut Scratch::NEW.clone())?;
        let watch = match &self.health {
            Some(health) => Some(Watch::new(&self.params, &package, health, self.watch.as_ref())?),
            None => None,
        };
        let neighbours = self.params.neighbours();
        self.state.switch(neighbours, &self.params, &package, &mut self.inbox)?;
        let after = requirements.serial_after_activation(&package);
        self.highest = self.highest.max(Some(after));
        let basis = substitute(self.scenario, &package);
        let basis = basis.unwrap_or_else(|| Basis::Network(networks.of(bytes)));
        self.network = Some(Driven::new(basis, N));
        if let Some((first, current)) = &mut self.packages {
            first.get_or_insert_with(|| bytes.clone());
            *current = Some(bytes.clone());
        }
        self.watch = watch;
        if self.scenario.observer.is_some() {
            // The switch to the field observer brings its own, and the way back the paper's.
            self.params = self.params.clone().with_exchange(package.node.exchange)?;
            if matches!(self.params.trigger(), Trigger::Event(_)) {
                let trigger = Trigger::Event(package.node.trigger);
                self.params = self.params.clone().with_trigger(trigger)?;
            }
        }
        Ok(())
    }

    /// Returns the agent's statistics.
    pub(super) fn finish(mut self) -> AgentStatistics {
        self.statistics.health = self.watch.as_ref().map(Watch::counters);
        self.statistics
    }
}
