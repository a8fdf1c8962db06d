//! Every test that needs more than one module or crate, in one binary; a module for each subject.

mod bits;
mod command_line;
mod core_against_oracle;
mod core_properties;
mod core_refusals;
mod described;
mod determinism;
mod drawn_network;
mod health;
mod levenberg_marquardt;
mod links;
mod oracle;
mod paper_run;
mod reproduce;
mod scales;
mod scenario_errors;
mod watched_ring;
