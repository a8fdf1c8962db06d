//! Every test that needs more than one module or crate, in one binary.

mod core_against_oracle;
mod drawn_network;
mod oracle;
mod paper_run;
