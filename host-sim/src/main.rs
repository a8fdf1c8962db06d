//! Command line of the simulator: `host-sim help` says what there is.

use std::process::ExitCode;

fn main() -> ExitCode {
    host_sim::commands::main()
}
