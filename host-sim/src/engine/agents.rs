//! One agent of the network as the engine steps it: the core's parameters and state, its
//! inbox, and what is measured of it.

use agent_core::agent::capture::Sample;
use agent_core::agent::hold::Hold;
use agent_core::agent::inbox::Inbox;
use agent_core::agent::{AgentParams, AgentState, StepError, StepOutput};
use agent_core::health::HealthSettings;
use agent_core::math::parameter::ParameterError;
use agent_core::observer::feedback::Neighbour;
use agent_core::observer::network::{InnerNetwork, LAYER_WIDTH_MAX, Scratch};
use agent_core::package::{AgentConfig, Capacity, InUse, Refusal, Requirements, accept};
use agent_core::service::Outcome;
use agent_core::wire::frame::FrameBytes;
use agent_core::{StateVector, Tick};

use super::link::Link;
use super::run_observer::AgentStep;
use super::statistics::AgentStatistics;
use super::watch::{Watch, is_recoverable};
use crate::packages::{PackageBytes, PackageParameters};
use crate::scenario;

type SharedNetwork = InnerNetwork<PackageParameters>;

type HeldPlaces<const N: usize> = Vec<Option<Hold<N>>>;

pub(super) type SimulatedState<const N: usize> = AgentState<N, LAYER_WIDTH_MAX, HeldPlaces<N>>;

pub(super) type SimulatedInbox<const N: usize> = Inbox<N, HeldPlaces<N>>;

/// What the core's parameters borrow: on a node it would be static buffers.
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

    /// The core's parameters of this node.
    pub(super) fn params<const N: usize>(
        &mut self,
        node: &AgentConfig<'_>,
    ) -> Result<AgentParams<'_, N>, ParameterError> {
        node.params(&mut self.neighbours, &mut self.outer_gain)
    }
}

/// Norms that Theorem 2's bounding constant needs.
#[derive(Clone, Copy, Debug)]
pub(super) struct GainNorms {
    /// `|K_1|`.
    pub(super) gain: f64,
    /// `|K_1 C_i^T|`.
    pub(super) gain_output: f64,
}

/// One agent.
pub(super) struct SimulatedAgent<'s, const N: usize> {
    params: AgentParams<'s, N>,
    state: SimulatedState<N>,
    inbox: SimulatedInbox<N>,
    network: Option<SharedNetwork>,
    /// What is in use, as the rule against older packages asks.
    in_use: Option<InUse>,
    /// `C_i` in double precision, `m` rows: what the plant's sensor does.
    sensor: Vec<[f64; N]>,
    measurement: [f32; N],
    norms: Option<(GainNorms, Box<Scratch>)>,
    /// How the agent is watched, if it is.
    health: Option<HealthSettings>,
    /// Its watch, from the first package on.
    watch: Option<Watch<N>>,
    pub(super) statistics: AgentStatistics,
    /// Of the last step, if there is something to learn from it.
    pub(super) last_sample: Option<Sample<N>>,
    /// What the last step broadcast.
    pub(super) outgoing: Option<FrameBytes>,
    pub(super) failure: Option<StepError>,
    /// What came of the last step, in the words of a node.
    outcome: Outcome,
}

impl<'s, const N: usize> SimulatedAgent<'s, N> {
    /// The agent with these parameters, on its feedback alone until a package is loaded.
    pub(super) fn new(
        params: AgentParams<'s, N>,
        agent: &scenario::Agent,
        outer_weights: &[f32],
        norms: Option<GainNorms>,
        health: Option<HealthSettings>,
    ) -> Result<Self, ParameterError> {
        let places = vec![None; params.neighbours().len()];
        let estimate = StateVector::from_iterator(agent.initial_estimate.iter().map(|&x| x as f32));
        let state = AgentState::new(&params, estimate, outer_weights, places.clone())?;
        let sensor = agent
            .output_matrix
            .row_iter()
            .map(|row| std::array::from_fn(|column| row[column]))
            .collect();
        let outgoing = Some(state.announcement(&params).encode());
        Ok(Self {
            params,
            state,
            inbox: Inbox::new(places),
            network: None,
            in_use: None,
            sensor,
            measurement: [0.0; N],
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

    /// Takes delivery, measures, and steps the core. A failure is kept for the engine to find,
    /// because agents are stepped in parallel.
    #[inline]
    pub(super) fn step(&mut self, tick: Tick, truth: &[f64; N], link: &impl Link, index: usize) {
        let (inbox, params) = (&mut self.inbox, &self.params);
        let (refused, watch) = (&mut self.statistics.frames_refused, &mut self.watch);
        link.deliver(index, tick, |bytes| {
            // A node drops a frame that it cannot use and goes on; so does its simulation.
            let accepted = match watch {
                None => inbox.accept(params.neighbours(), bytes),
                Some(watch) => watch.accept(params, inbox, bytes),
            };
            *refused += u64::from(accepted.is_err());
        });
        for (measured, row) in self.measurement.iter_mut().zip(&self.sensor) {
            let exact = row.iter().zip(truth).fold(0.0, |sum, (c, x)| sum + c * x);
            *measured = exact as f32;
        }
        let measurement = &self.measurement[..self.sensor.len()];
        let network_in_use = self.watch.as_ref().is_none_or(Watch::network_in_use);
        let network = self.network.as_ref().filter(|_| network_in_use);
        let outcome = self.state.step(&self.params, network, tick, measurement, &mut self.inbox);
        self.outcome = outcome.as_ref().map_or_else(Outcome::from, |_| Outcome::Stepped);
        if self.norms.is_some()
            && let Ok(output) = &outcome
        {
            self.observe_bounds(&output.sample, network_in_use);
        }
        let Some(watch) = &mut self.watch else {
            match outcome {
                Ok(output) => self.take_output(output),
                Err(failure) => self.failure = Some(failure),
            }
            return;
        };
        let (params, state, inbox) = (&self.params, &mut self.state, &mut self.inbox);
        let anew = watch.observe(params, state, inbox, tick, &outcome);
        match (anew, outcome) {
            // What led there is nothing to learn from.
            (Some(frame), _) => {
                self.outcome = Outcome::Restarted;
                self.outgoing = Some(frame.encode());
                self.last_sample = None;
            }
            (None, Ok(output)) => self.take_output(output),
            (None, Err(failure)) => {
                self.last_sample = None;
                self.failure = Some(failure).filter(|&failure| !is_recoverable(failure));
            }
        }
    }

    #[inline]
    fn take_output(&mut self, output: StepOutput<N>) {
        self.outgoing = output.broadcast.map(|frame| frame.encode());
        self.last_sample = Some(output.sample);
    }

    /// Keeps the largest `e_2i_max` of Theorem 2 and the largest norm of the outer weights.
    fn observe_bounds(&mut self, sample: &Sample<N>, network_in_use: bool) {
        let Some((norms, scratch)) = &mut self.norms else { return };
        let network = self.network.as_ref().filter(|_| network_in_use);
        let features = network.and_then(|network| {
            let features = network.features(sample.estimate.as_slice(), scratch)?;
            Some(norm(features))
        });
        let weights = f64::from(self.state.outer_weights().norm_squared()).sqrt();
        let rate = weights * features.unwrap_or(0.0)
            + norms.gain * norm(self.state.consensus_term().as_slice())
            + norms.gain_output * norm(self.state.output_error(&self.params));
        let statistics = &mut self.statistics;
        statistics.hold_error_rate_max = statistics.hold_error_rate_max.max(rate);
        statistics.outer_weights_norm_max = statistics.outer_weights_norm_max.max(weights);
    }

    /// Calls `hear` with `sigma_i` at the estimate, shape `[L]`, and `W_hat_i` row by row, shape
    /// `[L, N]`; `None` if the agent runs on its feedback alone.
    pub(super) fn with_features(&mut self, hear: impl FnOnce(Option<(&[f32], &[f32])>)) {
        let network_in_use = self.watch.as_ref().is_none_or(Watch::network_in_use);
        let network = self.network.as_ref().filter(|_| network_in_use);
        let (Some(network), Some((_, scratch))) = (network, &mut self.norms) else {
            return hear(None);
        };
        let weights: Vec<f32> =
            self.state.outer_weights().rows().iter().flat_map(|row| row.iter().copied()).collect();
        match network.features(self.state.estimate().as_slice(), scratch) {
            Some(features) => hear(Some((features, &weights))),
            None => hear(None),
        }
    }

    /// `x_hat` at the tick after the last step.
    #[inline]
    pub(super) fn estimate(&self) -> &[f32] {
        self.state.estimate().as_slice()
    }

    /// `W_hat`, row by row.
    pub(super) fn outer_weights(&self) -> Vec<f32> {
        self.state.outer_weights().rows().iter().flat_map(|row| row.iter().copied()).collect()
    }

    /// What the last step took and did.
    pub(super) fn last_step(&self) -> AgentStep<'_> {
        AgentStep {
            measurement: &self.measurement[..self.sensor.len()],
            outcome: self.outcome,
            estimate: self.estimate(),
            derivative: self.last_sample.as_ref().map(|sample| sample.derivative.as_slice()),
            outer_weights: self.outer_weights(),
            broadcast: self.outgoing.as_deref(),
        }
    }

    /// Takes a package into use, between two steps and with the checks of a node. The agent's
    /// parameters stay as they are: whoever calls has seen that the package has the same.
    pub(super) fn load(&mut self, bytes: &PackageBytes) -> Result<(), Refusal> {
        self.load_after(bytes, self.in_use)
    }

    /// Goes back to a package, which may be older than the one in use; otherwise as
    /// [`Self::load`].
    pub(super) fn go_back(&mut self, bytes: &PackageBytes) -> Result<(), Refusal> {
        self.load_after(bytes, None)
    }

    fn load_after(&mut self, bytes: &PackageBytes, in_use: Option<InUse>) -> Result<(), Refusal> {
        let requirements = Requirements { public_key: None, in_use, capacity: Capacity::UNLIMITED };
        let package = accept::<N>(bytes.as_bytes(), &requirements, &mut Scratch::NEW.clone())?;
        let watch = match &self.health {
            Some(health) => Some(Watch::new(&self.params, &package, health, self.watch.as_ref())?),
            None => None,
        };
        let neighbours = self.params.neighbours();
        self.state.switch(neighbours, &self.params, &package, &mut self.inbox)?;
        self.in_use = Some(InUse { agent: package.node.agent, version: package.version });
        self.network = Some(bytes.network());
        self.watch = watch;
        Ok(())
    }

    /// What was measured of it.
    pub(super) fn finish(mut self) -> AgentStatistics {
        self.statistics.health = self.watch.as_ref().map(Watch::counters);
        self.statistics
    }
}

fn norm(values: &[f32]) -> f64 {
    values.iter().fold(0.0, |sum, &v| sum + f64::from(v) * f64::from(v)).sqrt()
}
