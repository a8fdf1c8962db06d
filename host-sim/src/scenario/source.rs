//! The text of a scenario: a built-in one, or a file.

use std::path::Path;

use super::{Change, Scenario, ScenarioError, built_in};

/// The text of a scenario that has not been read yet.
#[derive(Clone, Debug)]
pub struct ScenarioSource {
    /// Its name in errors: the path, or the name of the built-in scenario.
    pub name: String,
    /// The text, as written.
    pub text: String,
}

impl ScenarioSource {
    /// Finds the built-in scenario of that name, or reads the file `path`. A built-in name takes
    /// precedence over a file of the same name; `./NAME` refers to the file.
    ///
    /// # Errors
    /// As [`Scenario::read_text`].
    pub fn find(path: &Path) -> Result<Self, ScenarioError> {
        match path.to_str().and_then(|name| Some((name, built_in(name)?))) {
            Some((name, text)) => Ok(Self { name: name.to_owned(), text: text.to_owned() }),
            None => Ok(Self { name: path.display().to_string(), text: Scenario::read_text(path)? }),
        }
    }

    /// Reads and checks the scenario; returns it with its changed text.
    ///
    /// # Errors
    /// As [`Scenario::parse_changed`].
    pub fn load(&self, changes: &[Change]) -> Result<(Scenario, String), ScenarioError> {
        Scenario::parse_changed(&self.name, &self.text, changes)
    }
}
