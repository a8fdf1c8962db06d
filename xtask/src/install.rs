//! Installs the program and its files outside of this project, below a prefix.
//!
//! ```text
//! PREFIX/bin/host-sim
//! PREFIX/share/host-sim/qemu-mps2-an386.elf   the emulated board's firmware
//! PREFIX/share/host-sim/memory.x              the memory map that it was linked with
//! ```

use std::{
    env, fs, io,
    path::{Path, PathBuf},
};

use crate::{
    firmware,
    step::{Failure, cargo, run, target_folder, workspace},
};

/// Arguments of `cargo xtask install`.
#[derive(Debug)]
pub(crate) struct Options {
    prefix: Option<PathBuf>,
}

impl Options {
    /// Reads the arguments after the task; `None` if they are invalid.
    pub(crate) fn read(arguments: &[&str]) -> Option<Self> {
        match *arguments {
            [] => Some(Self { prefix: None }),
            ["--prefix", prefix] if !prefix.is_empty() => {
                Some(Self { prefix: Some(prefix.into()) })
            }
            _ => None,
        }
    }
}

/// Builds and installs.
///
/// # Errors
/// A build fails, the program contains a path of this machine, or a file cannot be written.
pub(crate) fn install(options: &Options, debian: bool) -> Result<(), Failure> {
    let prefix = match &options.prefix {
        Some(prefix) => prefix.clone(),
        None => env::home_dir()
            .map(|home| home.join(".local"))
            .ok_or_else(|| Failure::new("cannot find the home folder", "name one with --prefix"))?,
    };
    let mut build = cargo("build");
    build.args(["--quiet", "--release", "--package", "host-sim", "--bin", "host-sim"]);
    run("the program", &mut build, "see the error above")?;
    let program = target_folder().join("release").join(program_name());
    check_paths(&program)?;
    let (board, firmware) = firmware::emulated(debian)?;

    let share = prefix.join("share/host-sim");
    put(&program, &prefix.join("bin").join(program_name()))?;
    put(&firmware, &share.join(format!("{}.elf", board.name)))?;
    put(&board.memory_map(), &share.join("memory.x"))
}

fn program_name() -> String {
    format!("host-sim{}", env::consts::EXE_SUFFIX)
}

/// Checks that the program does not contain the path of this folder, where it would look for other
/// files later.
fn check_paths(program: &Path) -> Result<(), Failure> {
    let bytes = fs::read(program).map_err(|error| failed(program, &error))?;
    let path = workspace().as_os_str().as_encoded_bytes();
    if bytes.windows(path.len()).any(|bytes| bytes == path) {
        let what = format!("{} contains the path {}", program.display(), workspace().display());
        let hint = "remove env!(\"CARGO_MANIFEST_DIR\") and similar macros from its sources";
        return Err(Failure::new(what, hint));
    }
    Ok(())
}

/// Copies a file atomically, because the old program may be running.
fn put(from: &Path, to: &Path) -> Result<(), Failure> {
    let folder = to.parent().unwrap_or(to);
    fs::create_dir_all(folder).map_err(|error| failed(folder, &error))?;
    let temporary = to.with_extension(format!("{}.partial", std::process::id()));
    let copied = fs::copy(from, &temporary).and_then(|_| fs::rename(&temporary, to));
    if let Err(error) = copied {
        // Best effort: the first error is the one reported.
        let _ = fs::remove_file(&temporary);
        return Err(failed(to, &error));
    }
    println!("installed: {}", to.display());
    Ok(())
}

fn failed(path: &Path, error: &io::Error) -> Failure {
    Failure::new(format!("{}: {error}", path.display()), "check that it is readable and writable")
}
