//! Coverage-guided fuzzing on the stable toolchain.
//!
//! The targets have cargo-fuzz's layout, but cargo-fuzz requires a nightly compiler. The fuzzer
//! itself only needs LLVM's coverage counters, which are stable code generation options, and
//! libFuzzer, whose sources are in the crate libfuzzer-sys and need a C++ compiler. The address
//! sanitizer is not available: it would find nothing in code without `unsafe`, but it would also
//! report the operands of `memcmp`. A target therefore cannot learn a long byte string that is
//! compared as a slice; it can learn numbers and small arrays.

use std::{
    env, fs, io,
    path::{Path, PathBuf},
    process::Command,
};

use crate::{
    compiler::host,
    packages,
    step::{Failure, cargo, on_path, run, run_filtering, target_folder, workspace},
};

/// Flags that make the program report its coverage and its comparisons to libFuzzer.
const COVERAGE: [&str; 6] = [
    "--cfg=fuzzing",
    "-Cpasses=sancov-module",
    "-Cllvm-args=-sanitizer-coverage-level=4",
    "-Cllvm-args=-sanitizer-coverage-inline-8bit-counters",
    "-Cllvm-args=-sanitizer-coverage-pc-table",
    "-Cllvm-args=-sanitizer-coverage-trace-compares",
];

/// Default running time of each target. \[s\]
const SECONDS: u32 = 10;
/// An input that takes longer is a finding. \[s\]
const TIMEOUT: u32 = 60;
/// An input that takes more memory is a finding. \[MB\]
const MEMORY: u32 = 2048;

/// Command-line arguments.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Options {
    seconds: u32,
    /// All targets, if none is named.
    targets: Vec<String>,
}

impl Options {
    /// Reads `[--seconds N] [TARGET...]`; `None` if the arguments are invalid.
    pub(crate) fn read(arguments: &[&str]) -> Option<Self> {
        let mut options = Self { seconds: SECONDS, targets: vec![] };
        let mut arguments = arguments.iter();
        while let Some(&argument) = arguments.next() {
            if argument == "--seconds" {
                options.seconds = arguments.next()?.parse().ok().filter(|&seconds| seconds > 0)?;
            } else if argument.starts_with('-') {
                return None;
            } else {
                options.targets.push(argument.to_owned());
            }
        }
        Some(options)
    }
}

/// Builds the fuzz targets and runs each from its corpus.
///
/// # Errors
/// A finding, a target that does not exist, or no C++ compiler.
pub(crate) fn fuzz(options: &Options, debian: bool) -> Result<(), Failure> {
    let failed = |error: io::Error| {
        Failure::new(
            format!("fuzzing: {error}"),
            "check that fuzz/ is complete and target/ is writable",
        )
    };
    let known = targets().map_err(failed)?;
    if let Some(unknown) = options.targets.iter().find(|target| !known.contains(target)) {
        return Err(Failure::new(
            format!("unknown fuzz target {unknown}"),
            format!("choose one of: {}", known.join(", ")),
        ));
    }
    let chosen = if options.targets.is_empty() { &known } else { &options.targets };
    let host = prepare(debian)?;
    run(
        "fuzz targets",
        apply(&mut fuzz_cargo("build"), &host).arg("--bins"),
        "see the error above",
    )?;
    let programs = folder().join(&host).join("release");
    for target in chosen {
        run_target(target, &programs.join(target), options.seconds)?;
    }
    Ok(())
}

/// Checks formatting and clippy's lints of the fuzz targets with the build settings of [`fuzz`], so
/// that both share their artifacts.
///
/// # Errors
/// A check fails, or there is no C++ compiler.
pub(crate) fn lint(debian: bool) -> Result<(), Failure> {
    run(
        "formatting of the fuzz targets",
        fuzz_cargo("fmt").args(["--", "--check"]),
        "run `cargo fmt --manifest-path fuzz/Cargo.toml`",
    )?;
    let host = prepare(debian)?;
    run(
        "clippy on the fuzz targets",
        apply(&mut fuzz_cargo("clippy"), &host).args(["--all-targets", "--", "-D", "warnings"]),
        "follow clippy's suggestion, or allow the lint with a reason",
    )
}

/// Returns the names of all targets, in alphabetical order.
fn targets() -> io::Result<Vec<String>> {
    let mut names = vec![];
    for entry in fs::read_dir(workspace().join("fuzz/fuzz_targets"))? {
        let path = entry?.path();
        if let (Some(name), Some("rs")) =
            (path.file_stem(), path.extension().and_then(|extension| extension.to_str()))
        {
            names.push(name.to_string_lossy().into_owned());
        }
    }
    names.sort();
    Ok(names)
}

/// Makes sure that there is a C++ compiler; returns the triple of this machine.
pub(crate) fn prepare(debian: bool) -> Result<String, Failure> {
    if env::var_os("CXX").is_none() && !on_path("c++") {
        if !packages::allowed(debian) {
            return Err(Failure::new(
                "libFuzzer needs a C++ compiler",
                "install g++ or clang++ (on Debian: cargo xtask fuzz --debian), or set CXX",
            ));
        }
        packages::install(&["g++"])?;
    }
    host().ok_or_else(|| {
        Failure::new("rustc does not report its host", "check the output of `rustc -vV`")
    })
}

fn fuzz_cargo(task: &str) -> Command {
    let mut command = cargo(task);
    command.args(["--manifest-path", "fuzz/Cargo.toml"]);
    command
}

/// Makes `command` compile with coverage. `--target` is given explicitly so that the flags do
/// not apply to build scripts and procedural macros.
fn apply<'command>(command: &'command mut Command, host: &str) -> &'command mut Command {
    command
        .env_remove("CARGO_ENCODED_RUSTFLAGS")
        .env("RUSTFLAGS", COVERAGE.join(" "))
        .env("CARGO_TARGET_DIR", folder())
        .args(["--quiet", "--release", "--target", host])
}

/// Returns the folder for programs, findings and additions to the corpora.
fn folder() -> PathBuf {
    target_folder().join("fuzz")
}

/// Runs one target, starting from the committed corpus and the additions of earlier runs.
fn run_target(target: &str, program: &Path, seconds: u32) -> Result<(), Failure> {
    let added = folder().join("corpus").join(target);
    let findings = folder().join("findings").join(target);
    for folder in [&added, &findings] {
        fs::create_dir_all(folder).map_err(|error| {
            Failure::new(format!("{}: {error}", folder.display()), "check that it is writable")
        })?;
    }
    let mut command = Command::new(program);
    command
        .current_dir(workspace())
        .arg(format!("-max_total_time={seconds}"))
        .arg(format!("-timeout={TIMEOUT}"))
        .arg(format!("-rss_limit_mb={MEMORY}"))
        // libFuzzer appends a file name directly.
        .arg(format!("-artifact_prefix={}/", findings.display()))
        .arg(&added)
        .arg(Path::new("fuzz/corpus").join(target));
    let mut finding = None;
    run_filtering(&format!("fuzz target {target}"), &mut command, "see the output above", |line| {
        if let Some(path) = written_to(line) {
            finding = Some(path.to_owned());
        }
        is_of_interest(line)
    })
    .map_err(|failure| match finding {
        Some(path) => Failure::new(
            format!("fuzz target {target} failed: see {path}"),
            format!(
                "reproduce it with `{} {path}`; after fixing it, copy the input to \
                 fuzz/corpus/{target}/ as a regression test",
                program.display()
            ),
        ),
        None => failure,
    })
}

/// Returns where libFuzzer has written the input that it stopped at.
fn written_to(line: &str) -> Option<&str> {
    line.split_once("Test unit written to ").map(|(_, path)| path.trim())
}

/// Whether to show a line: all but the thousands about new or smaller inputs, and the dictionary at
/// the end.
fn is_of_interest(line: &str) -> bool {
    let mut words = line.split_whitespace();
    let first = words.next().unwrap_or_default();
    let is_status = first.starts_with('#') && words.next().is_some_and(|word| word != "DONE");
    let is_new_function = first.starts_with("NEW_FUNC");
    let is_dictionary = first.starts_with('"') || first.starts_with("######");
    !is_status && !is_new_function && !is_dictionary
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn targets_and_time_are_read_in_any_order() {
        let options = |seconds, targets: &[&str]| {
            Some(Options { seconds, targets: targets.iter().map(|&t| t.to_owned()).collect() })
        };
        assert_eq!(Options::read(&[]), options(SECONDS, &[]));
        assert_eq!(Options::read(&["frame", "--seconds", "1800"]), options(1800, &["frame"]));
        assert_eq!(Options::read(&["--seconds", "5", "b", "a"]), options(5, &["b", "a"]));
        for wrong in [&["--seconds"][..], &["--seconds", "0"], &["--seconds", "x"], &["--fast"]] {
            assert_eq!(Options::read(wrong), None);
        }
    }

    #[test]
    fn only_the_end_of_a_run_and_findings_are_shown() {
        for dull in [
            "#12\tNEW    cov: 219 ft: 427 corp: 9/493b lim: 85 exec/s: 0 rss: 27Mb L: 81/85",
            "#139796\tREDUCE cov: 22 ft: 28 corp: 15/284b lim: 1360 exec/s: 0 rss: 27Mb",
            "#65536\tpulse  cov: 22 ft: 28 corp: 15/284b lim: 1360 exec/s: 0 rss: 27Mb",
            "\tNEW_FUNC[1/2]: 0x55624f428121",
            "###### Recommended dictionary. ######",
            "\"\\203\\004\\034]\" # Uses: 589",
        ] {
            assert!(!is_of_interest(dull), "{dull}");
        }
        for telling in [
            "#224696\tDONE   cov: 421 ft: 1683 corp: 390/43Kb lim: 443 exec/s: 14043 rss: 28Mb",
            "thread '<unnamed>' (12) panicked at fuzz_targets/package.rs:57:9:",
            "",
        ] {
            assert!(is_of_interest(telling), "{telling}");
        }
        let line = "artifact_prefix='x/'; Test unit written to x/crash-98fd42";
        assert_eq!(written_to(line), Some("x/crash-98fd42"));
    }
}
