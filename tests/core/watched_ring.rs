//! Three watched agents on a ring that observe a moving point, with ways to disturb them.

use agent_core::agent::inbox::Inbox;
use agent_core::agent::region::StateBox;
use agent_core::agent::{AgentParams, AgentState, StepError};
use agent_core::health::{Advice, Health, HealthParams, HealthSettings, WatchedAgent, WatchedStep};
use agent_core::math::activation::Activation;
use agent_core::math::symmetric::SymmetricMatrix;
use agent_core::observer::feedback::{Neighbour, ObserverParams, OutputMatrix};
use agent_core::observer::network::{Architecture, InnerNetwork, Layer};
use agent_core::observer::outer_law::OuterLawParams;
use agent_core::observer::projection::ProjectionParams;
use agent_core::observer::trigger::TriggerParams;
use agent_core::wire::frame::{Frame, FrameBytes};
use agent_core::{StateVector, Tick};
use nalgebra::SMatrix;

use crate::core::bits::{StateBits, state_bits};
use crate::core::random_network::{Draw, ParamBuffers};

/// Number of features.
const FEATURES: usize = 5;
/// \[s\]
const STEP_SIZE: f32 = 1e-3;
/// Limit of each component's motion.
const LIMIT: f32 = 6.0;
/// The box of trained inputs.
pub(crate) const BOX: StateBox<'static> = StateBox { low: &[-LIMIT; 3], high: &[LIMIT; 3] };

/// Each agent hears the other two.
const NEIGHBOURS: [[Neighbour; 2]; 3] = [
    [Neighbour { id: 1, weight: 1.0 }, Neighbour { id: 2, weight: 1.0 }],
    [Neighbour { id: 0, weight: 1.0 }, Neighbour { id: 2, weight: 1.0 }],
    [Neighbour { id: 0, weight: 1.0 }, Neighbour { id: 1, weight: 1.0 }],
];

/// An agent that measures one component, with its health monitoring.
pub(crate) struct Watched {
    pub(crate) params: AgentParams<'static, 3>,
    pub(crate) health_params: HealthParams<3>,
    pub(crate) state: AgentState<3, FEATURES, ParamBuffers<3>>,
    pub(crate) inbox: Inbox<3, ParamBuffers<3>>,
    pub(crate) health: Health,
    /// Why the last step was refused, if it was.
    pub(crate) refusal: Option<StepError>,
}

/// The ring.
pub(crate) struct Ring {
    pub(crate) agents: Vec<Watched>,
    pub(crate) tick: Tick,
    /// Whether implausible frames are refused on arrival.
    pub(crate) guarded: bool,
    inner_network: InnerNetwork<Vec<f32>>,
    outer_weights: Vec<f32>,
    amplitudes: StateVector<3>,
    rates: StateVector<3>,
    phases: StateVector<3>,
    on_the_air: Vec<FrameBytes>,
}

impl Ring {
    /// Creates the ring for a seed.
    pub(crate) fn new(seed: u64, settings: &HealthSettings) -> Self {
        let mut draw = Draw::new(seed);
        let layers =
            [12, FEATURES as u8].map(|width| Layer { width, activation: Activation::Tanh });
        let architecture = Architecture::new(3, &layers).unwrap();
        let parameters = draw.signed_many(architecture.parameter_count(), 0.5);
        let outer_weights = draw.signed_many(FEATURES * 3, 3.0);
        let agents = (0..3).map(|index| {
            let mut row = StateVector::<3>::zeros();
            row[index] = 1.0;
            let params = AgentParams::new(
                index as u32,
                STEP_SIZE,
                ObserverParams {
                    output_matrix: OutputMatrix::new(&[row]).unwrap(),
                    gain: SMatrix::from_diagonal_element(120.0),
                    neighbours: &NEIGHBOURS[index],
                },
                OuterLawParams {
                    gain: SymmetricMatrix::Scalar(3.0),
                    projection: ProjectionParams {
                        radius: 19.0,
                        boundary_layer: 1.0,
                        smoothing: 0.1,
                        smoothness: 1,
                    },
                },
                // Fires at a hold error of 0.05.
                TriggerParams { hold_error_weight: 4e5, consensus_weight: 0.3, threshold: 1e3 },
            )
            .unwrap();
            let places = vec![None; 2];
            Watched {
                health_params: HealthParams::new(&params, &BOX, 0.0, settings).unwrap(),
                state: AgentState::new(
                    &params,
                    StateVector::zeros(),
                    &outer_weights,
                    places.clone(),
                )
                .unwrap(),
                params,
                inbox: Inbox::new(places),
                health: Health::new(),
                refusal: None,
            }
        });
        let agents: Vec<_> = agents.collect();
        Self {
            on_the_air: agents.iter().map(|a| a.state.announcement(&a.params).encode()).collect(),
            agents,
            tick: 0,
            guarded: true,
            inner_network: InnerNetwork::new(architecture, parameters).unwrap(),
            outer_weights,
            amplitudes: StateVector::from_fn(|_, _| draw.positive(0.3, 0.9) * LIMIT),
            rates: StateVector::from_fn(|_, _| draw.positive(0.3, 3.0)),
            phases: draw.vector(3.0),
        }
    }

    /// Returns the position of the point.
    fn truth(&self) -> StateVector<3> {
        let time = self.tick as f32 * STEP_SIZE;
        let angle = self.rates * time + self.phases;
        self.amplitudes.component_mul(&angle.map(f32::sin))
    }

    /// Broadcasts a frame to every agent that listens to its sender.
    pub(crate) fn inject(&mut self, frame: &Frame<3>) {
        self.on_the_air.push(frame.encode());
    }

    /// Takes one step of every agent; `disturb` can change its measurement.
    pub(crate) fn step(&mut self, mut disturb: impl FnMut(usize, &mut f32)) {
        let (truth, tick) = (self.truth(), self.tick);
        let frames = std::mem::take(&mut self.on_the_air);
        for (index, agent) in self.agents.iter_mut().enumerate() {
            let neighbours = agent.params.neighbours();
            for bytes in &frames {
                let sender = Frame::<3>::decode(bytes).map(|frame| frame.sender);
                if sender == Ok(index as u32) {
                    continue;
                }
                let accepted = if self.guarded {
                    let region = agent.health_params.plausible_region();
                    agent.inbox.accept_within(neighbours, region, bytes)
                } else {
                    agent.inbox.accept(neighbours, bytes)
                };
                if let Err(error) = accepted {
                    agent.health.frame_refused(&error);
                }
            }
            let mut measurement = [truth[index]];
            disturb(index, &mut measurement[0]);
            let network = Some(&self.inner_network).filter(|_| agent.health.network_in_use());
            let outcome =
                agent.state.step(&agent.params, network, tick, &measurement, &mut agent.inbox);
            let advice = agent.health.observe(&agent.health_params, tick, &outcome, &agent.state);
            agent.refusal = outcome.err();
            let broadcast = match advice {
                Advice::Continue => outcome.ok().and_then(|output| output.broadcast),
                Advice::Restart => Some(
                    agent
                        .health
                        .restart(
                            &agent.health_params,
                            &agent.params,
                            &mut agent.state,
                            &mut agent.inbox,
                            tick,
                            &self.outer_weights,
                        )
                        .unwrap(),
                ),
            };
            self.on_the_air.extend(broadcast.map(|frame| frame.encode()));
        }
        self.tick += 1;
    }

    /// Like [`Self::step`], which is an independent copy, but with [`WatchedAgent`].
    pub(crate) fn step_as_shipped(&mut self, mut disturb: impl FnMut(usize, &mut f32)) {
        let (truth, tick) = (self.truth(), self.tick);
        let frames = std::mem::take(&mut self.on_the_air);
        for (index, agent) in self.agents.iter_mut().enumerate() {
            let mut watched = WatchedAgent {
                params: &agent.params,
                health_params: &agent.health_params,
                state: &mut agent.state,
                inbox: &mut agent.inbox,
                health: &mut agent.health,
            };
            for bytes in &frames {
                if Frame::<3>::decode(bytes).map(|frame| frame.sender) != Ok(index as u32) {
                    let _ = watched.receive(bytes);
                }
            }
            let mut measurement = [truth[index]];
            disturb(index, &mut measurement[0]);
            let network = Some(&self.inner_network);
            let step = watched.step(network, &self.outer_weights, tick, &measurement);
            self.on_the_air.extend(step.broadcast().map(|frame| frame.encode()));
            agent.refusal = match step {
                WatchedStep::Refused(error) => Some(error),
                WatchedStep::Taken(_) | WatchedStep::Restarted(_) => None,
            };
        }
        self.tick += 1;
    }

    /// Returns the frames in transit.
    pub(crate) fn on_the_air(&self) -> &[FrameBytes] {
        &self.on_the_air
    }

    /// Takes undisturbed steps.
    pub(crate) fn skip(&mut self, steps: Tick) {
        (0..steps).for_each(|_| self.step(|_, _| ()));
    }

    /// `|e_1i|`.
    fn error(&self, agent: usize) -> f64 {
        let error = self.agents[agent].state.estimate() - self.truth();
        error.iter().fold(0.0, |sum, &e| sum + f64::from(e) * f64::from(e)).sqrt()
    }

    /// Returns the root mean square of `|e_1i|` for each agent over the next `steps` undisturbed
    /// steps.
    pub(crate) fn error_level(&mut self, steps: Tick) -> [f64; 3] {
        let mut sums = [0.0; 3];
        for _ in 0..steps {
            self.step(|_, _| ());
            for (agent, sum) in sums.iter_mut().enumerate() {
                *sum += self.error(agent).powi(2);
            }
        }
        sums.map(|sum| (sum / steps as f64).sqrt())
    }

    /// Returns the bits of every agent's state.
    pub(crate) fn bits(&self) -> Vec<StateBits> {
        self.agents.iter().map(|agent| state_bits(&agent.params, &agent.state)).collect()
    }
}
