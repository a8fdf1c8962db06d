//! Command line of the simulator: `host-sim help` says what there is.

use std::process::ExitCode;

fn main() -> ExitCode {
    ExitCode::SUCCESS
}
