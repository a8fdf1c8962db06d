//! Every test that needs more than one module or crate, in one binary; a module for each subject.

mod baselines;
mod bits;
mod borders;
mod command_line;
mod core_against_oracle;
mod core_properties;
mod core_refusals;
#[cfg(unix)]
mod cosim;
#[cfg(unix)]
mod cosim_faults;
#[cfg(unix)]
mod cosim_qemu;
#[cfg(unix)]
mod cosim_service;
#[cfg(unix)]
mod cosim_serving;
mod determinism;
#[cfg(unix)]
mod fake_node;
mod files;
mod flash;
mod health;
mod image;
mod json_documented;
mod levenberg_marquardt;
mod links;
#[cfg(unix)]
mod loop_node;
mod memory_map;
#[cfg(unix)]
mod node_commands;
mod nor_flash;
mod oracle;
mod packages;
mod paper_run;
mod random_network;
mod reproduce;
mod scales;
mod scenario_builder;
mod scenario_errors;
#[cfg(unix)]
mod soak;
mod store_damage;
mod store_histories;
mod store_model;
mod store_packages;
mod store_power_cuts;
mod store_reading;
mod tensors;
mod units;
mod verdicts;
mod watched_ring;
mod watched_runs;
mod weights_commands;
