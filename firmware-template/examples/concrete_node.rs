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
use agent_core::hold::Hold;
use agent_core::inbox::Inbox;
use agent_core::network::{Architecture, NetworkError};
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
}

/// Takes in a received frame.
///
/// # Errors
/// What the inbox refuses.
#[inline(never)]
pub fn receive(
    node: &mut Node,
    params: &AgentParams<'static, N>,
    bytes: &[u8],
) -> Result<(), FrameError> {
    node.inbox.accept(params.neighbours(), bytes)
}

/// Takes one step and returns the frame to broadcast, if one is due.
///
/// # Errors
/// What the agent refuses.
#[inline(never)]
pub fn step(
    node: &mut Node,
    params: &AgentParams<'static, N>,
    tick: u64,
    measurement: &[f32],
) -> Result<Option<FrameBytes>, StepError> {
    let Node { state, inbox, bank, samples } = node;
    let StepOutput { broadcast, sample } =
        state.step(params, bank.active(), tick, measurement, inbox)?;
    samples.offer(&sample);
    Ok(broadcast.map(|frame| frame.encode()))
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
