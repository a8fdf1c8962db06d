//! The simulator, its scenarios, its training, and its verdicts.

mod determinism;
mod embedding;
mod examples;
mod field_observer;
mod known_inputs;
mod levenberg_marquardt;
mod links;
mod lorenz96;
mod methods;
mod networks;
mod packages;
mod paper_run;
mod random_disturbance;
mod recordings;
mod relearning;
pub(crate) mod reproduce;
mod scales;
pub(crate) mod scenario_builder;
mod scenario_errors;
mod tensors;
mod trigger;
mod units;
mod verdicts;
mod watched_runs;
mod wscc9;
