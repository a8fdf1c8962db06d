//! Runs commands, reports their progress, and describes failures.

use std::{
    env,
    ffi::OsStr,
    fmt, fs,
    io::{BufRead, BufReader, Read},
    path::{Path, PathBuf},
    process::{Command, Stdio},
    time::Instant,
};

/// Why a task failed, and what to do about it.
#[derive(Debug)]
pub(crate) struct Failure {
    /// What failed.
    pub(crate) what: String,
    /// How to fix it.
    pub(crate) hint: String,
}

impl Failure {
    pub(crate) fn new(what: impl Into<String>, hint: impl Into<String>) -> Self {
        Self { what: what.into(), hint: hint.into() }
    }
}

impl fmt::Display for Failure {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}\n  hint: {}", self.what, self.hint)
    }
}

/// Returns the root folder of the workspace.
pub(crate) fn workspace() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap_or(Path::new("."))
}

/// Returns cargo's target folder, absolute.
pub(crate) fn target_folder() -> PathBuf {
    workspace().join(env::var_os("CARGO_TARGET_DIR").unwrap_or_else(|| "target".into()))
}

/// Returns whether this is a run of continuous integration.
pub(crate) fn in_ci() -> bool {
    env::var_os("CI").is_some_and(|value| !value.is_empty() && value != "false")
}

/// Creates `cargo <task>` with the toolchain that runs this program, in the workspace.
pub(crate) fn cargo(task: &str) -> Command {
    let mut command = Command::new(env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    command.current_dir(workspace()).arg(task);
    if in_ci() && task != "fmt" {
        command.arg("--locked");
    }
    command
}

/// Creates `cargo <task>` for the crate in `folder`, which is a separate workspace.
///
/// With CI=true its lock file must be up to date, unless the crate has just been copied and
/// renamed: then the lock file still has the old name.
pub(crate) fn cargo_in(folder: &Path, task: &str) -> Command {
    let mut command = Command::new(env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    command.current_dir(folder).arg(task);
    if in_ci() && task != "fmt" && is_locked(folder) {
        command.arg("--locked");
    }
    command
}

/// Whether the lock file in `folder` contains the package there.
fn is_locked(folder: &Path) -> bool {
    let read = |name: &str| fs::read_to_string(folder.join(name)).unwrap_or_default();
    let manifest = read("Cargo.toml");
    let name = manifest.lines().find(|line| line.starts_with("name = "));
    name.is_some_and(|name| read("Cargo.lock").lines().any(|line| line == name))
}

/// Runs one step and passes its output through.
///
/// # Errors
/// The command cannot be started, or its exit status is not 0; `hint` says what to do about that.
pub(crate) fn run(name: &str, command: &mut Command, hint: &str) -> Result<(), Failure> {
    run_reading(name, command, hint, |_| ())
}

/// Like [`run`], and passes every line of the standard output to `read`.
///
/// # Errors
/// Same as [`run`].
pub(crate) fn run_reading(
    name: &str,
    command: &mut Command,
    hint: &str,
    mut read: impl FnMut(&str),
) -> Result<(), Failure> {
    supervise(name, command, hint, Stream::Output, |line| {
        read(line);
        true
    })
}

/// Like [`run`], and passes through only those lines of the standard error output that `keep`
/// selects.
///
/// # Errors
/// Same as [`run`].
pub(crate) fn run_filtering(
    name: &str,
    command: &mut Command,
    hint: &str,
    keep: impl FnMut(&str) -> bool,
) -> Result<(), Failure> {
    supervise(name, command, hint, Stream::Errors, keep)
}

/// The output of a command that is read.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Stream {
    Output,
    Errors,
}

fn supervise(
    name: &str,
    command: &mut Command,
    hint: &str,
    stream: Stream,
    mut keep: impl FnMut(&str) -> bool,
) -> Result<(), Failure> {
    let shown = show(command);
    println!("==> {name}: {shown}");
    let start = Instant::now();
    let failed = |reason: String| Failure::new(format!("{name}: `{shown}`: {reason}"), hint);
    match stream {
        Stream::Output => command.stdout(Stdio::piped()),
        Stream::Errors => command.stderr(Stdio::piped()),
    };
    let mut child =
        command.stdin(Stdio::null()).spawn().map_err(|error| failed(error.to_string()))?;
    let output = child.stdout.take().map(|output| Box::new(output) as Box<dyn Read>);
    let errors = child.stderr.take().map(|errors| Box::new(errors) as Box<dyn Read>);
    if let Some(output) = output.or(errors) {
        for line in BufReader::new(output).split(b'\n') {
            let line = line.map_err(|error| failed(error.to_string()))?;
            let line = String::from_utf8_lossy(&line);
            if keep(&line) {
                println!("{line}");
            }
        }
    }
    let status = child.wait().map_err(|error| failed(error.to_string()))?;
    if !status.success() {
        return Err(failed(status.to_string()));
    }
    println!("<== {name}: ok, {:.1} s", start.elapsed().as_secs_f64());
    Ok(())
}

/// Lets a command give way to others: the longest chain of steps then ends first, and what can use every core
/// fills the rest. Where there is no `nice` the command stays as it is.
pub(crate) fn giving_way(command: &Command) -> Command {
    let nice: &[&str] = if on_path("nice") { &["nice", "-n", "5"] } else { &[] };
    let words =
        nice.iter().map(OsStr::new).chain([command.get_program()]).chain(command.get_args());
    let words: Vec<&OsStr> = words.collect();
    let mut polite = Command::new(words[0]);
    polite.args(&words[1..]);
    polite.envs(command.get_envs().filter_map(|(name, value)| Some((name, value?))));
    if let Some(folder) = command.get_current_dir() {
        polite.current_dir(folder);
    }
    polite
}

/// Runs a command and returns its standard output, or `None` if it fails.
pub(crate) fn ask(command: &mut Command) -> Option<String> {
    let output = command.stdin(Stdio::null()).stderr(Stdio::null()).output().ok()?;
    output.status.success().then(|| String::from_utf8_lossy(&output.stdout).into_owned())
}

/// Returns whether a program with that name is on the search path.
pub(crate) fn on_path(program: &str) -> bool {
    env::var_os("PATH")
        .is_some_and(|path| env::split_paths(&path).any(|folder| folder.join(program).is_file()))
}

/// Formats the command as one would type it.
fn show(command: &Command) -> String {
    let variables = command
        .get_envs()
        .filter_map(|(name, value)| Some(format!("{}={}", quote(name), quote(value?))));
    let program = Path::new(command.get_program());
    // cargo passes on its own full path; everything else is shown as called.
    let program = if program.ends_with("bin/cargo") && program != Path::new("/usr/bin/cargo") {
        OsStr::new("cargo")
    } else {
        program.as_os_str()
    };
    let words = std::iter::once(program).chain(command.get_args()).map(quote);
    variables.chain(words).collect::<Vec<_>>().join(" ")
}

fn quote(word: &OsStr) -> String {
    let word = word.to_string_lossy();
    if word.contains([' ', '"', '$']) { format!("'{word}'") } else { word.into_owned() }
}
