//! Strangers against the firmware in emulators: one at the service port, and one with a radio.
//!
//! Three nodes of the firmware: agent 1, its twin, and agent 2, the neighbour of both. Agent 1 and its
//! twin have the same flash and hear and measure the same, and only agent 1 hears the stranger. As long
//! as their states agree bit for bit, nothing that the stranger sent has had any effect.

use std::borrow::Cow;
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use agent_core::service::seal::PortKey;
use agent_core::service::{Request, Session, receive};
use agent_core::wire::authentic::{self, Header, Kind, NetworkKey, Stamp};
use agent_core::wire::secret::Secret;
use host_sim::analysis::TriggerConstants;
use host_sim::cosim::board::{Board, Turn};
use host_sim::cosim::qemu::{Channel, PROGRAM, Qemu};
use host_sim::keys::{FleetKeys, FleetSecret, NetworkNumbers};
use host_sim::learning::trained;
use host_sim::packages::PackageBytes;
use host_sim::scenario::{PAPER, Scenario};
use host_sim::service::provision::NewKeys;
use host_sim::service::{Line, Message};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::port::{Target, attack};
use super::{Outcome, alter};
use crate::cosim::lockstep;
use crate::cosim::loop_node::{Quirks, region};
use crate::keyed::test_node::encoded;

const DIMENSION: usize = 3;
const TIMEOUT: Duration = Duration::from_secs(20);
/// Frames of the stranger in a step; a node takes up to eight.
const FRAMES: u64 = 6;
/// Steps within which a true neighbour is believed again: 2 s.
const BELIEVED_AGAIN: u64 = 2_000;

/// The firmware to attack: `cargo xtask attack` builds it.
fn firmware() -> Qemu {
    let firmware = std::env::var_os("ATTACK_FIRMWARE").map(PathBuf::from);
    Qemu {
        program: PROGRAM.into(),
        firmware: firmware.expect("`cargo xtask attack` names the firmware"),
        region: region(),
        timeout: TIMEOUT,
        stop: Arc::default(),
    }
}

fn fleet() -> FleetKeys {
    FleetKeys::new(FleetSecret::new([0x33; 32]), NetworkNumbers::FIRST)
}

/// The packages of two neighbours among the paper's agents.
fn packages() -> [PackageBytes; 2] {
    let scenario = Scenario::parse("paper", PAPER).unwrap();
    let trigger = TriggerConstants::new(&scenario);
    let network = scenario.network.as_ref().unwrap();
    let inner = vec![0.1; network.architecture.parameter_count()];
    [0, 1].map(|agent| trained::initial(&scenario, &trigger, network, &inner, agent, 0).unwrap())
}

/// A node with keys; returns also what it broadcasts first.
fn node(qemu: &Qemu, package: &PackageBytes, epoch: u32) -> (Board, Vec<Vec<u8>>) {
    let mut board = qemu.start(Channel::Pipes, package).unwrap();
    board.set_timeout(TIMEOUT);
    let fleet = fleet();
    board.set_keys(fleet.port_keys());
    let keys = NewKeys { fleet: &fleet, operator: None, epoch };
    let first = board.begin(package, &[0.0; DIMENSION], Some(&keys)).unwrap();
    (board, first)
}

impl Target for Board {
    fn send(&mut self, request: &[u8]) -> Message<'static> {
        // Random bytes are a frame or a tick now and then. The board in the loop takes these without an
        // answer, so whether the node still answers is asked behind them.
        let exchange = match receive(request) {
            Some(Request::Frame { .. } | Request::Tick { .. }) => {
                self.forward_stimulus(request).unwrap();
                self.exchange(&Request::Query)
            }
            _ => self.forward(request),
        };
        let exchange = exchange.unwrap();
        let last = exchange.answers.last().unwrap();
        match receive::<Message<'_>>(last).unwrap() {
            Message::Refused(problem) => Message::Refused(problem),
            Message::Status(status) => Message::Status(status),
            Message::Report(report) => Message::Report(report),
            Message::Session(session) => Message::Session(session),
            // What it is does not matter, except that it is not a refusal.
            _ => Message::Done,
        }
    }

    fn session(&mut self) -> (Session, PortKey) {
        let exchange = self.exchange(&Request::Session).unwrap();
        let Some(Message::Session(Some(session))) = receive(&exchange.answers[0]) else {
            panic!("no session")
        };
        let key = self.keys().unwrap().of(session.agent);
        assert_eq!(key.proof(&session), session.proof);
        (session, key)
    }

    fn restart(&mut self, _way: u32) {
        self.reset().unwrap();
    }

    fn flash(&self) -> Option<&[u8]> {
        None
    }
}

/// The stranger at the port of an emulated node.
pub(super) fn at_the_port(tries: u64, seed: u64) -> Outcome {
    let [package, _] = packages();
    let (mut board, _) = node(&firmware(), &package, 1_000);
    attack("port-requests-emulated", &mut board, DIMENSION, tries, seed)
}

/// The stranger with a radio near an emulated node: everything on the air is recorded, and sent again
/// as it is, changed, cut, joined, and sealed with another key. Nodes reboot.
///
/// Accepted are steps in which agent 1 differs from its twin. Harm is a true frame that the twin still
/// refuses [`BELIEVED_AGAIN`] steps after a reboot.
pub(super) fn with_a_radio(tries: u64, seed: u64) -> Outcome {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut outcome = Outcome { name: "radio-frames-emulated", tries: 0, accepted: 0, harm: 0 };
    let (qemu, packages) = (firmware(), packages());
    let (mut attacked, first) = node(&qemu, &packages[0], 1_000);
    let (mut twin, of_twin) = node(&qemu, &packages[0], 1_000);
    assert_eq!(first, of_twin);
    let (mut neighbour, mut of_neighbour) = node(&qemu, &packages[1], 5_000);
    let mut of_twin = of_twin;
    let mut recorded = Vec::new();
    let (mut step, mut rebooted, mut refused) = (0u64, 0, 0);
    while outcome.tries < tries {
        recorded.extend(of_twin.iter().chain(&of_neighbour).cloned());
        if recorded.len() > 20_000 {
            recorded.drain(..1_000);
        }
        if step.is_multiple_of(12_000) && step > 0 {
            // What the rebooted node has said last is lost.
            if step.is_multiple_of(24_000) {
                for board in [&mut attacked, &mut twin] {
                    board.reset().unwrap();
                    board.subscribe().unwrap();
                }
                of_twin.clear();
            } else {
                neighbour.reset().unwrap();
                neighbour.subscribe().unwrap();
                of_neighbour.clear();
            }
            rebooted = step;
        }
        if step == rebooted + BELIEVED_AGAIN {
            refused = frames_refused(&mut twin);
        } else if step > rebooted + BELIEVED_AGAIN && step.is_multiple_of(1_000) {
            outcome.harm += u64::from(frames_refused(&mut twin) != refused);
        }
        let measurement = [(step as f32 * 0.01).sin()];
        let mut frames: Vec<Vec<u8>> = of_neighbour.clone();
        twin.hand(borrowed(&frames));
        twin.feed(1, Some(&measurement)).unwrap();
        neighbour.hand(borrowed(&of_twin));
        neighbour.feed(1, Some(&[(step as f32 * 0.013).cos()])).unwrap();
        // The stranger's come before, between and after the true ones.
        for _ in 0..FRAMES {
            let place = random.random_range(0..=frames.len());
            frames.insert(place, forged(&recorded, &mut random));
        }
        outcome.tries += FRAMES;
        attacked.hand(borrowed(&frames));
        attacked.feed(1, Some(&measurement)).unwrap();
        let (found, expected) = (attacked.turn().unwrap(), twin.turn().unwrap());
        outcome.accepted += u64::from(!is_same(&found, &expected));
        of_twin = expected.frames;
        of_neighbour = neighbour.turn().unwrap().frames;
        step += 1;
    }
    outcome
}

/// Whether two nodes have done the same, bit for bit.
fn is_same(one: &Turn, other: &Turn) -> bool {
    let bits = |turn: &Turn| {
        let state = turn.state.as_ref().unwrap();
        let numbers = state.estimate.iter().chain(&state.derivative).chain(&state.outer_weights);
        (state.tick, state.outcome, numbers.map(|number| number.to_bits()).collect::<Vec<_>>())
    };
    bits(one) == bits(other) && estimates(one) == estimates(other)
}

/// The broadcasts of the observer; a hello of the stranger may be answered.
fn estimates(turn: &Turn) -> Vec<&Vec<u8>> {
    let keys = fleet().network_keys();
    let is_estimate = |bytes: &&Vec<u8>| {
        matches!(authentic::open(bytes, &keys), Ok((Header { kind: Kind::Estimate, .. }, _)))
    };
    turn.frames.iter().filter(is_estimate).collect()
}

fn frames_refused(board: &mut Board) -> u32 {
    let health = board.status().unwrap().health;
    health.frames_refused + health.frames_stale
}

fn borrowed(frames: &[Vec<u8>]) -> impl Iterator<Item = Cow<'_, [u8]>> {
    frames.iter().map(|bytes| Cow::from(bytes.as_slice()))
}

/// A frame of the stranger, which is never a true one that the receiver still waits for.
fn forged(recorded: &[Vec<u8>], random: &mut ChaCha8Rng) -> Vec<u8> {
    // What is on the air in this step is at the end.
    let old = recorded.len().saturating_sub(8).max(1);
    let mut bytes = recorded[random.random_range(0..old)].clone();
    match random.random_range(0..6) {
        0 | 1 => {}
        2 | 3 => {
            let other = &recorded[random.random_range(0..old)];
            alter(&mut bytes, other, authentic::TAG_LENGTH, random);
        }
        4 => {
            let foreign = NetworkKey::new(random.random_range(0..3), Secret::new(random.random()));
            let stamp = Stamp { epoch: u32::MAX, sequence: u32::MAX };
            let (sender, tick) = (random.random_range(0..4), random.random());
            let header = Header { sender, stamp, tick, kind: Kind::Estimate };
            bytes =
                authentic::seal(&header, &[1e3_f32.to_le_bytes(); DIMENSION], &foreign).to_vec();
        }
        _ => bytes.iter_mut().skip(1).for_each(|byte| *byte = random.random()),
    }
    bytes
}

#[test]
fn a_stimulus_without_an_answer_is_not_silence() {
    let mut board = lockstep::board(None, &Quirks::default(), false);
    board.hello().unwrap();
    let measurement = Some([0.5].into_iter().collect());
    for request in [
        Request::Frame { bytes: &[0x5a; 39] },
        Request::Tick { periods: 0, measurement: None },
        Request::Tick { periods: u32::MAX, measurement },
    ] {
        let answer = Target::send(&mut board, &encoded(&request));
        assert!(matches!(answer, Message::Status(_)), "{request:?}: {answer:?}");
    }
    assert!(matches!(Target::send(&mut board, &[0xff]), Message::Refused(_)));
}

#[test]
#[should_panic(expected = "Silent")]
fn a_node_that_falls_silent_is_found_behind_a_frame() {
    let (here, _there) = UnixStream::pair().unwrap();
    let mut board = Board::new(Line::over_socket(here, &Arc::default()).unwrap(), "mute", false);
    board.set_timeout(Duration::from_millis(20));
    Target::send(&mut board, &encoded(&Request::Frame { bytes: &[0x5a; 39] }));
}
