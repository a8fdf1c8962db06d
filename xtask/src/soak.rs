//! The firmware under everything that can go wrong, for a long time, in emulators: `tests/soak/`.

use crate::{
    emulate, firmware,
    step::{Failure, cargo, run_reading},
};

/// Steps that continuous integration takes.
const STEPS: u64 = 20_000;
/// Any would do; always the same one makes a failure come again.
const SEED: u64 = 1;

/// What `cargo xtask soak` is asked for.
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
    /// Reads `[--steps N] [--seed S]`; `None` if that is not what there is.
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

/// Builds the emulated board's firmware and lets three nodes of it run.
///
/// # Errors
/// The first thing that a node does and should not, or anything that is missing for the soak.
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
    let hint = "the line with the seed says in which step which node went wrong; the same seed and \
                firmware go wrong there again";
    let mut passed = false;
    run_reading("soak", &mut command, hint, |line| {
        passed |= line.starts_with("test result: ok. 1 passed");
    })?;
    if passed { Ok(()) } else { Err(Failure::new("soak: it did not run", "see tests/soak")) }
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
