//! A node of the paper's firmware on a board that is played by a test: agent 1 or agent 2 of a network
//! of two, with keys.

use std::cell::Cell;
use std::collections::VecDeque;
use std::num::NonZeroU32;

use agent_core::AgentId;
use agent_core::health::HealthSettings;
use agent_core::package::StepRange;
use agent_core::package::signature::PublicKey;
use agent_core::service::seal::PortKey;
use agent_core::service::{
    CHUNK_LENGTH_MAX, Problem, Provision, Request, Response, Seal, Session, Status, Subscription,
    receive, send,
};
use agent_core::store::{MappedFlash, RateLimit};
use agent_core::wire::authentic::NetworkKey;
use agent_core::wire::cobs::{Decoder, SerialError};
use agent_core::wire::secret::Secret;
use firmware_template::board::RequestBuffer;
use firmware_template::{
    Board, Epochs, LinkErrorKind, Memory, Node, Progress, SensorErrorKind, Settings, Start,
};
use host_sim::analysis::TriggerConstants;
use host_sim::learning::trained;
use host_sim::packages::{Draft, PackageBytes};
use host_sim::service::Message;

use crate::sim::scenario_builder::{Described, network, picks};
use crate::store::packages::{Flash, LAYOUT, new_flash};

/// State dimension.
const N: usize = 2;

type KeyedNode = Node<'static, Flash, N, 4, 1, 16>;

/// The operator's secrets.
pub(crate) fn port_secret(agent: AgentId) -> Secret {
    Secret::new([0x70 ^ agent as u8; 16])
}

pub(crate) fn network_key(number: u8) -> NetworkKey {
    NetworkKey::new(number, Secret::new([number ^ 0x5a; 16]))
}

/// A package for agent 1 or 2 of two.
pub(crate) fn package(agent: AgentId, version: u32) -> PackageBytes {
    package_of(two_agents(), agent, version)
}

/// A package with which the agent broadcasts its first sample only.
pub(crate) fn quiet_package(agent: AgentId) -> PackageBytes {
    package_of(Described { epsilon: 1e12, ..two_agents() }, agent, 1)
}

fn two_agents() -> Described {
    Described::linear(N, "path", [(picks(N, [0]), 1), (picks(N, [1]), 1)])
}

fn package_of(mut described: Described, agent: AgentId, version: u32) -> PackageBytes {
    described.network = network(&[(5, "tanh"), (3, "logistic")], "2.0");
    let scenario = described.scenario();
    let network = scenario.network.as_ref().unwrap();
    let count = network.architecture.parameter_count();
    let inner: Vec<_> = (0..count).map(|i| ((i as f32 + version as f32) * 0.7).sin()).collect();
    let trigger = TriggerConstants::new(&scenario);
    let index = agent as usize - 1;
    let initial = trained::initial(&scenario, &trigger, network, &inner, index, 0).unwrap();
    Draft { version, ..Draft::copy(&initial.package()) }.seal().unwrap()
}

thread_local! {
    /// What the node that works keeps during a reset.
    static KEPT: Cell<Epochs> = const { Cell::new(Epochs { next: 0, end: 0 }) };
}

/// How a node's life ends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Off {
    /// A reset keeps some memory.
    Reset,
    /// The supply fails.
    Power,
}

/// A node, and what a test knows of it.
pub(crate) struct TestNode {
    node: Option<Box<KeyedNode>>,
    pub(crate) board: TestBoard,
    public_key: Option<PublicKey>,
    kept: Epochs,
    boots: u32,
    /// What the operator knows of the session.
    pub(crate) session: Option<Session>,
}

impl TestNode {
    /// A blank node after its first start.
    pub(crate) fn blank() -> Self {
        Self::with_public_key(None)
    }

    pub(crate) fn with_public_key(public_key: Option<PublicKey>) -> Self {
        Self::with_flash(new_flash(), public_key)
    }

    /// A node after its first start with this flash.
    pub(crate) fn with_flash(flash: Flash, public_key: Option<PublicKey>) -> Self {
        let mut node = Self {
            node: None,
            board: TestBoard::default(),
            public_key,
            kept: Epochs::default(),
            boots: 0,
            session: None,
        };
        node.start(flash, false);
        node
    }

    /// A node with a port key, network key 1, and a confirmed package.
    pub(crate) fn provisioned(agent: AgentId) -> Self {
        let mut node = Self::blank();
        assert_eq!(node.provision(agent, 1_000, &[]), Ok(()));
        assert_eq!(node.give_network_keys(&[1]), Ok(()));
        assert_eq!(node.push(&package(agent, 1)), Ok(()));
        node
    }

    fn start(&mut self, flash: Flash, factory_reset: bool) {
        self.boots += 1;
        KEPT.set(self.kept);
        let settings = Settings {
            layout: LAYOUT,
            public_key: self.public_key,
            step_range: StepRange::DEFAULT,
            health: HealthSettings { telemetry_interval: 1_000_000, ..HealthSettings::RECOMMENDED },
            update_limit: RateLimit::NONE,
            trial: firmware_template::RECOMMENDED_TRIAL,
            sample_stride: NonZeroU32::MIN,
            subscription: Subscription { state_every: None, outer_weights: false },
            fallback: None,
            stack_unused: None,
            start: Start { boots: Some(self.boots), epochs: self.kept, ..Start::default() },
            keep_epochs: Some(|epochs| KEPT.set(epochs)),
            factory_reset,
            version: [0, 1, 0],
        };
        // The few kilobytes of each start are not given back.
        let memory = Box::leak(Box::new(Memory::new()));
        self.board = TestBoard::default();
        self.session = None;
        self.node = Some(Box::new(KeyedNode::new(flash, settings, memory).unwrap()));
        self.work();
    }

    /// Ends this life and begins another.
    pub(crate) fn restart(&mut self, off: Off) {
        self.restart_with(off, false);
    }

    /// Restarts with the button held.
    pub(crate) fn reset_by_hand(&mut self) {
        self.restart_with(Off::Power, true);
    }

    fn restart_with(&mut self, off: Off, factory_reset: bool) {
        let flash = self.node.take().unwrap().into_flash();
        if off == Off::Power {
            (self.kept, self.boots) = (Epochs::default(), 0);
        }
        self.start(flash, factory_reset);
    }

    pub(crate) fn node(&self) -> &KeyedNode {
        self.node.as_ref().unwrap()
    }

    /// The bytes in flash.
    pub(crate) fn flash(&self) -> &[u8] {
        self.node().flash().mapped()
    }

    /// Lets the node work until nothing is pending; it restarts if it was asked to.
    fn work(&mut self) {
        KEPT.set(self.kept);
        loop {
            let progress = self.node.as_mut().unwrap().poll(&mut self.board);
            self.kept = KEPT.get();
            match progress {
                Progress::Worked => {}
                Progress::Idle => return,
                Progress::Reset => {
                    let said = std::mem::take(&mut self.board.said);
                    self.restart(Off::Reset);
                    self.board.said.splice(..0, said);
                    return;
                }
            }
        }
    }

    /// A step with these frames; returns what the node broadcasts.
    pub(crate) fn step(&mut self, frames: impl IntoIterator<Item = Vec<u8>>) -> Vec<Vec<u8>> {
        self.board.received.extend(frames);
        self.board.periods = 1;
        self.work();
        std::mem::take(&mut self.board.sent)
    }

    /// Sends bytes as they come out of their frame, and returns the answer.
    pub(crate) fn send(&mut self, bytes: &[u8]) -> Message<'static> {
        self.board.said.clear();
        self.board.requests.push_back(bytes.to_vec());
        self.work();
        self.board.answer()
    }

    /// Sends bytes as they come out of their frame, and returns everything that the node says, framed.
    pub(crate) fn converse(&mut self, bytes: &[u8]) -> Vec<u8> {
        self.board.said.clear();
        self.board.requests.push_back(bytes.to_vec());
        self.work();
        std::mem::take(&mut self.board.said)
    }

    pub(crate) fn ask(&mut self, request: &Request<'_>) -> Message<'static> {
        self.send(&encoded(request))
    }

    pub(crate) fn status(&mut self) -> Status {
        match self.ask(&Request::Query) {
            Message::Status(status) => status,
            other => panic!("{other:?}"),
        }
    }

    /// Asks for the session and checks its proof, as an operator does.
    pub(crate) fn open_session(&mut self) -> Session {
        let Message::Session(Some(session)) = self.ask(&Request::Session) else {
            panic!("no session")
        };
        let key = PortKey::new(port_secret(session.agent));
        assert_eq!(session.proof, key.proof(&session));
        self.session = Some(session);
        session
    }

    /// Seals a request with the next counter of the session.
    pub(crate) fn sealed(&mut self, request: &Request<'_>) -> Vec<u8> {
        if self.session.is_none() {
            self.open_session();
        }
        let session = self.session.as_mut().unwrap();
        session.counter += 1;
        let key = PortKey::new(port_secret(session.agent));
        seal(&key, session.epoch.unwrap(), session.counter, request)
    }

    pub(crate) fn ask_sealed(&mut self, request: &Request<'_>) -> Message<'static> {
        let bytes = self.sealed(request);
        self.send(&bytes)
    }

    /// Provisions the node as an agent, sealed if it is provisioned already.
    pub(crate) fn provision(
        &mut self,
        agent: AgentId,
        epoch: u32,
        signature: &[u8],
    ) -> Result<(), Problem> {
        let provision = Provision { agent, port_key: port_secret(agent), epoch };
        let bytes = [&provision.to_bytes()[..], signature].concat();
        let request = Request::Provision { bytes: &bytes };
        let is_provisioned = self.ask(&Request::Session) != Message::Session(None);
        let answer = if is_provisioned { self.ask_sealed(&request) } else { self.ask(&request) };
        self.session = None;
        done(&answer)
    }

    pub(crate) fn give_network_keys(&mut self, numbers: &[u8]) -> Result<(), Problem> {
        let bytes: Vec<_> =
            numbers.iter().flat_map(|&number| network_key(number).to_bytes()).collect();
        done(&self.ask_sealed(&Request::NetworkKeys { bytes: &bytes }))
    }

    /// Pushes, activates and confirms a package, sealed.
    pub(crate) fn push(&mut self, package: &PackageBytes) -> Result<(), Problem> {
        let bytes = package.as_bytes();
        let mut requests = vec![Request::Begin { length: bytes.len() as u32 }];
        for (index, bytes) in bytes.chunks(CHUNK_LENGTH_MAX).enumerate() {
            let offset = (index * CHUNK_LENGTH_MAX) as u32;
            requests.push(Request::Chunk { offset, bytes });
        }
        requests.extend([Request::Stage, Request::Activate, Request::Confirm]);
        for request in requests {
            if let Message::Refused(problem) = self.ask_sealed(&request) {
                return Err(problem);
            }
        }
        Ok(())
    }
}

pub(crate) fn done(answer: &Message<'_>) -> Result<(), Problem> {
    match answer {
        Message::Done => Ok(()),
        Message::Refused(problem) => Err(*problem),
        other => panic!("{other:?}"),
    }
}

/// A seal with a salt of its own.
pub(crate) fn salted(counter: u32) -> Seal {
    Seal { counter, salt: u64::from(counter).wrapping_mul(0x9e37_79b9_7f4a_7c15).to_le_bytes() }
}

/// A sealed request.
pub(crate) fn seal(key: &PortKey, epoch: u32, counter: u32, request: &Request<'_>) -> Vec<u8> {
    let mut body = encoded(request);
    let tag = key.seal(epoch, &salted(counter), &mut body);
    [encoded(&Request::Sealed(salted(counter))), body, tag.to_vec()].concat()
}

pub(crate) fn encoded(request: &Request<'_>) -> Vec<u8> {
    let mut stream = Vec::new();
    send(request, |bytes| stream.extend_from_slice(bytes));
    contents(&stream).remove(0)
}

fn contents(stream: &[u8]) -> Vec<Vec<u8>> {
    let mut decoder = Decoder::<4096>::new();
    stream.iter().filter_map(|&byte| Some(decoder.push(byte)?.unwrap().to_vec())).collect()
}

/// The board of a [`TestNode`].
#[derive(Default)]
pub(crate) struct TestBoard {
    periods: u32,
    requests: VecDeque<Vec<u8>>,
    received: VecDeque<Vec<u8>>,
    pub(crate) sent: Vec<Vec<u8>>,
    said: Vec<u8>,
}

impl TestBoard {
    /// The answer among what the node has said.
    fn answer(&self) -> Message<'static> {
        let messages = contents(&self.said);
        let found = messages.iter().find_map(|bytes| {
            let message = receive::<Message<'_>>(bytes).unwrap();
            message.is_answer().then(|| owned(message))
        });
        found.expect("every request has an answer")
    }
}

/// Answers have no bytes of their own.
fn owned(message: Message<'_>) -> Message<'static> {
    match message {
        Response::Broadcast { .. } => unreachable!("not an answer"),
        Response::Status(status) => Response::Status(status),
        Response::Upload(upload) => Response::Upload(upload),
        Response::Staged { version } => Response::Staged { version },
        Response::InUse { version } => Response::InUse { version },
        Response::Done => Response::Done,
        Response::Refused(problem) => Response::Refused(problem),
        Response::Sample { tick, estimate, derivative } => {
            Response::Sample { tick, estimate, derivative }
        }
        Response::SamplesEnd { next } => Response::SamplesEnd { next },
        Response::Report(report) => Response::Report(report),
        Response::Session(session) => Response::Session(session),
        other => panic!("not an answer: {other:?}"),
    }
}

impl Board for TestBoard {
    fn start(&mut self, _period: f32) {}

    fn elapsed(&mut self) -> u32 {
        std::mem::take(&mut self.periods)
    }

    fn rest(&mut self) {}

    fn measure(&mut self, measurement: &mut [f32]) -> Result<usize, SensorErrorKind> {
        measurement[0] = 0.25;
        Ok(1)
    }

    fn broadcast(&mut self, frame: &[u8]) -> Result<(), LinkErrorKind> {
        self.sent.push(frame.to_vec());
        Ok(())
    }

    fn frame<'buffer>(
        &mut self,
        buffer: &'buffer mut [u8],
    ) -> Option<Result<&'buffer [u8], LinkErrorKind>> {
        let frame = self.received.pop_front()?;
        let Some(place) = buffer.get_mut(..frame.len()) else {
            return Some(Err(LinkErrorKind::Overflow));
        };
        place.copy_from_slice(&frame);
        Some(Ok(place))
    }

    fn request<'buffer>(
        &mut self,
        buffer: &'buffer mut RequestBuffer,
    ) -> Option<Result<&'buffer mut [u8], SerialError>> {
        let request = self.requests.pop_front()?;
        let Some(place) = buffer.get_mut(..request.len()) else {
            return Some(Err(SerialError::TooLong));
        };
        place.copy_from_slice(&request);
        Some(Ok(place))
    }

    fn respond(&mut self, bytes: &[u8]) {
        self.said.extend_from_slice(bytes);
    }

    fn flush(&mut self) {}
}
