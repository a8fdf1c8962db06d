//! Nodes of a running co-simulation, offered to others: a socket for each, at which anybody can talk
//! to the node as if it were on a desk.
//!
//! Between two steps the relay hands requests of clients to the nodes, and their answers back: one
//! request a node, of its clients in turn, and more only while there is time left until the next
//! step. So a client that asks without end does not slow the others down, and one that does not read loses what
//! it does not read, and then its connection. Two things the relay keeps to itself: the node goes on to tell
//! everything to the co-simulation, whatever its clients subscribe to, and time and frames come from
//! the simulator only.
//!
//! A node that dies or hangs takes no more steps; the others go on, with the simulated agent in its
//! place. A request to reset it starts it again.
//!
//! Cost: for each client, 1 KiB of requests and 64 KiB of what waits for it, at most.
//!
//! A package that a client has activated is switched in for the simulated agent, too, before the next
//! step: the comparison goes on. A node that a client resets, or lets begin elsewhere, is not
//! compared any more, nor is one that hears frames of such a node which its simulated neighbour
//! did not send.

use std::collections::VecDeque;
use std::io::{ErrorKind, Read, Write};
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use agent_core::Tick;
use agent_core::agent::capture::is_due;
use agent_core::service::{
    Problem, REQUEST_LENGTH_MAX, Request, Response, State, Status, Subscription, receive, send,
};
use agent_core::wire::cobs::{Decoder, Encoder};
use serde::Serialize;

use super::board::Turn;
use super::fault::Fault;
use super::lockstep::LoopNode;
use super::socket::Socket;
use super::{CosimError, Service};
use crate::engine::run_observer::Switch;
use crate::packages::PackageBytes;
use crate::scenario::Scenario;
use crate::service::Message;
use crate::service::nodes_file::{self, NodesFile};
use crate::stop::Stop;

/// Bytes that wait for a client; of more, the newest messages are lost, as on a slow line.
const UNSENT_MAX: usize = 1 << 16;

/// How far the run may fall behind real time before it stops trying to catch up.
const LAG_MAX: Duration = Duration::from_secs(1);

/// Longest rest between two looks at the clients.
const REST: Duration = Duration::from_millis(5);

/// Most clients of a node at a time; others are sent away.
const CLIENTS_MAX: usize = 16;

/// How long a client may leave what waits for it unread while more is lost.
const UNREAD_MAX: Duration = Duration::from_secs(5);

/// Between two notices that the run is late.
const LATE_NOTICE: Duration = Duration::from_secs(10);

type RequestDecoder = Decoder<{ REQUEST_LENGTH_MAX + agent_core::wire::crc::CHECKSUM_LENGTH }>;

/// The sockets and the pace.
pub(super) struct Relay {
    sockets: Vec<NodeSocket>,
    /// The file that says what they are part of.
    told: PathBuf,
    /// One step in real time.
    step: Duration,
    pace: Pace,
    stop: Arc<AtomicBool>,
}

/// How well real time is kept.
#[derive(Default)]
struct Pace {
    next_step: Option<Instant>,
    begun: Option<Instant>,
    steps: u64,
    /// Time that the run has given up to catch up with.
    lost: Duration,
    noticed: Option<Instant>,
}

/// What happened between two steps.
#[derive(Default)]
pub(super) struct Between {
    /// Nodes, from 0, that cannot go on.
    pub(super) faults: Vec<(usize, Fault)>,
    /// Nodes that are to be started again.
    pub(super) restarts: Vec<Restart>,
    /// How much of the speed is kept, if that is to be told.
    pub(super) late: Option<f64>,
}

/// A client wants a node to be started again.
pub(super) struct Restart {
    /// The node, from 0.
    pub(super) node: usize,
    client: usize,
}

/// One node's socket, and what is known of its packages.
struct NodeSocket {
    socket: Socket,
    clients: Vec<Client>,
    /// Whose turn it is.
    next: usize,
    uploaded: Vec<u8>,
    in_use: Option<PackageBytes>,
    before: Option<PackageBytes>,
}

/// What one pass over the clients of a node has done.
#[derive(Default)]
struct Served {
    /// Whether there was a request.
    request: bool,
    /// The package that the agent is to use, and whether it goes back to it.
    switch: Option<(PackageBytes, bool)>,
}

/// Somebody at a socket.
struct Client {
    socket: UnixStream,
    decoder: RequestDecoder,
    /// Requests that have arrived and wait for their turn.
    requests: VecDeque<Vec<u8>>,
    unsent: Vec<u8>,
    /// Since when messages are lost because it does not read.
    losing_since: Option<Instant>,
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
    pub(super) fn new(
        service: &Service,
        scenario: &Scenario,
        seed: u64,
    ) -> Result<Self, CosimError> {
        let folder = &service.folder;
        std::fs::create_dir_all(folder)
            .map_err(|error| CosimError::Serve { path: folder.clone(), error })?;
        let path = |agent| folder.join(format!("agent-{agent}.sock"));
        let agents = 1..=scenario.agents.len();
        // Nothing is touched before all places are known to be free.
        agents.clone().try_for_each(|agent| Socket::check(&path(agent)).map(|_| ()))?;
        if NodesFile::is_occupied(folder) {
            let what = "there is something here that is not about nodes";
            return Err(CosimError::Occupied { path: folder.join(nodes_file::NAME), what });
        }
        let sockets = agents.map(|agent| {
            Ok(NodeSocket {
                socket: Socket::bind(path(agent))?,
                clients: Vec::new(),
                next: 0,
                uploaded: Vec::new(),
                in_use: None,
                before: None,
            })
        });
        let sockets = sockets.collect::<Result<_, CosimError>>()?;
        let told = NodesFile::new(&scenario.name, scenario.hash, seed).write(folder)?;
        let step = Duration::from_secs_f64(scenario.time.step_size / service.speed);
        Ok(Self { sockets, told, step, pace: Pace::default(), stop: service.stop.clone() })
    }

    /// Whether somebody wants the run to end.
    pub(super) fn is_over(&self, stop: &Stop) -> bool {
        stop.is_requested() || self.stop.load(Ordering::Relaxed)
    }

    /// The nodes have begun with these packages.
    pub(super) fn begin<'p>(&mut self, packages: impl Iterator<Item = &'p PackageBytes>) {
        for (door, package) in self.sockets.iter_mut().zip(packages) {
            door.in_use = Some(package.clone());
        }
    }

    /// A node takes no more steps: its clients hear no more of it.
    pub(super) fn end_node(&mut self, index: usize) {
        self.sockets[index].clients.clear();
    }

    /// A node has been started again: the one who wanted it gets an answer, and all a greeting.
    pub(super) fn started_again(&mut self, restart: &Restart, status: Status) {
        let door = &mut self.sockets[restart.node];
        (door.in_use, door.before) = (None, None);
        if let Some(client) = door.clients.get_mut(restart.client) {
            client.say(&Reply::Done);
        }
        for client in &mut door.clients {
            client.say(&Reply::Hello(status));
            client.write_out();
        }
    }

    /// How much of the speed that was asked for has been kept, at most 1.
    pub(super) fn real_time_kept(&self) -> f64 {
        self.pace.kept(self.step)
    }

    /// A learning cycle has switched packages in.
    pub(super) fn learned(&mut self, switches: &[Switch]) {
        for switch in switches {
            self.sockets[switch.agent].switched(Some(switch.package.clone()));
        }
    }

    /// Waits until it is time for the step at `tick`, and serves clients meanwhile.
    pub(super) fn between_steps(
        &mut self,
        tick: Tick,
        nodes: &mut [LoopNode],
        switches: &mut Vec<Switch>,
        stop: &Stop,
    ) -> Between {
        let mut between = Between::default();
        let due = *self.pace.next_step.get_or_insert_with(Instant::now);
        loop {
            let mut busy = false;
            for (index, (door, node)) in self.sockets.iter_mut().zip(&mut *nodes).enumerate() {
                if between.faults.iter().any(|(ended, _)| *ended == index) {
                    continue;
                }
                if node.has_ended() {
                    if between.restarts.is_empty()
                        && let Some(client) = door.wants_restart()
                    {
                        between.restarts.push(Restart { node: index, client });
                    }
                    continue;
                }
                match door.serve(tick, node) {
                    Ok(served) => {
                        busy |= served.request;
                        switches.extend(served.switch.map(|(package, back)| Switch {
                            agent: index,
                            package,
                            back,
                        }));
                    }
                    Err(fault) => between.faults.push((index, fault)),
                }
            }
            let left = due.saturating_duration_since(Instant::now());
            if left.is_zero() || self.is_over(stop) || !between.restarts.is_empty() {
                break;
            }
            // Where there is time left, the next request is not kept waiting.
            if !busy {
                std::thread::sleep(left.min(REST));
            }
        }
        between.late = self.pace.advance(due, self.step, Instant::now());
        between
    }

    /// Tells the clients of a node what it did in its turn.
    pub(super) fn pass_on(&mut self, index: usize, turn: &Turn) {
        let door = &mut self.sockets[index];
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
        // Best effort: the run is over.
        let _ = std::fs::remove_file(&self.told);
    }
}

impl Pace {
    /// A step that was due at `due` begins `now`. Returns how much of the speed is kept, if it is time
    /// to tell.
    fn advance(&mut self, due: Instant, step: Duration, now: Instant) -> Option<f64> {
        self.begun.get_or_insert(now);
        self.steps += 1;
        let behind = now.saturating_duration_since(due);
        let gives_up = behind > LAG_MAX;
        self.next_step = Some(if gives_up { now } else { due } + step);
        if !gives_up {
            return None;
        }
        self.lost += behind;
        let quiet = self.noticed.is_some_and(|last| now - last < LATE_NOTICE);
        (!quiet).then(|| {
            self.noticed = Some(now);
            self.kept(step)
        })
    }

    /// The share of the speed that has been kept, at most 1: real time that was given up counts.
    fn kept(&self, step: Duration) -> f64 {
        let wanted = step.as_secs_f64() * self.steps as f64;
        if self.lost.is_zero() { 1.0 } else { wanted / (wanted + self.lost.as_secs_f64()) }
    }
}

impl NodeSocket {
    /// Lets those in who wait at the socket.
    fn let_in(&mut self) {
        while let Some(socket) = self.socket.accept() {
            if self.clients.len() < CLIENTS_MAX && socket.set_nonblocking(true).is_ok() {
                self.clients.push(Client::new(socket));
            }
        }
    }

    /// Hands one request of the next client that has one to the node, and writes out what waits for
    /// any of them.
    fn serve(&mut self, tick: Tick, node: &mut LoopNode) -> Result<Served, Fault> {
        self.let_in();
        let clients = self.clients.len();
        let mut served = Served::default();
        for index in (0..clients).map(|offset| (self.next + offset) % clients) {
            let Some(request) = self.clients[index].request() else { continue };
            self.next = index + 1;
            served.request = true;
            match self.carry_out(index, &request, node)? {
                Effect::None => {}
                Effect::Parted(reason) => node.stop_comparing(tick, reason),
                Effect::Switched { back } => match &self.in_use {
                    Some(package) if self.is_of_agent(package) => {
                        node.report.switches += 1;
                        if node.report.parted.is_none() {
                            served.switch = Some((package.clone(), back));
                        }
                    }
                    Some(_) => node.stop_comparing(tick, "its package has other parameters"),
                    None => node.stop_comparing(tick, "it uses an unknown package"),
                },
            }
            break;
        }
        self.clients.iter_mut().for_each(Client::write_out);
        self.clients.retain(|client| !client.gone);
        Ok(served)
    }

    /// The client, if there is one, that wants the node started again. It is the only thing that can
    /// be asked of a node that has ended: a client that asks for anything else is disconnected.
    fn wants_restart(&mut self) -> Option<usize> {
        self.let_in();
        let mut wanted = None;
        for (index, client) in self.clients.iter_mut().enumerate() {
            match client.request().map(|bytes| is_reset(&bytes)) {
                None => {}
                Some(true) if wanted.is_none() => wanted = Some(index),
                Some(_) => client.gone = true,
            }
        }
        if wanted.is_none() {
            self.clients.retain(|client| !client.gone);
        }
        wanted
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

fn is_reset(request: &[u8]) -> bool {
    matches!(receive::<Request<'_>>(request), Some(Request::Reset))
}

/// What the relay itself says.
type Reply<'a> = Response<'a, Vec<f32>>;

impl Client {
    fn new(socket: UnixStream) -> Self {
        Self {
            socket,
            decoder: RequestDecoder::new(),
            requests: VecDeque::new(),
            unsent: Vec::new(),
            losing_since: None,
            subscription: Subscription::default(),
            gone: false,
        }
    }

    /// The next request. Damaged ones are left out, as they are on a node. More is read only when
    /// nothing waits, so that a client that asks faster than it is answered has to wait itself.
    fn request(&mut self) -> Option<Vec<u8>> {
        if self.requests.is_empty() {
            let mut buffer = [0; 1024];
            match self.socket.read(&mut buffer) {
                Ok(0) => self.gone = true,
                Ok(length) => {
                    for &byte in &buffer[..length] {
                        if let Some(Ok(request)) = self.decoder.push(byte) {
                            self.requests.push_back(request.to_vec());
                        }
                    }
                }
                Err(error) if error.kind() == ErrorKind::WouldBlock => {}
                Err(_) => self.gone = true,
            }
        }
        self.requests.pop_front()
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
        } else {
            let since = *self.losing_since.get_or_insert_with(Instant::now);
            self.gone |= since.elapsed() > UNREAD_MAX;
        }
    }

    fn write_out(&mut self) {
        if self.unsent.is_empty() {
            return;
        }
        match self.socket.write(&self.unsent) {
            Ok(length) => {
                self.unsent.drain(..length);
                self.losing_since = None;
            }
            Err(error) if error.kind() == ErrorKind::WouldBlock => {}
            Err(_) => self.gone = true,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STEP: Duration = Duration::from_millis(10);

    #[test]
    fn real_time_that_is_caught_up_with_is_kept_and_what_is_given_up_is_told() {
        let (mut pace, start) = (Pace::default(), Instant::now());
        let mut now = start;
        let mut advance = |pace: &mut Pace, late: Duration| {
            let due = pace.next_step.unwrap_or(now);
            now = due + late;
            pace.advance(due, STEP, now)
        };
        assert_eq!(advance(&mut pace, Duration::ZERO), None);
        assert_eq!(advance(&mut pace, LAG_MAX), None);
        assert_eq!((pace.kept(STEP), pace.next_step), (1.0, Some(start + 2 * STEP)));
        // Ten seconds for the work of one step: three steps in ten seconds.
        let share = advance(&mut pace, Duration::from_secs(10)).unwrap();
        assert!((0.0029..0.0031).contains(&share), "{share}");
        // That is told once in a while only.
        assert_eq!(advance(&mut pace, Duration::from_secs(2)), None);
        assert!(pace.kept(STEP) < share + 0.0005);
    }

    #[test]
    fn a_client_that_does_not_read_costs_little_and_is_sent_away() {
        let (here, there) = UnixStream::pair().unwrap();
        here.set_nonblocking(true).unwrap();
        let mut client = Client::new(here);
        for _ in 0..100_000 {
            client.forward(&[1; 100]);
            client.write_out();
        }
        assert!(client.unsent.len() <= UNSENT_MAX && !client.gone);
        // It has lost messages for too long.
        client.losing_since = Instant::now().checked_sub(2 * UNREAD_MAX);
        client.forward(&[1; 100]);
        assert!(client.gone);
        drop(there);
    }

    #[test]
    fn requests_wait_with_the_client_that_sends_too_many() {
        let (here, mut there) = UnixStream::pair().unwrap();
        here.set_nonblocking(true).unwrap();
        let mut requests = Vec::new();
        for _ in 0..2000 {
            send(&Request::Query, |bytes| requests.extend_from_slice(bytes));
        }
        there.write_all(&requests).unwrap();
        let mut client = Client::new(here);
        let mut count = 0;
        while let Some(request) = client.request() {
            assert!(matches!(receive(&request), Some(Request::Query)));
            // What is read at a time: 1 KiB of messages of 7 bytes.
            assert!(client.requests.len() < 150, "{}", client.requests.len());
            count += 1;
        }
        assert_eq!(count, 2000);
    }
}
