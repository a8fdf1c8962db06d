//! The origin of a recording, as comment lines at the head of its CSV file.
//!
//! ```text
//! # recorded by host-sim 0.1.0
//! # agent: 1
//! # package: version 2, checksum 0x1f2e3d4c
//! # recipe: better
//! # scenario: paper, hash 0x0123456789abcdef
//! # step: 0.001 s
//! ```
//!
//! Unknown fields are omitted. `train` refuses samples from another agent or with a different step, and
//! warns if the scenario differs, because recipes may have been changed on purpose.

use std::fmt::Write;
use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;

use super::RecordingError;
use crate::warning::{Warning, WarningCode};

/// Maximum length of the comments. \[byte\]
const HEAD_MAX: u64 = 1 << 14;

/// The origin of a recording, if known.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RecordingSource {
    /// The agent, from 1.
    pub agent: Option<u64>,
    /// Version and checksum of the package in use at the start.
    pub package: Option<(u32, u32)>,
    /// Training recipe of its network.
    pub recipe: Option<String>,
    /// Name of the scenario.
    pub scenario: Option<String>,
    /// Hash of the scenario's text.
    pub scenario_hash: Option<u64>,
    /// `dt`. \[s\]
    pub step: Option<f64>,
}

impl RecordingSource {
    /// Returns the comment lines for the head of the file.
    #[must_use]
    pub fn head(&self) -> String {
        let mut text = format!("# recorded by host-sim {}\n", env!("CARGO_PKG_VERSION"));
        // Writing into a string cannot fail.
        if let Some(agent) = self.agent {
            let _ = writeln!(text, "# agent: {agent}");
        }
        if let Some((version, checksum)) = self.package {
            let _ = writeln!(text, "# package: version {version}, checksum {checksum:#010x}");
        }
        if let Some(recipe) = &self.recipe {
            let _ = writeln!(text, "# recipe: {}", plain(recipe));
        }
        match (&self.scenario, self.scenario_hash) {
            (None, None) => {}
            (name, hash) => {
                let name = name.as_deref().map_or("unknown".to_owned(), plain);
                let hash = hash.map_or(String::new(), |hash| format!(", hash {hash:#018x}"));
                let _ = writeln!(text, "# scenario: {name}{hash}");
            }
        }
        if let Some(step) = self.step {
            let _ = writeln!(text, "# step: {step} s");
        }
        text
    }

    /// Reads the comments at the head of a file. Unknown lines are ignored. For a pipe, which can
    /// be read only once, nothing is known.
    ///
    /// # Errors
    /// If the file cannot be read.
    pub fn read(path: &Path) -> std::io::Result<Self> {
        let mut source = Self::default();
        if !std::fs::metadata(path)?.is_file() {
            return Ok(source);
        }
        let head = BufReader::new(File::open(path)?.take(HEAD_MAX));
        for line in head.split(b'\n') {
            let line = line?;
            let line = String::from_utf8_lossy(&line);
            let Some(comment) = line.trim_start_matches('\u{feff}').strip_prefix('#') else {
                break;
            };
            if let Some((key, value)) = comment.split_once(':') {
                source.take(key.trim(), value.trim());
            }
        }
        Ok(source)
    }

    fn take(&mut self, key: &str, value: &str) {
        match key {
            "agent" => self.agent = value.parse().ok(),
            "package" => {
                let fields = value.strip_prefix("version ");
                self.package = fields.and_then(|fields| {
                    let (version, checksum) = fields.split_once(", checksum ")?;
                    Some((version.parse().ok()?, u32::try_from(hexadecimal(checksum)?).ok()?))
                });
            }
            "recipe" => self.recipe = Some(value.to_owned()),
            "scenario" => {
                let (name, hash) = match value.rsplit_once(", hash ") {
                    Some((name, hash)) => (name, hexadecimal(hash)),
                    None => (value, None),
                };
                self.scenario = (name != "unknown").then(|| name.to_owned());
                self.scenario_hash = hash;
            }
            "step" => {
                let number = value.trim_end_matches('s').trim().parse().ok();
                self.step = number.filter(|step: &f64| step.is_finite());
            }
            _ => {}
        }
    }

    /// Checks that these samples, read from `path`, are for `agent`, from 1, of this scenario.
    /// Returns a warning if the scenario differs.
    ///
    /// # Errors
    /// If the agent or the step differs.
    pub fn check(
        &self,
        path: &Path,
        agent: usize,
        scenario: &SourceScenario<'_>,
    ) -> Result<Option<Warning>, RecordingError> {
        let wrong = |problem: String, hint: String| {
            Err(RecordingError { path: path.to_owned(), line: None, problem, hint })
        };
        if let Some(own) = self.agent.filter(|&own| own != agent as u64) {
            return wrong(
                format!("samples of agent {own}, not of agent {agent}"),
                format!("give --agent {own}, or a recording of agent {agent}"),
            );
        }
        // The node stores the step in single precision.
        let step = scenario.step as f32;
        if let Some(own) = self.step.filter(|&own| own as f32 != step) {
            return wrong(
                format!(
                    "recorded with a step of {own} s, but scenario {} has {step} s",
                    scenario.name
                ),
                "give the scenario of the node, or record again".to_owned(),
            );
        }
        let other = self.scenario_hash.filter(|&hash| hash != scenario.hash);
        Ok(other.map(|hash| {
            let name = self.scenario.as_deref().unwrap_or("(unnamed)");
            Warning::new(
                WarningCode::OtherScenario,
                format!(
                    "{}: recorded with scenario {name} (hash {hash:#018x}), but this is {} (hash \
                     {:#018x}); ignore this if only recipes were changed, otherwise give the scenario it was recorded with",
                    path.display(),
                    scenario.name,
                    scenario.hash
                ),
            )
        }))
    }
}

/// The scenario that samples are used for.
#[derive(Clone, Copy, Debug)]
pub struct SourceScenario<'s> {
    /// Its name.
    pub name: &'s str,
    /// Hash of its text.
    pub hash: u64,
    /// `dt`. \[s\]
    pub step: f64,
}

/// Replaces control characters with spaces.
fn plain(text: &str) -> String {
    text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect()
}

fn hexadecimal(text: &str) -> Option<u64> {
    u64::from_str_radix(text.strip_prefix("0x")?, 16).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn source() -> RecordingSource {
        RecordingSource {
            agent: Some(2),
            package: Some((7, 0x12_34ab)),
            recipe: Some("better".to_owned()),
            scenario: Some("my, own".to_owned()),
            scenario_hash: Some(0xfedc_ba98_7654_3210),
            step: Some(1e-3),
        }
    }

    #[test]
    fn a_head_round_trips() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("samples.csv");
        for source in [source(), RecordingSource::default()] {
            let text = source.head() + "time [s],xhat1,dxhat1\n# agent: 9\n";
            std::fs::write(&path, text).unwrap();
            assert_eq!(RecordingSource::read(&path).unwrap(), source);
        }
    }

    #[cfg(unix)]
    #[test]
    fn a_pipe_is_not_consumed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("pipe");
        let made = std::process::Command::new("mkfifo").arg(&path).status().unwrap();
        assert!(made.success());
        let text = source().head() + "time [s],xhat1,dxhat1\n0,1,2\n0.5,3,4\n1.0,5,6\n";
        let writer = {
            let path = path.clone();
            std::thread::spawn(move || std::fs::write(path, text))
        };
        assert_eq!(RecordingSource::read(&path).unwrap(), RecordingSource::default());
        let recording = crate::packages::Recording::load(&path, 1, 1).unwrap();
        assert_eq!(recording.samples.inputs(), [1.0, 3.0, 5.0]);
        writer.join().unwrap().unwrap();
    }

    #[test]
    fn a_name_with_control_characters_stays_on_one_line() {
        let source = RecordingSource { recipe: Some("a\n# agent: 3\u{1b}[2J".into()), ..source() };
        let head = source.head();
        assert!(
            !head.contains('\u{1b}') && head.contains("# recipe: a # agent: 3 [2J\n"),
            "{head}"
        );
    }

    #[test]
    fn a_different_agent_or_step_is_refused_and_a_different_scenario_warned_about() {
        let scenario = |hash, step| SourceScenario { name: "paper", hash, step };
        let own = scenario(0xfedc_ba98_7654_3210, 1e-3);
        let path = Path::new("samples.csv");
        assert_eq!(source().check(path, 2, &own).unwrap(), None);
        let error = source().check(path, 1, &own).unwrap_err().to_string();
        let expected = "samples.csv: samples of agent 2, not of agent 1; give --agent 2";
        assert!(error.starts_with(expected), "{error}");
        let other = scenario(own.hash, 2e-3);
        let error = source().check(path, 2, &other).unwrap_err().to_string();
        assert!(error.contains("a step of 0.001 s, but scenario paper has 0.002 s"), "{error}");
        let warning = source().check(path, 2, &scenario(1, 1e-3)).unwrap().unwrap();
        assert_eq!(warning.code, WarningCode::OtherScenario);
        assert!(warning.text.contains("scenario my, own (hash 0xfedcba9876543210)"), "{warning}");
        assert_eq!(RecordingSource::default().check(path, 1, &other).unwrap(), None);
    }
}
