//! Every test that needs more than one module or crate, in one binary.

mod bits;
mod core_against_oracle;
mod core_properties;
mod core_refusals;
mod drawn_network;
mod oracle;
mod paper_run;
