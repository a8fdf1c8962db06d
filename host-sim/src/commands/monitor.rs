//! `monitor`: what a running node tells, on the terminal and into a file.

use std::num::NonZeroU32;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use agent_core::health::HealthCounters;
use agent_core::service::{Event, Outcome, Request, State, Status, Subscription};
use agent_core::{AgentId, Tick};
use clap::Args;
use serde::Serialize;

use super::board_report::{BoardReport, errors_line, fault_line};
use super::node::{RETRY_POLICY, connect, text};
use super::{CommandError, ErrorCode, Format, health, load_scenario, print_json, print_text};
use crate::interruption::{self, Again};
use crate::packages::{PackageBytes, RecordingSource};
use crate::service::client::understood;
use crate::service::nodes_file::NodesFile;
use crate::service::push::{done, in_use, status_and};
use crate::service::record::{RecordCounts, Recorder, step_size};
use crate::service::record_file::RecordFile;
use crate::service::{Address, Client, LineError, Message, RetryPolicy, ServiceError};

/// Between two states, by default. \[steps\]
const EVERY: NonZeroU32 = NonZeroU32::new(500).unwrap();

/// Between two lines while every step is recorded.
const LINE: Duration = Duration::from_millis(500);

/// Between two requests for the node's own samples.
const SAMPLES: Duration = Duration::from_millis(200);

/// Arguments of `monitor`.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// The node: unix:PATH or serial:/dev/tty...[@BAUD]
    endpoint: Address,
    /// Records samples and outer weights for `train`, until Ctrl-C
    #[arg(long, value_name = "FILE.csv")]
    record: Option<PathBuf>,
    /// With --record: adds to a recording of the same agent
    #[arg(long, requires = "record")]
    append: bool,
    /// With --record: the scenario of the node, to be named in the file [default: the one that
    /// `cosim --serve` runs]
    #[arg(long, requires = "record")]
    scenario: Option<PathBuf>,
    /// With --record: the package in use, whose recipe is to be named in the file
    #[arg(long, requires = "record")]
    package: Option<PathBuf>,
    /// A state with every so many steps [default: 500; with --record, 1]. A recording takes the
    /// sample of every step with 1, and with more those that the node keeps itself
    #[arg(long)]
    every: Option<NonZeroU32>,
    /// Ends after so many states
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..))]
    count: Option<u64>,
    /// Text, or the node's messages as one JSON object a line
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

/// How long saying good-bye may take, also after Ctrl-C.
const GOOD_BYE: RetryPolicy = RetryPolicy { timeout: Duration::from_millis(400), tries: 1 };

pub(super) fn execute(arguments: &Arguments) -> Result<(), CommandError> {
    interruption::listen(Again::Exit);
    let mut node = connect(&arguments.endpoint)?;
    let mut board = BoardReport::default();
    let before = status_and(&mut node, RETRY_POLICY, &mut |message| board.hear(message))?;
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
    // What has been recorded is worth something, however it ended.
    let saved = monitor.finish();
    // The node may be gone.
    node.set_grace(GOOD_BYE.timeout);
    let _ = subscribe(&mut node, Subscription::default(), GOOD_BYE);
    listened?;
    saved
}

fn subscribe(
    node: &mut Client,
    subscription: Subscription,
    retry_policy: RetryPolicy,
) -> Result<(), ServiceError> {
    let request = Request::Subscribe(subscription);
    node.request(&request, retry_policy, &mut |_| {}, "that it is done", done)
}

/// The recording of a node that is as `before`.
fn recorder(
    arguments: &Arguments,
    path: &Path,
    before: &Status,
    all_steps: bool,
) -> Result<Recorder, CommandError> {
    let Some(package) = before.package else {
        return Err(CommandError::new(
            ErrorCode::Node,
            "the node has no package, and so nothing to record; push one first".to_owned(),
        ));
    };
    let step = step_size(package.step_size);
    let source = source(arguments, before, step)?;
    let file = RecordFile::open(path, arguments.append, &source)?;
    let stride = if all_steps { 1 } else { before.firmware.sample_stride };
    Ok(Recorder::new(file, step, stride.into()))
}

/// Where the samples come from, as far as anything here knows.
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
                "{}: is not the package that the node uses; give that one as --package, or none",
                path.display()
            ))
            .about(path));
        }
        let provenance = package.package().provenance;
        source.recipe = Some(provenance.recipe.to_owned());
        source.scenario_hash = Some(u64::from_be_bytes(provenance.scenario_hash));
    }
    if let Some(path) = &arguments.scenario {
        let scenario = load_scenario(path)?;
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
    /// `dt`, if there is a package that tells it. \[s\]
    step: Option<f64>,
    /// Who the node was at the beginning.
    agent: Option<AgentId>,
    subscription: Subscription,
    /// Whether there is a state with every step.
    all_steps: bool,
    recorder: Option<Recorder>,
    states: u64,
    /// Messages that arrived damaged, or that this program does not know.
    unreadable: u64,
    last_line: Option<Instant>,
    /// From which tick on the node is asked for samples.
    next_sample: Tick,
    /// Why nothing is printed any more: a recording goes on without.
    lost_output: Option<std::io::Error>,
}

impl Monitor<'_> {
    /// Until the end is asked for, or the wanted states have come.
    fn listen(&mut self, node: &mut Client) -> Result<(), CommandError> {
        let mut last_samples = Instant::now();
        while !interruption::requested() && self.arguments.count.is_none_or(|n| self.states < n) {
            match node.next(SAMPLES) {
                Ok(Ok(bytes)) => self.hear(node, &bytes)?,
                // The next one will come.
                Ok(Err(_)) => self.unreadable += 1,
                Err(LineError::Silent | LineError::Interrupted) => {}
                Err(error) => return Err(ServiceError::from(error).into()),
            }
            if let Some(recorder) = &mut self.recorder {
                recorder.write_if_due()?;
            }
            // Samples are of use only once their outer weights are known.
            let wanted = self.recorder.is_some() && !self.all_steps && self.states > 0;
            if wanted && last_samples.elapsed() >= SAMPLES {
                last_samples = Instant::now();
                node.prepare(&Request::Samples { from: self.next_sample, most: u8::MAX });
                node.flush(RETRY_POLICY.timeout).map_err(ServiceError::from)?;
            }
        }
        Ok(())
    }

    fn hear(&mut self, node: &mut Client, bytes: &[u8]) -> Result<(), CommandError> {
        let message = match understood(bytes) {
            Ok(message) => message,
            // A newer node may know more messages.
            Err(ServiceError::Nonsense(_)) => {
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
                self.next_sample = self.next_sample.max(recorder.next_tick());
                return Ok(());
            }
            (Message::State(state), _) => return self.state(state, &message),
            (Message::Hello(status), _) => self.began_again(node, status)?,
            _ => {}
        }
        let json = self.arguments.format == Format::Json;
        let time = |tick: &Tick| self.time(*tick);
        let line = match &message {
            message if json => return self.print(|| print_json(message)),
            Message::Event(Event::Confirmed { tick, version }) => {
                format!("{}  version {version} has proved itself\n", time(tick))
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

    /// The node has been reset: what it was told is forgotten, and its ticks begin again.
    fn began_again(&mut self, node: &mut Client, status: &Status) -> Result<(), CommandError> {
        let package = status.package;
        if let Some(recorder) = &mut self.recorder {
            if package.map(|package| package.agent) != self.agent {
                return Err(CommandError::new(ErrorCode::Node,
                    "the node is another agent since it was reset, so the recording ends; record it \
                     into another file"
                        .to_owned(),
                ));
            }
            recorder.reset();
            self.next_sample = 0;
        }
        self.step = package.map(|package| step_size(package.step_size)).or(self.step);
        node.prepare(&Request::Subscribe(self.subscription));
        Ok(node.flush(RETRY_POLICY.timeout).map_err(ServiceError::from)?)
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
                recorder.accompany(state);
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

    /// Prints, unless the output is gone while a recording goes on: that is worth more.
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

    /// Without a package the length of a step is not known.
    fn time(&self, tick: Tick) -> String {
        match self.step {
            Some(step) => format!("t = {:9.3} s", tick as f64 * step),
            None => format!("tick {tick:9}"),
        }
    }

    /// Writes what is left of a recording, and says what is in it.
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
                bad => format!(" ({bad} were not finite or of another length)"),
            };
            return Err(CommandError::new(
                ErrorCode::Node,
                format!(
                    "{}: not written, since no sample came{left_out}; see that the node steps, and record \
                 longer",
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
            // The recording is there; a closed pipe is not an error, as for other commands.
            Err(CommandError::Output(error)) if error.kind() == std::io::ErrorKind::BrokenPipe => {
                Ok(())
            }
            printed => printed,
        }
    }
}

/// What is in a recording, and what is not.
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
            (lost, "lost on the way"),
            (bad, "left out, not finite or of another length"),
            (not_stepped, "missing because the node took no step"),
            (self.unreadable, "messages that could not be read"),
        ];
        let mut text = format!("Written to {}: {samples} samples", self.file);
        for (count, what) in left_out.iter().filter(|(count, _)| *count > 0) {
            text += &format!(", {count} {what}");
        }
        if resets > 0 {
            text += &format!(", {} pieces, since the node was reset", resets + 1);
        }
        text + "\n"
    }
}

fn outcome_text(outcome: Outcome) -> &'static str {
    match outcome {
        Outcome::Stepped => "a step",
        Outcome::Restarted => "was lost and has restarted",
        Outcome::NoPackage => "no package",
        Outcome::NoMeasurement => "no measurement",
        Outcome::MeasurementLength => "a measurement of another length",
        Outcome::MeasurementNotFinite => "a measurement that is not finite",
        Outcome::Diverged => "would have overflowed",
        Outcome::Refused => "no step",
    }
}
