//! The header of a sample file: the meaning of each column, and the unit of time.

use crate::files::text::Refusal;

/// The columns of each quantity.
#[derive(Debug)]
pub(super) struct Columns {
    pub(super) time: usize,
    /// Factor that converts a time to seconds; `None` if the header has no unit.
    pub(super) time_scale: Option<f64>,
    pub(super) estimate: Vec<usize>,
    pub(super) derivative: Vec<usize>,
    pub(super) weights: Vec<usize>,
    /// RMS of the innovation, and broadcasts per second, if both are there.
    pub(super) observed: Option<[usize; 2]>,
}

impl Columns {
    /// Finds the columns, or returns a problem and a hint.
    pub(super) fn find(
        headers: &[String],
        dimension: usize,
        features: usize,
    ) -> Result<Self, Refusal> {
        let expected = format!(
            "use the columns time, xhat1 to xhat{dimension} and dxhat1 to dxhat{dimension} for the \
             scenario's {dimension} state components"
        );
        if headers.iter().all(|name| name.trim().parse::<f64>().is_ok()) {
            return Err((
                "the first line has numbers instead of column names".to_owned(),
                expected,
            ));
        }
        let names: Vec<Name> = headers.iter().map(|header| Name::of(header)).collect();
        let find = |name: &str| -> Result<usize, Refusal> {
            let mut places = names.iter().enumerate().filter(|(_, found)| found.word == name);
            match (places.next(), places.next()) {
                (Some((place, _)), None) => Ok(place),
                (None, _) => Err((format!("missing column {name}"), expected.clone())),
                _ => Err((format!("duplicate column {name}"), expected.clone())),
            }
        };
        let too_many = format!("xhat{}", dimension + 1);
        if names.iter().any(|name| name.word == too_many) {
            return Err((format!("unexpected column {too_many}"), expected));
        }
        let time = match find("time") {
            Err(missing) if names.iter().all(|name| name.word != "time") => {
                find("timestamp").or_else(|_| find("t")).map_err(|_| missing)?
            }
            found => found?,
        };
        let time_scale = time_scale(&headers[time], &names[time].unit)?;
        let all = |stem: &str| -> Result<Vec<usize>, Refusal> {
            (1..=dimension).map(|c| find(&format!("{stem}{c}"))).collect()
        };
        let (estimate, derivative) = (all("xhat")?, all("dxhat")?);
        for &column in &derivative {
            check_rate(&headers[column], &names[column].unit)?;
        }
        let is_weight = |name: &&Name| {
            let indices = name.word.strip_prefix('w').and_then(|indices| indices.split_once('_'));
            indices.is_some_and(|(l, c)| l.parse::<u32>().is_ok() && c.parse::<u32>().is_ok())
        };
        let weights = match names.iter().filter(is_weight).count() {
            0 => Vec::new(),
            found if found == features * dimension => (0..found)
                .map(|i| find(&format!("w{}_{}", i / dimension + 1, i % dimension + 1)))
                .collect::<Result<_, _>>()?,
            found => {
                let problem = format!("{found} columns of outer weights");
                let hint = format!(
                    "use w1_1 to w{features}_{dimension} for the scenario's network, or none"
                );
                return Err((problem, hint));
            }
        };
        let observed = match (find("innovation_rms"), find("broadcasts_per_second")) {
            (Ok(rms), Ok(rate)) => Some([rms, rate]),
            _ => None,
        };
        Ok(Self { time, time_scale, estimate, derivative, weights, observed })
    }
}

/// A column header split into name and unit: `Time (ms)` is `time` and `(ms)`.
struct Name {
    word: String,
    unit: String,
}

/// Characters that separate a name from its unit.
const SEPARATORS: &[char] = &[' ', '\t', '_', '/', '.', '-', ':', ','];

impl Name {
    fn of(header: &str) -> Self {
        let header = header.trim();
        let lower = header.to_ascii_lowercase();
        let stem = ["timestamp", "time", "dxhat", "xhat", "t"]
            .into_iter()
            .find(|stem| lower.starts_with(stem))
            .unwrap_or_default();
        let behind = &header[stem.len()..];
        let is_time = !stem.ends_with("hat");
        let digits = behind.strip_prefix('_').unwrap_or(behind);
        let length = digits.find(|c: char| !c.is_ascii_digit()).unwrap_or(digits.len());
        let (index, unit) = if is_time { ("", behind) } else { digits.split_at(length) };
        // `timeMs` is a time; `timeout` is not, and `xhat` alone is not a component.
        let camel =
            is_time && header.as_bytes()[..stem.len()].last().is_some_and(u8::is_ascii_lowercase);
        let separate = match unit.chars().next() {
            None => true,
            Some(c) => !c.is_alphanumeric() || camel && c.is_ascii_uppercase(),
        };
        if !stem.is_empty() && separate && (is_time || !index.is_empty()) {
            return Self { word: format!("{stem}{index}"), unit: unit.trim().to_owned() };
        }
        let word = lower.split(|c: char| c.is_whitespace() || c == '[' || c == '(').next();
        Self { word: word.unwrap_or_default().to_owned(), unit: String::new() }
    }
}

/// Returns a unit of time in seconds.
fn seconds(unit: &str) -> Option<f64> {
    // The micro sign and the Greek letter look the same.
    Some(match unit.to_lowercase().replace('\u{b5}', "\u{3bc}").as_str() {
        "s" | "sec" | "secs" | "second" | "seconds" => 1.0,
        "ms" | "msec" | "msecs" | "millis" | "millisec" | "millisecond" | "milliseconds" => 1e-3,
        "us" | "\u{3bc}s" | "usec" | "usecs" | "\u{3bc}sec" | "micros" | "microsec"
        | "microsecond" | "microseconds" => 1e-6,
        "ns" | "nsec" | "nsecs" | "nanos" | "nanosec" | "nanosecond" | "nanoseconds" => 1e-9,
        "min" | "mins" | "minute" | "minutes" => 60.0,
        "h" | "hr" | "hrs" | "hour" | "hours" => 3600.0,
        "d" | "day" | "days" => 86_400.0,
        _ => return None,
    })
}

/// Returns the factor that converts a time in this unit to seconds; `None` without a unit.
fn time_scale(header: &str, unit: &str) -> Result<Option<f64>, Refusal> {
    let refused = || {
        if header.contains('\u{fffd}') {
            let problem = format!("the unit of {header:?} is not UTF-8");
            return (problem, "save the file as UTF-8, or use us for microseconds".to_owned());
        }
        let problem = format!("unknown unit of time in {header:?}");
        (problem, "use `time [s]`, or [ms], [us], [ns], [min], [h]".to_owned())
    };
    let is_bracket = |c: char| "[](){}<>".contains(c);
    let inner = match unit.find(is_bracket) {
        // Words such as `since start` may precede the brackets.
        Some(at) => {
            let qualifiers = ["since", "start", "elapsed", "of", "the", "from", "relative", "run"];
            let mut words = unit[..at].split(SEPARATORS).filter(|word| !word.is_empty());
            if !words.all(|word| qualifiers.contains(&word.to_lowercase().as_str())) {
                return Err(refused());
            }
            unit[at..].trim_matches(is_bracket)
        }
        None => unit,
    };
    let inner = inner.trim_matches(SEPARATORS);
    let inner = inner.strip_prefix("in ").unwrap_or(inner).trim();
    if inner.is_empty() {
        return if unit.contains(is_bracket) { Err(refused()) } else { Ok(None) };
    }
    seconds(inner).map(Some).ok_or_else(refused)
}

/// Refuses derivatives per any unit of time but the second; they are never scaled.
fn check_rate(header: &str, unit: &str) -> Result<(), Refusal> {
    let unit = unit.trim_matches(|c: char| "[](){}<> ".contains(c));
    let denominator = unit.rsplit_once('/').or_else(|| unit.rsplit_once(" per ")).or_else(|| {
        let inverse = unit.strip_suffix("^-1").or_else(|| unit.strip_suffix("\u{207b}\u{b9}"))?;
        inverse.rsplit_once([' ', '*', '\u{b7}']).or(Some(("", inverse)))
    });
    let Some((_, by)) = denominator else { return Ok(()) };
    match seconds(by.trim()) {
        Some(factor) if factor != 1.0 => Err((
            format!("{header:?} is per {}", by.trim()),
            "use derivatives per second".to_owned(),
        )),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scale(time: &str) -> Result<Option<f64>, String> {
        let headers = [time, "xhat1", "dxhat1"].map(str::to_owned);
        Columns::find(&headers, 1, 0)
            .map(|columns| columns.time_scale)
            .map_err(|(problem, _)| problem)
    }

    #[test]
    fn accepts_common_spellings_of_time_units() {
        for (factor, spellings) in [
            (
                1.0,
                vec![
                    "time [s]",
                    "Time (s)",
                    "time_s",
                    "t [s]",
                    "TIME/s",
                    "time in seconds",
                    "timeS",
                ],
            ),
            (
                1e-3,
                vec![
                    "time (ms)",
                    "time ms",
                    "time [ms]",
                    "time_ms",
                    "time/ms",
                    "t (ms)",
                    "timeMs",
                    "time / ms",
                    "TIME_MS",
                    "timestamp_ms",
                    "time since start (ms)",
                    "time-millis",
                    "t, ms",
                    "time [ ms ]",
                    "time in milliseconds",
                    "time [msec]",
                ],
            ),
            (
                1e-6,
                vec![
                    "t (us)",
                    "time [\u{b5}s]",
                    "time [\u{3bc}s]",
                    "time in microseconds",
                    "time_us",
                ],
            ),
            (1e-9, vec!["timestamp [ns]", "time.ns"]),
            (60.0, vec!["Time [min]", "time_minutes"]),
            (3600.0, vec!["time (h)", "time [hours]"]),
        ] {
            for spelling in spellings {
                assert_eq!(scale(spelling), Ok(Some(factor)), "{spelling}");
            }
        }
        for spelling in ["time", "Time", "t", "timestamp", "time "] {
            assert_eq!(scale(spelling), Ok(None), "{spelling}");
        }
    }

    #[test]
    fn unknown_time_units_are_refused() {
        for spelling in [
            "time [m]",
            "time (ticks)",
            "time_steps",
            "time [UTC]",
            "time [10 ms]",
            "time []",
            "time (UTC) [ms]",
            "time local",
            "t/T",
            "time [s^2]",
            "time [\u{fffd}s]",
        ] {
            let problem = scale(spelling).unwrap_err();
            assert!(problem.contains("unit of"), "{spelling}: {problem}");
        }
        for spelling in ["timeout", "times", "tempo", "lifetime"] {
            assert_eq!(scale(spelling), Err("missing column time".to_owned()), "{spelling}");
        }
    }

    #[test]
    fn derivatives_must_be_per_second() {
        for (unit, accepted) in [
            ("", true),
            (" [V/s]", true),
            (" (m/s)", true),
            (" [state unit/s]", true),
            ("_mps", true),
            (" [rad/s^2]", true),
            (" [V/ms]", false),
            (" (km/h)", false),
            (" [1/min]", false),
            (" V per hour", false),
            (" [V ms^-1]", false),
            (" [V s^-1]", true),
            (" [parts/unit]", true),
        ] {
            let headers =
                ["time".to_owned(), "xhat1 [anything]".to_owned(), format!("dxhat1{unit}")];
            let found = Columns::find(&headers, 1, 0);
            assert_eq!(found.is_ok(), accepted, "{unit}");
            if let Err((problem, hint)) = found {
                assert!(problem.contains(unit) && hint.contains("per second"), "{problem}");
            }
        }
    }
}
