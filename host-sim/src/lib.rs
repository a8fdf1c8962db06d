//! Simulator.
#![forbid(unsafe_code)]

pub mod analysis;
pub mod engine;
pub mod graph;
pub mod plant;
pub mod scenario;
pub mod training;
