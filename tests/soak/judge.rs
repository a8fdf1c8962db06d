//! Checks a node's output against its input: exactly one correct answer to each request, in order;
//! steps as requested; finite numbers; counters that only rise.
//!
//! The judge is independent of the node's code; its knowledge of packages comes from
//! [`super::store`] and [`super::supply`].

use std::collections::VecDeque;

use agent_core::Tick;
use agent_core::health::BoardErrors;
use agent_core::service::{
    Event, Outcome, PROTOCOL_VERSION, Problem, RefusalReport, Request, State, Status, Subscription,
    receive,
};
use agent_core::wire::frame::Frame;
use host_sim::service::Message;
use host_sim::service::client::name;

use super::line;
use super::report::Tally;
use super::store::{Answer, Package, Store};
use super::supply::Supply;

/// Steps that a trial of a minute takes at least.
const GOOD_STEPS: u32 = 60_000;
/// Number of samples that a node keeps.
const SAMPLES: u32 = 64;

/// The externally known state of a node.
#[derive(Clone, Debug)]
pub(super) struct Judge {
    /// From 0.
    agent: usize,
    pub(super) store: Store,
    pub(super) subscription: Subscription,
    next_tick: Tick,
    messages_damaged: u32,
    measurements_missing: u32,
    counters: Vec<u32>,
    /// Steps taken since the package in use was activated.
    taken_on_trial: u32,
}

/// The parts of a node's output that others need.
#[derive(Clone, Debug, Default)]
pub(super) struct Told {
    pub(super) broadcasts: Vec<Vec<u8>>,
    /// The last estimate.
    pub(super) estimate: Option<Vec<f32>>,
}

type Said<'m> = VecDeque<Message<'m>>;

impl Judge {
    pub(super) fn new(agent: usize, factory: Package) -> Self {
        Self {
            agent,
            store: Store::new(factory),
            subscription: Subscription::default(),
            next_tick: 0,
            messages_damaged: 0,
            measurements_missing: 0,
            counters: Vec::new(),
            taken_on_trial: 0,
        }
    }

    /// Checks the output `said` of a node against its input `stream`.
    ///
    /// The expected message and the one found.
    /// What it should have said and what it has.
    pub(super) fn judge(
        &mut self,
        stream: &[u8],
        messages: &[Vec<u8>],
        supply: &Supply,
        tally: &mut Tally,
    ) -> Result<Told, String> {
        let mut said = parsed(messages)?;
        let mut told = Told::default();
        for message in line::heard(stream) {
            let Some(bytes) = message else {
                self.messages_damaged += 1;
                tally.event("message found damaged");
                continue;
            };
            match receive::<Request<'_>>(&bytes) {
                Some(request) => self
                    .carried_out(&request, &mut said, &mut told, supply, tally)
                    .map_err(|error| format!("after {request:?}: {error}"))?,
                None => answered(&mut said, &Message::Refused(Problem::Unknown))?,
            }
        }
        match said.pop_front() {
            None => Ok(told),
            Some(message) => Err(format!("unsolicited message: {}", name(&message))),
        }
    }

    fn carried_out(
        &mut self,
        request: &Request<'_>,
        said: &mut Said<'_>,
        told: &mut Told,
        supply: &Supply,
        tally: &mut Tally,
    ) -> Result<(), String> {
        let answer = match *request {
            Request::Frame { .. } => {
                tally.event("frame taken from the line");
                return Ok(());
            }
            Request::Tick { periods, ref measurement } => {
                return self.turned(periods, measurement.as_deref(), said, told, tally);
            }
            Request::Query => {
                if self.measurements_missing > 0 {
                    match said.pop_front() {
                        Some(Message::BoardErrors { tick, counters }) => {
                            self.missing_are(tick, self.next_tick, &counters)?;
                        }
                        other => return Err(instead("what its sensor has reported", other)),
                    }
                }
                return match said.pop_front() {
                    Some(Message::Status(status)) => self.check_status(&status),
                    other => Err(instead("its status", other)),
                };
            }
            Request::Report => {
                return match said.pop_front() {
                    Some(Message::Report(_)) => Ok(()),
                    other => Err(instead("its report", other)),
                };
            }
            Request::ForgetUnreadable => return answered(said, &Message::Done),
            Request::Numbered { .. } => {
                return answered(said, &Message::Refused(Problem::Unknown));
            }
            Request::Session => return answered(said, &Message::Session(None)),
            // Its nodes have no keys.
            Request::OperatorKeys { .. } => {
                return answered(said, &Message::Refused(Problem::Unknown));
            }
            Request::Sealed(_) | Request::NetworkKeys { .. } | Request::FactoryReset => {
                return answered(said, &Message::Refused(Problem::NotProvisioned));
            }
            Request::Provision { .. } => return Err("unexpected provision".to_owned()),
            Request::Samples { from, most } => return sampled(from, most, said),
            Request::StartAt { ref estimate } => {
                let usable = estimate.len() == 3 && estimate.iter().all(|x| x.is_finite());
                self.unasked(said, told, tally)?;
                let refused = Message::Refused(Problem::Estimate);
                return answered(said, if usable { &Message::Done } else { &refused });
            }
            Request::Subscribe(subscription) => {
                self.subscription = subscription;
                return answered(said, &Message::Done);
            }
            // The driver sends it separately, and checks its answer itself.
            Request::Reset => return Err("unexpected reset request".to_owned()),
            Request::Begin { length } => self.store.begin(length),
            Request::Chunk { offset, bytes } => self.store.chunk(self.agent, offset, bytes),
            Request::Stage => self.store.stage(self.agent, supply),
            Request::Activate => self.store.activate(),
            Request::Confirm => self.store.confirm(),
            Request::Revert => self.store.revert(),
        };
        let what = match request {
            Request::Begin { .. } => "begin",
            Request::Chunk { .. } => "chunk",
            Request::Stage => "stage",
            Request::Activate => "activate",
            Request::Confirm => "confirm",
            _ => "revert",
        };
        let result = match (&answer, said.pop_front()) {
            (Answer::Exactly(expected), Some(found)) if *expected == found => match found {
                Message::Refused(Problem::Store(error)) => {
                    let error = format!("{error:?}");
                    error.split(' ').next().unwrap_or_default().to_owned()
                }
                _ => "done".to_owned(),
            },
            (Answer::PackageRefused, Some(Message::Refused(Problem::Package(report)))) => {
                format!("{:?}", report.kind)
            }
            (expected, found) => {
                tally.wrong_acceptances += u64::from(matches!(found, Some(Message::Staged { .. })));
                return Err(instead(&format!("{expected:?} to {what}"), found));
            }
        };
        if what == "activate" && result == "done" {
            self.taken_on_trial = 0;
        }
        tally.answer(format!("{what}: {result}"));
        Ok(())
    }

    /// Handles the messages before the state of a step, or before the answer to a start.
    fn unasked(
        &mut self,
        said: &mut Said<'_>,
        told: &mut Told,
        tally: &mut Tally,
    ) -> Result<(), String> {
        while let Some(message) = said.front() {
            match message {
                Message::Broadcast { bytes } => {
                    let frame = Frame::<3>::decode(bytes).map_err(|error| error.to_string())?;
                    if frame.sender as usize != self.agent + 1 {
                        return Err(format!(
                            "its broadcast names agent {} as the sender",
                            frame.sender
                        ));
                    }
                    tally.event("broadcast");
                    told.broadcasts.push(bytes.to_vec());
                }
                Message::Health { counters, .. } => {
                    self.counters_rise(&counters.to_array())?;
                    tally.event("health report");
                }
                // One of the next tick belongs to the answer to a query.
                Message::BoardErrors { tick, counters } if *tick + 1 == self.next_tick => {
                    self.missing_are(*tick + 1, self.next_tick, counters)?;
                    tally.event("board error report");
                }
                Message::Event(Event::Confirmed { tick, version }) => {
                    let due = self.store.is_on_trial() && self.taken_on_trial >= GOOD_STEPS;
                    if !due || *version != self.store.in_use.version || tick + 1 != self.next_tick {
                        return Err(format!(
                            "unexpected confirmation of version {version} in tick {tick}"
                        ));
                    }
                    self.store.way_back = None;
                    tally.event("confirmed by good steps");
                }
                Message::Event(Event::Reverted { tick, version, .. }) => {
                    let due = self.store.is_on_trial() && tick + 1 == self.next_tick;
                    if !due || *version != self.store.in_use.version {
                        return Err(format!(
                            "unexpected revert of version {version} in tick {tick}"
                        ));
                    }
                    let _ = self.store.revert();
                    tally.event("reverted by the trial");
                }
                _ => break,
            }
            said.pop_front();
        }
        Ok(())
    }

    fn turned(
        &mut self,
        periods: u32,
        measurement: Option<&[f32]>,
        said: &mut Said<'_>,
        told: &mut Told,
        tally: &mut Tally,
    ) -> Result<(), String> {
        if periods == 0 {
            return Ok(());
        }
        let tick = self.next_tick + Tick::from(periods) - 1;
        self.next_tick = tick + 1;
        // Each of the paper's agents measures one component. Without a usable measurement it continues
        // observing, which may restart it, too.
        let usual = match measurement {
            None => Outcome::NoMeasurement,
            Some(y) if y.len() > 3 => Outcome::NoMeasurement,
            Some(&[y]) if y.is_finite() => Outcome::Stepped,
            Some(y) if y.len() == 1 => Outcome::MeasurementNotFinite,
            Some(_) => Outcome::MeasurementLength,
        };
        let expected = match usual {
            Outcome::MeasurementLength => vec![usual],
            _ => vec![usual, Outcome::Restarted, Outcome::Diverged],
        };
        self.measurements_missing += u32::from(usual == Outcome::NoMeasurement);
        let is_measured = usual == Outcome::Stepped;
        self.taken_on_trial = self.taken_on_trial.saturating_add(u32::from(is_measured));
        self.unasked(said, told, tally)?;
        let every = self.subscription.state_every;
        if every.is_none_or(|every| !tick.is_multiple_of(Tick::from(every.get()))) {
            return Ok(());
        }
        let Some(Message::State(state)) = said.pop_front() else {
            return Err(format!("no state reported in tick {tick}"));
        };
        if state.tick != tick || !expected.contains(&state.outcome) {
            return Err(format!(
                "unexpected state in tick {tick} after {measurement:?}: {state:?}"
            ));
        }
        if state.outcome == Outcome::Restarted || state.outcome == Outcome::Diverged {
            tally.event(if state.outcome == Outcome::Restarted {
                "agent restarted"
            } else {
                "step refused: it overflows"
            });
        }
        finite(&state)?;
        told.estimate = Some(state.estimate);
        Ok(())
    }

    /// Checks the greeting after a restart.
    pub(super) fn rebooted(&mut self, greeting: &[u8]) -> Result<(), String> {
        self.store.reboot();
        *self = Self {
            subscription: Subscription::default(),
            next_tick: 0,
            messages_damaged: 0,
            measurements_missing: 0,
            counters: Vec::new(),
            ..self.clone()
        };
        match receive::<Message<'_>>(greeting) {
            Some(Message::Hello(status)) => self.check_status(&status),
            other => Err(instead("its greeting", other)),
        }
    }

    /// Checks that the status matches everything that has happened.
    fn check_status(&mut self, status: &Status) -> Result<(), String> {
        let Some(package) = &status.package else { return Err("it has no package".to_owned()) };
        let store = &self.store;
        let found = (
            (package.version, package.checksum, package.slot, package.agent as usize),
            package.trial.is_some(),
            status.staged,
            status.upload.map(|upload| upload.received),
        );
        let expected = (
            (store.in_use.version, store.in_use.checksum, store.slot, self.agent + 1),
            store.is_on_trial(),
            store.staged.is_some(),
            store.upload.as_ref().map(super::store::Unfinished::received),
        );
        if found != expected {
            return Err(format!("its status is {found:?}, expected {expected:?}"));
        }
        let counts = (status.tick, status.messages_damaged, status.measurements_missing);
        let expected = (self.next_tick, self.messages_damaged, self.measurements_missing);
        if counts != expected {
            return Err(format!("its counters are {counts:?}, expected {expected:?}"));
        }
        let sound = status.protocol == PROTOCOL_VERSION
            && status.refused_at_start == [None::<RefusalReport>; 2]
            && status.samples <= SAMPLES
            && status.broadcasts_lost == 0
            && !status.firmware.signed_only;
        if !sound {
            return Err(format!("{status:?}"));
        }
        self.counters_rise(&status.health.to_array())
    }

    /// Whether the node has counted the samples that are missing, and no other error of its board.
    fn missing_are(&self, tick: Tick, expected: Tick, found: &BoardErrors) -> Result<(), String> {
        let sensor = found.sensor_not_ready.saturating_add(found.sensor_other);
        let rest = BoardErrors { sensor_not_ready: 0, sensor_other: 0, ..*found };
        if tick != expected || sensor != self.measurements_missing || !rest.is_empty() {
            return Err(format!(
                "it reports {found:?} for tick {tick}, where {} samples are missing in tick {expected}",
                self.measurements_missing
            ));
        }
        Ok(())
    }

    fn counters_rise(&mut self, counters: &[u32]) -> Result<(), String> {
        if self.counters.iter().zip(counters).any(|(before, now)| now < before) {
            return Err(format!("counters decreased from {:?} to {counters:?}", self.counters));
        }
        self.counters = counters.to_vec();
        Ok(())
    }
}

/// Parses the messages in order.
///
/// # Errors
/// The first invalid message.
fn parsed(messages: &[Vec<u8>]) -> Result<Said<'_>, String> {
    let parse = |bytes: &'_ Vec<u8>| format!("unrecognised message: {bytes:02x?}");
    messages.iter().map(|bytes| receive(bytes).ok_or_else(|| parse(bytes))).collect()
}

/// Describes messages.
pub(super) fn names(messages: &[Vec<u8>]) -> Vec<String> {
    parsed(messages).map_or_else(|error| vec![error], |said| said.iter().map(name).collect())
}

fn instead(expected: &str, found: Option<Message<'_>>) -> String {
    let found = found.map_or_else(|| "nothing".to_owned(), |message| name(&message));
    format!("expected {expected}, found {found}")
}

fn answered(said: &mut Said<'_>, expected: &Message<'static>) -> Result<(), String> {
    match said.pop_front() {
        Some(found) if found == *expected => Ok(()),
        found => Err(instead(&name(expected), found)),
    }
}

fn sampled(from: Tick, most: u8, said: &mut Said<'_>) -> Result<(), String> {
    let (mut next, mut count) = (from, 0);
    loop {
        match said.pop_front() {
            Some(Message::Sample { tick, estimate, derivative }) if tick >= next => {
                if !estimate.iter().chain(&derivative).all(|x| x.is_finite()) {
                    return Err(format!(
                        "the sample of tick {tick} is {estimate:?}, {derivative:?}"
                    ));
                }
                (next, count) = (tick + 1, count + 1);
            }
            Some(Message::SamplesEnd { next: found })
                if found == next && count <= u32::from(most) =>
            {
                return Ok(());
            }
            other => return Err(instead("a sample, or the end of samples", other)),
        }
    }
}

fn finite(state: &State<Vec<f32>>) -> Result<(), String> {
    let State { estimate, derivative, outer_weights, .. } = state;
    let mut numbers = estimate.iter().chain(derivative).chain(outer_weights);
    if estimate.len() != 3 || !numbers.all(|number| number.is_finite()) {
        return Err(format!("{state:?}"));
    }
    Ok(())
}
