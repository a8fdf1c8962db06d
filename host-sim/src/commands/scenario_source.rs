//! The scenario of a command: a file or a built-in one, with the changes of `--set`.

use std::path::Path;

use clap::Args;

use super::CommandError;
use crate::scenario::{Change, Scenario, ScenarioSource, built_in};
use crate::terminal;

/// Changes of a scenario's keys, an option of every command that reads one.
#[derive(Clone, Debug, Default, Args)]
pub(super) struct Changes {
    /// Change a key of the scenario, such as design.epsilon=500, agents.2.sensor.noise=0.1 or
    /// observer.preset=field; can be given several times
    #[arg(long = "set", value_name = "KEY=VALUE", value_parser = parse)]
    pub(super) set: Vec<Change>,
}

fn parse(text: &str) -> Result<Change, String> {
    Change::parse("--set", text).map_err(|error| error.to_string())
}

impl Changes {
    /// Refuses changes if there is no scenario to apply them to.
    pub(super) fn refuse_without_scenario(&self) -> Result<(), CommandError> {
        match self.set.first() {
            Some(change) => {
                let problem = format!("{change}: there is no scenario to change; name one");
                Err(CommandError::usage(problem))
            }
            None => Ok(()),
        }
    }
}

/// Finds the text of a scenario, as [`ScenarioSource::find`] does, and says so if a file of the same name is passed over.
pub(super) fn find(path: &Path) -> Result<ScenarioSource, CommandError> {
    let source = ScenarioSource::find(path)?;
    // A path such as ./NAME is not the name.
    if built_in(&source.name).is_some() && path.is_file() {
        let name = &source.name;
        terminal::note(format_args!(
            "using the built-in scenario {name}; write ./{name} to use the file of that name"
        ));
    }
    Ok(source)
}

/// Loads the built-in scenario of that name, or the file `path`, with these changes.
pub(super) fn load_scenario(path: &Path, changes: &Changes) -> Result<Scenario, CommandError> {
    Ok(load_with_text(path, changes)?.0)
}

/// Like [`load_scenario`]; also returns the changed text.
pub(super) fn load_with_text(
    path: &Path,
    changes: &Changes,
) -> Result<(Scenario, String), CommandError> {
    Ok(find(path)?.load(&changes.set)?)
}
