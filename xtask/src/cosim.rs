//! The co-simulation with the firmware that users get, in the emulator that they use.

use crate::{
    firmware::{self, BOARDS, EMULATED},
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
    let board = BOARDS.iter().find(|board| board.name == EMULATED);
    let board =
        board.ok_or_else(|| Failure::new("no emulated board", "see xtask/src/firmware.rs"))?;
    let program = firmware::build(board, None, debian)?;
    let mut tests = cargo("test");
    tests.args(["--package", "integration-tests", "--test", "integration"]);
    tests.args(["cosim_in_qemu", "--", "--ignored"]).env(FIRMWARE, program);
    run(
        "co-simulation with the firmware",
        &mut tests,
        "`host-sim cosim` shows the first difference, or which node failed",
    )
}
