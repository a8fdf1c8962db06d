//! Runs the firmware in emulators for a long time, under all kinds of faults; see `tests/soak/`.

use crate::{
    emulate, firmware,
    step::{Failure, cargo, run_reading},
};

/// Number of steps in continuous integration.
const STEPS: u64 = 20_000;
/// Arbitrary but fixed, so that failures are reproducible.
const SEED: u64 = 1;

/// Arguments of `cargo xtask soak`.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Options {
    steps: u64,
    seed: u64,
}

impl Default for Options {
    fn default() -> Self {
        Self { steps: STEPS, seed: SEED }
    }
}

impl Options {
    /// Reads `[--steps N] [--seed S]`; `None` if the arguments are invalid.
    pub(crate) fn read(arguments: &[&str]) -> Option<Self> {
        let mut options = Self::default();
        let mut arguments = arguments.iter();
        while let Some(&argument) = arguments.next() {
            let value = arguments.next()?.parse().ok()?;
            match argument {
                "--steps" if value > 0 => options.steps = value,
                "--seed" => options.seed = value,
                _ => return None,
            }
        }
        Some(options)
    }
}

/// Builds the emulated board's firmware and runs three nodes of it.
///
/// # Errors
/// The first wrong behaviour of a node, or something required is missing.
pub(crate) fn soak(options: &Options, debian: bool) -> Result<(), Failure> {
    emulate::find_emulators(debian)?;
    let (_, program) = firmware::emulated(debian)?;
    let mut command = cargo("test");
    command
        .args(["--quiet", "--workspace", "--test", "integration"])
        .args(["soak::emulated", "--", "--exact", "--ignored", "--nocapture"])
        .env("SOAK_FIRMWARE", &program)
        .env("SOAK_STEPS", options.steps.to_string())
        .env("SOAK_SEED", options.seed.to_string());
    let hint = "the line with the seed names the step and the node that failed; the same seed and \
                firmware reproduce the failure";
    let mut passed = false;
    run_reading("soak", &mut command, hint, |line| {
        passed |= line.starts_with("test result: ok. 1 passed");
    })?;
    if passed { Ok(()) } else { Err(Failure::new("soak: no test ran", "see tests/soak")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_and_seed_can_be_given_in_any_order() {
        assert_eq!(Options::read(&[]), Some(Options::default()));
        let expected = Some(Options { steps: 1_000_000, seed: 7 });
        assert_eq!(Options::read(&["--seed", "7", "--steps", "1000000"]), expected);
        for wrong in [&["--steps"][..], &["--steps", "0"], &["--steps", "many"], &["5"]] {
            assert_eq!(Options::read(wrong), None);
        }
    }
}
