//! Command line of the simulator: `host-sim help` says what there is.

#![forbid(unsafe_code)]
#![deny(clippy::print_stdout, clippy::print_stderr)]

use std::process::ExitCode;

fn main() -> ExitCode {
    host_sim::commands::main()
}
