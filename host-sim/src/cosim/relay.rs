//! Nodes of a running co-simulation, offered to others: a socket for each, at which anybody can talk
//! to the node as if it were on a desk.
//!
//! Between two steps the relay hands the requests of its clients to the node, one at a time, and
//! its answers back. Two things it keeps to itself: the node goes on to tell everything to the
//! co-simulation, whatever its clients subscribe to, and time and frames come from the simulator only.
//!
//! A package that a client has activated is switched in for the simulated agent, too, before the next
//! step: the comparison goes on. A node that a client resets, or lets begin elsewhere, is not
//! compared any more, nor is one that hears frames of such a node which its simulated neighbour
//! did not send.

use std::io::{ErrorKind, Read, Write};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use agent_core::Tick;
use agent_core::capture::is_due;
use agent_core::serial::{Decoder, Encoder};
use agent_core::service::{
    Problem, REQUEST_LENGTH_MAX, Request, Response, State, Subscription, receive, send,
};
use serde::Serialize;

use super::board::Turn;
use super::fault::Fault;
use super::lockstep::LoopNode;
use super::{CosimError, Service};
use crate::engine::companion::Switch;
use crate::interruption;
use crate::packages::PackageBytes;
use crate::scenario::Scenario;
use crate::service::Message;

/// Bytes that wait for a client; of more, the newest messages are lost, as on a slow line.
const UNSENT_MAX: usize = 1 << 16;

/// How far the run may fall behind real time before it stops trying to catch up.
const LAG_MAX: Duration = Duration::from_secs(1);

/// Longest rest between two looks at the clients.
const REST: Duration = Duration::from_millis(5);

type RequestDecoder = Decoder<{ REQUEST_LENGTH_MAX + agent_core::checksum::CHECKSUM_LENGTH }>;

/// The sockets and the pace.
pub(super) struct Relay {
    doors: Vec<Door>,
    /// One step in real time.
    step: Duration,
    next_step: Option<Instant>,
    stop: Arc<AtomicBool>,
}

/// One node's socket, and what is known of its packages.
struct Door {
    path: PathBuf,
    listener: UnixListener,
    clients: Vec<Client>,
    uploaded: Vec<u8>,
    in_use: Option<PackageBytes>,
    before: Option<PackageBytes>,
}

/// Somebody at a socket.
struct Client {
    socket: UnixStream,
    decoder: RequestDecoder,
    unsent: Vec<u8>,
    subscription: Subscription,
    gone: bool,
}

/// What a request has done to a node, beyond its answer.
enum Effect {
    None,
    Switched { back: bool },
    Parted(&'static str),
}

impl Relay {
    /// Opens the sockets.
    pub(super) fn new(service: &Service, scenario: &Scenario) -> Result<Self, CosimError> {
        let named = |path: &PathBuf, error| CosimError::Serve { path: path.clone(), error };
        std::fs::create_dir_all(&service.folder).map_err(|e| named(&service.folder, e))?;
        let mut doors = Vec::new();
        for agent in 1..=scenario.agents.len() {
            let path = service.folder.join(format!("agent-{agent}.sock"));
            // What a run that was killed has left behind; one that goes on still listens.
            if UnixStream::connect(&path).is_err_and(|e| e.kind() == ErrorKind::ConnectionRefused) {
                std::fs::remove_file(&path).map_err(|e| named(&path, e))?;
            }
            let listener = UnixListener::bind(&path).map_err(|e| named(&path, e))?;
            let door = Door {
                path,
                listener,
                clients: Vec::new(),
                uploaded: Vec::new(),
                in_use: None,
                before: None,
            };
            door.listener.set_nonblocking(true).map_err(|e| named(&door.path, e))?;
            doors.push(door);
        }
        let step = Duration::from_secs_f64(scenario.time.step_size / service.speed);
        Ok(Self { doors, step, next_step: None, stop: service.stop.clone() })
    }

    /// Whether somebody wants the run to end.
    pub(super) fn is_over(&self) -> bool {
        interruption::requested() || self.stop.load(Ordering::Relaxed)
    }

    /// The nodes have begun with these packages.
    pub(super) fn begin(&mut self, packages: Vec<PackageBytes>) {
        for (door, package) in self.doors.iter_mut().zip(packages) {
            door.in_use = Some(package);
        }
    }

    /// A learning cycle has switched packages in.
    pub(super) fn learned(&mut self, switches: &[Switch]) {
        for switch in switches {
            self.doors[switch.agent].switched(Some(switch.package.clone()));
        }
    }

    /// Waits until it is time for the step at `tick`, and serves clients meanwhile. An error comes
    /// with the agent, from 0, whose node it is about.
    pub(super) fn between_steps(
        &mut self,
        tick: Tick,
        nodes: &mut [LoopNode],
        switches: &mut Vec<Switch>,
    ) -> Result<(), (usize, Fault)> {
        let due = *self.next_step.get_or_insert_with(Instant::now);
        loop {
            for (index, (door, node)) in self.doors.iter_mut().zip(&mut *nodes).enumerate() {
                let serve = door.serve(tick, node).map_err(|fault| (index, fault))?;
                let serve = serve.into_iter();
                switches.extend(serve.map(|(package, back)| Switch {
                    agent: index,
                    package,
                    back,
                }));
            }
            let left = due.saturating_duration_since(Instant::now());
            if left.is_zero() || self.is_over() {
                break;
            }
            std::thread::sleep(left.min(REST));
        }
        let behind = Instant::now().saturating_duration_since(due);
        self.next_step = Some(if behind > LAG_MAX { Instant::now() } else { due } + self.step);
        Ok(())
    }

    /// Tells the clients of a node what it did in its turn.
    pub(super) fn pass_on(&mut self, index: usize, turn: &Turn) {
        let door = &mut self.doors[index];
        for client in &mut door.clients {
            for bytes in &turn.unasked {
                client.forward(bytes);
            }
            if let Some(state) = &turn.state {
                client.tell(state);
            }
            client.write_out();
        }
    }
}

impl Drop for Relay {
    fn drop(&mut self) {
        for door in &self.doors {
            // Best effort: the run is over.
            let _ = std::fs::remove_file(&door.path);
        }
    }
}

impl Door {
    /// Serves everybody at this socket once. Returns the packages that the agent is to use one after
    /// the other, and whether it goes back to them.
    fn serve(
        &mut self,
        tick: Tick,
        node: &mut LoopNode,
    ) -> Result<Vec<(PackageBytes, bool)>, Fault> {
        while let Ok((socket, _)) = self.listener.accept() {
            if socket.set_nonblocking(true).is_ok() {
                self.clients.push(Client::new(socket));
            }
        }
        let mut switches = Vec::new();
        for index in 0..self.clients.len() {
            for request in self.clients[index].requests() {
                let effect = self.carry_out(index, &request, node)?;
                match effect {
                    Effect::None => {}
                    Effect::Parted(reason) => node.part(tick, reason),
                    Effect::Switched { back } => match &self.in_use {
                        Some(package) if self.is_of_agent(package) => {
                            node.report.switches += 1;
                            if node.report.parted.is_none() {
                                switches.push((package.clone(), back));
                            }
                        }
                        Some(_) => node.part(tick, "its package has other parameters"),
                        None => node.part(tick, "it uses a package that nobody here knows"),
                    },
                }
            }
            self.clients[index].write_out();
        }
        self.clients.retain(|client| !client.gone);
        Ok(switches)
    }

    /// Whether a package is for the agent with the parameters that it has been simulated with.
    fn is_of_agent(&self, package: &PackageBytes) -> bool {
        self.before.as_ref().is_none_or(|before| before.package().node == package.package().node)
    }

    fn switched(&mut self, package: Option<PackageBytes>) {
        self.before = std::mem::replace(&mut self.in_use, package);
    }

    /// Hands one request of a client to the node, and the answer back.
    fn carry_out(
        &mut self,
        client: usize,
        bytes: &[u8],
        node: &mut LoopNode,
    ) -> Result<Effect, Fault> {
        let asking = &mut self.clients[client];
        let request = match receive::<Request<'_>>(bytes) {
            None => {
                asking.say(&Reply::Refused(Problem::Unknown));
                return Ok(Effect::None);
            }
            Some(Request::Subscribe(subscription)) => {
                asking.subscription = subscription;
                asking.say(&Reply::Done);
                return Ok(Effect::None);
            }
            Some(Request::Frame { .. } | Request::Tick { .. }) => {
                asking.say(&Reply::Refused(Problem::NotInTheLoop));
                return Ok(Effect::None);
            }
            Some(Request::Reset) => {
                let status = node.board.reset()?;
                node.board.subscribe()?;
                asking.say(&Reply::Done);
                for client in &mut self.clients {
                    client.say(&Reply::Hello(status));
                }
                (self.in_use, self.before) = (None, None);
                return Ok(Effect::Parted("it has been reset"));
            }
            Some(request) => request,
        };
        let exchange = node.board.exchange(&request)?;
        for answer in &exchange.answers {
            asking.forward(answer);
        }
        for client in &mut self.clients {
            exchange.unasked.iter().for_each(|bytes| client.forward(bytes));
        }
        node.broadcast_alone(exchange.frames);
        let answer = exchange.answers.last().and_then(|answer| receive::<Message<'_>>(answer));
        Ok(self.effect(&request, answer.as_ref()))
    }

    /// What a request that got this answer has done.
    fn effect(&mut self, request: &Request<'_>, answer: Option<&Message<'_>>) -> Effect {
        match (request, answer) {
            (Request::Begin { length }, Some(Message::Upload(_))) => {
                // The node has accepted this length, so it is that of a slot at most.
                self.uploaded = vec![0; *length as usize];
            }
            (Request::Chunk { offset, bytes }, Some(Message::Upload(_))) => {
                let place = *offset as usize..(*offset as usize).saturating_add(bytes.len());
                if let Some(place) = self.uploaded.get_mut(place) {
                    place.copy_from_slice(bytes);
                }
            }
            (Request::Activate, Some(Message::InUse { .. })) => {
                let package = PackageBytes::new(&self.uploaded).ok();
                self.switched(package);
                return Effect::Switched { back: false };
            }
            (Request::Revert, Some(Message::InUse { .. })) => {
                let package = self.before.clone();
                self.switched(package);
                return Effect::Switched { back: true };
            }
            (Request::StartAt { .. }, Some(Message::Done)) => {
                return Effect::Parted("it has been told to begin elsewhere");
            }
            _ => {}
        }
        Effect::None
    }
}

/// What the relay itself says.
type Reply<'a> = Response<'a, Vec<f32>>;

impl Client {
    fn new(socket: UnixStream) -> Self {
        Self {
            socket,
            decoder: RequestDecoder::new(),
            unsent: Vec::new(),
            subscription: Subscription::default(),
            gone: false,
        }
    }

    /// The requests that have arrived. Damaged ones are left out, as they are on a node.
    fn requests(&mut self) -> Vec<Vec<u8>> {
        let mut requests = Vec::new();
        let mut buffer = [0; 1024];
        match self.socket.read(&mut buffer) {
            Ok(0) => self.gone = true,
            Ok(length) => {
                for &byte in &buffer[..length] {
                    if let Some(Ok(request)) = self.decoder.push(byte) {
                        requests.push(request.to_vec());
                    }
                }
            }
            Err(error) if error.kind() == ErrorKind::WouldBlock => {}
            Err(_) => self.gone = true,
        }
        requests
    }

    fn say(&mut self, message: &impl Serialize) {
        let mut framed = Vec::new();
        send(message, |bytes| framed.extend_from_slice(bytes));
        self.queue(&framed);
    }

    /// Sends on what a node said.
    fn forward(&mut self, message: &[u8]) {
        let mut framed = Vec::new();
        let mut encoder = Encoder::new(|bytes: &[u8]| framed.extend_from_slice(bytes));
        encoder.extend(message);
        encoder.finish();
        self.queue(&framed);
    }

    /// Tells a state as far as it has been subscribed to.
    fn tell(&mut self, state: &State<Vec<f32>>) {
        let every = self.subscription.state_every;
        if every.is_some_and(|every| is_due(state.tick, every)) {
            let mut state = state.clone();
            if !self.subscription.outer_weights {
                state.outer_weights.clear();
            }
            self.say(&Reply::State(state));
        }
    }

    fn queue(&mut self, framed: &[u8]) {
        if self.unsent.len() + framed.len() <= UNSENT_MAX {
            self.unsent.extend_from_slice(framed);
        }
    }

    fn write_out(&mut self) {
        match self.socket.write(&self.unsent) {
            Ok(length) => drop(self.unsent.drain(..length)),
            Err(error) if error.kind() == ErrorKind::WouldBlock => {}
            Err(_) => self.gone = true,
        }
    }
}
