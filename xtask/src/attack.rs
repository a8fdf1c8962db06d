//! Plays strangers against nodes and prints what came of it: `tests/attacks/`.

use std::fs;

use crate::step::{Failure, cargo, run, target_folder};
use crate::{emulate, firmware};

/// Number of tries of each attack.
const TRIES: u64 = 1_000_000;
/// Arbitrary but fixed, so that findings are reproducible.
const SEED: u64 = 1;

/// Arguments of `cargo xtask attack`.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Options {
    tries: u64,
    seed: u64,
    is_json: bool,
}

impl Options {
    /// Reads `[--tries N] [--seed S] [--format text|json]`; `None` if the arguments are invalid.
    pub(crate) fn read(arguments: &[&str]) -> Option<Self> {
        let mut options = Self { tries: TRIES, seed: SEED, is_json: false };
        let mut arguments = arguments.iter();
        while let Some(&argument) = arguments.next() {
            let &value = arguments.next()?;
            match (argument, value) {
                ("--tries", tries) => options.tries = tries.parse().ok().filter(|&n| n > 0)?,
                ("--seed", seed) => options.seed = seed.parse().ok()?,
                ("--format", "json") => options.is_json = true,
                ("--format", "text") => options.is_json = false,
                _ => return None,
            }
        }
        Some(options)
    }
}

/// Makes every attack and prints the outcomes; with `--format json` nothing else is printed.
///
/// # Errors
/// An attack that succeeded, or the attacks cannot be run.
pub(crate) fn attack(options: &Options, debian: bool) -> Result<(), Failure> {
    emulate::find_emulators(debian)?;
    let (_, firmware) = firmware::emulated(debian)?;
    let report = target_folder().join("attack.json");
    let _ = fs::remove_file(&report);
    let mut command = cargo("test");
    // With optimisation: a million tries of each.
    command
        .args(["--quiet", "--workspace", "--release", "--test", "integration"])
        .args(["attacks::report", "--", "--exact", "--ignored", "--nocapture"])
        .env("ATTACK_FIRMWARE", &firmware)
        .env("ATTACK_TRIES", options.tries.to_string())
        .env("ATTACK_SEED", options.seed.to_string())
        .env("ATTACK_REPORT", &report);
    let hint = "see tests/attacks; the same seed and number of tries reproduce it";
    if options.is_json {
        let failed = |reason: String| Failure::new(format!("attack: {reason}"), hint);
        let output = command.output().map_err(|error| failed(error.to_string()))?;
        if !output.status.success() {
            return Err(failed(String::from_utf8_lossy(&output.stderr).into_owned()));
        }
    } else {
        run("attack", &mut command, hint)?;
    }
    let text = fs::read_to_string(&report)
        .map_err(|error| Failure::new(format!("attack: {}: {error}", report.display()), hint))?;
    if options.is_json {
        println!("{text}");
    }
    let harmless =
        |key: &str| text.split(&format!("\"{key}\":")).skip(1).all(|rest| rest.starts_with(['0']));
    if harmless("accepted") && harmless("harm") {
        Ok(())
    } else {
        Err(Failure::new("attack: an attack succeeded", hint))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arguments_can_be_given_in_any_order() {
        let expected = Options { tries: 5, seed: 2, is_json: true };
        let read = Options::read(&["--format", "json", "--seed", "2", "--tries", "5"]);
        assert_eq!(read, Some(expected));
        assert!(Options::read(&[]).is_some_and(|options| !options.is_json));
        for wrong in [&["--tries"][..], &["--tries", "0"], &["--format", "xml"], &["5"]] {
            assert_eq!(Options::read(wrong), None);
        }
    }
}
