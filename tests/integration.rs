//! Every test that needs more than one module or crate, in one binary; a module for each subject.

mod bits;
mod command_line;
mod core_against_oracle;
mod core_properties;
mod core_refusals;
mod described;
mod determinism;
mod drawn_network;
mod flash;
mod image;
mod levenberg_marquardt;
mod links;
mod memory_map;
mod nor_flash;
mod oracle;
mod paper_run;
mod reproduce;
mod scales;
mod scenario_errors;
mod store_damage;
mod store_histories;
mod store_model;
mod store_power_cuts;
mod tensors;
