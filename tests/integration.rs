//! Every test that needs more than one module or crate, in one binary; a module for each subject.

mod bits;
mod core_against_oracle;
mod core_properties;
mod core_refusals;
mod drawn_network;
mod levenberg_marquardt;
mod oracle;
mod paper_run;
mod scenario_errors;
