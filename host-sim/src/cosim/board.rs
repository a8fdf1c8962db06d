//! A node in the loop: the messages that co-simulation exchanges with it, and what it runs on.

use std::time::{Duration, Instant};

use agent_core::service::{Numbers, PROTOCOL_VERSION, Problem, Request, Status, Subscription};
use tempfile::TempDir;

use super::fault::Fault;
use super::process::Process;
use crate::packages::PackageBytes;
use crate::service::client::{decode, name};
use crate::service::push::{self, PushError};
use crate::service::{Client, Line, LineError, Message, RetryPolicy, ServiceError};

/// How long a node has for everything that is not said otherwise.
pub const TIMEOUT: Duration = Duration::from_secs(10);

/// Between two looks at whether the node's process still runs.
const SLICE: Duration = Duration::from_millis(100);

/// How long a process that has closed its line may take to end.
const END: Duration = Duration::from_secs(1);

/// A node and the line to it.
#[derive(Debug)]
pub struct Board {
    client: Client,
    /// Name, for messages.
    label: String,
    /// Where it is an emulator: its process.
    process: Option<Process>,
    /// Whether it has a flash of its own, with whatever package in it, and a life before this.
    lives_on: bool,
    timeout: Duration,
    /// Removed at the end, after the process.
    _folder: Option<TempDir>,
}

/// What a node did in a turn.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Turn {
    /// What it told of it.
    pub state: Option<agent_core::service::State<Vec<f32>>>,
    /// The frames that it broadcast.
    pub frames: Vec<Vec<u8>>,
    /// What else it said, as it was framed.
    pub unasked: Vec<Vec<u8>>,
}

/// What a node said to a request.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Exchange {
    /// The answer as it was framed, in its parts.
    pub answers: Vec<Vec<u8>>,
    /// The frames that it broadcast meanwhile.
    pub frames: Vec<Vec<u8>>,
    /// What else it said, as it was framed.
    pub unasked: Vec<Vec<u8>>,
}

impl Board {
    /// The node at the end of a line, called `label`. If it `lives_on`, it has a package of its
    /// own, which is replaced if it is another.
    #[must_use]
    pub fn new(line: Line, label: &str, lives_on: bool) -> Self {
        Self {
            client: Client::new(line),
            label: label.to_owned(),
            process: None,
            lives_on,
            timeout: TIMEOUT,
            _folder: None,
        }
    }

    /// The same with a process that runs it and a folder with what the process needs.
    #[must_use]
    pub fn with_process(mut self, process: Process, folder: TempDir) -> Self {
        (self.process, self._folder) = (Some(process), Some(folder));
        self
    }

    /// What it runs on.
    #[must_use]
    pub fn label(&self) -> &str {
        &self.label
    }

    /// Lets what is under way go on for so long after a signal has asked for the end.
    pub fn set_grace(&mut self, grace: Duration) {
        self.client.set_grace(grace);
    }

    /// Gives it this long for an answer.
    pub fn set_timeout(&mut self, timeout: Duration) {
        self.timeout = timeout;
    }

    /// Ends its process at once, if it has one.
    pub fn kill(&mut self) {
        if let Some(process) = &mut self.process {
            process.kill();
        }
    }

    /// Lets it go on with what its flash holds, and tell everything of every step. Returns how it is.
    ///
    /// # Errors
    /// See [`Fault`].
    pub fn rejoin(&mut self) -> Result<Status, Fault> {
        let status = if self.lives_on { self.greet()? } else { self.hello()? };
        if status.protocol != PROTOCOL_VERSION {
            return Err(Fault::Protocol { found: status.protocol });
        }
        self.subscribe()?;
        Ok(status)
    }

    /// Tells its process to end, without waiting, if it has one.
    pub fn terminate(&mut self) {
        if let Some(process) = &mut self.process {
            process.terminate();
        }
    }

    /// Waits for it to have begun, sees that it is this agent with this package, and lets it begin at
    /// this estimate. Returns the frames that it broadcasts meanwhile.
    ///
    /// # Errors
    /// See [`Fault`].
    pub fn begin(
        &mut self,
        package: &PackageBytes,
        estimate: &[f32],
    ) -> Result<Vec<Vec<u8>>, Fault> {
        let mut status = if self.lives_on { self.greet()? } else { self.hello()? };
        check_firmware(&status, package)?;
        let right = |status: &Status| {
            let checksum = push::checksum(package.as_bytes());
            let agent = package.package().node.agent;
            status.package.is_some_and(|used| (used.agent, used.checksum) == (agent, checksum))
        };
        if self.lives_on {
            if !right(&status) {
                self.replace(package.as_bytes())?;
            }
            status = self.reset()?;
        }
        if !right(&status) {
            let refusal = status.refused_at_start.into_iter().flatten().next();
            return Err(Fault::Package { refusal: refusal.map(|refusal| refusal.to_string()) });
        }
        self.subscribe()?;
        self.start_at(estimate)
    }

    /// Lets it tell everything of every step.
    ///
    /// # Errors
    /// See [`Fault`].
    pub fn subscribe(&mut self) -> Result<(), Fault> {
        let state_every = Some(core::num::NonZeroU32::MIN);
        let subscription = Subscription { state_every, outer_weights: true };
        self.ask(&Request::Subscribe(subscription), "tell its states", is_done)?;
        Ok(())
    }

    /// Lets it begin at this estimate. Returns the frames that it broadcasts.
    ///
    /// # Errors
    /// See [`Fault`].
    pub fn start_at(&mut self, estimate: &[f32]) -> Result<Vec<Vec<u8>>, Fault> {
        let estimate = numbers(estimate);
        self.ask(&Request::StartAt { estimate }, "start", is_done)
    }

    /// Hands it the frames of its neighbours and its measurement: time for a step.
    ///
    /// # Errors
    /// See [`Fault`].
    pub fn feed<'f>(
        &mut self,
        frames: impl Iterator<Item = &'f [u8]>,
        measurement: &[f32],
    ) -> Result<(), Fault> {
        for bytes in frames {
            self.client.prepare(&Request::Frame { bytes });
        }
        let measurement = Some(numbers(measurement));
        self.client.prepare(&Request::Tick { periods: 1, measurement });
        let sent = self.client.flush(self.timeout);
        sent.map_err(|error| self.line_fault(error, "readiness to receive"))
    }

    /// What it does then.
    ///
    /// # Errors
    /// See [`Fault`].
    pub fn turn(&mut self) -> Result<Turn, Fault> {
        const EXPECTED: &str = "a state after its step";
        let mut turn = Turn::default();
        let deadline = Instant::now() + self.timeout;
        let mut said = 0;
        loop {
            let bytes = self.message(deadline, "state after its step")?;
            said = counted(said)?;
            match heard(&bytes)? {
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
                _ => turn.unasked.push(bytes),
            }
        }
    }

    /// Hands over a package between two steps: it is in use from the next one on, on trial.
    ///
    /// # Errors
    /// See [`Fault`].
    pub fn push(&mut self, package: &[u8]) -> Result<(), Fault> {
        let retry_policy = RetryPolicy { timeout: self.timeout, tries: 1 };
        let client = &mut self.client;
        // The next package would be refused while one is on trial; the simulated agent has none.
        let pushed = push::status(client, retry_policy)
            .and_then(|status| match status.package.and_then(|used| used.trial) {
                Some(_) => push::confirm(client, retry_policy),
                None => Ok(()),
            })
            .map_err(PushError::from)
            .and_then(|()| push::transfer(client, package, retry_policy, &mut |_| {}))
            .and_then(|_| push::activate(client, package, retry_policy));
        pushed.map(|_| ()).map_err(|error| self.push_fault("take a package", error))
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
            PushError::Service(ServiceError::Unrecognised(bytes)) => Fault::Nonsense(bytes),
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

    /// Puts another package into a flash that lives on, for good.
    fn replace(&mut self, package: &[u8]) -> Result<(), Fault> {
        self.push(package)?;
        self.ask(&Request::Confirm, "confirm its package", is_done)?;
        Ok(())
    }

    /// Asks for what it has to do, and returns the frames that it broadcasts meanwhile.
    fn ask(
        &mut self,
        request: &Request<'_>,
        what: &'static str,
        is_expected: fn(&Message<'_>) -> bool,
    ) -> Result<Vec<Vec<u8>>, Fault> {
        let exchange = self.exchange(request)?;
        for answer in &exchange.answers {
            match heard(answer)? {
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

    /// Asks, and returns all that it says up to the end of the answer.
    ///
    /// # Errors
    /// See [`Fault`].
    pub fn exchange(&mut self, request: &Request<'_>) -> Result<Exchange, Fault> {
        self.client.prepare(request);
        let sent = self.client.flush(self.timeout);
        sent.map_err(|error| self.line_fault(error, "readiness to receive"))?;
        let mut exchange = Exchange::default();
        let deadline = Instant::now() + self.timeout;
        let mut said = 0;
        loop {
            let bytes = self.message(deadline, "answer")?;
            said = counted(said)?;
            match heard(&bytes)? {
                Message::Broadcast { bytes } => exchange.frames.push(bytes.to_vec()),
                message @ Message::Hello(_) => {
                    return Err(Fault::Unexpected { found: name(&message), expected: "an answer" });
                }
                Message::Sample { .. } => exchange.answers.push(bytes),
                message if message.is_answer() => {
                    exchange.answers.push(bytes);
                    return Ok(exchange);
                }
                _ => exchange.unasked.push(bytes),
            }
        }
    }

    /// Asks how it is.
    ///
    /// # Errors
    /// See [`Fault`].
    pub fn status(&mut self) -> Result<Status, Fault> {
        for answer in &self.exchange(&Request::Query)?.answers {
            if let Message::Status(status) = heard(answer)? {
                return Ok(status);
            }
        }
        Err(Fault::Unexpected { found: "another answer".to_owned(), expected: "a status" })
    }

    /// Resets it, as a power cycle does.
    ///
    /// # Errors
    /// See [`Fault`].
    pub fn reset(&mut self) -> Result<Status, Fault> {
        self.ask(&Request::Reset, "reset", is_done)?;
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
            // Until it has begun, what comes may be anything.
            if let Ok(bytes) = self.raw(deadline, "greeting")? {
                match decode(&bytes) {
                    Ok(Message::Hello(status) | Message::Status(status)) => return Ok(status),
                    Err(ServiceError::Protocol { found }) => return Err(Fault::Protocol { found }),
                    _ => {}
                }
            }
        }
    }

    /// The status of a node that may have begun long ago, or be about to.
    fn greet(&mut self) -> Result<Status, Fault> {
        let second = Duration::from_secs(1);
        let tries = u32::try_from(self.timeout.as_secs()).unwrap_or(u32::MAX).max(1);
        let retry_policy = RetryPolicy { timeout: self.timeout.min(second), tries };
        self.client.prepare_delimiter();
        push::status(&mut self.client, retry_policy)
            .map_err(|error| self.push_fault("tell its status", error.into()))
    }

    /// The next message that arrived as it was sent.
    fn message(&mut self, deadline: Instant, expected: &'static str) -> Result<Vec<u8>, Fault> {
        let message = self.raw(deadline, expected)?;
        message.map_err(|error| Fault::Nonsense(error.to_string()))
    }

    /// The next message, or what is wrong with it; whatever else comes, not after the deadline.
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
        Some(Fault::Ended { status: status.to_string(), said: process.said() })
    }
}

/// Whether the answer is that it has been done.
fn is_done(message: &Message<'_>) -> bool {
    matches!(message, Message::Done)
}

fn heard(bytes: &[u8]) -> Result<Message<'_>, Fault> {
    decode(bytes).map_err(|error| match error {
        ServiceError::Unrecognised(bytes) => Fault::Nonsense(bytes),
        ServiceError::Protocol { found } => Fault::Protocol { found },
        other => Fault::Nonsense(other.to_string()),
    })
}

/// Most messages that a node has to say between two of the simulator's. \[1\]
const MESSAGES_MAX: usize = 1024;

/// One more message of so many.
fn counted(said: usize) -> Result<usize, Fault> {
    if said < MESSAGES_MAX { Ok(said + 1) } else { Err(Fault::Flood { messages: said }) }
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

/// Components as a message carries them.
fn numbers(values: &[f32]) -> Numbers {
    // A state has as many components as there is room for, or fewer.
    Numbers::from_slice(values).unwrap_or_default()
}
