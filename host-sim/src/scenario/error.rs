//! What is wrong with a scenario file, where, and how to hint it.

/// Why a scenario cannot be read: file, line, key, problem and hint, in one line of text.
///
/// `paper.toml:17: agents[2].output_matrix: row 1 has 2 entries, the state has 3; give every
/// row 3 entries`
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct ScenarioError {
    /// The file, as it was named.
    pub file: String,
    /// Line of the key or the value, from 1; of the table's head if a key is missing; `None`
    /// if the file cannot be opened.
    pub line: Option<usize>,
    /// Dotted path of the key; entries of lists count from 1. `None` if the text is not TOML.
    pub key: Option<String>,
    /// What is wrong.
    pub problem: String,
    /// What to write instead.
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

/// The candidate that `word` is a slip of the keyboard away from (a letter more, less, other or
/// swapped with its neighbour), if there is one that is nearer than all others. Case counts for
/// nothing.
pub(super) fn closest<'c>(
    word: &str,
    candidates: impl IntoIterator<Item = &'c str>,
) -> Option<&'c str> {
    let lower = word.to_lowercase();
    let near_enough = 1 + word.chars().count() / 5;
    let mut near: Vec<(usize, &str)> = candidates
        .into_iter()
        .map(|candidate| (strsim::osa_distance(&lower, &candidate.to_lowercase()), candidate))
        .filter(|&(distance, _)| distance <= near_enough)
        .collect();
    near.sort_by_key(|&(distance, _)| distance);
    match near[..] {
        [(_, only)] => Some(only),
        [(first, nearest), (second, _), ..] if first < second => Some(nearest),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_what_is_near_is_proposed() {
        let keys = ["duration", "step", "plant_integrator"];
        assert_eq!(closest("durration", keys), Some("duration"));
        assert_eq!(closest("stepp", keys), Some("step"));
        assert_eq!(closest("integrator", keys), None);
        assert_eq!(closest("x", keys), None);
        assert_eq!(closest("Step", keys), Some("step"));
        assert_eq!(closest("setp", keys), Some("step"));
        assert_eq!(closest("rand", ["tan", "cat"]), None);
        assert_eq!(closest("k3", ["k1", "k2"]), None, "one is as near as the other");
    }
}
