//! The field observer at the centre of a star: instructions of a step in which all three held samples
//! evolve by their rates, and by the network.
//!
//! A program of its own, because `agent-core` then has another feature.

use agent_core::StateVector;
use agent_core::agent::AgentState;
use agent_core::agent::hold::Hold;
use agent_core::agent::inbox::Inbox;
use agent_core::observer::network::Scratch;
use agent_core::package::{Capacity, Requirements, StepRange, accept};

use crate::Unusable;
use crate::draw::{scaled, triangle};
use crate::meter::{Figure, Figures, Meter};
use crate::node::{FEATURES, N, NEIGHBOURS, ParamBuffers};

/// Number of steps.
const STEPS: u32 = 400;
/// Steps between two frames of a neighbour.
const FRAME_PERIOD: u32 = 40;

/// Numbers are used in place, so a package is aligned to four bytes.
#[repr(C, align(4))]
struct Aligned<const LENGTH: usize>([u8; LENGTH]);

/// Agent 1 of `host-sim run paper --set observer.preset=field --set observer.error=0.014 --set
/// observer.hold=model --set learning.1.shared=true`, seed 0, and the same with `observer.hold=rate`.
static MODEL: &Aligned<LENGTH> = &Aligned(*include_bytes!("../fixtures/field-model.weights"));
static RATE: &Aligned<LENGTH> = &Aligned(*include_bytes!("../fixtures/field-rate.weights"));

/// Bytes of each fixture.
const LENGTH: usize = include_bytes!("../fixtures/field-model.weights").len();

const REQUIREMENTS: Requirements<'static> = Requirements {
    public_keys: &[],
    agent: None,
    highest: None,
    step_range: StepRange::ANY,
    capacity: Capacity {
        features: FEATURES,
        neighbours: NEIGHBOURS,
        gain_entries: N,
        known_inputs: 0,
    },
};

type State = AgentState<N, FEATURES, [Option<Hold<N>>; NEIGHBOURS]>;

/// Counts the instructions of both kinds of steps.
///
/// # Errors
/// If a package is refused, or the agent diverges.
pub fn field(meter: &mut impl Meter) -> Result<Figures, Unusable> {
    let mut figures = Figures::NONE;
    steps(&RATE.0, Figure::FieldRate, meter, &mut figures)?;
    steps(&MODEL.0, Figure::FieldModel, meter, &mut figures)?;
    Ok(figures)
}

#[inline(never)]
fn steps(
    bytes: &'static [u8],
    figure: Figure,
    meter: &mut impl Meter,
    figures: &mut Figures,
) -> Result<(), Unusable> {
    let refused = |what: &'static str| Unusable { what };
    let mut scratch = Scratch::NEW;
    let package = accept::<N>(bytes, &REQUIREMENTS, &mut scratch)
        .map_err(|_| refused("the package with the field observer is refused"))?;
    let mut places = ParamBuffers::EMPTY;
    let params = places.params(&package.node)?;
    let mut state: State =
        AgentState::new(&params, StateVector::zeros(), package.outer_weights, [None; NEIGHBOURS])
            .map_err(|_| refused("the package's agent is invalid"))?;
    state
        .set_field(&params, package.node.field)
        .map_err(|_| refused("the field observer's parameters are invalid"))?;
    let mut inbox = Inbox::new([None; NEIGHBOURS]);
    for tick in 0..STEPS {
        if tick.is_multiple_of(FRAME_PERIOD) && tick > 0 {
            // The neighbours announce what this agent does, so that they predict alike.
            let mut frame = state.announcement(&params);
            (frame.sequence, frame.tick) = (tick / FRAME_PERIOD, tick.into());
            for sender in [2, 3] {
                frame.sender = sender;
                let taken = inbox.accept(params.neighbours(), &frame.encode());
                taken.map_err(|_| refused("a neighbour's frame is refused"))?;
            }
        }
        let measured = [scaled(triangle(tick, 1_500), 10)];
        let (step, instructions) = meter.count(|| {
            taken(&mut state, &params, &package.network, tick.into(), &measured, &mut inbox)
        });
        let is_silent = step.ok_or(refused("a step of the field observer is refused"))?;
        if is_silent && tick > FRAME_PERIOD {
            figures.add(figure, instructions);
        }
    }
    Ok(())
}

/// Takes a step; returns whether it had no broadcast. Not inlined, so that its instructions are those
/// on a node.
#[inline(never)]
fn taken(
    state: &mut State,
    params: &agent_core::AgentParams<'_, N>,
    network: &agent_core::InnerNetwork<&[f32]>,
    tick: u64,
    measured: &[f32],
    inbox: &mut Inbox<N, [Option<Hold<N>>; NEIGHBOURS]>,
) -> Option<bool> {
    let output = state.step(params, Some(network), tick, measured, inbox).ok()?;
    Some(output.broadcast.is_none())
}
