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
//! | [`figures`], [`report`] | pictures; tables and CSV files |
//! | [`progress`], [`output_file`] | progress bars; files that are whole or not there |
//! | [`tensors`] | networks from and for PyTorch, JAX and NumPy |
//! | [`commands`] | what the command line does |
#![forbid(unsafe_code)]

pub mod analysis;
pub mod commands;
pub mod engine;
pub mod figures;
pub mod graph;
pub mod output_file;
pub mod plant;
pub mod progress;
pub mod report;
pub mod scenario;
pub mod tensors;
pub mod training;
