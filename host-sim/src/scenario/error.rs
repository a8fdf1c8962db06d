//! What is wrong with a scenario file, where, and how to mend it.

/// Why a scenario cannot be read: file, line, key, problem and mend, in one line of text.
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
    /// Dotted path of the key; entries of lists count from 1. `None` if the text is no TOML.
    pub key: Option<String>,
    /// What is wrong.
    pub problem: String,
    /// What to write instead.
    pub mend: String,
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
        write!(f, ": {}; {}", self.problem, self.mend)
    }
}

impl core::error::Error for ScenarioError {}

/// The candidate nearest to `word` by insertions, deletions and replacements of letters, if one
/// is near enough to be what was meant.
pub(super) fn closest<'c>(
    word: &str,
    candidates: impl IntoIterator<Item = &'c str>,
) -> Option<&'c str> {
    let near_enough = 1 + word.chars().count() / 4;
    candidates
        .into_iter()
        .map(|candidate| (edit_distance(word, candidate), candidate))
        .filter(|&(distance, _)| distance <= near_enough)
        .min_by_key(|&(distance, _)| distance)
        .map(|(_, candidate)| candidate)
}

fn edit_distance(from: &str, to: &str) -> usize {
    let to: Vec<char> = to.chars().collect();
    let mut row: Vec<usize> = (0..=to.len()).collect();
    for (i, from) in from.chars().enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, &to) in to.iter().enumerate() {
            let replaced = diagonal + usize::from(from != to);
            diagonal = row[j + 1];
            row[j + 1] = replaced.min(row[j] + 1).min(row[j + 1] + 1);
        }
    }
    row[to.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances() {
        for (from, to, distance) in
            [("", "", 0), ("", "ab", 2), ("kitten", "sitting", 3), ("gain", "gian", 2)]
        {
            assert_eq!(edit_distance(from, to), distance, "{from} {to}");
            assert_eq!(edit_distance(to, from), distance, "{to} {from}");
        }
    }

    #[test]
    fn only_what_is_near_is_proposed() {
        let keys = ["duration", "step", "plant_integrator"];
        assert_eq!(closest("durration", keys), Some("duration"));
        assert_eq!(closest("stepp", keys), Some("step"));
        assert_eq!(closest("integrator", keys), None);
        assert_eq!(closest("x", keys), None);
    }
}
