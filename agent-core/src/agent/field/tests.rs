//! Tests of the step with the field observer: three agents on a star, each measuring one component.
//! Agent 1, in the middle, is the root of direction 0 and relays 1 and 2.

mod echo;

extern crate std;

use core::num::NonZeroU32;
use std::format;
use std::vec;
use std::vec::Vec;

use nalgebra::SMatrix;
use proptest::prelude::*;

use super::*;
use crate::agent::exchange::ExchangeParams;
use crate::agent::region::Region;
use crate::math::activation::Activation;
use crate::math::symmetric::SymmetricMatrix;
use crate::observer::feedback::{Neighbour, ObserverParams, OutputMatrix};
use crate::observer::field::Options;
use crate::observer::field::disturbance::Model;
use crate::observer::field::tests::words;
use crate::observer::network::{Architecture, InnerNetwork, Layer};
use crate::observer::outer_law::OuterLawParams;
use crate::observer::projection::ProjectionParams;
use crate::observer::trigger::{Trigger, TriggerParams};
use crate::wire::frame::Frame;

const STEP: f32 = 1e-3;
const FEATURES: usize = 4;
const NEIGHBOURS: [&[Neighbour]; 3] = [
    &[Neighbour { id: 2, weight: 1.0 }, Neighbour { id: 3, weight: 1.0 }],
    &[Neighbour { id: 1, weight: 1.0 }],
    &[Neighbour { id: 1, weight: 1.0 }],
];
const OUTER_WEIGHTS: [f32; 3 * FEATURES] =
    [0.5, -0.25, 0.125, 0.75, 0.5, -0.5, -0.25, 0.25, 1.0, 0.5, -0.75, 0.25];

type Network = InnerNetwork<Vec<f32>>;
type Holds = Vec<Option<Hold<3>>>;

fn network() -> Network {
    let layer = Layer { width: FEATURES as u8, activation: Activation::Tanh };
    let architecture = Architecture::new(3, &[layer]).unwrap();
    let parameters = (0..architecture.parameter_count()).map(|k| (k * 7 % 11) as f32 * 0.2 - 1.0);
    InnerNetwork::new(architecture, parameters.collect()).unwrap()
}

fn options(hold: HoldKind) -> Options {
    Options {
        digest: 0x1234,
        hold,
        coupling: Coupling::Trees,
        uses_network: true,
        adapts: false,
        has_harmonics: true,
        is_half: false,
        timeout: 0,
        bias_kept: 0.999,
        relay_share: 0.9,
    }
}

/// Parameters of the agent in place `i` of the star.
fn field(i: usize, options: Options) -> FieldParams<3> {
    let model = Model {
        bias_gain: 400.0,
        cosine_gain: 100.0,
        sine_gain: 200.0,
        rotation_cosine: libm::cosf(0.003),
        rotation_sine: libm::sinf(0.003),
        clip: 8.0,
    };
    let directions = core::array::from_fn(|c| Direction {
        output: (c == i).then_some(0),
        parent: match (i, c) {
            (0, 1) => Some(0),
            (0, 2) => Some(1),
            _ => (c != i).then_some(0),
        },
        spare: None,
        is_announced: i == 0 || c == i,
        scale: 1.0,
        root_gain: 60.0,
        tree_gain: 120.0,
        radius: 0.02,
        model,
    });
    FieldParams {
        options,
        transform: SMatrix::identity(),
        inverse: SMatrix::identity(),
        low: [-5.0; 3].into(),
        high: [5.0; 3].into(),
        directions,
    }
}

fn params(i: usize, exchange: ExchangeParams) -> AgentParams<'static, 3> {
    let mut row = StateVector::zeros();
    row[i] = 1.0;
    let observer = ObserverParams {
        output_matrix: OutputMatrix::new(&[row]).unwrap(),
        gain: SMatrix::from_diagonal_element(60.0),
        neighbours: NEIGHBOURS[i],
    };
    let projection =
        ProjectionParams { radius: 19.0, boundary_layer: 1.0, smoothing: 0.125, smoothness: 1 };
    let outer_law = OuterLawParams { gain: SymmetricMatrix::Scalar(0.5), projection };
    let trigger = TriggerParams { hold_error_weight: 1e4, consensus_weight: 0.0, threshold: 4.0 };
    let params = AgentParams::new(i as u32 + 1, STEP, observer, outer_law, trigger).unwrap();
    params.with_exchange(exchange).unwrap()
}

#[derive(Clone)]
struct Member {
    params: AgentParams<'static, 3>,
    state: AgentState<3, FEATURES, Holds>,
    inbox: Inbox<3, Holds>,
    network: Option<Network>,
    /// Ticks and frames of its broadcasts, as its neighbours decode them.
    sent: Vec<(Tick, Frame<3>)>,
}

impl Member {
    fn new(i: usize, exchange: ExchangeParams) -> Self {
        let params = params(i, exchange);
        let places = vec![None; NEIGHBOURS[i].len()];
        let state =
            AgentState::new(&params, [0.3; 3].into(), &OUTER_WEIGHTS, places.clone()).unwrap();
        let inbox = Inbox::new(places);
        Self { params, state, inbox, network: Some(network()), sent: vec![] }
    }

    fn set(&mut self, field: &FieldParams<3>) {
        self.state.set_field(&self.params, &words(field)).unwrap();
    }

    fn attempt(
        &mut self,
        tick: Tick,
        measurement: Option<f32>,
    ) -> Result<StepOutput<3>, StepError> {
        let measurement = measurement.map(|y| [y]);
        let measurement = measurement.as_ref().map(|y| &y[..]);
        let Self { params, state, inbox, network, .. } = self;
        state.attempt(params, network.as_ref(), tick, measurement, inbox)
    }

    /// Takes a step and returns what it broadcasts, as it arrives.
    fn step(&mut self, tick: Tick, measurement: Option<f32>) -> Option<Frame<3>> {
        let broadcast = self.attempt(tick, measurement).unwrap().broadcast?;
        let frame = Frame::decode(&broadcast.encode()).unwrap();
        assert_eq!(frame, broadcast);
        self.sent.push((tick + 1, frame));
        Some(frame)
    }

    fn hear(&mut self, frame: &Frame<3>) {
        self.inbox.accept(self.params.neighbours(), &frame.encode()).unwrap();
    }

    /// Returns what it holds of this agent.
    fn hold_of(&self, id: u32) -> Option<&Hold<3>> {
        let place = self.params.neighbours().iter().position(|n| n.id == id)?;
        self.state.neighbour_holds()[place].as_ref()
    }

    fn kinds(&self) -> Vec<Option<HoldKind>> {
        self.sent.iter().map(|(_, frame)| frame.announced.map(|a| a.hold)).collect()
    }
}

/// The component that the agent in place `c` measures.
fn plant(c: usize, tick: Tick) -> f32 {
    let t = tick as f32 * STEP;
    [libm::sinf(2.0 * t), 0.7 * libm::cosf(3.0 * t), 0.4 * libm::sinf(5.0 * t + 1.0)][c]
}

#[derive(Clone)]
struct Fleet(Vec<Member>);

impl Fleet {
    fn new(options: Options) -> Self {
        let mut fleet = Self((0..3).map(|i| Member::new(i, ExchangeParams::PAPER)).collect());
        for i in 0..3 {
            fleet.0[i].set(&field(i, options));
        }
        fleet
    }

    fn send(&mut self, sender: usize, frame: &Frame<3>) {
        let id = sender as u32 + 1;
        for member in &mut self.0 {
            if member.params.neighbours().iter().any(|n| n.id == id) {
                member.hear(frame);
            }
        }
    }

    /// Takes a step with all agents; returns which of them broadcast.
    fn step(&mut self, tick: Tick) -> [bool; 3] {
        let sent = [0, 1, 2].map(|i| self.0[i].step(tick, Some(plant(i, tick))));
        for (i, frame) in sent.iter().enumerate() {
            if let Some(frame) = frame {
                self.send(i, frame);
            }
        }
        sent.map(|frame| frame.is_some())
    }

    /// Returns how many ends of edges hold the sample that its sender holds, after a step in which
    /// `sent` are new; all must.
    fn agreements(&self, sent: [bool; 3]) -> usize {
        let mut count = 0;
        for (i, member) in self.0.iter().enumerate().filter(|(i, _)| !sent[*i]) {
            for other in &self.0 {
                if let Some(hold) = other.hold_of(i as u32 + 1) {
                    assert_eq!(bits(hold), bits(member.state.own_hold()));
                    count += 1;
                }
            }
        }
        count
    }
}

/// Bits of a held sample, and of what evolves with it.
fn bits(hold: &Hold<3>) -> Vec<u32> {
    let announced = hold.announced().map(|announced| {
        let disturbances = announced.disturbances.iter();
        let numbers = disturbances.flat_map(|d| [d.bias, d.cosine, d.sine]);
        numbers.chain(announced.rate.iter().copied()).map(f32::to_bits).collect::<Vec<_>>()
    });
    let estimate = hold.estimate().iter().map(|x| x.to_bits());
    estimate.chain(announced.into_iter().flatten()).collect()
}

/// The error of an agent's estimate of the plant.
fn error(member: &Member, tick: Tick) -> f32 {
    let estimate = member.state.estimate().iter().enumerate();
    estimate.fold(0.0, |largest, (c, x)| largest.max((x - plant(c, tick)).abs()))
}

#[test]
fn both_ends_of_an_edge_hold_the_same_bits() {
    for hold in HoldKind::ALL {
        for (is_half, has_harmonics) in [(false, true), (true, true), (true, false)] {
            let mut fleet = Fleet::new(Options { is_half, has_harmonics, ..options(hold) });
            let mut agreements = 0;
            for tick in 0..1_000 {
                let sent = fleet.step(tick);
                agreements += fleet.agreements(sent);
            }
            assert!(agreements > 3_000, "{agreements}");
            for member in &fleet.0 {
                assert!(member.sent.len() > 10);
                assert_eq!(member.sent[0].0, 1);
                assert!(error(member, 1_000) < 0.1, "{hold:?} {}", error(member, 1_000));
                // Before an agent has heard the others it takes them for equal.
                assert!(member.kinds().iter().all(|&kind| kind == Some(hold)));
            }
        }
    }
}

#[test]
fn the_zero_order_hold_keeps_its_sample() {
    let mut fleet = Fleet::new(options(HoldKind::ZeroOrder));
    for tick in 0..300 {
        fleet.step(tick);
        let (_, last) = fleet.0[1].sent.last().unwrap();
        assert_eq!(fleet.0[1].state.own_hold().estimate(), &last.estimate);
    }
}

#[test]
fn agents_with_other_predictions_announce_rates() {
    let mut fleet = Fleet::new(options(HoldKind::Model));
    fleet.0[2].set(&field(2, Options { digest: 0x4321, ..options(HoldKind::Model) }));
    let mut agreements = 0;
    for tick in 0..1_000 {
        let sent = fleet.step(tick);
        // The first announcements are made before anything is heard.
        agreements += if tick > 3 { fleet.agreements(sent) } else { 0 };
    }
    assert!(agreements > 3_000);
    let [middle, same, other] = [0, 1, 2].map(|i| fleet.0[i].kinds());
    for kinds in [&middle, &other] {
        assert_eq!(kinds[0], Some(HoldKind::Model));
        assert!(kinds[1..].iter().all(|&kind| kind == Some(HoldKind::Rate)), "{kinds:?}");
        assert!(kinds.len() > 10);
    }
    // The second agent's only neighbour predicts as it does.
    assert!(same.iter().all(|&kind| kind == Some(HoldKind::Model)));
}

/// A sample that evolves by the model cannot be followed by a neighbour that falls back to feedback, so
/// its sender must not wait for the next event.
#[test]
fn a_neighbour_that_leaves_its_network_gets_a_rate_at_once() {
    let mut fleet = Fleet::new(options(HoldKind::Model));
    (0..500).for_each(|tick| {
        fleet.step(tick);
    });
    fleet.0[1].network = None;
    let sent_before = fleet.0[0].sent.len();
    for tick in 500..502 {
        fleet.step(tick);
    }
    let (tick, frame) = *fleet.0[1].sent.last().unwrap();
    let announced = frame.announced.unwrap();
    assert_eq!((tick, announced.digest, announced.hold), (501, 0, HoldKind::Rate));
    let (tick, frame) = *fleet.0[0].sent.last().unwrap();
    assert_eq!((tick, frame.announced.unwrap().hold), (502, HoldKind::Rate));
    let mut agreements = 0;
    for tick in 502..700 {
        let sent = fleet.step(tick);
        agreements += fleet.agreements(sent);
    }
    assert!(agreements > 600);
    // It does not go on for ever.
    assert!(fleet.0[0].sent.len() - sent_before < 100);
    // And back to the model when the network is back.
    fleet.0[1].network = Some(network());
    (700..1_200).for_each(|tick| {
        fleet.step(tick);
    });
    assert_eq!(fleet.0[0].kinds().last(), Some(&Some(HoldKind::Model)));
    assert_eq!(fleet.0[1].kinds().last(), Some(&Some(HoldKind::Model)));
}

#[test]
fn what_has_not_been_heard_does_nothing() {
    let mut alone = Member::new(0, ExchangeParams::PAPER);
    alone.network = None;
    alone.set(&field(0, options(HoldKind::Rate)));
    for tick in 0..100 {
        alone.step(tick, Some(1.0));
    }
    let estimate = alone.state.estimate();
    assert!(estimate[0] > 0.9 && [estimate[1], estimate[2]] == [0.3; 2]);
    // It announces what it has itself, without disturbances.
    let (_, frame) = alone.sent[0];
    let announced = frame.announced.unwrap();
    assert_eq!((announced.digest, announced.directions), (0, 0b111));
    assert_eq!(announced.disturbances[1], Disturbance::NONE);
    assert_eq!(frame.estimate[1], 0.3);
}

#[test]
fn a_relay_announces_its_parents_sample() {
    for hold in HoldKind::ALL {
        let mut fleet = Fleet::new(options(hold));
        let mut compared = 0;
        for tick in 0..1_000 {
            let sent = fleet.step(tick);
            let relay = &fleet.0[0];
            if !sent[0] || tick < 10 {
                continue;
            }
            let (_, frame) = relay.sent.last().unwrap();
            let announced = frame.announced.unwrap();
            for c in [1, 2] {
                let parent = relay.hold_of(c as u32 + 1).unwrap();
                assert_eq!(announced.disturbance(c), parent.announced().unwrap().disturbance(c));
                let (sample, held) = (frame.estimate[c], parent.estimate()[c]);
                assert!((sample - held).abs() <= 2e-7 * (1.0 + held.abs()), "{sample} {held}");
                compared += 1;
            }
            assert_eq!(frame.estimate[0], relay.state.estimate()[0]);
        }
        assert!(compared > 20);
    }
}

#[test]
fn a_relay_passes_on_what_moves_by_its_share_of_the_radius() {
    // The radius is 0.02; the parent's sample moves by 0.015.
    for (relay_share, passes_on) in [(0.5, true), (0.9, false)] {
        let mut member = Member::new(0, ExchangeParams::PAPER);
        member.network = None;
        member.set(&field(0, Options { relay_share, ..options(HoldKind::ZeroOrder) }));
        for (sequence, from, x) in [(0, 0, 0.3), (1, 200, 0.315)] {
            member.hear(&sample(2, sequence, from, [0.3, x, 0.3]));
            for tick in from..from + 200 {
                member.step(tick, Some(0.3));
            }
        }
        let late = member.sent.iter().any(|(tick, _)| *tick > 200);
        assert_eq!(late, passes_on, "{relay_share}");
    }
}

/// A sample of agent `sender` at `tick`, held constant.
fn sample(sender: u32, sequence: u32, tick: Tick, estimate: [f32; 3]) -> Frame<3> {
    let announced = Announced { digest: 0x1234, ..Announced::NONE };
    Frame { announced: Some(announced), ..Frame::new(sender, sequence, tick, estimate.into()) }
}

#[test]
fn a_silent_parent_is_replaced_by_the_spare_one() {
    let mut member = Member::new(0, ExchangeParams::PAPER);
    member.network = None;
    let mut own = field(0, Options { timeout: 20, ..options(HoldKind::ZeroOrder) });
    own.directions[1].spare = Some(1);
    member.set(&own);
    // Agent 2, the parent, says 1, and agent 3 says -1; the estimate starts at 0.3.
    let mut followed = vec![];
    for tick in 0..100 {
        if tick < 30 && tick % 10 == 0 {
            member.hear(&sample(2, tick as u32, tick, [0.0, 1.0, 0.0]));
        }
        if tick < 60 && tick % 10 == 0 {
            member.hear(&sample(3, tick as u32, tick, [0.0, -1.0, 0.0]));
        }
        let derivative = member.attempt(tick, Some(0.0)).unwrap().sample.derivative[1];
        followed.push(derivative > 0.0);
        if tick == 41 {
            // The relay has announced what it follows now.
            let (frame, own) = (member.state.own_hold(), member.hold_of(3).unwrap());
            assert!((frame.estimate()[1] - own.estimate()[1]).abs() < 1e-6);
        }
    }
    // The parent's last sample is from tick 20, the spare's from 50; then neither is fresh.
    let from_parent = |tick: usize| tick <= 40 || tick > 70;
    let expected: Vec<_> = (0..100).map(from_parent).collect();
    assert_eq!(followed, expected);
}

#[test]
fn a_step_without_a_measurement_goes_on_with_what_is_known() {
    let mut fleet = Fleet::new(options(HoldKind::Model));
    (0..500).for_each(|tick| {
        fleet.step(tick);
    });
    let member = &mut fleet.0[1];
    member.network = None;
    let before = (*member.state.estimate(), member.state.disturbances()[1]);
    let output = member.attempt(500, None).unwrap();
    let (estimate, after) = (member.state.estimate(), member.state.disturbances()[1]);
    let expected = before.0[1] + STEP * (before.1.bias + before.1.cosine);
    assert!((estimate[1] - expected).abs() < 1e-6);
    assert_eq!(after.bias, before.1.bias * 0.999);
    let size = |d: &Disturbance| libm::hypotf(d.cosine, d.sine);
    assert!((size(&after) - size(&before.1)).abs() < 1e-5);
    assert_ne!(after.cosine, before.1.cosine);
    // It still follows its neighbour.
    assert!((output.sample.derivative[0]).is_finite() && estimate[0] != before.0[0]);
    assert_eq!(member.state.output_error(&member.params), [0.0]);
}

#[test]
fn a_refused_step_keeps_the_estimate_and_the_next_one_catches_up() {
    for hold in [HoldKind::ZeroOrder, HoldKind::Rate] {
        let mut fleet = Fleet::new(options(hold));
        (0..500).for_each(|tick| {
            fleet.step(tick);
        });
        let before = fleet.0[0].clone();
        let refusal = fleet.0[0].attempt(500, Some(f32::MAX));
        assert_eq!(refusal, Err(StepError::Diverged));
        let state = &fleet.0[0].state;
        assert_eq!(state.estimate(), before.state.estimate());
        assert_eq!(state.disturbances(), before.state.disturbances());
        assert_eq!(state.own_hold(), before.state.own_hold());
        // Frames are taken over, so none waits for ever.
        assert!(fleet.0[0].inbox.is_empty());
        // The same tick again is the same step as without the refusal.
        let (mut again, mut at_once) = (fleet.0[0].clone(), before);
        again.step(500, Some(0.5));
        at_once.step(500, Some(0.5));
        assert_eq!(again.state.estimate(), at_once.state.estimate());
        assert_eq!(again.state.neighbour_holds(), at_once.state.neighbour_holds());
        // The others do not wait for it; two ticks later all hold the same again.
        for (tick, skipped) in [(500, true), (501, true), (502, false)] {
            for i in 0..3 {
                if i > 0 || !skipped {
                    let measured = plant(i, tick);
                    if let Some(frame) = fleet.0[i].step(tick, Some(measured)) {
                        fleet.send(i, &frame);
                    }
                }
            }
        }
        for (i, j) in [(0, 1), (0, 2), (1, 0), (2, 0)] {
            let sender = &fleet.0[i];
            if sender.sent.last().is_some_and(|(tick, _)| *tick == 503) {
                continue;
            }
            let held = fleet.0[j].hold_of(i as u32 + 1).unwrap();
            let error = difference(held.estimate(), sender.state.own_hold().estimate());
            assert!(error.norm() < 1e-5, "{hold:?} {i} {j}: {error}");
        }
    }
}

#[test]
fn a_restart_begins_without_disturbances_and_announces_itself() {
    let mut fleet = Fleet::new(options(HoldKind::Rate));
    (0..500).for_each(|tick| {
        fleet.step(tick);
    });
    let Member { params, state, .. } = &mut fleet.0[1];
    assert_ne!(state.disturbances(), &[Disturbance::NONE; 3]);
    let frame = state.restart(params, 500, [0.0; 3].into(), &OUTER_WEIGHTS).unwrap();
    // The sample is held constant until the next step announces how it evolves.
    assert_eq!((frame.announced, frame.tick), (None, 501));
    assert_eq!(state.disturbances(), &[Disturbance::NONE; 3]);
    assert_eq!(state.feedback(params), StateVector::<3>::zeros());
    for i in [0, 2] {
        if let Some(frame) = fleet.0[i].step(500, Some(plant(i, 500))) {
            fleet.send(i, &frame);
        }
    }
    fleet.send(1, &frame);
    assert!(fleet.step(501)[1]);
    let (tick, frame) = fleet.0[1].sent.last().unwrap();
    assert_eq!((*tick, frame.announced.map(|a| a.hold)), (502, Some(HoldKind::Rate)));
    for tick in 502..1_500 {
        let sent = fleet.step(tick);
        fleet.agreements(sent);
    }
    assert!(error(&fleet.0[1], 1_500) < 0.1);
}

#[test]
fn the_papers_agent_holds_samples_of_the_field_observer() {
    let mut paper = Member::new(1, ExchangeParams::PAPER);
    let rate = [9.0; 3].into();
    let announced = Announced { hold: HoldKind::Rate, rate, digest: 7, ..Announced::NONE };
    let frame = Frame { announced: Some(announced), ..sample(1, 0, 0, [2.0, 0.5, -1.0]) };
    paper.hear(&frame);
    for tick in 0..50 {
        paper.step(tick, Some(0.0));
        assert_eq!(paper.hold_of(1).unwrap().estimate(), &frame.estimate);
    }
    // It speaks as in the paper.
    assert!(paper.sent.len() > 2 && paper.kinds().iter().all(Option::is_none));
}

#[test]
fn the_field_observer_holds_samples_of_the_papers_agents() {
    let mut member = Member::new(1, ExchangeParams::PAPER);
    member.set(&field(1, options(HoldKind::Model)));
    let frame = Frame::new(1, 0, 0, [2.0, 0.5, -1.0].into());
    member.hear(&frame);
    for tick in 0..500 {
        member.step(tick, Some(0.0));
        assert_eq!(member.hold_of(1).unwrap().estimate(), &frame.estimate);
    }
    let estimate = member.state.estimate();
    assert!((estimate[0] - 2.0).abs() < 0.05 && (estimate[2] + 1.0).abs() < 0.05, "{estimate}");
    // What such a neighbour predicts is not known.
    assert!(member.kinds().iter().all(|&kind| kind == Some(HoldKind::Rate)));
}

#[test]
fn agents_switch_from_the_papers_observer_and_back() {
    let mut fleet = Fleet((0..3).map(|i| Member::new(i, ExchangeParams::PAPER)).collect());
    let mut twin = fleet.clone();
    for tick in 0..200 {
        fleet.step(tick);
        // Setting no field observer changes nothing.
        twin.0.iter_mut().for_each(|m| m.state.set_field(&m.params, &[]).unwrap());
        twin.step(tick);
    }
    for (a, b) in fleet.0.iter().zip(&twin.0) {
        assert_eq!((a.state.estimate(), &a.sent), (b.state.estimate(), &b.sent));
    }
    for i in 0..3 {
        fleet.0[i].set(&field(i, options(HoldKind::Rate)));
    }
    let mut agreements = 0;
    for tick in 200..700 {
        let sent = fleet.step(tick);
        assert!(tick > 200 || sent == [true; 3]);
        agreements += fleet.agreements(sent);
    }
    assert!(agreements > 1_500);
    // An agent that goes back says so at once: its sample no longer evolves.
    let Member { state, params, .. } = &mut fleet.0[1];
    state.set_field(params, &[]).unwrap();
    assert!(state.field().is_none());
    assert!(fleet.step(700)[1]);
    let (_, frame) = fleet.0[1].sent.last().unwrap();
    assert_eq!(frame.announced, None);
    for tick in 701..900 {
        let sent = fleet.step(tick);
        if !sent[1] {
            let held = fleet.0[0].hold_of(2).unwrap();
            assert_eq!(held.estimate(), fleet.0[1].state.own_hold().estimate());
        }
    }
}

#[test]
fn an_agent_that_begins_again_keeps_its_field_observer() {
    let mut fleet = Fleet((0..3).map(|i| Member::new(i, ExchangeParams::PAPER)).collect());
    for i in 0..3 {
        fleet.0[i].set(&field(i, options(HoldKind::Rate)));
    }
    let fresh = format!("{:?}", fleet.0[1].state);
    for tick in 0..50 {
        fleet.step(tick);
    }
    let Member { state, params, .. } = &mut fleet.0[1];
    assert_ne!(format!("{state:?}"), fresh);
    state.begin_again(params, [0.3; 3].into(), &OUTER_WEIGHTS).unwrap();
    state.scratch = Scratch::NEW;
    assert_eq!(format!("{state:?}"), fresh);
    state.begin(params, [0.3; 3].into(), &OUTER_WEIGHTS).unwrap();
    assert!(state.field().is_none());
}

/// An agent that switches later than its neighbour has held the neighbour's sample constant so far.
#[test]
fn samples_that_were_held_constant_catch_up() {
    let rate = StateVector::<3>::new(1.0, -2.0, 0.5);
    let announced = Announced { hold: HoldKind::Rate, rate, digest: 7, ..Announced::NONE };
    let frame = Frame { announced: Some(announced), ..sample(1, 0, 10, [0.0; 3]) };
    let mut member = Member::new(1, ExchangeParams::PAPER);
    (0..10).for_each(|tick| {
        member.step(tick, Some(0.0));
    });
    member.hear(&frame);
    (10..30).for_each(|tick| {
        member.step(tick, Some(0.0));
    });
    member.set(&field(1, options(HoldKind::Rate)));
    for tick in [30, 31, 40, 2_500] {
        member.step(tick, Some(0.0));
        // At the next tick; one Euler step of at most a second for what was missed.
        let time = (tick as f32 + 1.0 - 10.0) * STEP;
        let expected = if tick < 2_000 { rate * time } else { rate * 1.032 };
        let held = member.hold_of(1).unwrap().estimate();
        assert!((held - expected).norm() < 1e-5, "{tick}: {held}");
    }
}

/// A parent that says farewell is no longer followed; when it is back, the samples of all ends agree again.
#[cfg(feature = "exchange")]
#[test]
fn a_fleet_goes_on_without_an_agent_that_stands_still_and_takes_it_back() {
    for hold in HoldKind::ALL {
        let mut fleet = Fleet::new(options(hold));
        (0..400).for_each(|tick| {
            fleet.step(tick);
        });
        let farewell = fleet.0[0].state.farewell(1).unwrap();
        fleet.send(0, &farewell);
        for tick in 400..440 {
            for i in [1, 2] {
                let frame = fleet.0[i].step(tick, Some(plant(i, tick)));
                // Agent 1 cannot hear it.
                assert!(frame.is_none_or(|frame| !frame.is_farewell));
                assert!(fleet.0[i].hold_of(1).unwrap().is_absent());
                let kind = fleet.0[i].kinds().last().copied().flatten();
                assert_eq!(kind, Some(hold), "an absent neighbour does not predict otherwise");
            }
        }
        let before = fleet.0[0].sent.len();
        // All of them broadcast within two steps.
        let first = fleet.step(440);
        assert!(first[0] && fleet.0[0].sent.len() == before + 1);
        let second = fleet.step(441);
        assert!(second[1] && second[2], "{hold:?} {second:?}");
        let mut agreements = 0;
        for tick in 442..700 {
            let sent = fleet.step(tick);
            agreements += fleet.agreements(sent);
        }
        assert!(agreements > 800, "{agreements}");
        for member in &fleet.0 {
            assert!(error(member, 700) < 0.1, "{hold:?} {}", error(member, 700));
        }
    }
}

/// The agent's own model of a disturbance turns by what it has missed, but only after a farewell.
#[cfg(feature = "exchange")]
#[test]
fn oscillations_go_on_while_the_chip_stands_still() {
    let mut fleet = Fleet::new(options(HoldKind::Rate));
    (0..400).for_each(|tick| {
        fleet.step(tick);
    });
    let before = fleet.0[0].state.disturbances()[0];
    let model = field(0, options(HoldKind::Rate)).directions[0].model;
    let mut away = fleet.0[0].clone();
    let mut late = fleet.0[0].clone();
    let _ = away.state.farewell(1).unwrap();
    for (member, steps) in [(&mut away, 501), (&mut late, 1)] {
        member.step(900, None);
        let expected = (0..steps).fold(before, |turned, _| model.rotated(&turned));
        let found = member.state.disturbances()[0];
        assert_eq!((found.cosine, found.sine), (expected.cosine, expected.sine), "{steps}");
        assert!(expected.cosine != before.cosine);
    }
}

#[test]
fn the_exchange_beats_waits_and_repeats() {
    // Without a network and at rest, nothing happens by itself.
    let run = |exchange: ExchangeParams, event: Tick, measured: f32| {
        let mut member = Member::new(1, exchange);
        member.network = None;
        member.set(&field(1, options(HoldKind::ZeroOrder)));
        for tick in 0..100 {
            member.step(tick, Some(if tick < event { 0.3 } else { measured }));
        }
        member.sent.iter().map(|&(tick, _)| tick).collect::<Vec<_>>()
    };
    let off = ExchangeParams::PAPER;
    assert_eq!(run(off, 100, 0.3), [1]);
    assert_eq!(run(ExchangeParams { heartbeat: 30, ..off }, 100, 0.3), [1, 31, 61, 91]);
    let event = run(off, 40, 0.325);
    assert!(event.len() > 1 && event[1] > 41, "{event:?}");
    let repeated = run(ExchangeParams { repeat: 3, ..off }, 40, 0.325);
    assert_eq!(repeated[..3], [1, event[1], event[1] + 3]);
    let apart = run(ExchangeParams { gap: 60, ..off }, 40, 0.4);
    assert_eq!(apart, [1, 61]);
}

#[test]
fn a_late_sample_goes_on_by_its_own_motion() {
    let exchange = ExchangeParams { delay: 7, smoothing: 50, ..ExchangeParams::PAPER };
    for hold in HoldKind::ALL {
        let mut sender = Member::new(0, ExchangeParams::PAPER);
        sender.set(&field(0, options(hold)));
        let mut receiver = Member::new(1, exchange);
        receiver.set(&field(1, options(hold)));
        let mut on_the_way = vec![];
        let mut largest: f32 = 0.0;
        for tick in 0..1_000 {
            on_the_way
                .extend(sender.step(tick, Some(plant(0, tick))).map(|frame| (tick + 8, frame)));
            if let Some(&(_, frame)) = on_the_way.iter().find(|(at, _)| *at == tick) {
                receiver.hear(&frame);
            }
            receiver.step(tick, Some(0.3));
            // Compare when nothing has been on the way for a while.
            let quiet = sender.sent.last().is_none_or(|(sent, _)| sent + 8 <= tick);
            if let (true, Some(held)) = (quiet, receiver.hold_of(1)) {
                assert_eq!(held.lag(), 7);
                let own = sender.state.own_hold().estimate();
                largest = largest.max(difference(held.estimate(), own).norm());
            }
        }
        assert!(sender.sent.len() > 5);
        // The model is advanced by one long step in place of short ones.
        let tolerance = if hold == HoldKind::Model { 1e-3 } else { 1e-6 };
        assert!(largest < tolerance, "{hold:?} {largest}");
    }
}

/// The mean velocity of the paper's observer must not move samples that evolve by themselves.
#[test]
fn the_mean_velocity_ends_with_the_papers_observer() {
    let exchange = ExchangeParams { delay: 20, smoothing: 2, ..ExchangeParams::PAPER };
    let mut member = Member::new(1, exchange);
    for tick in 0..20 {
        member.step(tick, Some(5.0));
    }
    member.set(&field(1, options(HoldKind::ZeroOrder)));
    let frame = sample(1, 0, 0, [1.0, 2.0, 3.0]);
    member.hear(&frame);
    member.step(20, Some(5.0));
    assert_eq!(member.hold_of(1).unwrap().estimate(), &frame.estimate);
}

/// A link's smallest delay is any number of steps in a package.
#[test]
fn an_absurd_delay_does_not_stop_the_agent() {
    let exchange = ExchangeParams { delay: u32::MAX, ..ExchangeParams::PAPER };
    let mut member = Member::new(1, exchange);
    member.set(&field(1, options(HoldKind::Rate)));
    let announced = Announced { hold: HoldKind::Rate, directions: 1, ..Announced::NONE };
    member.hear(&Frame { announced: Some(announced), ..sample(1, 0, 0, [1.0; 3]) });
    for tick in 0..3 {
        member.step(tick, Some(0.0));
    }
}

/// What a neighbour that joins late is told is what the others hold, although the sample has evolved.
#[test]
fn an_answer_brings_the_sample_as_it_is_now() {
    for hold in HoldKind::ALL {
        for is_half in [false, true] {
            let mut fleet = Fleet::new(Options { is_half, ..options(hold) });
            let mut newcomer = Member::new(1, ExchangeParams::PAPER);
            newcomer.set(&field(1, Options { is_half, ..options(hold) }));
            let mut tick = 0;
            // Until the sample has evolved for a while.
            loop {
                fleet.step(tick);
                let own = fleet.0[0].state.own_hold();
                if tick > 300 && tick > own.tick() + 1 {
                    let mut ahead = fleet.clone();
                    if (1..4).all(|later| !ahead.step(tick + later)[0]) {
                        break;
                    }
                }
                tick += 1;
            }
            let (sequence, taken) = {
                let own = fleet.0[0].state.own_hold();
                (own.sequence(), own.tick())
            };
            let answer = fleet.0[0].state.announcement(&fleet.0[0].params);
            let answer = Frame::<3>::decode(&answer.encode()).unwrap();
            assert_eq!((answer.sequence, answer.tick), (sequence, tick + 1));
            assert!(answer.tick > taken);
            newcomer.hear(&answer);
            // The others hear it, too, and go on as before.
            fleet.send(0, &answer);
            let mut compared = 0;
            for tick in tick + 1..tick + 20 {
                newcomer.step(tick, Some(0.0));
                let sent = fleet.step(tick);
                fleet.agreements(sent);
                if sent[0] {
                    break;
                }
                let held = newcomer.hold_of(1).unwrap();
                assert_eq!(bits(held), bits(fleet.0[0].state.own_hold()), "{hold:?} {is_half}");
                compared += 1;
            }
            assert!(compared > 2);
        }
    }
}

/// With `T = 1` and without disturbances, the coupling by held estimates is the paper's observer.
#[test]
fn held_coupling_is_the_papers_observer() {
    let every_step = Trigger::Periodic(NonZeroU32::new(1).unwrap());
    for (trigger, tolerance) in [(Some(every_step), 1e-5), (None, 0.02)] {
        let mut papers = Fleet((0..3).map(|i| Member::new(i, ExchangeParams::PAPER)).collect());
        if let Some(trigger) = trigger {
            for member in &mut papers.0 {
                member.params = member.params.clone().with_trigger(trigger).unwrap();
            }
        }
        let mut fields = papers.clone();
        for i in 0..3 {
            let options = Options {
                coupling: Coupling::Held,
                adapts: true,
                has_harmonics: false,
                ..options(HoldKind::ZeroOrder)
            };
            let mut own = field(i, options);
            for direction in &mut own.directions {
                (direction.tree_gain, direction.model) = (60.0, Model::NONE);
            }
            fields.0[i].set(&own);
        }
        for tick in 0..500 {
            papers.step(tick);
            fields.step(tick);
            for (paper, field) in papers.0.iter().zip(&fields.0) {
                let error = difference(paper.state.estimate(), field.state.estimate()).norm();
                assert!(error < tolerance, "{tick}: {error}");
            }
        }
        for (paper, field) in papers.0.iter().zip(&fields.0) {
            let (paper, field) = (paper.sent.len(), field.sent.len());
            assert!(paper > 50 && paper.abs_diff(field) <= paper / 5, "{paper} {field}");
            assert!(trigger.is_none() || (paper, field) == (500, 500));
        }
    }
}

/// The paper's trigger compares the hold error with the consensus term, both in the state's units.
#[test]
fn the_consensus_term_is_in_the_states_units() {
    let mut member = Member::new(1, ExchangeParams::PAPER);
    let mut own = field(1, Options { coupling: Coupling::Current, ..options(HoldKind::ZeroOrder) });
    own.transform = SMatrix::from_diagonal_element(4.0);
    own.inverse = SMatrix::from_diagonal_element(0.25);
    member.set(&own);
    member.hear(&sample(1, 0, 0, [1.3, 0.3, 0.8]));
    member.step(0, Some(0.3));
    let term = member.state.consensus_term();
    assert!((term - StateVector::<3>::new(1.0, 0.0, 0.5)).norm() < 1e-6, "{term}");
}

proptest! {
    /// Whatever a neighbour announces, within the plausible region, steps do not fail.
    #[test]
    fn no_announcement_makes_a_step_diverge(
        frames in prop::collection::vec(
            (prop::array::uniform3(-100.0..100.0_f32), prop::collection::vec(any::<u32>(), 12), 0..3_usize, 0..8_u16, any::<bool>()),
            1..6,
        ),
        own in 0..3_usize, angle in 0.0..1.5_f32,
    ) {
        let finite = |bits: u32| {
            let number = f32::from_bits(bits);
            if number.is_finite() { number } else { f32::MAX }
        };
        let mut member = Member::new(0, ExchangeParams::PAPER);
        let mut params = field(0, options(HoldKind::ALL[own]));
        for direction in &mut params.directions {
            direction.model.rotation_cosine = libm::cosf(angle);
            direction.model.rotation_sine = libm::sinf(angle);
        }
        member.set(&params);
        let region = Region::new([-100.0; 3].into(), [100.0; 3].into()).unwrap();
        let mut tick = 0;
        for (sequence, (estimate, numbers, hold, directions, same)) in (0..).zip(&frames) {
            let mut numbers = numbers.iter().map(|&bits| finite(bits));
            let mut next = || numbers.next().unwrap_or(0.0);
            let mut announced = Announced {
                digest: if *same { 0x1234 } else { 9 },
                hold: HoldKind::ALL[*hold],
                has_harmonics: true,
                directions: *directions,
                ..Announced::NONE
            };
            if announced.hold == HoldKind::Rate {
                announced.rate = [next(), next(), next()].into();
            }
            for c in 0..3 {
                if announced.announces(c) {
                    announced.disturbances[c] =
                        Disturbance { bias: next(), cosine: next(), sine: next() };
                }
            }
            for sender in [2, 3] {
                let frame = Frame {
                    announced: Some(announced),
                    ..Frame::new(sender, sequence, tick, (*estimate).into())
                };
                let _ = member.inbox.accept_within(NEIGHBOURS[0], &region, &frame.encode());
            }
            for _ in 0..40 {
                // Each broadcast is one that neighbours can decode.
                member.step(tick, Some(0.5));
                tick += 1;
            }
        }
        prop_assert!(member.state.estimate().norm() < 1e4);
    }
}

#[test]
fn what_a_sample_announces_evolves_between_broadcasts() {
    let mut fleet = Fleet::new(options(HoldKind::Rate));
    let params = field(0, options(HoldKind::Rate));
    let (mut compared, mut changed) = (0, 0);
    for tick in 0..500 {
        let before = *fleet.0[0].state.own_hold();
        fleet.step(tick);
        let after = fleet.0[0].state.own_hold();
        if after.sequence() != before.sequence() {
            continue;
        }
        let (Some(before), Some(after)) = (before.announced(), after.announced()) else { continue };
        let mut expected = *before;
        params.move_on(&mut expected);
        assert_eq!(expected, *after, "{tick}");
        compared += 1;
        changed += u32::from(before != after);
    }
    assert!(compared > 100 && changed > 100, "{changed} of {compared}");
}
