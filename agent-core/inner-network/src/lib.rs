//! The inner network of an observer: its activations, and its evaluation layer by layer.
//!
//! `agent-core` uses it under the names `math::activation` and `observer::network`. It is a crate of
//! its own because cargo sets the optimisation level per crate: nine tenths of the arithmetic of a
//! step are here, in a twentieth of a node's code. Nothing in it is generic over the state, so all of
//! it is compiled at its own level, whatever that of the firmware.
#![no_std]
#![forbid(unsafe_code)]

pub mod activation;
pub mod network;

/// Largest number of network inputs, and largest state dimension: more with the feature `wide`, for simulators.
pub const INPUTS_MAX: usize = if cfg!(feature = "wide") { 40 } else { 12 };
