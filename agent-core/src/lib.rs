//! One agent of a distributed observer: every node of a sensor network estimates the whole
//! state of a system whose dynamics nobody knows, from its own partial measurement, a deep
//! network, and what its neighbours last broadcast.
//!
//! The crate needs no operating system, no heap and no `unsafe`, and it computes the same
//! bits on every target: only IEEE additions, subtractions, multiplications, divisions and
//! comparisons in single precision, in an order that the source fixes, never fused, never a
//! platform's mathematical library.
//!
//! # The parts, in the order in which a step uses them
//! | module | what it is | equation in the paper |
//! | --- | --- | --- |
//! | [`frame`] | what an agent broadcasts, as bytes | |
//! | [`inbox`] | received frames, checked, waiting for the next step | |
//! | [`hold`] | the sampled estimates of the agent and its neighbours | `x_i_tilde` |
//! | [`activation`], [`network`] | the inner deep network | `Phi func` |
//! | [`observer`] | output error, consensus term, state derivative | `Observer i` |
//! | [`outer_law`], [`projection`] | the adaptation of the outer weights | `What_i Dot` |
//! | [`trigger`] | when to broadcast | `Trigger` |
//! | [`agent`] | parameters, state, and the step that joins all these | |
//! | [`health`] | what goes wrong at run time: counted, and what to do about it | `Zeno Bound` |
//! | [`capture`] | samples for offline training | |
//! | [`serial`], [`service`] | messages on a stream; what a node and a laptop say to each other | |
//! | [`package`] | all of the above parameters as bytes that prove themselves | |
//! | [`checksum`], [`signature`] | against damage; against strangers | |
//! | [`store`] | weight packages in flash, safe against loss of power at any instant | |
//! | [`symmetric`], [`numeric`], [`parameter`], [`region`] | gains; ordered sums; ranges; boxes | |
//!
//! Parameters ([`agent::AgentParams`]) never change and can live in flash; the state
//! ([`agent::AgentState`]) is all that does. Time, measurements and frames are arguments, the
//! frame to broadcast is a return value: nothing here touches a peripheral, except that
//! [`store`] writes through the flash driver that it is given.
#![no_std]
#![forbid(unsafe_code)]

pub mod activation;
pub mod agent;
pub mod capture;
pub mod checksum;
mod codec;
pub mod frame;
pub mod health;
pub mod hold;
pub mod inbox;
pub mod network;
pub mod numeric;
pub mod observer;
pub mod outer_law;
pub mod package;
pub mod parameter;
pub mod projection;
pub mod region;
mod sequence;
pub mod serial;
pub mod service;
pub mod signature;
pub mod store;
pub mod symmetric;
pub mod trigger;

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
