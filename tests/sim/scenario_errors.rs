//! Every message of the scenario loader, word for word; the loader does not panic on any text.
//!
//! The cases are in `scenario_errors/*.txt`, one block each:
//!
//! ```text
//! < paper            the built-in scenario to start from
//! - step = 0.001     the first place with this text (several lines: several `-`) ...
//! + step = 0.003     ... becomes this
//! @ duration = 40.0  the error names the line on which this first appears afterwards
//! ! message          the message, after file and line
//! ```

use host_sim::scenario::{BUILT_IN, PAPER, Scenario, built_in};
use proptest::prelude::*;

struct Case {
    text: String,
    line: usize,
    message: String,
}

/// Returns the lines of `block` that start with `mark`, without the mark.
fn marked(block: &str, mark: char) -> String {
    let lines = block.lines().filter_map(|line| line.strip_prefix(mark));
    lines.map(|line| line.strip_prefix(' ').unwrap_or(line)).collect::<Vec<_>>().join("\n")
}

fn case(block: &str) -> Case {
    let base = built_in(&marked(block, '<')).expect("a built-in scenario");
    let (from, to, place) = (marked(block, '-'), marked(block, '+'), marked(block, '@'));
    assert!(base.contains(&from), "nothing to replace:\n{block}");
    let text = base.replacen(&from, &to, 1);
    let offset = text.find(&place).unwrap_or_else(|| panic!("no such place:\n{block}"));
    let line = text[..offset].lines().count() + usize::from(text[..offset].ends_with('\n'));
    Case { line: line.max(1), text, message: marked(block, '!') }
}

fn check(cases: &str) {
    for block in cases.split("\n\n") {
        let Case { text, line, message } = case(block);
        let error = Scenario::parse("case.toml", &text).expect_err(block);
        assert_eq!(error.to_string(), format!("case.toml:{line}: {message}"), "\n{block}");
        assert!(!error.hint.is_empty(), "{block}");
    }
}

#[test]
fn invalid_toml() {
    check(include_str!("scenario_errors/toml.txt"));
}

#[test]
fn unknown_keys() {
    check(include_str!("scenario_errors/keys.txt"));
}

#[test]
fn known_inputs() {
    check(include_str!("scenario_errors/inputs.txt"));
}

#[test]
fn missing_keys() {
    check(include_str!("scenario_errors/missing.txt"));
}

#[test]
fn wrong_types() {
    check(include_str!("scenario_errors/types.txt"));
}

#[test]
fn numbers_out_of_range() {
    check(include_str!("scenario_errors/numbers.txt"));
}

#[test]
fn unknown_choices() {
    check(include_str!("scenario_errors/choices.txt"));
}

#[test]
fn wrong_shapes() {
    check(include_str!("scenario_errors/shapes.txt"));
}

#[test]
fn asymmetric_and_indefinite_matrices() {
    check(include_str!("scenario_errors/matrices.txt"));
}

#[test]
fn invalid_graphs() {
    check(include_str!("scenario_errors/graph.txt"));
}

#[test]
fn invalid_learning_cycles() {
    check(include_str!("scenario_errors/learning.txt"));
}

#[test]
fn invalid_observers() {
    check(include_str!("scenario_errors/observer.txt"));
}

#[test]
fn invalid_health_settings() {
    check(include_str!("scenario_errors/health.txt"));
}

#[test]
fn invalid_expressions() {
    check(include_str!("scenario_errors/expressions.txt"));
}

/// A file in the system's temporary directory, removed at the end.
struct TemporaryFile(std::path::PathBuf);

impl TemporaryFile {
    fn new(name: &str, content: &[u8]) -> Self {
        let path = std::env::temp_dir().join(format!("{}-{name}", std::process::id()));
        std::fs::write(&path, content).expect("the temporary directory can be written");
        Self(path)
    }
}

impl Drop for TemporaryFile {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.0);
    }
}

#[test]
fn errors_name_the_file() {
    let file = TemporaryFile::new("paper.toml", PAPER.as_bytes());
    assert_eq!(Scenario::load(&file.0).expect("the paper is sound").name, "paper");
    let file = TemporaryFile::new("latin.toml", b"name = \"latin\"\n# \xe4\n");
    let message = Scenario::load(&file.0).unwrap_err().to_string();
    let expected = ":2: is not UTF-8; save the file as UTF-8 text";
    assert_eq!(message, format!("{}{expected}", file.0.display()));
}

#[test]
fn missing_files() {
    let error = Scenario::load("no/such.toml".as_ref()).unwrap_err();
    // The rest of the message depends on the system.
    assert!(error.problem.starts_with("cannot be read: "), "{error}");
    assert!(error.to_string().starts_with("no/such.toml: cannot be read: "), "{error}");
    let hint = "pass the path of a scenario file, or the name of a built-in scenario (paper, deployment, lorenz, \
                pendulum, duffing, expressions); `host-sim scenario paper > mine.toml` writes a \
                starting point";
    assert_eq!((error.line, error.key, error.hint.as_str()), (None, None, hint));
    let error = Scenario::load("lorentz".as_ref()).unwrap_err();
    assert!(error.hint.starts_with("pass lorenz, the path"), "{error}");
    assert!(error.hint.contains("`host-sim scenario lorenz >"), "{error}");
}

#[cfg(target_os = "linux")]
#[test]
fn rejects_an_endless_file() {
    let error = Scenario::load("/dev/zero".as_ref()).unwrap_err().to_string();
    assert!(error.starts_with("/dev/zero: file is larger than 16 MiB"), "{error}");
}

#[test]
fn every_built_in_scenario_loads() {
    for (name, text) in BUILT_IN {
        assert_eq!(Scenario::parse(name, text).map(|scenario| scenario.name), Ok(name.to_owned()));
    }
}

/// Checks that an error has a line, a problem and a hint.
fn is_complete(text: &str) -> Result<(), TestCaseError> {
    if let Err(error) = Scenario::parse("any.toml", text) {
        let lines = text.lines().count().max(1) + 1;
        prop_assert!(error.line.is_some_and(|line| (1..=lines).contains(&line)), "{}", error);
        prop_assert!(!error.problem.is_empty() && !error.hint.is_empty(), "{}", error);
    }
    Ok(())
}

/// Values that are valid for some keys and invalid for others.
const VALUES: &[&str] = &[
    "nan",
    "-inf",
    "0",
    "-1",
    "1e308",
    "5e-324",
    "9223372036854775807",
    "true",
    "\"\"",
    "\"ä\"",
    "[]",
    "[[]]",
    "{}",
    "[[1, 2], [3]]",
    "[nan, 1, 1]",
    "1979-05-27",
    "[[1, 1]]",
    "\"x^^2\"",
    "[\"x\", \"y\", \"z\"]",
    "{ fill = inf }",
    "{ random = true }",
    "1000",
    "\"linear\"",
];

proptest! {
    #[test]
    fn no_text_makes_the_loader_panic(text in "\\PC{0,200}|[a-z\\[\\]{}=\".,0-9\n -]{0,200}") {
        is_complete(&text)?;
    }

    #[test]
    fn no_bytes_make_the_loader_panic(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        is_complete(&String::from_utf8_lossy(&bytes))?;
    }

    /// Replaces one value of a valid scenario, or removes one line.
    #[test]
    fn no_change_makes_the_loader_panic(
        base in prop::sample::select(BUILT_IN.as_slice()),
        line in any::<prop::sample::Index>(),
        value in prop::option::of(prop::sample::select(VALUES)),
    ) {
        let mut lines: Vec<String> = base.1.lines().map(str::to_owned).collect();
        let keys: Vec<usize> = (0..lines.len()).filter(|&i| lines[i].contains(" = ")).collect();
        let line = keys[line.index(keys.len())];
        let key = lines[line].split(" = ").next().unwrap_or_default().to_owned();
        lines[line] = value.map(|value| format!("{key} = {value}")).unwrap_or_default();
        is_complete(&lines.join("\n"))?;
    }
}
