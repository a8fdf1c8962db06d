//! Command line of the simulator: `host-sim help` says what there is.

#![forbid(unsafe_code)]

use std::process::ExitCode;

fn main() -> ExitCode {
    host_sim::commands::main()
}
