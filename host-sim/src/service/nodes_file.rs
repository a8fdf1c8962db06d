//! `nodes.json`, which describes the scenario of the nodes in a folder of sockets to their clients.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::files::input::read_limited;
use crate::files::output::{FileKind, OutputError, write_whole};

/// Name of the file.
pub const NAME: &str = "nodes.json";

/// Maximum size of the file. \[byte\]
const LENGTH_MAX: u64 = 1 << 14;

/// Describes the run that serves the nodes in a folder.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct NodesFile {
    /// Name of the scenario.
    pub scenario: String,
    /// Hash of its text, in hexadecimal.
    pub scenario_hash: String,
    /// Seed of the run.
    pub seed: u64,
    /// Id of the process that serves the nodes.
    pub process: u32,
}

impl NodesFile {
    /// The kind of this file.
    pub const KIND: FileKind = FileKind {
        name: "a list of served nodes",
        recognises: |bytes| serde_json::from_slice::<Self>(bytes).is_ok(),
    };

    /// Describes a run of this process.
    #[must_use]
    pub fn new(scenario: &str, hash: u64, seed: u64) -> Self {
        Self {
            scenario: scenario.to_owned(),
            scenario_hash: format!("{hash:#018x}"),
            seed,
            process: std::process::id(),
        }
    }

    /// Reads the file in this folder, if it exists and is valid.
    #[must_use]
    pub fn read(folder: &Path) -> Option<Self> {
        let bytes = read_limited(&folder.join(NAME), LENGTH_MAX).ok()?;
        serde_json::from_slice(&bytes).ok()
    }

    /// Returns whether the name is taken in this folder by something other than such a file.
    #[must_use]
    pub fn is_occupied(folder: &Path) -> bool {
        let there = std::fs::symlink_metadata(folder.join(NAME));
        there.is_ok_and(|there| !there.is_file() || Self::read(folder).is_none())
    }

    /// Writes the file into this folder and returns its path.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub fn write(&self, folder: &Path) -> Result<PathBuf, OutputError> {
        let path = folder.join(NAME);
        write_whole(&path, Self::KIND, |file| {
            serde_json::to_writer(&mut *file, self)?;
            file.write_all(b"\n")
        })?;
        Ok(path)
    }

    /// Returns the hash of the scenario's text.
    #[must_use]
    pub fn hash(&self) -> Option<u64> {
        u64::from_str_radix(self.scenario_hash.strip_prefix("0x")?, 16).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_file_round_trips_and_other_files_are_detected() {
        let folder = tempfile::tempdir().unwrap();
        assert!(!NodesFile::is_occupied(folder.path()));
        let file = NodesFile::new("paper", 0x12, 3);
        let path = file.write(folder.path()).unwrap();
        assert_eq!(NodesFile::read(folder.path()), Some(file.clone()));
        assert_eq!(file.hash(), Some(0x12));
        assert!(!NodesFile::is_occupied(folder.path()));
        std::fs::write(&path, "{\"precious\": 1}").unwrap();
        assert!(NodesFile::is_occupied(folder.path()) && NodesFile::read(folder.path()).is_none());
    }
}
