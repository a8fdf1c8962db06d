//! `run.json`: lists a run's result files and how they were produced.

use std::collections::BTreeSet;
use std::fs;
use std::io;
use std::path::Path;

use serde::{Deserialize, Serialize};

use crate::files::input::read_limited;
use crate::files::output::FileKind;
use crate::packages::PackageBytes;
use crate::page;
use crate::report::mcap;
use crate::scenario::Scenario;

/// Name of the file with all points of a frontier.
pub(in crate::commands) const FRONTIER: &str = "frontier.json";

/// Name of the file with all that is reported of a run.
pub(in crate::commands) const RESULTS: &str = "results.json";

/// The kind of that file.
pub(in crate::commands) const RESULTS_KIND: FileKind = FileKind {
    name: "the results of a run",
    recognises: |bytes| bytes.starts_with(b"{\"results\":1,"),
};

/// Name of the page about a run.
pub(in crate::commands) const PAGE: &str = "report.html";

/// The kind of [`FRONTIER`].
pub(in crate::commands) const FRONTIER_KIND: FileKind = FileKind {
    name: "the points of a frontier",
    recognises: |bytes| {
        let has = |key: &[u8]| bytes.windows(key.len()).any(|window| window == key);
        bytes.starts_with(b"{\"scenario\"") && has(b"\"initial_states\"")
    },
};

/// Name of the manifest file.
pub(super) const NAME: &str = "run.json";

/// Maximum size of a manifest: enough for tens of thousands of agents. \[byte\]
const BYTES_MAX: u64 = FileKind::BYTES_MAX;

/// Describes a run and its result files.
#[derive(Debug, Deserialize, PartialEq, Serialize)]
pub(super) struct Manifest {
    /// Version of this program.
    host_sim: String,
    /// Name of the scenario.
    scenario: String,
    /// Hash of its text as in packages, hexadecimal.
    scenario_hash: String,
    /// Random seed.
    seed: u64,
    /// The command line.
    command: Vec<String>,
    /// Whether all files are from this run; `false` if it was interrupted while moving them here.
    pub(super) complete: bool,
    /// Names of the result files, sorted, without the manifest itself.
    pub(super) files: BTreeSet<String>,
}

impl Manifest {
    pub(super) fn new(scenario: &Scenario, seed: u64) -> Self {
        Self {
            host_sim: env!("CARGO_PKG_VERSION").to_owned(),
            scenario: scenario.name.clone(),
            scenario_hash: format!("{:#018x}", scenario.hash),
            seed,
            command: command_line(),
            complete: false,
            files: BTreeSet::new(),
        }
    }

    /// The file kind of manifests.
    pub(super) const KIND: FileKind =
        FileKind { name: "a run's manifest", recognises: |bytes| Self::parse(bytes).is_some() };

    fn parse(bytes: &[u8]) -> Option<Self> {
        let mut manifest: Self = serde_json::from_slice(bytes).ok()?;
        // Security: only plain names of files in this folder are ever touched.
        manifest.files.retain(|name| is_plain(name));
        Some(manifest)
    }

    /// Reads the manifest in `folder`, if there is one.
    pub(super) fn read(folder: &Path) -> Option<Self> {
        let path = folder.join(NAME);
        let is_file = fs::symlink_metadata(&path).is_ok_and(|found| found.is_file());
        let bytes = is_file.then(|| read_limited(&path, BYTES_MAX).ok()).flatten()?;
        Self::parse(&bytes)
    }

    pub(super) fn write(&self, path: &Path) -> io::Result<()> {
        let mut text = serde_json::to_string_pretty(self)?;
        text.push('\n');
        fs::write(path, text)
    }
}

/// Returns the words of this process's command line.
pub(in crate::commands) fn command_line() -> Vec<String> {
    std::env::args_os().map(|word| word.to_string_lossy().into_owned()).collect()
}

/// Returns the command that wrote a folder, if its manifest says so.
pub(in crate::commands) fn command_of(folder: &Path) -> Vec<String> {
    Manifest::read(folder).map(|manifest| manifest.command).unwrap_or_default()
}

/// Returns whether all files of a run's folder are from one run, according to its manifest.
pub(in crate::commands) fn is_complete(folder: &Path) -> bool {
    Manifest::read(folder).is_none_or(|manifest| manifest.complete)
}

/// Returns whether `name` is that of a result directly in the folder.
fn is_plain(name: &str) -> bool {
    let letter = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '.');
    !name.starts_with('.') && name.chars().all(letter) && kind_of(name).is_some()
}

/// Whether files of this name show by their content that they are results; pictures and tables of other programs can
/// look the same.
pub(super) fn shows_origin(name: &str) -> bool {
    [NAME, RESULTS, FRONTIER, PAGE].contains(&name)
}

/// Returns the kind of a result, determined by its name.
pub(super) fn kind_of(name: &str) -> Option<FileKind> {
    match Path::new(name).extension()?.to_str()? {
        "csv" => Some(FileKind::TABLE),
        "svg" => Some(FileKind::SVG),
        "png" => Some(FileKind::PNG),
        "pdf" => Some(FileKind::PDF),
        "parquet" => Some(FileKind::PARQUET),
        "weights" => Some(PackageBytes::KIND),
        "html" => Some(page::KIND),
        "mcap" => Some(mcap::KIND),
        "json" if name == RESULTS => Some(RESULTS_KIND),
        "json" if name == FRONTIER => Some(FRONTIER_KIND),
        "json" => Some(Manifest::KIND).filter(|_| name == NAME),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_names_of_results_in_the_folder_are_taken_from_a_manifest() {
        let mut manifest =
            Manifest::new(&Scenario::parse("paper", crate::scenario::PAPER).unwrap(), 7);
        manifest.files = ["traces.csv", "errors.svg", "errors.pdf", "agent1_cycle1.weights"]
            .iter()
            .map(|&name| name.to_owned())
            .collect();
        let valid = manifest.files.clone();
        let hostile = ["../x.csv", "/etc/x.csv", "a/b.csv", "..", ".hidden.csv", "notes.txt", ""];
        let hostile = hostile.iter().chain(&["a\\b.csv", "C:x.csv", "x.csv\u{0}", "other.json"]);
        manifest.files.extend(hostile.map(|&name| name.to_owned()));
        let text = serde_json::to_vec(&manifest).unwrap();
        assert_eq!(Manifest::parse(&text).unwrap().files, valid);
        assert!(Manifest::parse(&text[..text.len() - 1]).is_none());
        assert!(Manifest::parse(b"{\"files\": [\"traces.csv\"]}").is_none());
    }
}
