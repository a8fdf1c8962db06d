//! A node's socket and clients, and the node's packages.

use agent_core::Tick;
use agent_core::service::seal::PortKey;
use agent_core::service::{Event, Problem, Provision, Request, receive, split_number, split_seal};

use super::client::{Client, Reply};
use crate::cosim::fault::Fault;
use crate::cosim::loop_node::LoopNode;
use crate::cosim::socket::Socket;
use crate::keys::PortKeys;
use crate::packages::PackageBytes;
use crate::service::Message;

/// Maximum number of clients of a node; further ones are disconnected.
const CLIENTS_MAX: usize = 16;

/// A node's socket and clients, and the node's packages.
pub(super) struct NodeSocket {
    socket: Socket,
    pub(super) clients: Vec<Client>,
    /// Index of the client whose turn it is.
    next: usize,
    uploaded: Vec<u8>,
    pub(super) in_use: Option<PackageBytes>,
    pub(super) before: Option<PackageBytes>,
    /// Whether the node has ended the trial of its package by itself.
    went_back: bool,
}

/// Result of serving a node's clients once.
#[derive(Default)]
pub(super) struct Served {
    /// Whether a request was handled.
    pub(super) request: bool,
    /// The package to switch the simulated agent to, and whether it is a revert.
    pub(super) switch: Option<(PackageBytes, bool)>,
}

/// Side effect of a request.
enum Effect {
    None,
    Switched {
        back: bool,
    },
    /// The node deviates from the simulation, for this reason.
    Deviates(&'static str),
    /// The node restarts, and deviates for this reason.
    Restarts(&'static str),
}

impl NodeSocket {
    /// Creates a socket without clients and with unknown packages.
    pub(super) fn new(socket: Socket) -> Self {
        Self {
            socket,
            clients: Vec::new(),
            next: 0,
            uploaded: Vec::new(),
            in_use: None,
            before: None,
            went_back: false,
        }
    }

    /// Accepts waiting clients.
    fn accept(&mut self) {
        while let Some(socket) = self.socket.accept() {
            if self.clients.len() < CLIENTS_MAX && socket.set_nonblocking(true).is_ok() {
                self.clients.push(Client::new(socket));
            }
        }
    }

    /// Handles one request, the clients taking turns, and writes unsent output of all clients.
    pub(super) fn serve(&mut self, tick: Tick, node: &mut LoopNode) -> Result<Served, Fault> {
        self.accept();
        let clients = self.clients.len();
        let mut served = Served::default();
        if std::mem::take(&mut self.went_back) {
            self.switched(self.before.clone());
            // The requests of the clients can wait until the simulated agent has switched, too.
            return Ok(Served { request: true, switch: self.switch(tick, node, true) });
        }
        for index in (0..clients).map(|offset| (self.next + offset) % clients) {
            let Some(request) = self.clients[index].request() else { continue };
            self.next = index + 1;
            served.request = true;
            match self.carry_out(index, &request, node)? {
                Effect::None => {}
                Effect::Deviates(reason) | Effect::Restarts(reason) => {
                    node.stop_comparing(tick, reason);
                }
                Effect::Switched { back } => served.switch = self.switch(tick, node, back),
            }
            break;
        }
        self.clients.iter_mut().for_each(Client::write_out);
        self.clients.retain(|client| !client.gone);
        Ok(served)
    }

    /// Returns the package that the simulated agent switches to after its node has.
    fn switch(&self, tick: Tick, node: &mut LoopNode, back: bool) -> Option<(PackageBytes, bool)> {
        match &self.in_use {
            Some(package) if self.is_of_agent(package) => {
                node.report.switches += 1;
                return node.report.parted.is_none().then(|| (package.clone(), back));
            }
            Some(_) => node.stop_comparing(tick, "its package has different parameters"),
            None => node.stop_comparing(tick, "it uses an unknown package"),
        }
        None
    }

    /// Notices messages that a node sent by itself: it may have ended a trial.
    pub(super) fn notice(&mut self, unsolicited: &[Vec<u8>]) {
        self.went_back |= unsolicited
            .iter()
            .any(|bytes| matches!(receive(bytes), Some(Message::Event(Event::Reverted { .. }))));
    }

    /// Returns the client that requests a restart of a stopped node, if any, and the request's number.
    /// Clients with any other request are disconnected, except for the question that precedes a
    /// sealed one.
    pub(super) fn restart_requested(&mut self) -> Option<(usize, Option<u16>)> {
        self.accept();
        let mut wanted = None;
        for (index, client) in self.clients.iter_mut().enumerate() {
            let Some(bytes) = client.request() else { continue };
            let (number, request) = split_number(&bytes);
            match receive::<Request<'_>>(request) {
                Some(Request::Reset) if wanted.is_none() => wanted = Some((index, number)),
                // The relay restarts it, so the request need not be sealed.
                Some(Request::Session) => {
                    client.answer(number, &Reply::Session(None));
                    client.write_out();
                }
                _ => client.gone = true,
            }
        }
        if wanted.is_none() {
            self.clients.retain(|client| !client.gone);
        }
        wanted
    }

    /// Returns whether a package is for this agent with the simulated parameters.
    fn is_of_agent(&self, package: &PackageBytes) -> bool {
        self.before.as_ref().is_none_or(|before| before.package().node == package.package().node)
    }

    /// Records a switch to this package, or to an unknown one.
    pub(super) fn switched(&mut self, package: Option<PackageBytes>) {
        self.before = std::mem::replace(&mut self.in_use, package);
    }

    /// Forwards a client's request to the node, and the answer back.
    fn carry_out(
        &mut self,
        client: usize,
        bytes: &[u8],
        node: &mut LoopNode,
    ) -> Result<Effect, Fault> {
        let asking = &mut self.clients[client];
        let (number, bytes) = split_number(bytes);
        let is_sealed = split_seal(bytes).0.is_some();
        let opened = node.board.open(bytes)?;
        let request = receive::<Request<'_>>(opened.as_deref().unwrap_or(bytes));
        match &request {
            // The node refuses it, too.
            _ if is_sealed && opened.is_none() => {}
            None | Some(Request::Numbered { .. } | Request::Sealed(_)) => {
                asking.answer(number, &Reply::Refused(Problem::Unknown));
                return Ok(Effect::None);
            }
            Some(Request::Subscribe(_)) if !is_sealed && node.board.seals()? => {
                asking.answer(number, &Reply::Refused(Problem::NotSealed));
                return Ok(Effect::None);
            }
            Some(Request::Subscribe(subscription)) => {
                asking.subscription = *subscription;
                asking.answer(number, &Reply::Done);
                return Ok(Effect::None);
            }
            Some(Request::Frame { .. } | Request::Tick { .. }) => {
                asking.answer(number, &Reply::Refused(Problem::NotInTheLoop));
                return Ok(Effect::None);
            }
            Some(_) => {}
        }
        let exchange = node.board.forward(bytes)?;
        let answer = exchange.answers.last().and_then(|answer| receive::<Message<'_>>(answer));
        let effect = self.effect(request.as_ref(), answer.as_ref(), node);
        // In the node's order: unsolicited messages precede the end of the answer.
        for client in &mut self.clients {
            exchange.unsolicited.iter().for_each(|bytes| client.forward(bytes));
        }
        if let Effect::Restarts(reason) = effect {
            let status = node.board.restarted()?;
            node.board.subscribe()?;
            self.clients[client].answer(number, &Reply::Done);
            for client in &mut self.clients {
                client.send(&Reply::Hello(status));
            }
            (self.in_use, self.before) = (None, None);
            return Ok(Effect::Deviates(reason));
        }
        for answer in &exchange.answers {
            self.clients[client].forward_answer(number, answer);
        }
        node.broadcast_alone(exchange.frames);
        Ok(effect)
    }

    /// Returns the side effect of a request with this answer.
    fn effect(
        &mut self,
        request: Option<&Request<'_>>,
        answer: Option<&Message<'_>>,
        node: &mut LoopNode,
    ) -> Effect {
        let Some(request) = request else { return Effect::None };
        match (request, answer) {
            (Request::Begin { length }, Some(Message::Upload(_))) => {
                // The node has accepted this length, so it is at most that of a slot.
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
                return Effect::Deviates("it was started from a different estimate");
            }
            (Request::Reset, Some(Message::Done)) => return Effect::Restarts("it was reset"),
            (Request::FactoryReset, Some(Message::Done)) => {
                return Effect::Restarts("it was reset to its factory state");
            }
            (Request::Provision { bytes }, Some(Message::Done)) => {
                if let Some((new, _)) = Provision::split(bytes) {
                    node.board.set_keys(PortKeys::Node(PortKey::new(new.port_key)));
                }
            }
            _ => {}
        }
        Effect::None
    }
}

#[cfg(test)]
mod tests;
