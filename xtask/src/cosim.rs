//! Tests co-simulation with the released firmware in the emulator.

use crate::{
    firmware,
    step::{Failure, cargo, run},
};

/// The variable that tells the tests where the firmware is.
const FIRMWARE: &str = "QEMU_MPS2_AN386_FIRMWARE";

/// Builds the emulated board's firmware and runs the tests that need it; the emulator must already
/// be installed.
///
/// # Errors
/// The firmware does not build, or a test fails.
pub(crate) fn test(debian: bool) -> Result<(), Failure> {
    let (_, program) = firmware::emulated(debian)?;
    let mut tests = cargo("test");
    tests.args(["--workspace", "--test", "integration"]);
    tests.args(["cosim_in_qemu", "--", "--ignored"]).env(FIRMWARE, program);
    run(
        "co-simulation with the firmware",
        &mut tests,
        "run `host-sim cosim` to see the first difference or the node that failed",
    )
}
