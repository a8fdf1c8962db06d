//! One agent of a distributed observer. Every node of a sensor network estimates the full state of
//! a system with unknown dynamics from its own partial measurement, a deep network, and its
//! neighbours' last broadcasts.
//!
//! The crate needs no operating system and no heap, contains no `unsafe`, and computes the same
//! bits on every target: it uses only single-precision IEEE additions, subtractions,
//! multiplications, divisions and comparisons, in the order the source fixes, never fused and never
//! from a platform's math library.
//!
//! # Modules, bottom up
//! Each module depends only on those above it in this table.
//!
//! | module | contents | equations in the paper |
//! | --- | --- | --- |
//! | [`math`] | ordered sums, activations, symmetric matrices, range checks | |
//! | [`wire`] | frames, COBS framing, CRC-32 | |
//! | [`observer`] | network, feedback, outer law, projection, trigger | `Phi func`, `Observer i`, `What_i Dot`, `Trigger` |
//! | [`agent`] | parameters, state, the step; held samples, inbox, capture | `x_i_tilde` |
//! | [`package`] | weight packages: encode, decode, accept, sign, activate | `Phi_hat` at `T_p` |
//! | [`store`] | packages in flash, safe against power loss at any instant | |
//! | [`health`] | run-time faults: counters, fallback, restart | `Zeno Bound` |
//! | [`service`] | requests and responses between a node and a laptop | |
//!
//! Parameters ([`agent::AgentParams`]) are immutable and can be placed in flash; all mutable data
//! is in the state ([`agent::AgentState`]). Time, measurements and frames are arguments, and the
//! frame to broadcast is a return value: nothing here touches a peripheral, except that [`store`]
//! writes through the flash driver it is given.
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

// The longest frame, and so the verdicts on bytes, depend on the feature.
#[cfg(all(test, feature = "field"))]
mod golden_bytes;

pub use inner_network::INPUTS_MAX;

/// Largest state dimension of a node, and of what it exchanges with a host.
pub const NODE_DIMENSION_MAX: usize = 12;

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

/// A vector in state space, shape `[N]`.
///
/// ```
/// use agent_core::StateVector;
///
/// let estimate = StateVector::<3>::new(5.0, 7.0, 8.0);
/// assert_eq!(estimate - estimate, StateVector::<3>::zeros());
/// ```
pub type StateVector<const N: usize> = nalgebra::SVector<f32, N>;

/// Number of an agent; must be unique within its network.
pub type AgentId = u32;

/// Discrete time: number of elapsed steps of length `step_size`.
pub type Tick = u64;

/// Compiles and runs the README's example, so that it stays correct.
#[cfg(doctest)]
#[doc = include_str!("../../README.md")]
struct Readme;
