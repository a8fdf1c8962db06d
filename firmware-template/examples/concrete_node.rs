//! One node with every type parameter filled in.
//!
//! Generic code becomes machine code only where it is used with concrete types. This is that
//! place for `cargo xtask cross`, which reads the instructions.
#![no_std]
#![forbid(unsafe_code)]

use agent_core::agent::{AgentParams, AgentState, StepError, StepOutput};
use agent_core::bank::NetworkBank;
use agent_core::capture::CaptureRing;
use agent_core::frame::{FrameBytes, FrameError};
use agent_core::health::{Advice, Health, HealthCounters, HealthParams, HealthSettings};
use agent_core::hold::Hold;
use agent_core::inbox::Inbox;
use agent_core::network::{Architecture, NetworkError};
use agent_core::package::StateBox;
use agent_core::parameter::ParameterError;
use core::{convert::Infallible, hint::black_box};
use embedded_hal::i2c::{ErrorType, I2c, Operation};
use firmware_template::{RegisterSensor, Sensor, registers::ReadError};

/// A bus on which every sensor reads 0 counts, which the compiler does not know.
#[derive(Debug)]
pub struct SilentBus;

impl ErrorType for SilentBus {
    type Error = Infallible;
}

impl I2c for SilentBus {
    fn transaction(&mut self, _: u8, operations: &mut [Operation<'_>]) -> Result<(), Infallible> {
        for operation in operations {
            if let Operation::Read(bytes) = operation {
                bytes.fill(black_box(0));
            }
        }
        Ok(())
    }
}

/// Reads a sensor with three channels.
///
/// # Errors
/// [`ReadError::Length`] if `measurement` does not have three elements.
#[inline(never)]
pub fn read(
    sensor: &mut RegisterSensor<'static, SilentBus, 3>,
    measurement: &mut [f32],
) -> Result<(), ReadError<Infallible>> {
    sensor.read(measurement)
}

/// State dimension, features, neighbours and inner parameters of the paper's agents.
const N: usize = 3;
const FEATURES: usize = 5;
const NEIGHBOURS: usize = 2;
const PARAMETERS: usize = 425;

/// Everything of a node that changes.
#[derive(Debug)]
pub struct Node {
    state: AgentState<N, FEATURES, [Option<Hold<N>>; NEIGHBOURS]>,
    inbox: Inbox<N, [Option<Hold<N>>; NEIGHBOURS]>,
    bank: NetworkBank<PARAMETERS>,
    samples: CaptureRing<N, 64>,
    health: Health,
}

/// What watches over the node, from its package and its user's choice.
///
/// # Errors
/// A setting that is out of its range.
#[inline(never)]
pub fn watch(
    params: &AgentParams<'static, N>,
    trained_box: &StateBox<'_>,
    broadcast_interval_min: f32,
    settings: &HealthSettings,
) -> Result<HealthParams<N>, ParameterError> {
    HealthParams::new(params, trained_box, broadcast_interval_min, settings)
}

/// Takes in a received frame.
///
/// # Errors
/// What the inbox refuses.
#[inline(never)]
pub fn receive(
    node: &mut Node,
    params: &AgentParams<'static, N>,
    watch: &HealthParams<N>,
    bytes: &[u8],
) -> Result<(), FrameError> {
    node.inbox
        .accept_within(params.neighbours(), watch.plausible_region(), bytes)
        .inspect_err(|error| node.health.frame_refused(error))
}

/// Takes one step, or begins anew with the package's outer weights, and returns the frame to
/// broadcast, if one is due.
///
/// # Errors
/// What the agent refuses; the watch has taken notice of it.
#[inline(never)]
pub fn step(
    node: &mut Node,
    params: &AgentParams<'static, N>,
    watch: &HealthParams<N>,
    outer_weights: &[f32],
    tick: u64,
    measurement: &[f32],
) -> Result<Option<FrameBytes>, StepError> {
    let Node { state, inbox, bank, samples, health } = node;
    let network = bank.active().filter(|_| health.network_in_use());
    let outcome = state.step(params, network, tick, measurement, inbox);
    if health.observe(watch, tick, &outcome, state) == Advice::Restart
        && let Ok(frame) = health.restart(watch, params, state, inbox, tick, outer_weights)
    {
        return Ok(Some(frame.encode()));
    }
    let StepOutput { broadcast, sample } = outcome?;
    samples.offer(&sample);
    Ok(broadcast.map(|frame| frame.encode()))
}

/// What there is to report, if it is time to.
#[inline(never)]
pub fn report(node: &mut Node, watch: &HealthParams<N>, tick: u64) -> Option<HealthCounters> {
    node.health.due(watch, tick)
}

/// Switches in a newly trained network.
///
/// # Errors
/// A network that does not fit.
#[inline(never)]
pub fn switch(
    node: &mut Node,
    architecture: Architecture,
    parameters: &[f32],
) -> Result<bool, NetworkError> {
    node.bank.stage(architecture, parameters)?;
    Ok(node.bank.switch())
}
