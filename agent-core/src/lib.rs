//! One agent of a distributed observer: every node of a sensor network estimates the whole
//! state of a system whose dynamics nobody knows, from its own partial measurement, a deep
//! network, and what its neighbours last broadcast.
//!
//! The crate needs no operating system, no heap and no `unsafe`, and it computes the same
//! bits on every target: only IEEE additions, subtractions, multiplications, divisions and
//! comparisons in single precision, in an order that the source fixes, never fused, never a
//! platform's mathematical library.
//!
//! # Modules, bottom up
//! Each one knows only those above it in this table.
//!
//! | module | holds | equations in the paper |
//! | --- | --- | --- |
//! | [`math`] | ordered sums, activations, symmetric matrices, parameter ranges | |
//! | [`wire`] | frames, COBS framing, CRC-32 | |
//! | [`observer`] | network, feedback, outer law, projection, trigger | `Phi func`, `Observer i`, `What_i Dot`, `Trigger` |
//! | [`agent`] | parameters, state, the step; held samples, inbox, capture | `x_i_tilde` |
//! | [`package`] | parameters as bytes: encode, decode, accept, sign, switch in | `Phi_hat` at `T_p` |
//! | [`store`] | packages in flash, safe against loss of power at any instant | |
//! | [`health`] | run-time faults: counters, fall-back, restart | `Zeno Bound` |
//! | [`service`] | requests and responses between a node and a laptop | |
//!
//! Parameters ([`agent::AgentParams`]) never change and can live in flash; the state
//! ([`agent::AgentState`]) is all that does. Time, measurements and frames are arguments, the
//! frame to broadcast is a return value: nothing here touches a peripheral, except that
//! [`store`] writes through the flash driver that it is given.
#![no_std]
#![forbid(unsafe_code)]

pub mod agent;
pub mod health;
pub mod math;
pub mod observer;
pub mod package;
pub mod service;
pub mod store;
pub mod wire;

#[cfg(test)]
mod golden_bytes;

/// Most inputs that a network can have; the largest state dimension.
pub const INPUTS_MAX: usize = 12;

pub use agent::hold::Hold;
pub use agent::inbox::Inbox;
pub use agent::region::{Region, StateBox};
pub use agent::{AgentParams, AgentState, StepError, StepOutput};
pub use health::{Health, HealthCounters, HealthParams, HealthSettings, WatchedAgent, WatchedStep};
pub use math::activation::Activation;
pub use math::symmetric::SymmetricMatrix;
pub use observer::feedback::{Neighbour, ObserverParams, OutputMatrix};
pub use observer::network::{Architecture, InnerNetwork, Layer};
pub use observer::outer_law::OuterLawParams;
pub use observer::projection::ProjectionParams;
pub use observer::trigger::{Trigger, TriggerParams};
pub use package::Package;
pub use store::Store;
pub use wire::frame::Frame;

/// A vector of the state space, shape `[N]`.
pub type StateVector<const N: usize> = nalgebra::SVector<f32, N>;

/// Number of an agent in its network; any scheme will do as long as no two share one.
pub type AgentId = u16;

/// Discrete time: how many steps of length `step_size` lie behind.
pub type Tick = u64;

/// The example in the README is compiled and run, so that it cannot drift.
#[cfg(doctest)]
#[doc = include_str!("../../README.md")]
struct Readme;
