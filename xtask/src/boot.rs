//! The firmware of the board `stm32f405` in QEMU, as far as that models the chip: `tests/cosim/stm32f405.rs`.

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

/// What a boot there does not show.
const NOT_EMULATED: &str = "the crystal and the PLL (the firmware goes on without them and says so), \
                            I2C1 and so the sensor, writing flash, the watchdog, and time";

/// Builds the firmware in both variants and boots it.
///
/// # Errors
/// It does not build, or does not do what it should.
pub(crate) fn boot(debian: bool) -> Result<(), Failure> {
    emulate::find_emulators(debian)?;
    let board = boards::find(BOARD)?;
    let compiler = Compiler::find(&[&board.target], debian)?;
    let program = firmware::build(&compiler, &board, &Variant::default())?;
    let variant = Variant { in_the_loop: true, public_key: None };
    let in_the_loop = firmware::build(&compiler, &board, &variant)?;
    let mut tests = cargo("test");
    tests.args(["--quiet", "--workspace", "--test", "integration"]);
    tests.args(["cosim::stm32f405::stm32f405_in_qemu", "--", "--ignored"]);
    tests.env("STM32F405_FIRMWARE", program).env("STM32F405_IN_THE_LOOP_FIRMWARE", in_the_loop);
    let mut passed = false;
    let hint = "tests/cosim/stm32f405.rs says what the firmware does first";
    run_reading(&format!("{BOARD} on QEMU's {MACHINE}"), &mut tests, hint, |line| {
        passed |= line.starts_with("test result: ok. 2 passed");
    })?;
    println!("    not emulated by {MACHINE}: {NOT_EMULATED}");
    if passed { Ok(()) } else { Err(Failure::new("boot: it did not run", hint)) }
}
