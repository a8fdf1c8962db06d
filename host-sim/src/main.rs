//! Command line of the simulator; see `host-sim help`.

#![forbid(unsafe_code)]
#![deny(clippy::print_stdout, clippy::print_stderr)]

use std::process::ExitCode;

fn main() -> ExitCode {
    host_sim::commands::main()
}
