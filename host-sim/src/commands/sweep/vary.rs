//! `--vary KEY=SPEC`: a key of the scenario and the values that it takes.
//!
//! | SPEC | values |
//! | --- | --- |
//! | `a,b,c` | these, each a TOML value or a string without quotes |
//! | `lo:hi:N` | N, evenly spaced |
//! | `lo:hi:logN` | N, evenly spaced on a logarithmic scale |
//! | `lo:hi`, `lo:hi:log` | with `--latin`: the range that values are drawn from |
//!
//! Numbers of a range are rounded to 12 significant digits, so that tables can be read. If both ends
//! are written as integers, those in between that are whole numbers are integers, too.

use std::str::FromStr;

/// Digits of the numbers of a range.
const DIGITS: usize = 12;
/// Most values of one key.
const VALUES_MAX: usize = 1_000_000;

/// A varied key.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Vary {
    /// As written on the command line.
    pub(super) text: String,
    pub(super) key: String,
    pub(super) spec: Spec,
}

/// The values of a varied key.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Spec {
    /// As written.
    List(Vec<String>),
    Range(Range),
}

/// Numbers between two ends.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Range {
    low: f64,
    high: f64,
    is_logarithmic: bool,
    /// Whether both ends are written as integers.
    is_whole: bool,
    /// `None` for values that are drawn.
    count: Option<usize>,
}

impl FromStr for Vary {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let example =
            "write KEY=SPEC, such as design.epsilon=100:10000:log9 or observer.preset=paper,field";
        let (key, spec) =
            text.split_once('=').ok_or_else(|| format!("has no values; {example}"))?;
        let (key, spec) = (key.trim().to_owned(), spec.trim());
        if key.is_empty() || spec.is_empty() {
            return Err(format!("is incomplete; {example}"));
        }
        let spec = match range(spec)? {
            Some(range) => Spec::Range(range),
            None => Spec::List(list(spec)?),
        };
        Ok(Self { text: text.to_owned(), key, spec })
    }
}

impl Spec {
    /// Returns all values as TOML; `None` for a range that values are drawn from.
    pub(super) fn values(&self) -> Option<Vec<String>> {
        match self {
            Self::List(values) => Some(values.clone()),
            Self::Range(range) => range.values(),
        }
    }
}

impl Range {
    fn values(&self) -> Option<Vec<String>> {
        let last = self.count?.saturating_sub(1).max(1) as f64;
        Some((0..self.count?).map(|k| self.at(k as f64 / last)).collect())
    }

    /// Whether values are to be drawn from it.
    pub(super) fn is_drawn(&self) -> bool {
        self.count.is_none()
    }

    /// Returns the number at a part of the range, 0 to 1, as TOML.
    pub(super) fn at(&self, part: f64) -> String {
        let Self { low, high, .. } = *self;
        let number = if part <= 0.0 {
            low
        } else if part >= 1.0 {
            high
        } else if self.is_logarithmic {
            // Neither power overflows, while high / low can.
            libm::pow(low, 1.0 - part) * libm::pow(high, part)
        } else if (high - low).is_finite() {
            low + part * (high - low)
        } else {
            low * (1.0 - part) + high * part
        };
        let number: f64 = format!("{number:.*e}", DIGITS - 1).parse().unwrap_or(number);
        if self.is_whole && number.fract() == 0.0 && number.abs() < 1e15 {
            return format!("{number:.0}");
        }
        ryu::Buffer::new().format(number).to_owned()
    }
}

/// Reads `lo:hi`, `lo:hi:N`, `lo:hi:log` or `lo:hi:logN`; `None` if this is a list.
fn range(spec: &str) -> Result<Option<Range>, String> {
    let parts: Vec<&str> = spec.split(':').map(str::trim).collect();
    let (low, high, scale) = match parts[..] {
        [low, high] => (low, high, ""),
        [low, high, scale] => (low, high, scale),
        _ => return Ok(None),
    };
    let (Ok(first), Ok(last)) = (low.parse::<f64>(), high.parse::<f64>()) else { return Ok(None) };
    if !(first.is_finite() && last.is_finite() && first < last) {
        return Err(format!("{low}:{high} is not a range; write the smaller number first"));
    }
    let (is_logarithmic, count) = match scale.strip_prefix("log") {
        Some(count) => (true, count),
        None => (false, scale),
    };
    if is_logarithmic && first <= 0.0 {
        return Err(format!("{low} has no logarithm; use a number above 0, or leave log out"));
    }
    let count = match count {
        "" => None,
        count => {
            let number = count.parse().ok().filter(|number| (2..=VALUES_MAX).contains(number));
            Some(number.ok_or_else(|| {
                format!("{count:?} is not a valid count of values; write 2 to {VALUES_MAX}, such as 9 or log9")
            })?)
        }
    };
    let is_whole = [low, high].iter().all(|end| end.parse::<i64>().is_ok());
    Ok(Some(Range { low: first, high: last, is_logarithmic, is_whole, count }))
}

/// Splits a list at its commas, but not inside brackets and quotes.
fn list(spec: &str) -> Result<Vec<String>, String> {
    let (mut values, mut depth, mut quote) = (vec![String::new()], 0usize, None);
    let wrong = |what: &str, hint: &str| format!("{spec} has {what}; {hint}");
    let mut is_escaped = false;
    for c in spec.chars() {
        let begins = values.last().is_some_and(|value| value.trim().is_empty());
        match (quote, c) {
            _ if is_escaped => {}
            (None, ',') if depth == 0 => {
                values.push(String::new());
                continue;
            }
            (None, '[' | '{' | '(') => depth += 1,
            (None, ']' | '}' | ')') => {
                depth = depth.checked_sub(1).ok_or_else(|| {
                    wrong("a bracket that is not opened", "remove it, or put the value in quotes")
                })?;
            }
            // Within a word it is an apostrophe.
            (None, '"' | '\'') if depth > 0 || begins => quote = Some(c),
            (Some(open), c) if c == open => quote = None,
            _ => {}
        }
        is_escaped = quote == Some('"') && c == '\\' && !is_escaped;
        if let Some(last) = values.last_mut() {
            last.push(c);
        }
    }
    if depth > 0 || quote.is_some() {
        let what = if quote.is_some() { "a quote" } else { "a bracket" };
        return Err(wrong(&format!("{what} that is not closed"), "close it"));
    }
    let values: Vec<String> = values.into_iter().map(|value| value.trim().to_owned()).collect();
    if values.iter().any(String::is_empty) {
        return Err("has an empty value; write values separated by commas".to_owned());
    }
    Ok(values)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn values(text: &str) -> Vec<String> {
        text.parse::<Vary>().unwrap().spec.values().unwrap()
    }

    #[test]
    fn lists_are_split_at_commas_outside_of_brackets_and_quotes() {
        assert_eq!(values("a.b=0.5, 1,2"), ["0.5", "1", "2"]);
        assert_eq!(values("observer.preset=paper,field"), ["paper", "field"]);
        assert_eq!(values("x=[1, 2],[3, 4]"), ["[1, 2]", "[3, 4]"]);
        assert_eq!(values("x={ a = 1, b = 2 }"), ["{ a = 1, b = 2 }"]);
        assert_eq!(values("x=max(t, 1),sin(t)"), ["max(t, 1)", "sin(t)"]);
        assert_eq!(values("x='a,b',\"c:1:2\""), ["'a,b'", "\"c:1:2\""]);
        assert_eq!(values("x=it's,that's"), ["it's", "that's"]);
        assert_eq!(values("x=\"a\\\",b\",c"), ["\"a\\\",b\"", "c"]);
        assert_eq!(
            values("d=[\"v\", \"-max(x, v)\"],[\"v\", \"-x\"]"),
            ["[\"v\", \"-max(x, v)\"]", "[\"v\", \"-x\"]"]
        );
    }

    #[test]
    fn ranges_are_even_and_end_exactly() {
        assert_eq!(values("x=0:1:5"), ["0", "0.25", "0.5", "0.75", "1"]);
        assert_eq!(values("x=0.0:1.0:11")[3], "0.3");
        assert_eq!(values("x=1:10:4"), ["1", "4", "7", "10"]);
        let epsilons = values("design.epsilon=100:10000:log9");
        assert_eq!(epsilons.len(), 9);
        assert_eq!((&*epsilons[0], &*epsilons[4], &*epsilons[8]), ("100", "1000", "10000"));
        assert_eq!(epsilons[1], "177.827941004");
    }

    #[test]
    fn the_widest_ranges_are_finite_and_increase() {
        assert_eq!(values("x=5e-324:1:log3"), ["5e-324", "2.22275874949e-162", "1.0"]);
        assert_eq!(values("x=1e-300:1e300:log3")[1], "1.0");
        assert_eq!(values("x=-1.7e308:1.7e308:3")[1], "0.0");
        for text in ["x=5e-324:1.7e308:log9", "x=-1.7e308:1.7e308:9", "x=1e-310:2e-310:log9"] {
            let numbers: Vec<f64> =
                values(text).iter().map(|value| value.parse().unwrap()).collect();
            assert!(numbers.iter().all(|number| number.is_finite()), "{text}: {numbers:?}");
            assert!(numbers.is_sorted_by(|a, b| a < b), "{text}: {numbers:?}");
        }
        let drawn = "x=5e-324:1:log".parse::<Vary>().unwrap();
        let Spec::Range(range) = drawn.spec else { panic!("{drawn:?}") };
        assert_eq!(range.at(0.5), "2.22275874949e-162");
    }

    #[test]
    fn mistakes_are_explained() {
        for (text, problem) in [
            ("design.epsilon", "has no values"),
            ("=1,2", "is incomplete"),
            ("x=", "is incomplete"),
            ("x=1,,2", "has an empty value"),
            ("x=[1, 2,[3, 4]", "[1, 2,[3, 4] has a bracket that is not closed"),
            ("x=1], 2", "1], 2 has a bracket that is not opened"),
            ("x=\"a,b", "\"a,b has a quote that is not closed"),
            ("x=2:1:3", "2:1 is not a range"),
            ("x=0:1:log3", "0 has no logarithm"),
            ("x=1:2:1", "\"1\" is not a valid count of values"),
            ("x=1:2:lin5", "\"lin5\" is not a valid count of values"),
        ] {
            let error = text.parse::<Vary>().unwrap_err();
            assert!(error.starts_with(problem), "{text}: {error}");
        }
    }
}
