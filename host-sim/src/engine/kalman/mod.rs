//! Event-triggered consensus Kalman filters over the same plant, links, sensors and frames as the
//! observer, to compare it with.
//!
//! They know what the observer does not: `f`, the size of the disturbance, for which they take white
//! noise, and the size of the measurement noise. An agent broadcasts its estimate when it is further from
//! what its neighbours predict by `f` from its last broadcast than the trigger's radius. Frames are
//! those of the observer, so bytes are counted alike; what they carry is in single precision.
//!
//! Scenarios with clocks of their own are refused; `[exchange]` is the observer's and has no effect here.

mod filter;

use agent_core::wire::frame::{AnyFrame, FrameBytes, Payload};
use agent_core::{AgentId, Tick};
use nalgebra::{DMatrix, DVector};

use super::failure::plant_error;
use super::link::{Link, RunLink};
use super::sensor::Sensor;
use super::simulated_plant::SimulatedPlant;
use super::state_size::StateSize;
use super::statistics::AgentStatistics;
use super::traces::{Traces, squared_error};
use super::{Progress, RunError, RunOptions, RunResult, check_support};
use crate::files::fnv::Fnv;
use crate::flow::{Trajectory, plant_course};
use crate::learning::agent_config::agent_id;
use crate::scenario::{Method, Scenario, Time};
use filter::{Filter, Model};

/// Radius of the trigger relative to the state's standard deviation, as `observer.error`.
const RADIUS: f64 = 0.014;
/// Time over which the disturbance is taken to be of one sign. \[s\]
const CORRELATION: f64 = 1.0;
/// Smallest standard deviation of noise relative to the state's, for exact sensors and plants.
const NOISE_MIN: f64 = 1e-3;
/// Most steps by which a late frame is predicted.
const LAG_MAX: Tick = 1_000;
/// Steps between progress reports.
const PROGRESS_STRIDE: Tick = 512;
/// Steps between checks for a request to stop: few, because a plant may take milliseconds a step.
const STOP_STRIDE: Tick = 8;

/// A sample of an agent, predicted to the present.
#[derive(Clone, Debug)]
struct Sample {
    tick: Tick,
    estimate: DVector<f64>,
}

struct Agent {
    filter: Filter,
    output_matrix: DMatrix<f64>,
    variance: f64,
    sensor: Option<Sensor>,
    measured: Vec<f32>,
    /// What the neighbours hold of this agent.
    own: Sample,
    sequence: u32,
    /// Samples of the neighbours, in the order of the graph.
    held: Vec<Option<Sample>>,
    is_down: bool,
    statistics: AgentStatistics,
    outgoing: Option<FrameBytes>,
}

struct Simulation<'s> {
    scenario: &'s Scenario,
    model: Model<'s>,
    agents: Vec<Agent>,
    /// `dt c`.
    consensus: f64,
    radius: f64,
    /// Of each component along the plant's trajectory.
    deviation: Vec<f64>,
    /// Smallest standard deviation of noise. \[state unit\]
    least: f64,
}

/// Returns the plant's trajectory, which the settings of the filters follow from.
///
/// # Errors
/// The scenario has what the filters do not support, or the plant diverges.
pub(super) fn course(scenario: &Scenario) -> Result<Trajectory, RunError> {
    check_support(scenario, scenario.method)?;
    plant_course(scenario).map_err(RunError::KalmanSettings)
}

/// Runs the Kalman filter of a scenario's method.
///
/// # Errors
/// If the plant diverges.
pub(super) fn run(
    scenario: &Scenario,
    mut link: RunLink<'_>,
    options: RunOptions,
    progress: &dyn Progress,
) -> Result<RunResult, RunError> {
    let mut simulation = Simulation::new(scenario, options)?;
    let (time, steps) = (scenario.time, scenario.steps());
    let evaluation = scenario.evaluation.ticks(&time);
    let mut plant = SimulatedPlant::new(scenario, options.seed);
    let mut truth = scenario.initial_state.clone();
    let mut traces = Traces::of(scenario);
    let mut digest = Fnv::default();
    let mut state_size = StateSize::new(truth.len());
    simulation.update_life(0);
    simulation.send(0, evaluation.contains(&0), &mut link, &mut digest);
    for tick in 0..steps {
        state_size.note(&truth, evaluation.contains(&tick));
        simulation.note(tick, evaluation.contains(&tick), &truth, &mut traces);
        simulation.step(tick, &truth, &link);
        if let Some(agent) = simulation.diverged() {
            return Err(RunError::KalmanDiverged { agent: agent + 1, time: time.at(tick + 1) });
        }
        simulation.update_life(tick + 1);
        simulation.send(tick + 1, evaluation.contains(&(tick + 1)), &mut link, &mut digest);
        let before = truth.clone();
        plant.advance(tick, &mut truth);
        if !truth.iter().all(|&x| (x as f32).is_finite()) {
            return Err(plant_error(scenario, plant.stepper(), tick, &before));
        }
        if tick.is_multiple_of(PROGRESS_STRIDE) {
            progress.step(tick, steps);
        }
        if tick.is_multiple_of(STOP_STRIDE) && progress.is_stopped() {
            return Err(RunError::Interrupted);
        }
    }
    simulation.note(steps, false, &truth, &mut traces);
    progress.step(steps, steps);
    for (index, agent) in simulation.agents.iter_mut().enumerate() {
        agent.filter.estimate.iter().for_each(|value| digest.add(&value.to_le_bytes()));
        agent.statistics.traffic = link.traffic(index);
    }
    Ok(RunResult {
        cycles: Vec::new(),
        agents: simulation.agents.into_iter().map(|agent| agent.statistics).collect(),
        trainings: Vec::new(),
        traces,
        missed: Vec::new(),
        layers: link.layer_counts(),
        largest_state: state_size.largest(),
        state_deviation: state_size.deviation(),
        bounds: None,
        digest: digest.finish(),
    })
}

impl<'s> Simulation<'s> {
    fn new(scenario: &'s Scenario, options: RunOptions) -> Result<Self, RunError> {
        let course = course(scenario)?;
        let settings = &scenario.kalman;
        let deviation = course.deviation();
        let size = deviation.iter().fold(0.0, |sum, d| sum + d * d).sqrt();
        let intensity = intensities(scenario, &course, size);
        let noise = DVector::from_iterator(intensity.len(), intensity.iter().map(|q| q * q));
        let mut model = Model::new(&scenario.plant, scenario.time, deviation.clone(), noise);
        if scenario.method == Method::Kalman {
            model.linearise_at(&course.mean());
        }
        let least = NOISE_MIN * size;
        let agents = scenario.agents.iter().enumerate().map(|(index, agent)| {
            let deviation = settings.measurement_noise;
            let deviation = deviation.unwrap_or_else(|| agent.sensor.deviation().max(least));
            let neighbours = scenario.graph.neighbours(index).len();
            let estimate = DVector::from_column_slice(&agent.initial_estimate);
            Agent {
                own: Sample { tick: 0, estimate: estimate.clone() },
                filter: Filter { estimate, covariance: DMatrix::zeros(0, 0) },
                output_matrix: agent.output_matrix.clone(),
                variance: deviation * deviation,
                sensor: Sensor::new(&agent.sensor, &scenario.time, index, options.seed),
                measured: vec![0.0; agent.output_matrix.nrows()],
                sequence: 0,
                held: vec![None; neighbours],
                is_down: false,
                statistics: AgentStatistics::default(),
                outgoing: None,
            }
        });
        let mut simulation = Self {
            scenario,
            model,
            agents: agents.collect(),
            consensus: consensus(scenario),
            radius: settings.radius.unwrap_or(RADIUS * size),
            deviation,
            least,
        };
        for index in 0..simulation.agents.len() {
            simulation.boot(index, 0);
        }
        Ok(simulation)
    }

    /// Starts an agent at `tick`, which broadcasts its initial estimate.
    fn boot(&mut self, index: usize, tick: Tick) {
        let agent = &mut self.agents[index];
        let initial = &self.scenario.agents[index].initial_estimate;
        agent.filter.estimate = DVector::from_column_slice(initial);
        // The variance of the state, and the error of the initial estimate, which the filter knows.
        let errors = initial.iter().zip(&self.scenario.initial_state).map(|(x, x0)| x - x0);
        let spread = self.deviation.iter().zip(errors);
        let spread = spread.map(|(d, error)| d * d + error * error + self.least * self.least);
        let spread = DVector::from_iterator(self.deviation.len(), spread);
        agent.filter.covariance = DMatrix::from_diagonal(&spread);
        agent.held.fill(None);
        agent.is_down = false;
        agent.broadcast(index, tick);
    }

    /// Takes agents down and boots them again at `tick`.
    fn update_life(&mut self, tick: Tick) {
        let scenario = self.scenario;
        for downtime in &scenario.life {
            let window = downtime.window.ticks(&scenario.time);
            if window.end == tick && tick < scenario.steps() {
                self.boot(downtime.agent, tick);
            }
        }
        for downtime in &scenario.life {
            if downtime.window.ticks(&scenario.time).start == tick {
                let agent = &mut self.agents[downtime.agent];
                (agent.is_down, agent.outgoing) = (true, None);
            }
        }
    }

    /// Returns an agent whose estimate is no longer finite in single precision.
    fn diverged(&self) -> Option<usize> {
        let is_finite = |agent: &Agent| {
            let covariance = agent.filter.covariance.iter();
            covariance.chain(&agent.filter.estimate).all(|&x| (x as f32).is_finite())
        };
        self.agents.iter().position(|agent| !is_finite(agent))
    }

    fn note(&mut self, tick: Tick, evaluated: bool, truth: &[f64], traces: &mut Traces) {
        let estimates: Vec<Vec<f32>> = self
            .agents
            .iter()
            .map(|agent| agent.filter.estimate.iter().map(|&x| x as f32).collect())
            .collect();
        if evaluated {
            for (agent, estimate) in self.agents.iter_mut().zip(&estimates) {
                if !agent.is_down {
                    agent.statistics.error(squared_error(estimate, truth));
                }
            }
        }
        if let Some(stride) = self.scenario.record.trace_stride
            && tick.is_multiple_of(u64::from(stride.get()))
        {
            let time = self.scenario.time.at(tick);
            traces.push(time, truth, estimates.iter().map(Vec::as_slice));
        }
    }

    fn step(&mut self, tick: Tick, truth: &[f64], link: &RunLink<'_>) {
        let time = self.scenario.time.at(tick);
        let state = DVector::from_column_slice(truth);
        self.model.linearise(time);
        for (index, agent) in self.agents.iter_mut().enumerate() {
            if agent.is_down {
                continue;
            }
            let neighbours = self.scenario.graph.neighbours(index);
            let model = &mut self.model;
            link.deliver(index, tick, &mut |bytes| {
                let Some((sender, sample)) = received(bytes, state.len()) else {
                    agent.statistics.frames_refused += 1;
                    return;
                };
                let place = neighbours.iter().position(|n| agent_id(n.agent) == sender);
                let Some(place) = place else { return };
                let held = &mut agent.held[place];
                if held.as_ref().is_none_or(|held| sample.tick > held.tick) {
                    *held = Some(predicted(sample, tick, model, &self.scenario.time));
                }
            });
            let exact = &agent.output_matrix * &state;
            let is_measured = match &mut agent.sensor {
                None => {
                    let values = agent.measured.iter_mut().zip(&exact);
                    values.for_each(|(measured, &exact)| *measured = exact as f32);
                    true
                }
                Some(sensor) => sensor.measure(tick, exact.as_slice(), &mut agent.measured),
            };
            if is_measured {
                agent.filter.correct(&agent.output_matrix, agent.variance, &agent.measured);
            }
            let mut sum = DVector::zeros(state.len());
            for (neighbour, held) in neighbours.iter().zip(&agent.held) {
                if let Some(held) = held {
                    sum += (&held.estimate - &agent.filter.estimate) * neighbour.weight;
                }
            }
            agent.filter.agree(self.consensus, &sum);
            agent.filter.predict(model, time);
            for sample in agent.held.iter_mut().flatten().chain([&mut agent.own]) {
                model.advance(time, &mut sample.estimate);
            }
            let distance = (&agent.filter.estimate - &agent.own.estimate).norm();
            if distance > self.radius {
                agent.broadcast(index, tick + 1);
            }
        }
    }

    fn send(&mut self, tick: Tick, evaluated: bool, link: &mut RunLink<'_>, digest: &mut Fnv) {
        for (index, agent) in self.agents.iter_mut().enumerate() {
            if let Some(bytes) = agent.outgoing.take() {
                let keep = self.scenario.record.events;
                agent.statistics.broadcast(tick, bytes.len(), keep, evaluated);
                digest.add(&bytes);
                link.send(index, tick, &bytes);
            }
        }
        link.advance(tick);
    }
}

impl Agent {
    fn broadcast(&mut self, index: usize, tick: Tick) {
        let estimate = &self.filter.estimate;
        let words = estimate.iter().map(|&x| (x as f32).to_le_bytes()).collect();
        // Neighbours predict from what was sent.
        let sent = estimate.map(|x| f64::from(x as f32));
        self.own = Sample { tick, estimate: sent };
        let frame = AnyFrame {
            sender: agent_id(index),
            sequence: self.sequence,
            tick,
            payload: Payload::Estimate,
            words,
        };
        self.sequence = self.sequence.wrapping_add(1);
        self.outgoing = Some(frame.encode());
    }
}

/// Decodes a frame with an estimate of `n` finite components.
fn received(bytes: &[u8], n: usize) -> Option<(AgentId, Sample)> {
    let frame = AnyFrame::decode(bytes).ok()?;
    let numbers = frame.words.iter().map(|&word| f64::from(f32::from_le_bytes(word)));
    let estimate = DVector::from_iterator(frame.words.len(), numbers);
    let is_valid = frame.payload == Payload::Estimate
        && estimate.len() == n
        && estimate.iter().all(|x| x.is_finite());
    is_valid.then_some((frame.sender, Sample { tick: frame.tick, estimate }))
}

/// Predicts a late sample to the present.
fn predicted(mut sample: Sample, now: Tick, model: &mut Model<'_>, time: &Time) -> Sample {
    for tick in sample.tick.max(now.saturating_sub(LAG_MAX))..now {
        model.advance(time.at(tick), &mut sample.estimate);
    }
    sample
}

/// Returns `dt c`: as set, or one over one more than the largest degree, the usual weight of a consensus
/// step.
fn consensus(scenario: &Scenario) -> f64 {
    let degrees = (0..scenario.agents.len()).map(|agent| scenario.graph.degree(agent));
    let largest = degrees.fold(0.0, f64::max);
    let given = scenario.kalman.consensus_gain.map(|gain| gain * scenario.time.step_size);
    given.unwrap_or(1.0 / (1.0 + largest))
}

/// Returns the intensity of the white noise that stands for disturbance and process noise in each
/// component. \[state unit/sqrt(s)\]
fn intensities(scenario: &Scenario, course: &Trajectory, size: f64) -> Vec<f64> {
    let n = scenario.dimension();
    if let Some(given) = scenario.kalman.process_noise {
        return vec![given; n];
    }
    let mut squares = vec![0.0; n];
    let mut disturbance = vec![0.0; n];
    for k in 0..course.samples() {
        let time = scenario.time.at(k as u64);
        scenario.disturbance.evaluate(time, course.state(k), &mut disturbance);
        squares.iter_mut().zip(&disturbance).for_each(|(sum, d)| *sum += d * d);
    }
    let noise = |c: usize| scenario.process_noise.get(c).copied().unwrap_or(0.0);
    let intensity = |(c, sum): (usize, &f64)| {
        let mean = sum / course.samples() as f64;
        (CORRELATION * mean + noise(c) * noise(c)).sqrt().max(NOISE_MIN * size)
    };
    squares.iter().enumerate().map(intensity).collect()
}
