//! Three nodes around the paper's plant, with clocks and a link of their own: the firmware's code,
//! flash in memory, and a simulated world.

use std::collections::VecDeque;
use std::num::NonZeroU32;

use agent_core::health::{HealthSettings, RevertReason};
use agent_core::package::TrialLimits;
use agent_core::service::{
    CHUNK_LENGTH_MAX, Event, Problem, Request, Subscription, TrialReport, receive, send,
};
use agent_core::wire::cobs::{Decoder, SerialError};
use firmware_template::board::RequestBuffer;
use firmware_template::{
    Board, LinkErrorKind, Memory, Node, Progress, RECOMMENDED_TRIAL, SensorErrorKind, Settings,
};
use host_sim::engine::{RunOptions, Silent, run};
use host_sim::packages::PackageBytes;
use host_sim::plant::Stepper;
use host_sim::scenario::{PAPER, Scenario};
use host_sim::service::Message;

use crate::store::packages::{Flash, LAYOUT, new_flash};

type BenchNode<'m> = Node<'m, Flash, 3, 8, 4, 16>;
pub(super) type BenchMemory = Memory<3, 8, 4, 16>;

/// Time between two moves of the plant, and the shortest period of the clocks. \[s\]
const STEP: f64 = 1e-3;
/// Length of a trial. \[s\]
pub(super) const TRIAL: u32 = 10;
/// When the packages are trained; the bench begins then. \[s\]
const TRAINED_AT: f64 = 20.0;
/// Steps between two reports of the estimate.
const REPORT: NonZeroU32 = NonZeroU32::new(10).unwrap();

/// The paper's scenario and the networks that its agents learn with a recipe.
pub(super) struct World {
    scenario: Scenario,
    /// `x_0` when the bench begins.
    state: Vec<f64>,
    pub(super) trained: Vec<PackageBytes>,
}

impl World {
    pub(super) fn new(recipe: &str, seed: u64) -> Self {
        let mut scenario = Scenario::parse("paper", PAPER).unwrap();
        scenario.time.duration = TRAINED_AT + STEP;
        scenario.evaluation.from = 19.0;
        scenario.evaluation.to = TRAINED_AT;
        scenario.learning[0].recipe = recipe.to_owned();
        let options = RunOptions { seed, learning: true, bounds: false };
        let result = run(&scenario, options, &Silent).unwrap();
        let trained = result.trainings.iter().map(|training| training.package.clone()).collect();
        let mut state = scenario.initial_state.clone();
        let mut stepper = Stepper::new(scenario.time.integrator);
        for step in 0..(TRAINED_AT / STEP) as u32 {
            let time = f64::from(step) * STEP;
            stepper.step(&scenario.plant, &scenario.disturbance, time, STEP, &mut state);
        }
        Self { scenario, state, trained }
    }
}

/// What became of a package.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum End {
    Confirmed,
    Reverted(RevertReason),
    /// The node did not take it.
    Refused,
    /// Neither, at the deadline.
    None,
}

/// Result of an observed trial.
#[derive(Clone, Copy, Debug)]
pub(super) struct Outcome {
    pub(super) end: End,
    /// From activation to the end. \[s\]
    pub(super) seconds: f64,
    /// RMS of the estimation error from activation to the end: of the agent, and of the others.
    /// \[state unit\]
    pub(super) rms: [f64; 2],
    /// What the node reports of the trial.
    pub(super) trial: Option<TrialReport>,
}

/// A node's surroundings.
struct Surroundings {
    period: f64,
    next: f64,
    now: f64,
    measurement: f32,
    requests: VecDeque<Vec<u8>>,
    received: VecDeque<Vec<u8>>,
    sent: Vec<Vec<u8>>,
    decoder: Box<Decoder<4096>>,
    estimate: [f64; 3],
    activated: bool,
    end: Option<End>,
    trial: Option<TrialReport>,
}

impl Surroundings {
    fn new() -> Self {
        Self {
            period: f64::INFINITY,
            next: f64::INFINITY,
            now: 0.0,
            measurement: 0.0,
            requests: VecDeque::new(),
            received: VecDeque::new(),
            sent: Vec::new(),
            decoder: Box::new(Decoder::new()),
            estimate: [0.0; 3],
            activated: false,
            end: None,
            trial: None,
        }
    }

    fn ask(&mut self, request: &Request<'_>) {
        let mut decoder = Decoder::<256>::new();
        send(request, |bytes| {
            for &byte in bytes {
                if let Some(message) = decoder.push(byte) {
                    self.requests.push_back(message.unwrap().to_vec());
                }
            }
        });
    }

    fn push(&mut self, package: &PackageBytes) {
        let bytes = package.as_bytes();
        self.ask(&Request::Begin { length: bytes.len() as u32 });
        for (index, bytes) in bytes.chunks(CHUNK_LENGTH_MAX).enumerate() {
            self.ask(&Request::Chunk { offset: (index * CHUNK_LENGTH_MAX) as u32, bytes });
        }
        self.ask(&Request::Stage);
        self.ask(&Request::Activate);
    }
}

impl Board for Surroundings {
    fn start(&mut self, period: f32) {
        if self.period != f64::from(period) {
            self.period = f64::from(period).max(STEP / 1000.0);
            self.next = self.now + self.period;
        }
    }

    fn elapsed(&mut self) -> u32 {
        if self.now < self.next {
            return 0;
        }
        let periods = 1.0 + ((self.now - self.next) / self.period).floor();
        self.next += periods * self.period;
        periods as u32
    }

    fn rest(&mut self) {}

    fn measure(&mut self, measurement: &mut [f32]) -> Result<usize, SensorErrorKind> {
        measurement[0] = self.measurement;
        Ok(1)
    }

    fn broadcast(&mut self, frame: &[u8]) -> Result<(), LinkErrorKind> {
        self.sent.push(frame.to_vec());
        Ok(())
    }

    fn frame<'buffer>(
        &mut self,
        buffer: &'buffer mut [u8],
    ) -> Option<Result<&'buffer [u8], LinkErrorKind>> {
        let frame = self.received.pop_front()?;
        let place = &mut buffer[..frame.len()];
        place.copy_from_slice(&frame);
        Some(Ok(place))
    }

    fn request<'buffer>(
        &mut self,
        buffer: &'buffer mut RequestBuffer,
    ) -> Option<Result<&'buffer mut [u8], SerialError>> {
        let request = self.requests.pop_front()?;
        let place = &mut buffer[..request.len()];
        place.copy_from_slice(&request);
        Some(Ok(place))
    }

    fn respond(&mut self, bytes: &[u8]) {
        for &byte in bytes {
            let Some(message) = self.decoder.push(byte) else { continue };
            match receive::<Message<'_>>(message.unwrap()).unwrap() {
                Message::State(state) => {
                    for (place, value) in self.estimate.iter_mut().zip(&state.estimate) {
                        *place = f64::from(*value);
                    }
                }
                Message::InUse { version: Some(_) } => self.activated = true,
                Message::Event(Event::Confirmed { .. }) => self.end = Some(End::Confirmed),
                Message::Event(Event::Reverted { reason, .. }) => {
                    self.end = Some(End::Reverted(reason));
                }
                Message::Report(report) => self.trial = report.trial,
                Message::Refused(Problem::Package(_)) if !self.activated => {
                    // What follows of the push has nothing to refer to.
                    self.requests.clear();
                    self.end = Some(End::Refused);
                }
                Message::Refused(problem) => panic!("{problem}"),
                _ => {}
            }
        }
    }

    fn flush(&mut self) {}
}

fn settings() -> Settings {
    Settings {
        layout: LAYOUT,
        public_key: None,
        step_range: agent_core::package::StepRange::DEFAULT,
        update_limit: agent_core::store::RateLimit::NONE,
        health: HealthSettings::RECOMMENDED,
        trial: TrialLimits { seconds: Some(TRIAL), ..RECOMMENDED_TRIAL },
        sample_stride: NonZeroU32::MIN,
        subscription: Subscription { state_every: Some(REPORT), outer_weights: false },
        fallback: None,
        stack_unused: None,
        start: firmware_template::Start::default(),
        keep_epochs: None,
        factory_reset: false,
        version: [0, 1, 0],
    }
}

/// Runs the nodes with `before` for `reference` \[s\], pushes `package` to one of them, and observes
/// its trial. Without a package, the node is observed for as long as a trial may take.
pub(super) fn observe(
    world: &World,
    before: &[PackageBytes],
    reference: f64,
    agent: usize,
    package: Option<&PackageBytes>,
) -> Outcome {
    let mut memories = [BenchMemory::new(), BenchMemory::new(), BenchMemory::new()];
    let mut surroundings = [0, 1, 2].map(|_| Surroundings::new());
    let mut nodes: Vec<BenchNode<'_>> = memories
        .iter_mut()
        .map(|memory| BenchNode::new(new_flash(), settings(), memory).unwrap())
        .collect();
    for (surroundings, before) in surroundings.iter_mut().zip(before) {
        surroundings.push(before);
        surroundings.ask(&Request::Confirm);
    }
    let scenario = &world.scenario;
    let mut stepper = Stepper::new(scenario.time.integrator);
    let mut x = world.state.clone();
    let (mut squares, mut count, mut activated_at) = ([0.0; 2], 0.0, None);
    let deadline = 3.0 * f64::from(TRIAL) + 0.2;
    let mut is_pushed = false;
    for step in 0_u32.. {
        let now = f64::from(step) * STEP;
        for (index, (node, place)) in nodes.iter_mut().zip(&mut surroundings).enumerate() {
            (place.now, place.measurement) = (now, x[index] as f32);
            while node.poll(place) != Progress::Idle {}
        }
        let sent = surroundings.each_mut().map(|place| std::mem::take(&mut place.sent));
        for (sender, receiver) in [(0, 1), (0, 2), (1, 0), (2, 0)] {
            surroundings[receiver].received.extend(sent[sender].iter().cloned());
        }
        let place = &mut surroundings[agent];
        if now >= reference && !is_pushed {
            (is_pushed, place.activated) = (true, false);
            match package {
                Some(package) => place.push(package),
                None => place.activated = true,
            }
        }
        if is_pushed && place.end == Some(End::Refused) {
            let (seconds, rms, trial) = (0.0, [0.0; 2], None);
            return Outcome { end: End::Refused, seconds, rms, trial };
        }
        if is_pushed && place.activated {
            let began = *activated_at.get_or_insert(now);
            let end = place.end;
            if (now - began) > 1.0 {
                for (index, place) in surroundings.iter().enumerate() {
                    let others = usize::from(index != agent);
                    let errors = place.estimate.iter().zip(&x);
                    let square: f64 = errors.map(|(e, x)| (e - x) * (e - x)).sum();
                    squares[others] += square / if others == 1 { 2.0 } else { 1.0 };
                }
                count += 1.0;
            }
            if end.is_some() || now - began > deadline {
                surroundings[agent].ask(&Request::Report);
                while nodes[agent].poll(&mut surroundings[agent]) != Progress::Idle {}
                return Outcome {
                    end: end.unwrap_or(End::None),
                    seconds: now - began,
                    trial: surroundings[agent].trial,
                    rms: squares.map(|square| (square / f64::max(count, 1.0)).sqrt()),
                };
            }
        }
        let time = TRAINED_AT + now;
        stepper.step(&scenario.plant, &scenario.disturbance, time, STEP, &mut x);
    }
    unreachable!("a trial ends")
}
