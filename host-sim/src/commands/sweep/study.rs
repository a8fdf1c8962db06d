//! What describes the results in a folder: `sweep.json` and `scenario.toml`.
//!
//! A study is continued only if everything that its results depend on is the same: the scenario
//! with the changes of `--set`, the cells, seeds and initial states, the part, and the version of this
//! program. A whole study can also be extended, by more seeds and more initial states: the runs that it
//! has are then among those of the new one.

use std::path::Path;

use serde::{Deserialize, Serialize};

use super::earlier;
use super::shard::Shard;
use super::summary::Summary;
use crate::commands::{CommandError, ErrorCode};
use crate::files::input::read_limited;
use crate::files::output::{FileKind, OutputError, write_result};
use crate::scenario::without_files;

/// Name of the description.
pub(super) const NAME: &str = "sweep.json";
/// Name of the scenario, with the changes of `--set`.
pub(super) const SCENARIO: &str = "scenario.toml";

/// Largest description or scenario. \[bytes\]
const BYTES_MAX: u64 = 64 << 20;

const KIND: FileKind = FileKind {
    name: "the description of a sweep",
    recognises: |bytes| serde_json::from_slice::<Study>(bytes).is_ok(),
};

/// What a folder holds before a study is carried out in it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Found {
    Nothing,
    /// The same study.
    Same,
    /// One with fewer seeds or initial states.
    Smaller,
}

/// Everything that the results depend on.
#[derive(Clone, Debug, Deserialize, PartialEq, Serialize)]
pub(super) struct Study {
    /// Version of this program.
    pub(super) host_sim: String,
    /// Name of the scenario.
    pub(super) scenario: String,
    /// Hash of its text, hexadecimal.
    pub(super) scenario_hash: String,
    /// The varied keys.
    pub(super) keys: Vec<String>,
    /// Number of combinations of their values.
    pub(super) cells: usize,
    /// Hash of all of them and of their recordings, hexadecimal.
    pub(super) cells_hash: String,
    /// The first seed.
    pub(super) seed: u64,
    pub(super) seeds: u64,
    pub(super) initial_states: u64,
    /// The part of the study, `K/N`.
    pub(super) shard: String,
    /// Number of runs of this part.
    pub(super) runs: u64,
    /// The command that repeats the study, without its output folder and number of threads; empty if an older
    /// version wrote this.
    #[serde(default)]
    pub(super) command: Vec<String>,
}

impl Study {
    /// The option with the part.
    pub(super) const SHARD: &str = "--shard";

    /// Returns the study in `folder`, or the one whose parts are in folders there, and the text of its
    /// scenario; `None` if there is neither, or if it does not describe the summarised
    /// table, which may be incomplete.
    pub(super) fn of(folder: &Path, summary: &Summary) -> Option<(Self, Option<String>)> {
        let whole = || {
            let mut firsts = (1..=20).map(|digits| folder.join(format!("shard-{:0digits$}", 1)));
            let (part, text) = Self::described(&firsts.find(|part| part.join(NAME).is_file())?)?;
            Some((part.whole(), text))
        };
        let found = Self::described(folder).or_else(whole);
        found.filter(|(study, _)| study.keys == summary.keys && study.runs >= summary.runs())
    }

    fn described(folder: &Path) -> Option<(Self, Option<String>)> {
        let bytes = read_limited(&folder.join(NAME), BYTES_MAX).ok()?;
        let study = serde_json::from_slice(&bytes).ok()?;
        let text = read_limited(&folder.join(SCENARIO), BYTES_MAX).ok();
        Some((study, text.and_then(|text| String::from_utf8(text).ok())))
    }

    /// Returns the study that this is a part of.
    fn whole(mut self) -> Self {
        if let Some(place) = self.command.iter().position(|word| word == Self::SHARD) {
            self.command.truncate(place);
        }
        let runs = self.seeds.saturating_mul(self.initial_states);
        Self {
            runs: runs.saturating_mul(self.cells as u64),
            shard: Shard::WHOLE.to_string(),
            ..self
        }
    }

    /// Checks that a folder holds this study, a smaller one that it extends, or nothing that it would
    /// replace. `text` is that of the scenario, as a copy there has it.
    pub(super) fn find(&self, folder: &Path, text: &str) -> Result<Found, CommandError> {
        let (description, scenario) = (folder.join(NAME), folder.join(SCENARIO));
        let before = read_limited(&description, BYTES_MAX).unwrap_or_default();
        let text_before = read_limited(&scenario, BYTES_MAX).unwrap_or_default();
        let text_before = String::from_utf8_lossy(&text_before);
        if before.is_empty() {
            let other = |path, kind| Err(OutputError::OtherInFolder { path, kind }.into());
            if !text_before.is_empty() && text_before != text {
                return other(scenario, "the scenario of this sweep");
            }
            let earlier = folder.join(earlier::NAME);
            return if earlier.exists() {
                other(earlier, "rows of this sweep")
            } else {
                Ok(Found::Nothing)
            };
        }
        let before: Self = serde_json::from_slice(&before).map_err(|_| {
            CommandError::from(OutputError::OtherInFolder { path: description, kind: KIND.name })
        })?;
        let mut differences = self.differences(&before);
        let (text_before, text) = (without_files(&text_before), without_files(text));
        if text_before != text {
            differences.push(text_difference(&text_before, &text));
        }
        if differences.is_empty() && before.scenario_hash != self.scenario_hash {
            let difference = "the recording or its path (plant.file) differs";
            differences.push(difference.to_owned());
        }
        if differences.is_empty() {
            return Ok(if self.extends(&before) { Found::Smaller } else { Found::Same });
        }
        let folder_shown = folder.display();
        let more =
            if self.is_whole() { " (it can have more --seeds and --initial-states)" } else { "" };
        let text = format!(
            "{folder_shown}: holds a different study: {}; repeat its command to continue it{more}, or choose \
             another folder with --out",
            differences.join(", ")
        );
        Err(CommandError::new(ErrorCode::OutputRefused, text).about(folder))
    }

    /// Writes the description into a folder. `text` is that of the scenario.
    pub(super) fn write(&self, folder: &Path, text: &str) -> Result<(), CommandError> {
        let path = folder.join(NAME);
        write_result(&folder.join(SCENARIO), ANY, |file| file.write_all(text.as_bytes()))?;
        let json = serde_json::to_string_pretty(self)
            .map_err(|error| OutputError::Write { path: path.clone(), error: error.into() })?;
        Ok(write_result(&path, KIND, |file| writeln!(file, "{json}"))?)
    }

    fn is_whole(&self) -> bool {
        self.shard == Shard::WHOLE.to_string()
    }

    /// Whether this whole study has all runs of `before`, which is the same otherwise, and more.
    fn extends(&self, before: &Self) -> bool {
        let (now, before) =
            ([self.seeds, self.initial_states], [before.seeds, before.initial_states]);
        self.is_whole()
            && now != before
            && now.iter().zip(before).all(|(now, before)| *now >= before)
    }

    /// Returns what differs, in words.
    fn differences(&self, before: &Self) -> Vec<String> {
        let shown =
            |text: &str| if text.is_empty() { "nothing".to_owned() } else { text.to_owned() };
        let extends = self.extends(before);
        let pairs = [
            ("host-sim", before.host_sim.clone(), self.host_sim.clone()),
            ("the scenario", before.scenario.clone(), self.scenario.clone()),
            ("what is varied", before.keys.join(" and "), self.keys.join(" and ")),
            ("the number of cells", before.cells.to_string(), self.cells.to_string()),
            ("--seed", before.seed.to_string(), self.seed.to_string()),
            ("--seeds", before.seeds.to_string(), self.seeds.to_string()),
            (
                "--initial-states",
                before.initial_states.to_string(),
                self.initial_states.to_string(),
            ),
            ("--shard", before.shard.clone(), self.shard.clone()),
        ];
        let differs = |(name, before, now): (&str, String, String)| {
            let (there, here) = (shown(&before), shown(&now));
            let is_extended = extends && matches!(name, "--seeds" | "--initial-states");
            (before != now && !is_extended)
                .then(|| format!("{name} is {there} there and {here} here"))
        };
        let mut differences: Vec<String> = pairs.into_iter().filter_map(differs).collect();
        let is_same_base = before.scenario_hash == self.scenario_hash;
        if differences.is_empty() && is_same_base && before.cells_hash != self.cells_hash {
            let difference = "the values of the varied keys differ, or a recording among them";
            differences.push(difference.to_owned());
        }
        differences
    }
}

/// The caller has checked what is replaced.
const ANY: FileKind = FileKind { name: "a scenario", recognises: |_| true };

/// Names the first line that differs.
fn text_difference(before: &str, now: &str) -> String {
    let count = before.lines().count().max(now.lines().count());
    let (mut there, mut here) = (before.lines(), now.lines());
    for number in 1..=count {
        let (there, here) = (there.next().unwrap_or_default(), here.next().unwrap_or_default());
        if there != here {
            return format!("line {number} of {SCENARIO} is `{there}` there and `{here}` here");
        }
    }
    format!("{SCENARIO} has different line endings there")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn study(seeds: u64) -> Study {
        Study {
            host_sim: "1".to_owned(),
            scenario: "paper".to_owned(),
            scenario_hash: "0x0".to_owned(),
            keys: vec!["a".to_owned()],
            cells: 1,
            cells_hash: "0x1".to_owned(),
            seed: u64::MAX,
            seeds,
            initial_states: 1,
            shard: "1/2".to_owned(),
            runs: 7,
            command: Vec::new(),
        }
    }

    #[test]
    fn differences_are_named() {
        assert!(study(3).differences(&study(3)).is_empty());
        assert_eq!(study(3).differences(&study(4)), ["--seeds is 4 there and 3 here"]);
        // Runs of a part belong to other parts if there are more.
        assert_eq!(study(4).differences(&study(3)), ["--seeds is 3 there and 4 here"]);
        let whole = |seeds| Study { shard: "1/1".to_owned(), ..study(seeds) };
        assert!(whole(4).differences(&whole(3)).is_empty());
        assert_eq!(whole(3).differences(&whole(4)), ["--seeds is 4 there and 3 here"]);
        let fewer = Study { initial_states: 2, ..whole(3) };
        assert_eq!(whole(4).differences(&fewer).len(), 2);
        let other = Study { cells_hash: "0x2".to_owned(), ..study(3) };
        assert!(
            study(3).differences(&other)[0].starts_with("the values of the varied keys differ")
        );
        assert_eq!(
            text_difference("a\nb = 1\n", "a\nb = 2\n"),
            "line 2 of scenario.toml is `b = 1` there and `b = 2` here"
        );
        let json = serde_json::to_string_pretty(&study(3)).unwrap();
        assert!((KIND.recognises)(json.as_bytes()));
    }
}
