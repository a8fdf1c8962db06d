//! Nodes of a running co-simulation, offered to others.
use agent_core::Tick;
use super::board::Turn;
use super::fault::Fault;
use super::lockstep::LoopNode;
use super::{CosimError, Service};
use crate::engine::companion::Switch;
use crate::packages::PackageBytes;
use crate::scenario::Scenario;

pub(super) struct Relay;

impl Relay {
    pub(super) fn new(_: &Service, _: &Scenario) -> Result<Self, CosimError> { Ok(Self) }
    pub(super) fn begin(&mut self, _: Vec<PackageBytes>) -> Result<(), CosimError> { Ok(()) }
    pub(super) fn learned(&mut self, _: &[Switch]) {}
    pub(super) fn between_steps(&mut self, _: Tick, _: &mut [LoopNode], _: &mut Vec<Switch>) -> Result<(), (usize, Fault)> { Ok(()) }
    pub(super) fn pass_on(&mut self, _: usize, _: &Turn) {}
}
