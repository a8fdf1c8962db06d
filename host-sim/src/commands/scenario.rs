//! `scenario`: prints a built-in scenario.

use std::fmt::Write;

use clap::Args;

use super::{Changes, CommandError, print_text};
use crate::scenario::{BUILT_IN, Scenario};

/// Arguments of `scenario`.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Name of the scenario [default: list all names]
    name: Option<String>,
    #[command(flatten)]
    changes: Changes,
}

pub(super) fn execute(arguments: &Arguments) -> Result<(), CommandError> {
    match &arguments.name {
        None => {
            arguments.changes.refuse_without_scenario()?;
            let mut list = String::new();
            for (name, text) in BUILT_IN {
                // The first line of every file describes it.
                let first = text.lines().next().unwrap_or_default().trim_start_matches("# ");
                let more = if first.ends_with('.') { "" } else { " ..." };
                // Writing into a string cannot fail.
                let _ = writeln!(list, "{name:12} {first}{more}");
            }
            print_text(&list)
        }
        Some(wanted) => {
            let Some((_, text)) = BUILT_IN.iter().find(|(name, _)| name == wanted) else {
                let names: Vec<_> = BUILT_IN.iter().map(|(name, _)| *name).collect();
                return Err(CommandError::usage(format!(
                    "unknown built-in scenario {wanted:?}; choose one of {}",
                    names.join(", ")
                )));
            };
            print_text(&Scenario::parse_changed(wanted, text, &arguments.changes.set)?.1)
        }
    }
}
