//! Tasks on the host: the tests of the whole workspace, and the lints.

use std::{env, fmt, path::PathBuf};

use crate::{
    boards,
    step::{Failure, cargo, cargo_in, giving_way, run, run_reading, target_folder, workspace},
};

/// Numbers of tests by result.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct TestCount {
    passed: usize,
    failed: usize,
    ignored: usize,
}

impl TestCount {
    /// Adds the numbers from the closing line of a test program; other lines are ignored.
    fn add(&mut self, line: &str) {
        let Some((_, counts)) =
            line.strip_prefix("test result: ").and_then(|rest| rest.split_once(". "))
        else {
            return;
        };
        for entry in counts.split(';') {
            let mut words = entry.split_whitespace();
            let Some(count) = words.next().and_then(|word| word.parse::<usize>().ok()) else {
                continue;
            };
            match words.next() {
                Some("passed") => self.passed += count,
                Some("failed") => self.failed += count,
                Some("ignored") => self.ignored += count,
                _ => {}
            }
        }
    }
}

impl fmt::Display for TestCount {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} passed, {} failed", self.passed, self.failed)?;
        if self.ignored > 0 {
            write!(f, ", {} skipped", self.ignored)?;
        }
        Ok(())
    }
}

/// Builds the program that the integration tests use, with them, so that nothing is compiled twice; returns
/// its path.
///
/// # Errors
/// A build failed.
pub(crate) fn simulator() -> Result<PathBuf, Failure> {
    let mut build = cargo("build");
    let parts = ["--bin", "simulator-under-test", "--test", "integration"];
    build.args(["--quiet", "--workspace"]).args(parts);
    run("host-sim", &mut build, "see the error above")?;
    let name = format!("debug/simulator-under-test{}", env::consts::EXE_SUFFIX);
    Ok(target_folder().join(name))
}

/// Builds the programs of [`test()`].
///
/// # Errors
/// A build failed.
pub(crate) fn build_tests() -> Result<(), Failure> {
    let mut build = cargo("test");
    build.args(["--quiet", "--workspace", "--no-run"]);
    run("the tests' programs", &mut giving_way(&build), "see the error above")
}

/// Runs the unit tests, integration tests, examples and doctests of every crate. They have deadlines, so they do not
/// give way.
///
/// # Errors
/// A test failed, or no test ran.
pub(crate) fn test() -> Result<TestCount, Failure> {
    let mut count = TestCount::default();
    run_reading(
        "tests on the host",
        cargo("test").args(["--workspace", "--no-fail-fast"]),
        "see the failures above; `cargo test -p <crate> <name>` repeats a single test",
        |line| count.add(line),
    )?;
    if count.passed == 0 {
        return Err(Failure::new(
            "tests on the host: no test ran",
            "check the output of `cargo test --workspace`",
        ));
    }
    Ok(count)
}

/// What clippy and rustdoc read beyond the default features; the same for both, so that dependencies are checked once.
const FEATURES: &str = "host-sim/wide,host-sim/parquet";

/// Checks formatting, clippy's lints and the documentation.
///
/// # Errors
/// A check fails.
pub(crate) fn lint() -> Result<(), Failure> {
    run("formatting", cargo("fmt").args(["--all", "--", "--check"]), "run `cargo fmt --all`")?;
    for board in boards::all()? {
        run(
            &format!("formatting of {}", board.name),
            cargo_in(&board.folder, "fmt").args(["--", "--check"]),
            "run `cargo fmt` in the board's folder",
        )?;
    }
    run(
        "formatting of the dense products",
        cargo_in(&workspace().join("host-sim/benches/dense"), "fmt").args(["--", "--check"]),
        "run `cargo fmt` in host-sim/benches/dense",
    )?;
    run(
        "clippy",
        cargo("clippy")
            .args(["--workspace", "--all-targets", "--features", FEATURES])
            .args(["--", "-D", "warnings"]),
        "follow clippy's suggestion, or allow the lint with a reason",
    )?;
    run(
        "documentation",
        cargo("doc")
            .args(["--workspace", "--no-deps", "--features", FEATURES])
            .env("RUSTDOCFLAGS", "-D warnings"),
        "fix the links and code blocks named above",
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn closing_lines_add_up() {
        let mut count = TestCount::default();
        count.add("running 3 tests");
        count.add("test result: ok. 2 passed; 0 failed; 1 ignored; 0 measured; 4 filtered out");
        count.add("test result: FAILED. 5 passed; 3 failed; 0 ignored; 0 measured");
        count.add("test passed ... ok");
        assert_eq!(count, TestCount { passed: 7, failed: 3, ignored: 1 });
        assert_eq!(count.to_string(), "7 passed, 3 failed, 1 skipped");
    }
}
