//! Frames: `Frame::decode`, `Frame::encode`, `Inbox::accept`, and the steps of an agent that
//! receives them.
//!
//! The input is a sequence of events, as [`fuzz::Event`] reads it.
#![no_main]

use std::collections::BTreeMap;

use agent_core::agent::inbox::Inbox;
use agent_core::agent::{AgentParams, AgentState, StepError};
use agent_core::math::numeric::all_finite;
use agent_core::math::symmetric::SymmetricMatrix;
use agent_core::observer::feedback::{Neighbour, ObserverParams, OutputMatrix};
use agent_core::observer::field::{Coupling, Direction, Disturbance, HoldKind, Options};
use agent_core::observer::network::InnerNetwork;
use agent_core::observer::outer_law::OuterLawParams;
use agent_core::observer::projection::ProjectionParams;
use agent_core::observer::trigger::TriggerParams;
use agent_core::wire::frame::{FRAME_LENGTH_MAX, Frame, FrameError};
use agent_core::{AgentId, StateVector, Tick};
use fuzz::Event;
use libfuzzer_sys::fuzz_target;
use nalgebra::SMatrix;

/// Short enough for a short input.
const RESTART_SILENCE: Tick = 2;
/// The receiver's state dimension.
const N: usize = 3;
const NEIGHBOURS: [Neighbour; 3] = [
    Neighbour { id: 4, weight: 1.0 },
    Neighbour { id: 9, weight: 0.5 },
    Neighbour { id: 300, weight: 2.0 },
];

type ParamBuffers = [Option<agent_core::agent::hold::Hold<N>>; NEIGHBOURS.len()];

fuzz_target!(|data: &[u8]| {
    let params = params();
    let mut state = AgentState::<N, 1, ParamBuffers>::new(
        &params,
        StateVector::zeros(),
        &[0.0; N],
        [None; NEIGHBOURS.len()],
    )
    .expect("the parameters are valid");
    let mut inbox = Inbox::<N, ParamBuffers>::new([None; NEIGHBOURS.len()]);
    let mut model = Model::default();
    // The same agent with the field observer, which moves samples on.
    let (mut field, mut field_inbox) = (state.clone(), inbox.clone());
    field.set_field(&params, &field_words()).expect("the parameters are valid");
    let mut tick = 0;
    for event in Event::read(data) {
        match event {
            Event::Received(bytes) => {
                check_decoding::<1>(&bytes);
                check_decoding::<2>(&bytes);
                check_decoding::<N>(&bytes);
                check_decoding::<4>(&bytes);
                check_decoding::<12>(&bytes);
                let expected = model.receive(&bytes);
                assert_eq!(inbox.accept(&NEIGHBOURS, &bytes), expected);
                let _ = field_inbox.accept(&NEIGHBOURS, &bytes);
            }
            Event::Step => {
                check_step(&params, &mut state, tick, &mut inbox, &mut model);
                check_field_step(&params, &mut field, tick, &mut field_inbox);
                tick += 1;
            }
        }
        assert_eq!(inbox.len(), model.waiting.len());
        assert_eq!(inbox.is_empty(), model.waiting.is_empty());
    }
    inbox.clear();
    assert!(inbox.is_empty());
});

/// Checks the properties of every frame that decodes from `bytes`, and of invalid bytes.
fn check_decoding<const N: usize>(bytes: &[u8]) {
    let frame = match Frame::<N>::decode(bytes) {
        Ok(frame) => frame,
        Err(FrameError::Dimension { expected, found }) => {
            assert_eq!(expected, N);
            return assert_ne!(found, N);
        }
        Err(FrameError::Length { found }) => {
            assert_eq!(found, bytes.len());
            return assert!(!(5..=FRAME_LENGTH_MAX).contains(&found));
        }
        Err(FrameError::UnknownSender { .. } | FrameError::DuplicateSender { .. }) => {
            panic!("decoding does not depend on neighbours")
        }
        Err(_) => return,
    };
    assert!(all_finite(&frame.estimate));
    // Each frame has exactly one encoding.
    let written = frame.encode();
    assert_eq!(Frame::<N>::decode(&written), Ok(frame));
    assert_eq!(written, bytes);
    // A frame with extra or missing bytes is refused.
    for cut in (0..written.len()).step_by(5) {
        assert!(Frame::<N>::decode(&written[..cut]).is_err());
    }
    for bit in (0..8 * written.len()).step_by(29) {
        let mut flipped = written.clone();
        flipped[bit / 8] ^= 1 << (bit % 8);
        assert_eq!(Frame::<N>::decode(&flipped), Err(FrameError::Checksum));
    }
}

/// A simpler inbox with simpler holds.
#[derive(Default)]
struct Model {
    /// The newest frame of each sender, until the next step.
    waiting: BTreeMap<AgentId, Frame<N>>,
    /// The held frame of each sender, with the step that took it over.
    held: BTreeMap<AgentId, (Frame<N>, Tick)>,
}

impl Model {
    /// Returns the expected result of the inbox for `bytes`.
    fn receive(&mut self, bytes: &[u8]) -> Result<(), FrameError> {
        let frame = Frame::<N>::decode(bytes)?;
        let sender = frame.sender;
        if NEIGHBOURS.iter().all(|neighbour| neighbour.id != sender) {
            return Err(FrameError::UnknownSender { sender });
        }
        if self.waiting.get(&sender).is_some_and(|older| !is_newer(&frame, older)) {
            return Err(FrameError::DuplicateSender { sender });
        }
        self.waiting.insert(sender, frame);
        Ok(())
    }

    /// Returns the senders that have said farewell and not been heard from since.
    fn absent(&self) -> Vec<AgentId> {
        let held = self.held.iter().filter(|(_, (frame, _))| frame.is_farewell);
        held.map(|(&sender, _)| sender).collect()
    }

    /// Takes over pending frames that are newer, or after a long silence; returns how many frames
    /// are dropped.
    fn step(&mut self, now: Tick) -> u32 {
        let mut dropped = 0;
        for (sender, frame) in std::mem::take(&mut self.waiting) {
            let stays = self.held.get(&sender).is_some_and(|(held, since)| {
                !is_newer(&frame, held) && now.saturating_sub(*since) <= RESTART_SILENCE
            });
            if stays {
                dropped += 1;
            } else {
                self.held.insert(sender, (frame, now));
            }
        }
        dropped
    }
}

/// Half of all sequence numbers are ahead of any number, across the wrap; ticks do not wrap.
fn is_newer(frame: &Frame<N>, older: &Frame<N>) -> bool {
    let ahead = frame.sequence.wrapping_sub(older.sequence) as i32;
    ahead > 0 || frame.tick > older.tick
}

/// A step takes all frames or none, and all results are finite.
fn check_step(
    params: &AgentParams<'_, N>,
    state: &mut AgentState<N, 1, ParamBuffers>,
    tick: u64,
    inbox: &mut Inbox<N, ParamBuffers>,
    model: &mut Model,
) {
    let (estimate, holds) = (*state.estimate(), state.neighbour_holds().to_vec());
    let network = None::<&InnerNetwork<&[f32]>>;
    match state.step(params, network, tick, &[0.0], inbox) {
        Ok(output) => {
            assert!(all_finite(&output.sample.derivative) && all_finite(state.estimate()));
            let was_absent = model.absent();
            assert_eq!(state.stale_frames(), model.step(tick));
            let has_returned = was_absent.iter().any(|sender| !model.absent().contains(sender));
            for (held, neighbour) in state.neighbour_holds().iter().zip(NEIGHBOURS) {
                let expected = model.held.get(&neighbour.id).map(|(frame, _)| frame);
                assert_eq!(held.map(|held| *held.estimate()), expected.map(|f| f.estimate));
                let numbers = held.map(|held| (held.tick(), held.sequence(), held.is_absent()));
                let frame = expected.map(|frame| (frame.tick, frame.sequence, frame.is_farewell));
                assert_eq!(numbers, frame);
            }
            assert!(!has_returned || output.broadcast.is_some());
            if let Some(frame) = output.broadcast {
                assert_eq!(Frame::<N>::decode(&frame.encode()), Ok(frame));
            }
        }
        Err(error) => {
            assert!(matches!(error, StepError::Diverged));
            assert_eq!(*state.estimate(), estimate);
            assert_eq!(state.neighbour_holds(), holds);
            // Without finite values nothing else can be checked on this agent.
            inbox.clear();
            model.waiting.clear();
        }
    }
}

/// A step takes all frames, and all results and samples are finite.
fn check_field_step(
    params: &AgentParams<'_, N>,
    state: &mut AgentState<N, 1, ParamBuffers>,
    tick: u64,
    inbox: &mut Inbox<N, ParamBuffers>,
) {
    let network = None::<&InnerNetwork<&[f32]>>;
    match state.step(params, network, tick, &[0.0], inbox) {
        Ok(output) => {
            assert!(all_finite(&output.sample.derivative) && all_finite(state.estimate()));
            if let Some(frame) = output.broadcast {
                assert_eq!(Frame::<N>::decode(&frame.encode()), Ok(frame));
            }
        }
        Err(error) => assert!(matches!(error, StepError::Diverged)),
    }
    assert!(inbox.is_empty());
    for held in state.neighbour_holds().iter().flatten() {
        assert!(all_finite(held.estimate()));
        let disturbances = held.announced().iter().flat_map(|a| a.disturbances).collect::<Vec<_>>();
        assert!(disturbances.iter().all(Disturbance::is_finite));
    }
}

/// Measures the first direction and follows the neighbours in the others.
fn field_words() -> Vec<f32> {
    let options = Options {
        digest: 0x1234,
        hold: HoldKind::Model,
        coupling: Coupling::Trees,
        uses_network: false,
        adapts: false,
        has_harmonics: true,
        is_half: false,
        timeout: 3,
        bias_kept: 0.5,
        relay_share: 0.9,
    };
    let identity = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
    let mut words = [&options.words()[..], &identity, &identity, &[-4.0; N], &[4.0; N]].concat();
    for c in 0..N as u8 {
        let direction = Direction {
            output: (c == 0).then_some(0),
            parent: c.checked_sub(1),
            spare: (c > 0).then_some(2),
            is_announced: c < 2,
            scale: 1.0,
            root_gain: 50.0,
            tree_gain: 100.0,
            radius: 0.125,
            model: agent_core::observer::field::disturbance::Model {
                bias_gain: 400.0,
                cosine_gain: 100.0,
                sine_gain: 200.0,
                rotation_cosine: 0.0,
                rotation_sine: 1.0,
                clip: 8.0,
            },
        };
        words.extend(direction.words());
    }
    words
}

fn params() -> AgentParams<'static, N> {
    let observer = ObserverParams {
        output_matrix: OutputMatrix::new(&[[1.0, 0.0, 0.0].into()]).expect("one row"),
        gain: SMatrix::from_diagonal_element(5.0),
        neighbours: &NEIGHBOURS,
    };
    let projection =
        ProjectionParams { radius: 19.0, boundary_layer: 1.0, smoothing: 0.125, smoothness: 1 };
    let outer_law = OuterLawParams { gain: SymmetricMatrix::Scalar(3.0), projection };
    let trigger = TriggerParams { hold_error_weight: 1e4, consensus_weight: 0.5, threshold: 10.0 };
    AgentParams::new(7, 1e-2, observer, outer_law, trigger)
        .expect("parameters in range")
        .with_restart_silence(RESTART_SILENCE)
}
