//! Boots the firmware of the board `stm32f405` in QEMU: `tests/cosim/stm32f405.rs`.

use crate::{
    boards,
    compiler::Compiler,
    emulate,
    firmware::{self, Variant},
    step::{Failure, cargo, run_reading},
};

/// The board, and QEMU's machine for it.
const BOARD: &str = "stm32f405";
const MACHINE: &str = "netduinoplus2";

/// Parts that are not tested there.
const NOT_EMULATED: &str = "the crystal and the PLL (the firmware reports a fault and continues), \
                            I2C1 and therefore the sensor, writing flash, the watchdog, and timing";

/// Builds the variants of the firmware and boots them.
///
/// # Errors
/// A build or a test fails.
pub(crate) fn boot(debian: bool) -> Result<(), Failure> {
    emulate::find_emulators(debian)?;
    let board = boards::find(BOARD)?;
    let compiler = Compiler::find(&[&board.target], debian)?;
    let build = |variant| firmware::build(&compiler, &board, &variant);
    let program = build(Variant::default())?;
    let in_the_loop = build(Variant { in_the_loop: true, ..Variant::default() })?;
    let embassy = build(Variant { feature: Some("embassy".to_owned()), ..Variant::default() })?;
    let mut tests = cargo("test");
    tests.args(["--quiet", "--workspace", "--test", "integration"]);
    tests.args(["cosim::stm32f405::stm32f405_in_qemu", "--", "--ignored"]);
    tests.env("STM32F405_FIRMWARE", program).env("STM32F405_IN_THE_LOOP_FIRMWARE", in_the_loop);
    tests.env("STM32F405_EMBASSY_FIRMWARE", embassy);
    let mut passed = false;
    let hint = "see tests/cosim/stm32f405.rs for the expected behaviour";
    run_reading(&format!("{BOARD} on QEMU's {MACHINE}"), &mut tests, hint, |line| {
        passed |= line.starts_with("test result: ok. 3 passed");
    })?;
    println!("    not emulated by {MACHINE}: {NOT_EMULATED}");
    if passed { Ok(()) } else { Err(Failure::new("boot: no test ran", hint)) }
}
