//! Simulator, offline trainer and reports for a network of agent-core observers.
//!
//! | module | purpose |
//! | --- | --- |
//! | [`scenario`] | experiments, read from TOML files and checked |
//! | [`plant`] | drift, disturbance and integrators, in f64 |
//! | [`graph`] | the communication graph |
//! | [`engine`] | runs: agents, links, learning cycles, statistics, traces |
//! | [`training`] | offline training of the inner layers |
//! | [`packages`] | weight packages: made, checked, in files |
//! | [`learning`] | from scenarios and recorded samples to packages |
//! | [`memory_map`] | where things lie in a board's memory, read from its `memory.x` |
//! | [`image`], [`flash`] | weight packages as flash images; writing them into a board |
//! | [`service`] | talking to a running node: packages, samples |
//! | [`cosim`] | runs together with nodes that are really there, compared bit for bit |
//! | [`analysis`] | the theorems' constants and bounds, held against a run |
//! | [`figures`], [`report`] | pictures; tables and CSV files |
//! | [`files`], [`number`] | files read and written, tables, hashes; numbers for people |
//! | [`terminal`] | the one place that prints |
//! | [`shell`], [`interruption`], [`stop`] | command lines for people to copy; Ctrl-C and other signals; a request to stop |
//! | [`signing`] | the operator's keys, for packages of weights |
//! | [`tensors`] | networks from and for PyTorch, JAX and NumPy |
//! | [`warning`] | what a person should know about a scenario, a training or a run |
//! | [`commands`] | what the command line does |
#![forbid(unsafe_code)]
#![deny(clippy::print_stdout, clippy::print_stderr)]

pub mod analysis;
pub mod commands;
#[cfg(unix)]
pub mod cosim;
pub mod engine;
pub mod figures;
pub mod files;
pub mod flash;
pub mod graph;
pub mod image;
pub mod interruption;
pub mod learning;
pub mod memory_map;
pub mod number;
pub mod packages;
pub mod plant;
pub mod report;
pub mod scenario;
#[cfg(unix)]
pub mod service;
pub mod shell;
pub mod signing;
pub mod stop;
pub mod tensors;
pub mod terminal;
pub mod training;
pub mod warning;
