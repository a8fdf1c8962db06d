//! `scenario`: prints a built-in scenario.

use std::io::Write;

use clap::Args;

use super::CommandError;
use crate::scenario::BUILT_IN;

/// Arguments of `scenario`.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Name of the scenario; without one, all names are listed
    name: Option<String>,
}

pub(super) fn execute(arguments: &Arguments) -> Result<(), CommandError> {
    let mut output = std::io::stdout().lock();
    match &arguments.name {
        None => {
            for (name, _) in BUILT_IN {
                writeln!(output, "{name}")?;
            }
        }
        Some(wanted) => {
            let Some((_, text)) = BUILT_IN.iter().find(|(name, _)| name == wanted) else {
                let names: Vec<_> = BUILT_IN.iter().map(|(name, _)| *name).collect();
                return Err(CommandError::Usage(format!(
                    "there is no built-in scenario {wanted:?}; choose one of {}",
                    names.join(", ")
                )));
            };
            output.write_all(text.as_bytes())?;
        }
    }
    Ok(())
}
