//! A node in the loop: the messages exchanged with it, and the process that runs it.

use std::borrow::Cow;
use std::time::{Duration, Instant};

use agent_core::AgentId;
use agent_core::service::{Numbers, PROTOCOL_VERSION, Problem, Request, Status, Subscription};
use tempfile::TempDir;

use super::fault::Fault;
use super::process::Process;
use crate::keys::PortKeys;
use crate::packages::PackageBytes;
use crate::service::client::{decode, name};
use crate::service::provision::{self, NewKeys};
use crate::service::push::{self, PushError};
use crate::service::{Client, Line, LineError, Message, RetryPolicy, ServiceError};

/// Default timeout for a node's reply.
pub const TIMEOUT: Duration = Duration::from_secs(10);

/// Interval for checking whether the node's process is still running.
const SLICE: Duration = Duration::from_millis(100);

/// How long to wait for a process to exit after it has closed its line.
const END: Duration = Duration::from_secs(1);

/// A node and its connection.
#[derive(Debug)]
pub struct Board {
    client: Client,
    /// Name, for messages.
    label: String,
    /// The emulator's process, if there is one.
    process: Option<Process>,
    /// Whether its flash persists, so that it may already be running and have another package.
    persistent: bool,
    timeout: Duration,
    /// Removed at the end, after the process.
    _folder: Option<TempDir>,
}

/// What a node sent in a step.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Turn {
    /// Its state after the step.
    pub state: Option<agent_core::service::State<Vec<f32>>>,
    /// The frames it broadcast.
    pub frames: Vec<Vec<u8>>,
    /// Other messages, without framing.
    pub unsolicited: Vec<Vec<u8>>,
}

/// A node's answer to a request.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Exchange {
    /// The messages of the answer, without framing.
    pub answers: Vec<Vec<u8>>,
    /// Frames broadcast in the meantime.
    pub frames: Vec<Vec<u8>>,
    /// Other messages, without framing.
    pub unsolicited: Vec<Vec<u8>>,
}

impl Board {
    /// Creates a board on this line, called `label` in messages. If its flash is `persistent`, a
    /// different package in it is replaced.
    #[must_use]
    pub fn new(line: Line, label: &str, persistent: bool) -> Self {
        Self {
            client: Client::new(line),
            label: label.to_owned(),
            process: None,
            persistent,
            timeout: TIMEOUT,
            _folder: None,
        }
    }

    /// Seals requests with these keys, if the node is provisioned.
    pub fn set_keys(&mut self, keys: PortKeys) {
        self.client.set_keys(keys);
    }

    /// Returns the keys, if there are any.
    #[must_use]
    pub fn keys(&self) -> Option<&PortKeys> {
        self.client.keys()
    }

    /// Attaches the process that runs the node, and the folder with its files.
    #[must_use]
    pub fn with_process(mut self, process: Process, folder: TempDir) -> Self {
        (self.process, self._folder) = (Some(process), Some(folder));
        self
    }

    /// Returns the name used in messages.
    #[must_use]
    pub fn label(&self) -> &str {
        &self.label
    }

    /// Sets how long waits continue after a stop request.
    pub fn set_grace(&mut self, grace: Duration) {
        self.client.set_grace(grace);
    }

    /// Sets the timeout for replies.
    pub fn set_timeout(&mut self, timeout: Duration) {
        self.timeout = timeout;
    }

    /// Kills its process, if there is one.
    pub fn kill(&mut self) {
        if let Some(process) = &mut self.process {
            process.kill();
        }
    }

    /// Continues with the contents of its flash, and subscribes to every step. Returns its status.
    ///
    /// # Errors
    /// See [`Fault`].
    pub fn rejoin(&mut self) -> Result<Status, Fault> {
        let status = if self.persistent { self.greet()? } else { self.hello()? };
        if status.protocol != PROTOCOL_VERSION {
            return Err(Fault::Protocol { found: status.protocol });
        }
        self.subscribe()?;
        Ok(status)
    }

    /// Terminates its process, if there is one, without waiting.
    pub fn terminate(&mut self) {
        if let Some(process) = &mut self.process {
            process.terminate();
        }
    }

    /// Waits for the node to start, ensures that it runs this package, gives it keys if there are any,
    /// and starts it at this estimate. Returns the frames it broadcasts.
    ///
    /// # Errors
    /// See [`Fault`].
    pub fn begin(
        &mut self,
        package: &PackageBytes,
        estimate: &[f32],
        keys: Option<&NewKeys<'_>>,
    ) -> Result<Vec<Vec<u8>>, Fault> {
        let mut status = if self.persistent { self.greet()? } else { self.hello()? };
        check_firmware(&status, package)?;
        let right = |status: &Status| {
            let checksum = push::checksum(package.as_bytes());
            let agent = package.package().node.agent;
            status.package.is_some_and(|used| (used.agent, used.checksum) == (agent, checksum))
        };
        if self.persistent {
            if !right(&status) {
                self.replace(package.as_bytes())?;
            }
            status = self.reset()?;
        }
        if !right(&status) {
            let refusal = status.refused_at_start.into_iter().flatten().next();
            return Err(Fault::Package { refusal: refusal.map(|refusal| refusal.to_string()) });
        }
        if let Some(keys) = keys {
            self.provision(keys, package.package().node.agent)?;
        }
        self.subscribe()?;
        self.start_at(estimate)
    }

    /// Gives it the keys of this agent.
    fn provision(&mut self, keys: &NewKeys<'_>, agent: AgentId) -> Result<(), Fault> {
        let retry_policy = RetryPolicy { timeout: self.timeout, tries: 1 };
        provision::provision(&mut self.client, keys, agent, retry_policy)
            .map_err(|error| self.push_fault("accept keys", error.into()))
    }

    /// Subscribes to the state and outer weights of every step.
    ///
    /// # Errors
    /// See [`Fault`].
    pub fn subscribe(&mut self) -> Result<(), Fault> {
        let state_every = Some(core::num::NonZeroU32::MIN);
        let subscription = Subscription { state_every, outer_weights: true };
        self.ask(&Request::Subscribe(subscription), "report its states", is_done)?;
        Ok(())
    }

    /// Starts it at this estimate. Returns the frames it broadcasts.
    ///
    /// # Errors
    /// See [`Fault`].
    pub fn start_at(&mut self, estimate: &[f32]) -> Result<Vec<Vec<u8>>, Fault> {
        let estimate = numbers(estimate);
        self.ask(&Request::StartAt { estimate }, "start", is_done)
    }

    /// Hands it frames of its neighbours, with the next [`Self::feed`].
    pub fn hand<'f>(&mut self, frames: impl Iterator<Item = Cow<'f, [u8]>>) {
        for bytes in frames {
            self.client.prepare(&Request::Frame { bytes: &bytes });
        }
    }

    /// Lets `periods` pass and sends the measurement, if the sensor has one, which triggers a step.
    ///
    /// # Errors
    /// See [`Fault`].
    pub fn feed(&mut self, periods: u32, measurement: Option<&[f32]>) -> Result<(), Fault> {
        let measurement = measurement.map(numbers);
        self.client.prepare(&Request::Tick { periods, measurement });
        self.flush()
    }

    /// Receives the results of the step.
    ///
    /// # Errors
    /// See [`Fault`].
    pub fn turn(&mut self) -> Result<Turn, Fault> {
        const EXPECTED: &str = "a state after its step";
        let mut turn = Turn::default();
        let deadline = Instant::now() + self.timeout;
        let mut count = 0;
        loop {
            let bytes = self.message(deadline, "state after its step")?;
            count = counted(count)?;
            match decoded(&bytes)? {
                Message::State(state) => {
                    turn.state = Some(state);
                    return Ok(turn);
                }
                Message::Broadcast { bytes } => turn.frames.push(bytes.to_vec()),
                message @ Message::Hello(_) => {
                    return Err(Fault::Unexpected { found: name(&message), expected: EXPECTED });
                }
                message if message.is_answer() => {
                    return Err(Fault::Unexpected { found: name(&message), expected: EXPECTED });
                }
                _ => turn.unsolicited.push(bytes),
            }
        }
    }

    /// Sends a package and activates it on trial, starting with the next step.
    ///
    /// # Errors
    /// See [`Fault`].
    pub fn push(&mut self, package: &[u8]) -> Result<(), Fault> {
        let retry_policy = RetryPolicy { timeout: self.timeout, tries: 1 };
        let client = &mut self.client;
        // A package is refused while another is on trial; simulated agents have no trials.
        let pushed = push::status(client, retry_policy)
            .and_then(|status| match status.package.and_then(|used| used.trial) {
                Some(_) => push::confirm(client, retry_policy),
                None => Ok(()),
            })
            .map_err(PushError::from)
            .and_then(|()| push::transfer(client, package, retry_policy, &mut |_| {}))
            .and_then(|_| push::activate(client, package, retry_policy))
            .and_then(|_| Ok(push::confirm(client, retry_policy)?));
        pushed.map_err(|error| self.push_fault("accept a package", error))
    }

    fn push_fault(&mut self, request: &'static str, error: PushError) -> Fault {
        match error {
            PushError::Service(ServiceError::Line(error)) => self.line_fault(error, "answer"),
            PushError::Service(ServiceError::Refused(problem)) => {
                Fault::Refused { request, problem }
            }
            PushError::Service(ServiceError::Unexpected { found, expected }) => {
                Fault::Unexpected { found, expected }
            }
            PushError::Service(ServiceError::Unrecognised(bytes)) => Fault::Unrecognised(bytes),
            PushError::Service(ServiceError::Protocol { found }) => Fault::Protocol { found },
            PushError::Service(ServiceError::Garbage { .. }) => {
                self.line_fault(LineError::Silent, "answer")
            }
            PushError::Another(problem) | PushError::Flash(problem) => {
                Fault::Refused { request, problem: Problem::Store(problem) }
            }
            error => Fault::Start(error.to_string()),
        }
    }

    /// Replaces the package in a persistent flash permanently.
    fn replace(&mut self, package: &[u8]) -> Result<(), Fault> {
        self.push(package)
    }

    /// Sends a request that must succeed, and returns the frames broadcast in the meantime.
    fn ask(
        &mut self,
        request: &Request<'_>,
        what: &'static str,
        is_expected: fn(&Message<'_>) -> bool,
    ) -> Result<Vec<Vec<u8>>, Fault> {
        let exchange = self.exchange(request)?;
        for answer in &exchange.answers {
            match decoded(answer)? {
                Message::Refused(problem) => {
                    return Err(Fault::Refused { request: what, problem });
                }
                message if !is_expected(&message) => {
                    return Err(Fault::Unexpected { found: name(&message), expected: "an answer" });
                }
                _ => {}
            }
        }
        Ok(exchange.frames)
    }

    /// Sends a request, sealed if there are keys and the node is provisioned, and returns all messages
    /// up to the end of the answer.
    ///
    /// # Errors
    /// See [`Fault`].
    pub fn exchange(&mut self, request: &Request<'_>) -> Result<Exchange, Fault> {
        let mut exchange = self.exchange_once(request)?;
        let seal_refused = |answer: &Vec<u8>| {
            matches!(decode(answer), Ok(Message::Refused(Problem::Seal | Problem::NotSealed)))
        };
        // Another client's request came between; the session is found again.
        if self.client.keys().is_some() && exchange.answers.iter().any(seal_refused) {
            let before = exchange;
            exchange = self.exchange_once(request)?;
            exchange.frames.splice(0..0, before.frames);
            exchange.unsolicited.splice(0..0, before.unsolicited);
        }
        Ok(exchange)
    }

    fn exchange_once(&mut self, request: &Request<'_>) -> Result<Exchange, Fault> {
        let prepared = self.client.prepare_sealed(request, self.timeout);
        prepared.map_err(|error| self.push_fault("accept a sealed request", error.into()))?;
        self.answer()
    }

    /// Forwards a request unchanged that another client has encoded without its number. Otherwise
    /// like [`Self::exchange`]. A frame or a tick would not be answered: see
    /// [`Self::forward_stimulus`].
    ///
    /// # Errors
    /// See [`Fault`].
    pub fn forward(&mut self, request: &[u8]) -> Result<Exchange, Fault> {
        self.client.prepare_encoded(request);
        self.answer()
    }

    /// Forwards an encoded frame or tick as it is, without waiting.
    ///
    /// # Errors
    /// See [`Fault`].
    pub fn forward_stimulus(&mut self, stimulus: &[u8]) -> Result<(), Fault> {
        self.client.prepare_encoded(stimulus);
        self.flush()
    }

    /// Decrypts a request, without its number, that another client has sealed for this node. `None`
    /// if it is not sealed, or sealed with a different key.
    ///
    /// # Errors
    /// See [`Fault`].
    pub fn open(&mut self, request: &[u8]) -> Result<Option<Vec<u8>>, Fault> {
        let opened = self.client.open(request, self.timeout);
        opened.map_err(|error| self.push_fault("report its session", error.into()))
    }

    /// Returns whether there are keys and the node is provisioned.
    ///
    /// # Errors
    /// See [`Fault`].
    pub fn seals(&mut self) -> Result<bool, Fault> {
        let seals = self.client.seals(self.timeout);
        seals.map_err(|error| self.push_fault("report its session", error.into()))
    }

    /// Sends what is prepared.
    fn flush(&mut self) -> Result<(), Fault> {
        let sent = self.client.flush(self.timeout);
        sent.map_err(|error| self.line_fault(error, "readiness to receive"))
    }

    /// Sends what is prepared, and returns all messages up to the end of the answer.
    fn answer(&mut self) -> Result<Exchange, Fault> {
        self.flush()?;
        let mut exchange = Exchange::default();
        let deadline = Instant::now() + self.timeout;
        let mut count = 0;
        loop {
            let bytes = self.message(deadline, "answer")?;
            count = counted(count)?;
            match decoded(&bytes)? {
                Message::Broadcast { bytes } => exchange.frames.push(bytes.to_vec()),
                message @ Message::Hello(_) => {
                    return Err(Fault::Unexpected { found: name(&message), expected: "an answer" });
                }
                Message::Sample { .. } => exchange.answers.push(bytes),
                message if message.is_answer() => {
                    exchange.answers.push(bytes);
                    return Ok(exchange);
                }
                _ => exchange.unsolicited.push(bytes),
            }
        }
    }

    /// Requests its status.
    ///
    /// # Errors
    /// See [`Fault`].
    pub fn status(&mut self) -> Result<Status, Fault> {
        for answer in &self.exchange(&Request::Query)?.answers {
            if let Message::Status(status) = decoded(answer)? {
                return Ok(status);
            }
        }
        Err(Fault::Unexpected { found: "a different answer".to_owned(), expected: "a status" })
    }

    /// Resets the node, as after power-on.
    ///
    /// # Errors
    /// See [`Fault`].
    pub fn reset(&mut self) -> Result<Status, Fault> {
        self.ask(&Request::Reset, "reset", is_done)?;
        self.restarted()
    }

    /// Waits until the node, which has confirmed a reset, has restarted.
    ///
    /// # Errors
    /// See [`Fault`].
    pub fn restarted(&mut self) -> Result<Status, Fault> {
        self.client.expect_reset();
        self.hello()
    }

    /// Waits for its greeting.
    ///
    /// # Errors
    /// See [`Fault`].
    pub fn hello(&mut self) -> Result<Status, Fault> {
        let deadline = Instant::now() + self.timeout;
        loop {
            // Before the greeting, anything may be received.
            if let Ok(bytes) = self.raw(deadline, "greeting")? {
                match decode(&bytes) {
                    Ok(Message::Hello(status) | Message::Status(status)) => return Ok(status),
                    Err(ServiceError::Protocol { found }) => return Err(Fault::Protocol { found }),
                    _ => {}
                }
            }
        }
    }

    /// Requests the status of a node that may be running already, or still be starting.
    fn greet(&mut self) -> Result<Status, Fault> {
        let second = Duration::from_secs(1);
        let tries = u32::try_from(self.timeout.as_secs()).unwrap_or(u32::MAX).max(1);
        let retry_policy = RetryPolicy { timeout: self.timeout.min(second), tries };
        self.client.prepare_delimiter();
        push::status(&mut self.client, retry_policy)
            .map_err(|error| self.push_fault("report its status", error.into()))
    }

    /// Receives the next message; a damaged one is an error.
    fn message(&mut self, deadline: Instant, expected: &'static str) -> Result<Vec<u8>, Fault> {
        let message = self.raw(deadline, expected)?;
        message.map_err(|error| Fault::Unrecognised(error.to_string()))
    }

    /// Receives the next message, or its framing error, before the deadline.
    fn raw(
        &mut self,
        deadline: Instant,
        expected: &'static str,
    ) -> Result<Result<Vec<u8>, agent_core::wire::cobs::SerialError>, Fault> {
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Err(self.line_fault(LineError::Silent, expected));
            }
            match self.client.next(left.min(SLICE)) {
                Ok(message) => return Ok(message),
                Err(LineError::Silent) => {
                    if let Some(fault) = self.end_of_process(Duration::ZERO) {
                        return Err(fault);
                    }
                }
                Err(error) => return Err(self.line_fault(error, expected)),
            }
        }
    }

    fn line_fault(&mut self, error: LineError, expected: &'static str) -> Fault {
        let process_ended = match error {
            LineError::Closed => self.end_of_process(END),
            LineError::Silent => self.end_of_process(Duration::ZERO),
            LineError::Interrupted | LineError::System(_) => None,
        };
        process_ended.unwrap_or_else(|| match error {
            LineError::Closed => Fault::Closed,
            LineError::Silent => {
                let (_, damaged) = self.client.received();
                Fault::Silent { expected, seconds: self.timeout.as_secs_f64(), damaged }
            }
            LineError::Interrupted => Fault::Interrupted,
            LineError::System(error) => Fault::System(error),
        })
    }

    fn end_of_process(&mut self, time: Duration) -> Option<Fault> {
        let process = self.process.as_mut()?;
        let status = process.ends_within(time)?;
        Some(Fault::Ended { status: status.to_string(), output: process.output() })
    }
}

/// Returns whether the message is [`Message::Done`].
fn is_done(message: &Message<'_>) -> bool {
    matches!(message, Message::Done)
}

fn decoded(bytes: &[u8]) -> Result<Message<'_>, Fault> {
    decode(bytes).map_err(|error| match error {
        ServiceError::Unrecognised(bytes) => Fault::Unrecognised(bytes),
        ServiceError::Protocol { found } => Fault::Protocol { found },
        other => Fault::Unrecognised(other.to_string()),
    })
}

/// Maximum number of messages from a node between two messages of the simulator.
const MESSAGES_MAX: usize = 1024;

/// Counts a message, up to the maximum.
fn counted(count: usize) -> Result<usize, Fault> {
    if count < MESSAGES_MAX { Ok(count + 1) } else { Err(Fault::Flood { messages: count }) }
}

fn check_firmware(status: &Status, package: &PackageBytes) -> Result<(), Fault> {
    if status.protocol != PROTOCOL_VERSION {
        return Err(Fault::Protocol { found: status.protocol });
    }
    let (firmware, content) = (status.firmware, package.package());
    let fits = [
        ("state components", content.dimension(), firmware.dimension),
        ("features", package.architecture().features(), firmware.features),
        ("neighbours", content.node.edge_weights.len(), firmware.neighbours),
    ];
    for (what, needed, room) in fits {
        let room = usize::from(room);
        if needed > room || (what == "state components" && needed != room) {
            return Err(Fault::Capacity { what, needed, room });
        }
    }
    if firmware.signed_only && !package.is_signed() {
        return Err(Fault::SignedOnly);
    }
    Ok(())
}

/// Converts components to the form used in messages.
fn numbers(values: &[f32]) -> Numbers {
    // The capacity suffices for every state.
    Numbers::from_slice(values).unwrap_or_default()
}
