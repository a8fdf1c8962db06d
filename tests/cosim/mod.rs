//! Nodes in lockstep with the simulator, emulated or over sockets, and their faults.

pub(crate) mod fake_node;
mod faults;
pub(crate) mod lockstep;
pub(crate) mod loop_node;
mod polled_node;
mod qemu;
mod service;
mod serving;
mod stm32f405;
