//! One agent of the network as the engine steps it: the core's parameters and state, its
//! inbox, and what is measured of it.

use std::sync::Arc;

use agent_core::Tick;
use agent_core::agent::{AgentParams, AgentState, StepError};
use agent_core::capture::Sample;
use agent_core::frame::FrameBytes;
use agent_core::hold::Hold;
use agent_core::inbox::Inbox;
use agent_core::network::{InnerNetwork, LAYER_WIDTH_MAX, Scratch};
use agent_core::observer::{Neighbour, ObserverParams, OutputMatrix};
use agent_core::outer_law::OuterLawParams;
use agent_core::parameter::ParameterError;
use agent_core::projection::ProjectionParams;
use agent_core::symmetric::SymmetricMatrix;
use agent_core::trigger::TriggerParams;
use agent_core::{AgentId, StateVector};
use nalgebra::{DMatrix, SMatrix};

use super::link::Link;
use super::statistics::AgentStatistics;
use crate::analysis::TriggerConstants;
use crate::scenario::{self, Scenario};

/// An inner network whose parameters several agents can share.
pub(super) type SharedNetwork = InnerNetwork<Arc<[f32]>>;

type Places<const N: usize> = Vec<Option<Hold<N>>>;

/// Stands in where there is no network, and so no outer weights to adapt.
const RESTING_OUTER_LAW: OuterLawParams<'static> = OuterLawParams {
    gain: SymmetricMatrix::Scalar(1.0),
    projection: ProjectionParams {
        radius: 1.0,
        boundary_layer: 1.0,
        smoothing: 1.0,
        smoothness: 0,
    },
};

/// What the core's parameters borrow: on a node it would lie in flash.
pub(super) struct Storage {
    neighbours: Vec<Vec<Neighbour>>,
    outer_gain: Vec<f32>,
}

impl Storage {
    pub(super) fn new(scenario: &Scenario) -> Self {
        let neighbours = (0..scenario.agents.len())
            .map(|i| {
                let edges = scenario.graph.neighbours(i).iter();
                edges
                    .map(|edge| Neighbour { id: agent_id(edge.agent), weight: edge.weight as f32 })
                    .collect()
            })
            .collect();
        let gain = scenario.network.as_ref().map(|network| &network.outer_law.gain);
        let outer_gain = match gain {
            None | Some(scenario::OuterGain::Scalar(_)) => Vec::new(),
            Some(scenario::OuterGain::Diagonal(gain)) => gain.iter().map(|&g| g as f32).collect(),
            Some(scenario::OuterGain::Full(gain)) => row_major(gain),
        };
        Self { neighbours, outer_gain }
    }

    fn outer_law(&self, law: &scenario::OuterLaw) -> OuterLawParams<'_> {
        OuterLawParams {
            gain: match &law.gain {
                scenario::OuterGain::Scalar(gain) => SymmetricMatrix::Scalar(*gain as f32),
                scenario::OuterGain::Diagonal(_) => SymmetricMatrix::Diagonal(&self.outer_gain),
                scenario::OuterGain::Full(_) => SymmetricMatrix::Full(&self.outer_gain),
            },
            projection: ProjectionParams {
                radius: (law.bound - law.boundary_layer) as f32,
                boundary_layer: law.boundary_layer as f32,
                smoothing: law.smoothing as f32,
                smoothness: law.smoothness,
            },
        }
    }

    /// The core's parameters of agent `index` (from 0).
    pub(super) fn params<const N: usize>(
        &self,
        scenario: &Scenario,
        trigger: &TriggerConstants,
        index: usize,
    ) -> Result<AgentParams<'_, N>, ParameterError> {
        let output_matrix = &scenario.agents[index].output_matrix;
        let rows: Vec<_> = output_matrix
            .row_iter()
            .map(|row| StateVector::<N>::from_iterator(row.iter().map(|&c| c as f32)))
            .collect();
        let observer = ObserverParams {
            output_matrix: OutputMatrix::new(&rows)?,
            gain: SMatrix::from_iterator(scenario.design.gain.iter().map(|&k| k as f32)),
            neighbours: &self.neighbours[index],
        };
        let outer_law = match &scenario.network {
            Some(network) => self.outer_law(&network.outer_law),
            None => RESTING_OUTER_LAW,
        };
        let trigger = TriggerParams {
            hold_error_weight: trigger.phi1 as f32,
            consensus_weight: trigger.phi2 as f32,
            threshold: trigger.threshold as f32,
        };
        AgentParams::new(
            agent_id(index),
            scenario.time.step_size as f32,
            observer,
            outer_law,
            trigger,
        )
    }
}

/// The number by which agent `index` (from 0) goes on the air.
pub(super) fn agent_id(index: usize) -> AgentId {
    AgentId::try_from(index + 1).expect("a scenario has at most 1,000 agents")
}

fn row_major(matrix: &DMatrix<f64>) -> Vec<f32> {
    matrix.transpose().iter().map(|&entry| entry as f32).collect()
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
    state: AgentState<N, LAYER_WIDTH_MAX, Places<N>>,
    inbox: Inbox<N, Places<N>>,
    network: Option<SharedNetwork>,
    /// `C_i` in double precision, `m` rows: what the plant's sensor does.
    sensor: Vec<[f64; N]>,
    measurement: [f32; N],
    norms: Option<(GainNorms, Box<Scratch>)>,
    pub(super) statistics: AgentStatistics,
    pub(super) last_sample: Option<Sample<N>>,
    /// What the last step broadcast.
    pub(super) outgoing: Option<FrameBytes>,
    pub(super) failure: Option<StepError>,
}

impl<'s, const N: usize> SimulatedAgent<'s, N> {
    pub(super) fn new(
        params: AgentParams<'s, N>,
        agent: &scenario::Agent,
        network: Option<SharedNetwork>,
        outer_weights: &[f64],
        norms: Option<GainNorms>,
    ) -> Result<Self, ParameterError> {
        let places = vec![None; params.neighbours().len()];
        let estimate = StateVector::from_iterator(agent.initial_estimate.iter().map(|&x| x as f32));
        let outer_weights: Vec<f32> = outer_weights.iter().map(|&w| w as f32).collect();
        let state = AgentState::new(&params, estimate, &outer_weights, places.clone())?;
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
            network,
            sensor,
            measurement: [0.0; N],
            norms: norms.map(|norms| (norms, Box::new(Scratch::NEW))),
            statistics: AgentStatistics::default(),
            last_sample: None,
            outgoing,
            failure: None,
        })
    }

    /// Takes delivery, measures, and steps the core. A failure is kept for the engine to find,
    /// because agents are stepped in parallel.
    #[inline]
    pub(super) fn step(&mut self, tick: Tick, truth: &[f64; N], link: &impl Link, index: usize) {
        let (inbox, neighbours) = (&mut self.inbox, self.params.neighbours());
        let refused = &mut self.statistics.frames_refused;
        link.deliver(index, tick, |bytes| {
            // A node drops a frame that it cannot use and goes on; so does its simulation.
            *refused += u64::from(inbox.accept(neighbours, bytes).is_err());
        });
        for (measured, row) in self.measurement.iter_mut().zip(&self.sensor) {
            let exact = row.iter().zip(truth).fold(0.0, |sum, (c, x)| sum + c * x);
            *measured = exact as f32;
        }
        let measurement = &self.measurement[..self.sensor.len()];
        let network = self.network.as_ref();
        match self.state.step(&self.params, network, tick, measurement, &mut self.inbox) {
            Ok(output) => {
                self.outgoing = output.broadcast.map(|frame| frame.encode());
                if self.norms.is_some() {
                    self.observe_bounds(&output.sample);
                }
                self.last_sample = Some(output.sample);
            }
            Err(failure) => self.failure = Some(failure),
        }
    }

    /// Keeps the largest `e_2i_max` of Theorem 2 and the largest norm of the outer weights.
    fn observe_bounds(&mut self, sample: &Sample<N>) {
        let Some((norms, scratch)) = &mut self.norms else { return };
        let features = self.network.as_ref().and_then(|network| {
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

    /// `x_hat` at the tick after the last step.
    #[inline]
    pub(super) fn estimate(&self) -> &[f32] {
        self.state.estimate().as_slice()
    }

    /// `W_hat`, row by row.
    pub(super) fn outer_weights(&self) -> Vec<f32> {
        self.state.outer_weights().rows().iter().flat_map(|row| row.iter().copied()).collect()
    }

    /// Switches in a newly trained network.
    pub(super) fn switch_network(&mut self, network: SharedNetwork) {
        self.network = Some(network);
    }
}

fn norm(values: &[f32]) -> f64 {
    values.iter().fold(0.0, |sum, &v| sum + f64::from(v) * f64::from(v)).sqrt()
}
