//! Scenario errors: what is wrong in the file, where, and how to fix it.

use crate::spelling::nearest;

/// Why a scenario cannot be read. Formatted as one line: file, line, key, problem and hint.
///
/// `paper.toml:17: agents[2].output_matrix: row 1 has 2 entries, expected 3 (the dimension of the
/// state); write 3 entries in every row`
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct ScenarioError {
    /// The file, as the user named it.
    pub file: String,
    /// Line of the key or value, from 1; the line of the table header if a key is missing. `None`
    /// if the file cannot be opened.
    pub line: Option<usize>,
    /// Dotted path of the key; list entries count from 1. After the change that the error is about,
    /// if there is one: `--set design.epsilon=-1: design.epsilon`. `None` if the text is not TOML.
    pub key: Option<String>,
    /// What is wrong.
    pub problem: String,
    /// How to fix it.
    pub hint: String,
}

impl core::fmt::Display for ScenarioError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "{}", self.file)?;
        if let Some(line) = self.line {
            write!(f, ":{line}")?;
        }
        if let Some(key) = &self.key {
            write!(f, ": {key}")?;
        }
        write!(f, ": {}; {}", self.problem, self.hint)
    }
}

impl core::error::Error for ScenarioError {}

/// Returns the candidate that is one typo away from `word` (a letter added, missing, replaced or
/// swapped with its neighbour), if exactly one candidate is closest. Ignores case.
pub(super) fn closest<'c>(
    word: &str,
    candidates: impl IntoIterator<Item = &'c str>,
) -> Option<&'c str> {
    let lower = word.to_lowercase();
    let near_enough = 1 + word.chars().count() / 5;
    let distance = |candidate: &str| strsim::osa_distance(&lower, &candidate.to_lowercase());
    nearest(candidates, distance, near_enough)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn suggests_only_close_matches() {
        let keys = ["duration", "step", "plant_integrator"];
        assert_eq!(closest("durration", keys), Some("duration"));
        assert_eq!(closest("stepp", keys), Some("step"));
        assert_eq!(closest("integrator", keys), None);
        assert_eq!(closest("x", keys), None);
        assert_eq!(closest("Step", keys), Some("step"));
        assert_eq!(closest("setp", keys), Some("step"));
        assert_eq!(closest("rand", ["tan", "cat"]), None);
        assert_eq!(closest("k3", ["k1", "k2"]), None, "both are equally close");
    }
}
