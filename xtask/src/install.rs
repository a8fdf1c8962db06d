//! The program and what it needs outside of this project, below a prefix.
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

/// What `cargo xtask install` is asked for.
#[derive(Debug)]
pub(crate) struct Options {
    prefix: Option<PathBuf>,
}

impl Options {
    /// Reads the arguments after the task; `None` if they are wrong.
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
/// Something does not build, holds a path of this machine, or cannot be written.
pub(crate) fn install(options: &Options, debian: bool) -> Result<(), Failure> {
    let prefix = match &options.prefix {
        Some(prefix) => prefix.clone(),
        None => env::home_dir()
            .map(|home| home.join(".local"))
            .ok_or_else(|| Failure::new("cannot find the home folder", "name one with --prefix"))?,
    };
    let mut build = cargo("build");
    build.args(["--quiet", "--release", "--package", "host-sim", "--bin", "host-sim"]);
    run("the program", &mut build, "the error above names the line")?;
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

/// A program that holds the path of this folder would look there for what belongs to others one day.
fn check_paths(program: &Path) -> Result<(), Failure> {
    let bytes = fs::read(program).map_err(|error| failed(program, &error))?;
    let path = workspace().as_os_str().as_encoded_bytes();
    if bytes.windows(path.len()).any(|bytes| bytes == path) {
        let what = format!("{} holds the path {}", program.display(), workspace().display());
        let hint = "remove env!(\"CARGO_MANIFEST_DIR\") and the like from its sources";
        return Err(Failure::new(what, hint));
    }
    Ok(())
}

/// Copies a file so that its place has the old one or the new one: a program may be running.
fn put(from: &Path, to: &Path) -> Result<(), Failure> {
    let folder = to.parent().unwrap_or(to);
    fs::create_dir_all(folder).map_err(|error| failed(folder, &error))?;
    let temporary = to.with_extension(format!("{}.partial", std::process::id()));
    let copied = fs::copy(from, &temporary).and_then(|_| fs::rename(&temporary, to));
    if let Err(error) = copied {
        // Best effort: the error that is reported is the first one.
        let _ = fs::remove_file(&temporary);
        return Err(failed(to, &error));
    }
    println!("installed: {}", to.display());
    Ok(())
}

fn failed(path: &Path, error: &io::Error) -> Failure {
    Failure::new(
        format!("{}: {error}", path.display()),
        "make sure that it can be read and written",
    )
}
