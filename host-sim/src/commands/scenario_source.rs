//! The scenario of a command: a file or a built-in one, with the changes of `--set`.

use std::path::Path;

use clap::Args;

use super::CommandError;
use crate::scenario::{Change, Scenario, built_in};
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

/// The text of a scenario that has not been read yet.
#[derive(Clone, Debug)]
pub(super) struct ScenarioSource {
    /// Its name in errors: the path, or the name of the built-in scenario.
    pub(super) name: String,
    pub(super) text: String,
}

impl ScenarioSource {
    /// Finds the built-in scenario of that name, or reads the file `path`. A built-in name takes
    /// precedence over a file of the same name; `./NAME` refers to the file.
    pub(super) fn find(path: &Path) -> Result<Self, CommandError> {
        let Some((name, text)) = path.to_str().and_then(|name| Some((name, built_in(name)?)))
        else {
            return Ok(Self { name: path.display().to_string(), text: Scenario::read_text(path)? });
        };
        if path.is_file() {
            terminal::note(format_args!(
                "using the built-in scenario {name}; write ./{name} to use the file of that name"
            ));
        }
        Ok(Self { name: name.to_owned(), text: text.to_owned() })
    }

    /// Reads and checks the scenario; returns it with its changed text.
    pub(super) fn load(&self, changes: &[Change]) -> Result<(Scenario, String), CommandError> {
        Ok(Scenario::parse_changed(&self.name, &self.text, changes)?)
    }
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
    ScenarioSource::find(path)?.load(&changes.set)
}
