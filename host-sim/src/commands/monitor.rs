//! `monitor`: what a running node tells, on the terminal and into a file.

use std::num::NonZeroU32;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use agent_core::Tick;
use agent_core::health::HealthCounters;
use agent_core::service::{Event, Outcome, Request, State, Subscription};
use clap::Args;

use super::node::{PATIENCE, connect, text};
use super::{CommandError, Format, health, print_json, print_text};
use crate::interruption::{self, Again};
use crate::service::conversation::understood;
use crate::service::push::{done, status};
use crate::service::record::{Recorder, step_size};
use crate::service::{Address, Conversation, LineError, Message, ServiceError};

/// Between two states, if nobody says otherwise. \[steps\]
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

pub(super) fn execute(arguments: &Arguments) -> Result<(), CommandError> {
    interruption::listen(Again::Exit);
    let mut node = connect(&arguments.endpoint)?;
    let before = status(&mut node, PATIENCE)?;
    match arguments.format {
        Format::Json => print_json(&Message::Status(before))?,
        Format::Text => print_text(&text(&arguments.endpoint, &before))?,
    }
    let step = before.package.map(|package| step_size(package.step_size));
    if arguments.record.is_some() && step.is_none() {
        return Err(CommandError::Node(
            "the node has no package, and so nothing to record; push one first".to_owned(),
        ));
    }
    let default = if arguments.record.is_some() { NonZeroU32::MIN } else { EVERY };
    let every = arguments.every.unwrap_or(default);
    let mut monitor = Monitor {
        arguments,
        step: step.unwrap_or(0.0),
        all_steps: every == NonZeroU32::MIN,
        recorder: Recorder::default(),
        states: 0,
        last_line: None,
        next_sample: before.tick,
    };
    let subscription =
        Subscription { state_every: Some(every), outer_weights: arguments.record.is_some() };
    subscribe(&mut node, subscription)?;
    let listened = monitor.listen(&mut node);
    // What has been recorded is worth something, however it ended.
    let saved = monitor.save();
    // The node may be gone.
    let _ = subscribe(&mut node, Subscription::default());
    listened?;
    saved
}

fn subscribe(node: &mut Conversation, subscription: Subscription) -> Result<(), ServiceError> {
    let request = Request::Subscribe(subscription);
    node.insist(&request, PATIENCE, &mut |_| {}, "that it is done", done)
}

struct Monitor<'a> {
    arguments: &'a Arguments,
    /// `dt`. \[s\]
    step: f64,
    /// Whether there is a state with every step.
    all_steps: bool,
    recorder: Recorder,
    states: u64,
    last_line: Option<Instant>,
    /// From which tick on the node is asked for samples.
    next_sample: Tick,
}

impl Monitor<'_> {
    /// Until the end is asked for, or the wanted states have come.
    fn listen(&mut self, node: &mut Conversation) -> Result<(), CommandError> {
        let mut last_samples = Instant::now();
        while !interruption::requested() && self.arguments.count.is_none_or(|n| self.states < n) {
            match node.next(SAMPLES) {
                Ok(Ok(bytes)) => self.hear(&understood(&bytes)?)?,
                // Lost on the way; the next one will come.
                Ok(Err(_)) | Err(LineError::Silent | LineError::Interrupted) => {}
                Err(error) => return Err(ServiceError::from(error).into()),
            }
            let wanted = self.arguments.record.is_some() && !self.all_steps;
            if wanted && last_samples.elapsed() >= SAMPLES {
                last_samples = Instant::now();
                node.prepare(&Request::Samples { from: self.next_sample, most: u8::MAX });
                node.flush(PATIENCE.timeout).map_err(ServiceError::from)?;
            }
        }
        Ok(())
    }

    fn hear(&mut self, message: &Message<'_>) -> Result<(), CommandError> {
        match message {
            Message::State(state) => self.state(state, message),
            Message::Sample { tick, estimate, derivative } => {
                self.recorder.sample(*tick, estimate, derivative);
                Ok(())
            }
            Message::SamplesEnd { .. } => {
                self.next_sample = self.next_sample.max(self.recorder.next_tick());
                Ok(())
            }
            _ if self.arguments.format == Format::Json => print_json(message),
            Message::Event(Event::Confirmed { tick, version }) => {
                print_text(&format!("{}  version {version} has proved itself\n", self.time(*tick)))
            }
            Message::Health { tick, counters } if *counters != HealthCounters::default() => {
                print_text(&format!("{}  health: {}\n", self.time(*tick), health::line(counters)))
            }
            Message::Hello(status) => {
                print_text(&format!("reset\n{}", text(&self.arguments.endpoint, status)))
            }
            _ => Ok(()),
        }
    }

    fn state(
        &mut self,
        state: &State<Vec<f32>>,
        message: &Message<'_>,
    ) -> Result<(), CommandError> {
        self.states += 1;
        if self.arguments.record.is_some() {
            if self.all_steps {
                self.recorder.state(state);
            } else {
                self.recorder.weights(state);
            }
            if self.all_steps && self.last_line.is_some_and(|last| last.elapsed() < LINE) {
                return Ok(());
            }
            self.last_line = Some(Instant::now());
        }
        if self.arguments.format == Format::Json {
            return print_json(message);
        }
        let numbers: Vec<_> = state.estimate.iter().map(|x| format!("{x:10.4}")).collect();
        let outcome = match state.outcome {
            Outcome::Stepped => String::new(),
            outcome => format!("  {}", outcome_text(outcome)),
        };
        let recorded = match self.recorder.len() {
            0 => String::new(),
            count => format!("  {count} samples"),
        };
        let time = self.time(state.tick);
        print_text(&format!("{time}  x_hat {}{outcome}{recorded}\n", numbers.join(" ")))
    }

    fn time(&self, tick: Tick) -> String {
        format!("t = {:9.3} s", tick as f64 * self.step)
    }

    fn save(&self) -> Result<(), CommandError> {
        let Some(path) = &self.arguments.record else { return Ok(()) };
        if !self.recorder.save(path, self.step)? {
            return Err(CommandError::Node(format!(
                "{}: not written, since no sample came; see that the node steps, and record longer",
                path.display()
            )));
        }
        match self.arguments.format {
            Format::Json => Ok(()),
            Format::Text => print_text(&format!(
                "Written to {}: {} samples\n",
                path.display(),
                self.recorder.len()
            )),
        }
    }
}

fn outcome_text(outcome: Outcome) -> &'static str {
    match outcome {
        Outcome::Stepped => "a step",
        Outcome::Restarted => "was lost and has begun anew",
        Outcome::NoPackage => "no package",
        Outcome::NoMeasurement => "no measurement",
        Outcome::MeasurementLength => "a measurement of another length",
        Outcome::MeasurementNotFinite => "a measurement that is not finite",
        Outcome::Diverged => "would have overflowed",
        Outcome::Refused => "no step",
    }
}
