//! Simulator, offline trainer and reports for a network of agent-core observers.
//!
//! | module | purpose |
//! | --- | --- |
//! | [`scenario`] | experiments, read from TOML files and checked |
//! | [`plant`] | drift, disturbance and integrators, in f64 |
//! | [`graph`] | the communication graph |
//! | [`agent`], [`frames`] | an agent outside a run; the content of frames |
//! | [`engine`] | runs: agents, links, learning cycles, statistics, traces |
//! | [`training`] | offline training of the inner layers |
//! | [`packages`] | weight packages: creating, checking, reading and writing them |
//! | [`learning`] | from scenarios and recorded samples to packages |
//! | [`offline`] | training on recordings, outside a run |
//! | [`memory_map`] | a board's memory layout, read from its `memory.x` |
//! | [`image`], [`flash`] | weight packages as flash images; flashing them with probe-rs |
//! | [`service`] | client for a running node: packages, samples |
//! | [`cosim`] | co-simulation with real nodes, compared bit for bit |
//! | [`analysis`] | constants and bounds of the theorems, compared with a run |
//! | [`flow`] | design of flow observers: directions, trees, gains, certificates |
//! | [`figures`], [`report`] | figures; tables and CSV files |
//! | [`page`] | a page about results, to look at in a browser |
//! | [`files`], [`number`] | reading and writing files, tables, hashes; number formatting |
//! | [`terminal`] | terminal output |
//! | [`random`] | the random numbers of links, sensors, plant and clocks |
//! | [`shell`], [`interruption`], [`stop`] | quoting of command lines; Ctrl-C and other signals; stop requests |
//! | [`signing`] | signing weight packages with the operator's key |
//! | [`keys`] | an operator's folder of keys: signing, ports of nodes, networks |
//! | [`tensors`] | exchange of networks with PyTorch, JAX and NumPy |
//! | [`error`] | errors with their stable codes |
//! | [`warning`] | warnings about a scenario, a training or a run |
//! | [`commands`] | the command line |
#![forbid(unsafe_code)]
#![deny(clippy::print_stdout, clippy::print_stderr)]

pub mod agent;
pub mod analysis;
pub mod basis;
pub mod commands;
#[cfg(unix)]
pub mod cosim;
pub mod engine;
pub mod error;
pub mod figures;
pub mod files;
pub mod flash;
pub mod flow;
pub mod frames;
pub mod graph;
pub mod image;
pub mod interruption;
pub mod keys;
pub mod learning;
pub mod memory_map;
pub mod number;
pub mod offline;
pub mod packages;
pub mod page;
pub mod plant;
pub mod random;
pub mod report;
mod reported;
pub mod scenario;
#[cfg(unix)]
pub mod service;
pub mod shell;
pub mod signing;
mod spelling;
pub mod stop;
pub mod tensors;
pub mod terminal;
pub mod training;
pub mod warning;
