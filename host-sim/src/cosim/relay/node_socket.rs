//! One node's socket, its clients, and what is known of the node's packages.

use agent_core::Tick;
use agent_core::service::{Problem, Request, receive};

use super::client::{Client, Reply};
use crate::cosim::fault::Fault;
use crate::cosim::loop_node::LoopNode;
use crate::cosim::socket::Socket;
use crate::packages::PackageBytes;
use crate::service::Message;

/// Most clients of a node at a time; others are sent away.
const CLIENTS_MAX: usize = 16;

/// One node's socket, and what is known of its packages.
pub(super) struct NodeSocket {
    socket: Socket,
    pub(super) clients: Vec<Client>,
    /// Whose turn it is.
    next: usize,
    uploaded: Vec<u8>,
    pub(super) in_use: Option<PackageBytes>,
    pub(super) before: Option<PackageBytes>,
}

/// What one pass over the clients of a node has done.
#[derive(Default)]
pub(super) struct Served {
    /// Whether there was a request.
    pub(super) request: bool,
    /// The package that the agent is to use, and whether it goes back to it.
    pub(super) switch: Option<(PackageBytes, bool)>,
}

/// What a request has done to a node, beyond its answer.
enum Effect {
    None,
    Switched { back: bool },
    Parted(&'static str),
}

impl NodeSocket {
    /// No clients, and nothing known of the node's packages.
    pub(super) fn new(socket: Socket) -> Self {
        Self {
            socket,
            clients: Vec::new(),
            next: 0,
            uploaded: Vec::new(),
            in_use: None,
            before: None,
        }
    }

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
    pub(super) fn serve(&mut self, tick: Tick, node: &mut LoopNode) -> Result<Served, Fault> {
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
    pub(super) fn wants_restart(&mut self) -> Option<usize> {
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

    /// The node has taken this package into use, or an unknown one.
    pub(super) fn switched(&mut self, package: Option<PackageBytes>) {
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
        // In the node's order: what it tells comes before the end of its answer.
        for client in &mut self.clients {
            exchange.unasked.iter().for_each(|bytes| client.forward(bytes));
        }
        for answer in &exchange.answers {
            self.clients[client].forward(answer);
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
