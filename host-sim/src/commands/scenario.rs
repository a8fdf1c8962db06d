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
            for (name, text) in BUILT_IN {
                // Every file says in its first line what it is.
                let first = text.lines().next().unwrap_or_default().trim_start_matches("# ");
                let more = if first.ends_with('.') { "" } else { " ..." };
                writeln!(output, "{name:12} {first}{more}")?;
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
