//! The driver: plant, clock, links, operators and faults for a network of nodes, each of them
//! twice, with the same stimuli.

use std::path::Path;
use std::time::Instant;

use agent_core::service::{Numbers, Request, receive};
use host_sim::plant::Stepper;
use host_sim::scenario::Scenario;
use host_sim::service::Message;
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::judge::{Judge, names};
use super::line::{disturbed, encoded};
use super::links::{Links, huge};
use super::operator::{Desk, Operator};
use super::peer::{End, Peer, Said};
use super::rates::Rates;
use super::report::Tally;
use super::store::Package;
use super::supply::{Supply, scenario};

/// The first number of a fence: later than the tick of any node.
const FENCES: u64 = 1 << 62;

/// Alternating periods with and without faults. \[steps\]
#[derive(Clone, Debug)]
pub(super) struct Course {
    pub(super) steps: u64,
    /// Fault-free steps at the start, whose second half determines the error bound.
    pub(super) calibration: u64,
    pub(super) faulty: u64,
    /// Above the thousand steps for which a neighbour can ignore a restarted node.
    pub(super) calm: u64,
    /// The end of a calm period, in which the error must be small again.
    pub(super) judged: u64,
    /// Frequency of resets and other incidents relative to the long run.
    pub(super) incidents: f64,
}

/// Largest permitted error after faults, relative to the largest in fault-free operation.
const ERROR_FACTOR: f64 = 2.0;

/// A node, twice, with its environment.
struct Place {
    node: Peer,
    twin: Peer,
    judge: Judge,
    operator: Operator,
    links: Links,
    neighbours: Vec<usize>,
    sensor: Vec<f64>,
    /// Periods that the node still has to miss, and how many it has missed.
    pause: (u32, u32),
    stream: Vec<u8>,
    /// Time of the last request for an answer.
    asked: Instant,
    estimate: Option<Vec<f32>>,
}

/// A running soak test.
pub(super) struct Soak {
    seed: u64,
    rng: ChaCha8Rng,
    scenario: Scenario,
    stepper: Stepper,
    truth: Vec<f64>,
    step: u64,
    fences: u64,
    supply: Supply,
    places: Vec<Place>,
    pub(super) tally: Tally,
}

impl Soak {
    /// Starts the nodes: the firmware in an emulator or, without one, the same code in a thread.
    pub(super) fn new(firmware: Option<&Path>, seed: u64) -> Result<Self, String> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let scenario = scenario();
        let supply = Supply::new(&scenario, &mut rng);
        let place = |agent: usize| {
            let package = supply.factory(agent);
            let edges = scenario.graph.neighbours(agent);
            let id = |agent: usize| agent as u32 + 1;
            let rows = &scenario.agents[agent].output_matrix;
            Ok(Place {
                node: match firmware {
                    Some(firmware) => Peer::emulated(firmware, &package)?,
                    None => Peer::twin(&package),
                },
                twin: Peer::twin(&package),
                judge: Judge::new(
                    agent,
                    Package::new(package.package().version, package.as_bytes()),
                ),
                operator: Operator::default(),
                links: Links::new(id(agent), edges.iter().map(|edge| id(edge.agent)).collect()),
                neighbours: edges.iter().map(|edge| edge.agent).collect(),
                sensor: rows.row(0).iter().copied().collect(),
                pause: (0, 0),
                stream: Vec::new(),
                asked: Instant::now(),
                estimate: None,
            })
        };
        let places = (0..scenario.agents.len()).map(place).collect::<Result<_, String>>()?;
        let mut soak = Self {
            seed,
            rng,
            stepper: Stepper::new(scenario.time.integrator),
            truth: scenario.initial_state.clone(),
            step: 0,
            fences: FENCES,
            supply,
            places,
            tally: Tally::new(),
            scenario,
        };
        for index in 0..soak.places.len() {
            soak.greeted(index).map_err(|error| soak.told(index, &error))?;
        }
        Ok(soak)
    }

    fn told(&self, index: usize, error: &str) -> String {
        format!("seed {}, step {}, agent {}: {error}", self.seed, self.step, index + 1)
    }

    /// Runs the whole course.
    ///
    /// # Errors
    /// The first wrong behaviour, with seed, step and agent.
    pub(super) fn run(&mut self, course: &Course) -> Result<(), String> {
        let (calm, learning) = (Rates::calm(), Rates::learning());
        let mut largest = 0.0f64;
        for step in 0..course.calibration {
            self.take_step(&learning)?;
            if 2 * step >= course.calibration {
                largest = largest.max(self.error().0);
            }
        }
        let calibrated = std::mem::replace(&mut self.tally, Tally::new());
        self.tally.bound = ERROR_FACTOR * largest;
        self.tally.longest_answer = calibrated.longest_answer;
        let faulty = Rates::faulty(course.incidents);
        let cycle = course.faulty + course.calm;
        for step in 0..course.steps {
            let phase = step % cycle;
            self.take_step(if phase < course.faulty { &faulty } else { &calm })?;
            if phase + course.judged >= cycle {
                let (error, index) = self.error();
                self.tally.largest_error = self.tally.largest_error.max(error);
                if error > self.tally.bound {
                    let bound = self.tally.bound;
                    let calm = phase - course.faulty;
                    let error = format!(
                        "its error after {calm} calm steps is {error}, above the bound {bound}"
                    );
                    return Err(self.told(index, &error));
                }
                self.tally.recoveries += u64::from(phase + 1 == cycle);
            }
            self.tally.progress(course.steps);
        }
        for index in 0..self.places.len() {
            self.cycle_power(index).map_err(|error| self.told(index, &error))?;
        }
        Ok(())
    }

    /// Returns the largest error of an agent's estimate, infinite if none was reported, and the
    /// agent.
    fn error(&self) -> (f64, usize) {
        let mut worst = (0.0, 0);
        for (index, place) in self.places.iter().enumerate() {
            let error = place.estimate.as_ref().map_or(f64::INFINITY, |estimate| {
                let pairs = estimate.iter().zip(&self.truth);
                pairs.map(|(&x, truth)| (f64::from(x) - truth).powi(2)).sum::<f64>().sqrt()
            });
            if error > worst.0 {
                worst = (error, index);
            }
        }
        worst
    }

    fn take_step(&mut self, rates: &Rates) -> Result<(), String> {
        for index in 0..self.places.len() {
            self.incident(index, rates).map_err(|error| self.told(index, &error))?;
        }
        self.fences += 1;
        for index in 0..self.places.len() {
            let stream = self.composed(index, rates);
            let place = &mut self.places[index];
            (place.stream, place.asked) = (stream, Instant::now());
            let sent = place.node.send(&place.stream).and_then(|()| place.twin.send(&place.stream));
            sent.map_err(|error| self.told(index, &error))?;
        }
        let mut broadcasts = Vec::new();
        for index in 0..self.places.len() {
            let said = self.heard(index, End::Fence(self.fences));
            let told = said.and_then(|said| {
                let place = &mut self.places[index];
                place.judge.judge(&place.stream, &said.messages, &self.supply, &mut self.tally)
            });
            let told = told.map_err(|error| self.told(index, &error))?;
            self.places[index].estimate = told.estimate;
            broadcasts.extend(told.broadcasts.into_iter().map(|frame| (index, frame)));
        }
        for (sender, frame) in broadcasts {
            for place in &mut self.places {
                if place.neighbours.contains(&sender) {
                    let (rng, tally) = (&mut self.rng, &mut self.tally);
                    place.links.send(&frame, self.step + 1, &rates.frame, rng, tally);
                }
            }
        }
        let time = self.scenario.time;
        let Self { stepper, scenario, truth, .. } = self;
        let (plant, disturbance) = (&scenario.plant, &scenario.disturbance);
        stepper.step(plant, disturbance, time.at(self.step), time.step_size, truth);
        self.step += 1;
        self.tally.steps += 1;
        Ok(())
    }

    /// Returns the bytes for a node before and for its next step.
    fn composed(&mut self, index: usize, rates: &Rates) -> Vec<u8> {
        let Self { rng, tally, supply, .. } = self;
        let Place { judge, operator, links, sensor, pause, .. } = &mut self.places[index];
        let frames = links.arrivals(self.step, &rates.frame, rng, tally);
        let mut messages: Vec<_> =
            frames.iter().map(|bytes| encoded(&Request::Frame { bytes })).collect();
        let mut desk =
            Desk { agent: index, judge, rates: &rates.operator, supply, rng: &mut *rng, tally };
        messages.extend(operator.requests(&mut desk));
        if pause.0 > 0 {
            *pause = (pause.0 - 1, pause.1 + 1);
        } else {
            let exact: f64 = sensor.iter().zip(&self.truth).map(|(row, x)| row * x).sum();
            let mut periods = std::mem::take(&mut pause.1) + 1;
            if rng.random_bool(rates.node.clock_jump) {
                tally.fault("clock jumps");
                periods = rng.random();
            }
            if rng.random_bool(rates.node.no_period) {
                tally.fault("no period has passed");
                periods = 0;
            }
            let measurement = measured(exact as f32, rates, rng, tally);
            let tick = encoded(&Request::Tick { periods, measurement });
            messages.insert(rng.random_range(0..=messages.len()), tick);
            tally.node_steps += 1;
            if rng.random_bool(rates.node.pause) {
                tally.fault("node misses periods");
                *pause = (rng.random_range(1..40), 0);
            }
        }
        let mut stream = disturbed(messages, &rates.message, rng, tally);
        // The fence arrives undamaged, so that the end of the node's output is known.
        stream.push(0);
        stream.extend(encoded(&Request::Samples { from: self.fences, most: 0 }));
        stream
    }

    /// Returns the output of both, if it is the same.
    fn heard(&mut self, index: usize, end: End) -> Result<Said, String> {
        let Place { node, twin, asked, .. } = &mut self.places[index];
        let said = node.hear(end)?;
        self.tally.longest_answer = self.tally.longest_answer.max(asked.elapsed());
        let by_twin = twin.hear(end).map_err(|error| format!("the twin: {error}"))?;
        self.tally.compared_bytes += said.bytes.len() as u64;
        if said.bytes != by_twin.bytes {
            said.messages.iter().for_each(|message| self.tally.stack(message));
            let same = said.messages.iter().map(|message| common(message));
            if !same.eq(by_twin.messages.iter().map(|message| common(message))) {
                let pairs = said.bytes.iter().zip(&by_twin.bytes);
                let longer = said.bytes.len().abs_diff(by_twin.bytes.len());
                let differing = pairs.filter(|(node, twin)| node != twin).count() + longer;
                self.tally.mismatching_bytes += differing as u64;
                return Err(difference(&said.messages, &by_twin.messages));
            }
        }
        Ok(said)
    }

    fn greeted(&mut self, index: usize) -> Result<(), String> {
        let said = self.heard(index, End::Hello)?;
        match &said.messages[..] {
            [greeting] => self.places[index].judge.rebooted(greeting),
            more => Err(format!("unexpected greeting: {:?}", names(more))),
        }
    }

    fn incident(&mut self, index: usize, rates: &Rates) -> Result<(), String> {
        let place = &mut self.places[index];
        place.asked = Instant::now();
        if self.rng.random_bool(rates.node.reset) {
            self.tally.fault("reset");
            for peer in [&mut place.node, &mut place.twin] {
                peer.send(&encoded(&Request::Reset))?;
            }
            let said = self.heard(index, End::Done)?;
            if said.messages.len() != 1 {
                return Err(format!("unexpected messages at a reset: {:?}", names(&said.messages)));
            }
            let place = &mut self.places[index];
            place.node.expect_reset();
            self.greeted(index)?;
        } else if self.rng.random_bool(rates.node.power) {
            self.tally.fault("power cut");
            self.cycle_power(index)?;
        }
        Ok(())
    }

    /// Cuts the power of both, compares their flash, and restarts them.
    fn cycle_power(&mut self, index: usize) -> Result<(), String> {
        let Place { node, twin, asked, .. } = &mut self.places[index];
        *asked = Instant::now();
        node.cycle_power()?;
        twin.cycle_power()?;
        let (flash, by_twin) = (node.flash(), twin.flash());
        self.tally.compared_bytes += flash.len() as u64;
        let differing = (0..flash.len()).filter(|&place| flash[place] != by_twin[place]);
        self.tally.mismatching_bytes += differing.clone().count() as u64;
        if let Some(place) = differing.min() {
            return Err(format!("its flash differs from its twin's, first at byte {place:#x}"));
        }
        self.greeted(index)
    }
}

/// Describes the first message that differs.
fn difference(node: &[Vec<u8>], twin: &[Vec<u8>]) -> String {
    let count = node.len().max(twin.len());
    let first = (0..count).find(|&place| {
        node.get(place).map(|message| common(message))
            != twin.get(place).map(|message| common(message))
    });
    let shown = |messages: &[Vec<u8>]| match messages.get(first.unwrap_or_default()) {
        Some(message) => format!("{:?}, {message:02x?}", names(std::slice::from_ref(message))),
        None => "nothing".to_owned(),
    };
    format!("message {first:?} of the node is {}; of its twin, {}", shown(node), shown(twin))
}

/// Returns a message without the fields that only a board has.
fn common(message: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::new();
    match receive::<Message<'_>>(message) {
        Some(Message::Status(mut status)) => {
            status.stack_unused = None;
            bytes = format!("{status:?}").into_bytes();
        }
        Some(Message::Hello(mut status)) => {
            status.stack_unused = None;
            bytes = format!("hello {status:?}").into_bytes();
        }
        _ => bytes.extend_from_slice(message),
    }
    bytes
}

/// Returns the sensor's measurement of the exact value.
fn measured(exact: f32, rates: &Rates, rng: &mut impl Rng, tally: &mut Tally) -> Option<Numbers> {
    let rates = &rates.measurement;
    let mut value = exact;
    let mut length = 1;
    if rng.random_bool(rates.not_a_number) {
        tally.fault("measurement not a number");
        value = f32::NAN;
    } else if rng.random_bool(rates.infinite) {
        tally.fault("measurement infinite");
        value = if rng.random() { f32::INFINITY } else { f32::NEG_INFINITY };
    } else if rng.random_bool(rates.huge) {
        tally.fault("measurement huge");
        value = huge(rng, 3.0);
    } else if rng.random_bool(rates.missing) {
        tally.fault("measurement missing");
        return None;
    } else if rng.random_bool(rates.other_length) {
        tally.fault("measurement of another length");
        length = [0, 2, 3, 4, 12][rng.random_range(0..5)];
    }
    Some(std::iter::repeat_n(value, length).collect())
}
