//! The co-simulation with the firmware that users get, in the emulator that they use.

use crate::{
    firmware,
    step::{Failure, cargo, run},
};

/// Where the tests find the firmware.
const FIRMWARE: &str = "QEMU_MPS2_AN386_FIRMWARE";

/// Builds the emulated board's firmware and runs the tests that need it; the emulator has been found
/// by then.
///
/// # Errors
/// There is no firmware, or a test fails.
pub(crate) fn test(debian: bool) -> Result<(), Failure> {
    let (_, program) = firmware::emulated(debian)?;
    let mut tests = cargo("test");
    tests.args(["--workspace", "--test", "integration"]);
    tests.args(["cosim_in_qemu", "--", "--ignored"]).env(FIRMWARE, program);
    run(
        "co-simulation with the firmware",
        &mut tests,
        "`host-sim cosim` shows the first difference, or which node failed",
    )
}
