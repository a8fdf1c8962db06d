//! `monitor`: shows a running node's messages and records its samples.

use std::num::NonZeroU32;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use agent_core::health::HealthCounters;
use agent_core::service::{Event, Outcome, Request, State, Status, Subscription};
use agent_core::{AgentId, Tick};
use clap::Args;
use serde::Serialize;

use super::board_report::{BoardReport, errors_line, fault_line};
use super::connection::{RETRY_POLICY, connect};
use super::key::NodeKeys;
use super::node::text;
use super::node_report::reason_text;
use super::{
    Changes, CommandError, ErrorCode, Format, health, load_scenario, print_json, print_text,
};
use crate::interruption::{self, SecondSignal};
use crate::packages::{PackageBytes, RecordingSource};
use crate::service::client::decode;
use crate::service::nodes_file::NodesFile;
use crate::service::push::{done, in_use, status_and};
use crate::service::record::{RecordCounts, Recorder, step_size};
use crate::service::record_file::RecordFile;
use crate::service::{Address, Client, LineError, Message, RetryPolicy, ServiceError};

/// Default interval between states. \[steps\]
const EVERY: NonZeroU32 = NonZeroU32::new(500).unwrap();

/// Interval between lines while every step is recorded.
const LINE: Duration = Duration::from_millis(500);

/// Interval between requests for the node's own samples.
const SAMPLES: Duration = Duration::from_millis(200);

/// Arguments of `monitor`.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Node: unix:PATH or serial:/dev/tty...[@BAUD]
    endpoint: Address,
    /// Record samples and outer weights for `train`, until Ctrl-C
    #[arg(long, value_name = "FILE.csv")]
    record: Option<PathBuf>,
    /// With --record: append to a recording of the same agent
    #[arg(long, requires = "record")]
    append: bool,
    /// With --record: the node's scenario, to be noted in the file [default: the one that
    /// `cosim --serve` runs]
    #[arg(long, requires = "record")]
    scenario: Option<PathBuf>,
    #[command(flatten)]
    changes: Changes,
    /// With --record: the package in use, whose recipe is noted in the file
    #[arg(long, requires = "record")]
    package: Option<PathBuf>,
    /// Report the state every N steps [default: 500; with --record, 1]. With 1, the sample of every
    /// step is recorded; with more, the samples that the node itself keeps are recorded
    #[arg(long, value_name = "N")]
    every: Option<NonZeroU32>,
    /// Exit after N states
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    count: Option<u64>,
    #[command(flatten)]
    keys: NodeKeys,
    /// Output format: text, or one JSON object per message, one per line
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

/// How long unsubscribing may take, also after Ctrl-C.
const UNSUBSCRIBE: RetryPolicy = RetryPolicy { timeout: Duration::from_millis(400), tries: 1 };

pub(super) fn execute(arguments: &Arguments) -> Result<(), CommandError> {
    interruption::listen(SecondSignal::Exit);
    let keys = arguments.keys.read()?;
    let mut node = connect(&arguments.endpoint, keys.as_ref())?;
    let mut board = BoardReport::default();
    let before = status_and(&mut node, RETRY_POLICY, &mut |message| board.record(message))?;
    let default = if arguments.record.is_some() { NonZeroU32::MIN } else { EVERY };
    let every = arguments.every.unwrap_or(default);
    let all_steps = every == NonZeroU32::MIN;
    let recorder = match &arguments.record {
        Some(path) => Some(recorder(arguments, path, &before, all_steps)?),
        None => None,
    };
    let mut monitor = Monitor {
        arguments,
        step: before.package.map(|package| step_size(package.step_size)),
        agent: before.package.map(|package| package.agent),
        subscription: Subscription {
            state_every: Some(every),
            outer_weights: arguments.record.is_some(),
        },
        all_steps,
        recorder,
        states: 0,
        unreadable: 0,
        last_line: None,
        next_sample: before.tick,
        lost_output: None,
    };
    match arguments.format {
        Format::Json => {
            monitor.print(|| print_json(&Message::Status(before)))?;
            for message in board.messages() {
                monitor.print(|| print_json(&message))?;
            }
        }
        Format::Text => {
            let text = text(&arguments.endpoint, &before) + &board.text();
            monitor.print(|| print_text(&text))?;
        }
    }
    subscribe(&mut node, monitor.subscription, RETRY_POLICY)?;
    let listened = monitor.listen(&mut node);
    // Keep the recorded samples even after an error.
    let saved = monitor.finish();
    // Best effort: the node may no longer be reachable.
    node.set_grace(UNSUBSCRIBE.timeout);
    let _ = subscribe(&mut node, Subscription::default(), UNSUBSCRIBE);
    listened?;
    saved
}

fn subscribe(
    node: &mut Client,
    subscription: Subscription,
    retry_policy: RetryPolicy,
) -> Result<(), ServiceError> {
    let request = Request::Subscribe(subscription);
    node.request(&request, retry_policy, &mut |_| {}, "a confirmation", done)
}

/// Asks for the samples of this tick and later ones.
fn samples_from(from: Tick) -> Request<'static> {
    Request::Samples { from, most: u8::MAX }
}

/// Sends a request, whose answer is among the messages that follow.
fn send(node: &mut Client, request: &Request<'_>) -> Result<(), ServiceError> {
    node.prepare_sealed(request, RETRY_POLICY.timeout)?;
    Ok(node.flush(RETRY_POLICY.timeout)?)
}

/// Opens the recording of a node whose status is `before`.
fn recorder(
    arguments: &Arguments,
    path: &Path,
    before: &Status,
    all_steps: bool,
) -> Result<Recorder, CommandError> {
    let Some(package) = before.package else {
        return Err(CommandError::new(
            ErrorCode::Node,
            "the node has no package, so there is nothing to record; push one first".to_owned(),
        ));
    };
    let step = step_size(package.step_size);
    let source = source(arguments, before, step)?;
    let file = RecordFile::open(path, arguments.append, &source)?;
    let stride = if all_steps { 1 } else { before.firmware.sample_stride };
    Ok(Recorder::new(file, step, stride.into()))
}

/// Returns what is known about the origin of the samples.
fn source(
    arguments: &Arguments,
    before: &Status,
    step: f64,
) -> Result<RecordingSource, CommandError> {
    let mut source = RecordingSource { step: Some(step), ..RecordingSource::default() };
    if let Some(package) = before.package {
        source.agent = Some(package.agent.into());
        source.package = Some((package.version, package.checksum));
    }
    if let Some(path) = &arguments.package {
        let package = PackageBytes::load(path)?;
        if in_use(before, package.as_bytes()).is_none() {
            return Err(CommandError::usage(format!(
                "{}: not the package in use on the node; give the one in use as --package, or leave --package out",
                path.display()
            ))
            .about(path));
        }
        let provenance = package.package().provenance;
        source.recipe = Some(provenance.recipe.to_owned());
        source.scenario_hash = Some(u64::from_be_bytes(provenance.scenario_hash));
    }
    if let Some(path) = &arguments.scenario {
        let scenario = load_scenario(path, &arguments.changes)?;
        source.scenario = Some(scenario.name.clone());
        source.scenario_hash = Some(scenario.hash);
    } else if let Address::Socket(socket) = &arguments.endpoint
        && let Some(nodes) = socket.parent().and_then(NodesFile::read)
    {
        source.scenario_hash = nodes.hash();
        source.scenario = Some(nodes.scenario);
    }
    Ok(source)
}

struct Monitor<'a> {
    arguments: &'a Arguments,
    /// `dt`, known only with a package. \[s\]
    step: Option<f64>,
    /// The node's agent at the start.
    agent: Option<AgentId>,
    subscription: Subscription,
    /// Whether every step is reported.
    all_steps: bool,
    recorder: Option<Recorder>,
    states: u64,
    /// Number of messages that were damaged or not recognised.
    unreadable: u64,
    last_line: Option<Instant>,
    /// First tick of the next request for samples.
    next_sample: Tick,
    /// Why printing has stopped, while the recording continues.
    lost_output: Option<std::io::Error>,
}

impl Monitor<'_> {
    /// Handles messages until interrupted or until the requested number of states has arrived.
    fn listen(&mut self, node: &mut Client) -> Result<(), CommandError> {
        let mut last_samples = Instant::now();
        while !interruption::requested() && self.arguments.count.is_none_or(|n| self.states < n) {
            match node.next(SAMPLES) {
                Ok(Ok(bytes)) => self.handle(node, &bytes)?,
                // Damaged; wait for the next message.
                Ok(Err(_)) => self.unreadable += 1,
                Err(LineError::Silent | LineError::Interrupted) => {}
                Err(error) => return Err(ServiceError::from(error).into()),
            }
            if let Some(recorder) = &mut self.recorder {
                recorder.write_if_due()?;
            }
            // Samples are useful only once their outer weights are known.
            let wanted = self.recorder.is_some() && !self.all_steps && self.states > 0;
            if wanted && last_samples.elapsed() >= SAMPLES {
                last_samples = Instant::now();
                send(node, &samples_from(self.next_sample))?;
            }
        }
        Ok(())
    }

    fn handle(&mut self, node: &mut Client, bytes: &[u8]) -> Result<(), CommandError> {
        let message = match decode(bytes) {
            Ok(message) => message,
            // A newer node may send messages that this version does not know.
            Err(ServiceError::Unrecognised(_)) => {
                self.unreadable += 1;
                return Ok(());
            }
            Err(error) => return Err(error.into()),
        };
        match (&message, &mut self.recorder) {
            (Message::Sample { tick, estimate, derivative }, Some(recorder)) => {
                return Ok(recorder.sample(*tick, estimate, derivative)?);
            }
            (Message::SamplesEnd { .. }, Some(recorder)) => {
                let next = self.next_sample.max(recorder.next_tick());
                let is_more = next > self.next_sample;
                self.next_sample = next;
                // A node sends a few at a time, so that its steps are not late.
                if is_more {
                    send(node, &samples_from(next))?;
                }
                return Ok(());
            }
            (Message::State(state), _) => return self.state(state, &message),
            (Message::Hello(status), _) => self.handle_reset(node, status)?,
            _ => {}
        }
        let json = self.arguments.format == Format::Json;
        let time = |tick: &Tick| self.time(*tick);
        let line = match &message {
            message if json => return self.print(|| print_json(message)),
            Message::Event(Event::Confirmed { tick, version }) => {
                format!("{}  version {version} confirmed\n", time(tick))
            }
            Message::Event(Event::Reverted { tick, version, reason }) => {
                format!("{}  version {version} reverted: {}\n", time(tick), reason_text(*reason))
            }
            Message::Event(Event::BoardFault(fault)) => fault_line(*fault),
            Message::BoardErrors { tick, counters } => {
                format!("{}  {}", time(tick), errors_line(counters))
            }
            Message::Health { tick, counters } if *counters != HealthCounters::default() => {
                format!("{}  health: {}\n", time(tick), health::line(counters))
            }
            Message::Hello(status) => format!("reset\n{}", text(&self.arguments.endpoint, status)),
            _ => return Ok(()),
        };
        self.print(|| print_text(&line))
    }

    /// Subscribes again after a reset of the node, whose ticks restart at 0.
    fn handle_reset(&mut self, node: &mut Client, status: &Status) -> Result<(), CommandError> {
        let package = status.package;
        if let Some(recorder) = &mut self.recorder {
            if package.map(|package| package.agent) != self.agent {
                return Err(CommandError::new(ErrorCode::Node,
                    "the node has run a different agent since its reset, so the recording ends; record \
                     the new agent to another file"
                        .to_owned(),
                ));
            }
            recorder.reset();
            self.next_sample = 0;
        }
        self.step = package.map(|package| step_size(package.step_size)).or(self.step);
        Ok(send(node, &Request::Subscribe(self.subscription))?)
    }

    fn state(
        &mut self,
        state: &State<Vec<f32>>,
        message: &Message<'_>,
    ) -> Result<(), CommandError> {
        self.states += 1;
        let mut recorded = String::new();
        if let Some(recorder) = &mut self.recorder {
            if self.all_steps {
                recorder.state(state)?;
            } else {
                recorder.observe(state);
            }
            if self.all_steps && self.last_line.is_some_and(|last| last.elapsed() < LINE) {
                return Ok(());
            }
            self.last_line = Some(Instant::now());
            recorded = match recorder.counts().samples {
                0 => String::new(),
                count => format!("  {count} samples"),
            };
        }
        if self.arguments.format == Format::Json {
            return self.print(|| print_json(message));
        }
        let numbers: Vec<_> = state.estimate.iter().map(|x| format!("{x:10.4}")).collect();
        let outcome = match state.outcome {
            Outcome::Stepped => String::new(),
            outcome => format!("  {}", outcome_text(outcome)),
        };
        let time = self.time(state.tick);
        let line = format!("{time}  x_hat {}{outcome}{recorded}\n", numbers.join(" "));
        self.print(|| print_text(&line))
    }

    /// Prints, and keeps recording if standard output fails.
    fn print(
        &mut self,
        print: impl FnOnce() -> Result<(), CommandError>,
    ) -> Result<(), CommandError> {
        if self.lost_output.is_some() {
            return Ok(());
        }
        match print() {
            Err(CommandError::Output(error)) if self.recorder.is_some() => {
                self.lost_output = Some(error);
                Ok(())
            }
            done => done,
        }
    }

    /// Formats the time, or the tick if the step size is unknown.
    fn time(&self, tick: Tick) -> String {
        match self.step {
            Some(step) => format!("t = {:9.3} s", tick as f64 * step),
            None => format!("tick {tick:9}"),
        }
    }

    /// Finishes the recording and prints its summary.
    fn finish(&mut self) -> Result<(), CommandError> {
        let json = self.arguments.format == Format::Json;
        let (Some(path), Some(recorder)) = (&self.arguments.record, self.recorder.take()) else {
            return match self.unreadable {
                unreadable if json || unreadable == 0 => Ok(()),
                unreadable => print_text(&format!("{unreadable} messages could not be read\n")),
            };
        };
        let counts = recorder.finish()?;
        if counts.samples == 0 {
            let left_out = match counts.bad {
                0 => String::new(),
                bad => format!(" ({bad} were not finite or had the wrong length)"),
            };
            return Err(CommandError::new(
                ErrorCode::Node,
                format!(
                    "{}: not written, because no samples were received{left_out}; check that the node is \
                 stepping, and record for longer",
                    path.display()
                ),
            ).about(path));
        }
        let report =
            RecordReport { file: path.display().to_string(), unreadable: self.unreadable, counts };
        let printed = match self.lost_output.take() {
            Some(error) => Err(CommandError::Output(error)),
            None if json => print_json(&report),
            None => print_text(&report.text()),
        };
        match printed {
            // As for other commands, a closed pipe is not an error.
            Err(CommandError::Output(error)) if error.kind() == std::io::ErrorKind::BrokenPipe => {
                Ok(())
            }
            printed => printed,
        }
    }
}

/// Summary of a recording.
#[derive(Serialize)]
struct RecordReport {
    file: String,
    #[serde(flatten)]
    counts: RecordCounts,
    /// Messages that could not be read.
    unreadable: u64,
}

impl RecordReport {
    fn text(&self) -> String {
        let RecordCounts { samples, lost, bad, not_stepped, resets } = self.counts;
        let left_out = [
            (lost, "lost in transit"),
            (bad, "skipped (not finite or wrong length)"),
            (not_stepped, "missing because the node took no step"),
            (self.unreadable, "messages that could not be read"),
        ];
        let mut text = format!("Written to {}: {samples} samples", self.file);
        for (count, what) in left_out.iter().filter(|(count, _)| *count > 0) {
            text += &format!(", {count} {what}");
        }
        if resets > 0 {
            text += &format!(", {} segments, because the node was reset", resets + 1);
        }
        text + "\n"
    }
}

fn outcome_text(outcome: Outcome) -> &'static str {
    match outcome {
        Outcome::Stepped => "a step",
        Outcome::Restarted => "restarted after an unusable estimate",
        Outcome::NoPackage => "no package",
        Outcome::NoMeasurement => "no measurement",
        Outcome::MeasurementLength => "a measurement of the wrong length",
        Outcome::MeasurementNotFinite => "a measurement that is not finite",
        Outcome::Diverged => "would have overflowed",
        Outcome::Refused => "no step",
    }
}
