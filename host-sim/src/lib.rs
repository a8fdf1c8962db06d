//! Simulator.
#![forbid(unsafe_code)]

pub mod training;
