//! Simulator.
#![forbid(unsafe_code)]

pub mod engine {
    //! Traces only.
    pub mod traces;
}
pub mod figures;
pub mod output_file;
pub mod progress;
pub mod report;
