//! Simulator, offline trainer and reports for a network of agent-core observers.
//!
//! | module | what it is |
//! | --- | --- |
//! | [`scenario`] | a checked experiment, read from a TOML file |
//! | [`plant`] | drift, disturbance and integrators, in f64 |
//! | [`graph`] | who hears whom |
//! | [`engine`] | the run: agents, links, learning cycles, statistics, traces |
//! | [`training`] | offline training of the inner layers |
//! | [`analysis`] | the theorems' constants and bounds, held against a run |
#![forbid(unsafe_code)]

pub mod analysis;
pub mod engine;
pub mod graph;
pub mod plant;
pub mod scenario;
pub mod training;
