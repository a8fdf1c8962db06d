//! `--shard K/N`: one of N contiguous parts of a study's runs.

use std::fmt;
use std::ops::Range;
use std::str::FromStr;

/// A part of a study.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Shard {
    /// From 1.
    number: u64,
    count: u64,
}

impl Shard {
    /// The whole study.
    pub(super) const WHOLE: Self = Self { number: 1, count: 1 };

    /// Whether its table begins with the header.
    pub(super) fn is_first(self) -> bool {
        self.number == 1
    }

    pub(super) fn is_whole(self) -> bool {
        self.count == 1
    }

    /// Returns the part's runs of these in all.
    pub(super) fn of(self, runs: u64) -> Range<u64> {
        let begin = |number: u64| {
            let begin = u128::from(runs) * u128::from(number) / u128::from(self.count);
            u64::try_from(begin).unwrap_or(runs)
        };
        begin(self.number - 1)..begin(self.number)
    }

    /// Returns the name of its folder. Names of all parts sort in the order of their numbers.
    pub(super) fn folder(self) -> String {
        let digits = self.count.to_string().len();
        format!("shard-{:0digits$}", self.number)
    }
}

impl fmt::Display for Shard {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.number, self.count)
    }
}

impl FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parsed = text.split_once('/').and_then(|(number, count)| {
            Some(Self { number: number.parse().ok()?, count: count.parse().ok()? })
        });
        parsed
            .filter(|shard| (1..=shard.count).contains(&shard.number))
            .ok_or_else(|| "write K/N, such as 1/8 for the first of eight parts".to_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_parts_are_contiguous_and_complete() {
        for (runs, count) in [(10, 3), (2, 5), (1000, 7), (0, 2), (u64::MAX, 3)] {
            let mut end = 0;
            for number in 1..=count {
                let part = Shard { number, count }.of(runs);
                assert_eq!(part.start, end);
                assert!(part.end - part.start <= runs / count + 1);
                end = part.end;
            }
            assert_eq!(end, runs);
        }
    }

    #[test]
    fn names_sort_like_numbers() {
        assert_eq!("2/8".parse::<Shard>().unwrap().folder(), "shard-2");
        assert_eq!("2/16".parse::<Shard>().unwrap().folder(), "shard-02");
        for text in ["0/2", "3/2", "1", "1/0", "a/b", "-1/2", ""] {
            assert!(text.parse::<Shard>().is_err(), "{text}");
        }
    }
}
