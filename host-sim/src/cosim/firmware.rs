//! Finds the firmware and the memory map of emulated nodes, in this order:
//!
//! 1. The files given on the command line.
//! 2. The project that contains the current folder, whose firmware is built. No other project is
//!    ever built; in particular, this program does not remember where it was built itself.
//! 3. The files installed alongside this program by `cargo xtask install`, in `../share/host-sim`.

use std::io::{BufRead, BufReader};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use agent_core::package::signature::PublicKey;
use nix::sys::signal::{Signal, killpg};
use nix::unistd::Pid;

use super::qemu::MACHINE;
use crate::stop::Stop;

/// Firmware and memory map of an emulated board.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Firmware {
    /// The program, an ELF file.
    pub program: PathBuf,
    /// The memory map it was linked with.
    pub memory: PathBuf,
}

/// Why the firmware is not available.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FirmwareError {
    /// A file was not found.
    #[error("{0}")]
    NotFound(String),
    /// The project's firmware cannot be built.
    #[error("{0}")]
    Build(String),
    /// The build was stopped.
    #[error("interrupted; nothing is left running")]
    Interrupted,
}

/// Source of firmware and memory map.
enum Source {
    Project(PathBuf),
    Share(PathBuf),
}

/// Finds firmware and memory map; the project's firmware is built. With a `key`, the firmware
/// accepts only packages signed with it. `say` is called with each line of the build's output, and
/// `stop` ends the build.
///
/// # Errors
/// See [`FirmwareError`].
pub fn find(
    program: Option<&Path>,
    memory: Option<&Path>,
    key: Option<&PublicKey>,
    say: fn(&str),
    stop: &Stop,
) -> Result<Firmware, FirmwareError> {
    if let Some(program) = program.filter(|program| !program.is_file()) {
        let problem = format!("{}: no such file", program.display());
        return Err(FirmwareError::NotFound(format!(
            "{problem}; give the firmware's ELF file, or leave out --firmware to build it"
        )));
    }
    if let (Some(program), Some(memory)) = (program, memory) {
        return Ok(Firmware { program: program.to_owned(), memory: memory.to_owned() });
    }
    let source = source()?;
    let from_source = match &source {
        Source::Project(project) => project.join("memory.x"),
        Source::Share(share) => share.join("memory.x"),
    };
    let memory = memory.map_or(from_source, Path::to_owned);
    let program = match (program, &source) {
        (Some(program), _) => program.to_owned(),
        (None, Source::Project(project)) => build(project, key, say, stop)?,
        (None, Source::Share(_)) if key.is_some() => {
            return Err(FirmwareError::NotFound(
                "the installed firmware accepts unsigned packages; give firmware built with the key as \
                 --firmware, or change to the project's folder"
                    .to_owned(),
            ));
        }
        (None, Source::Share(share)) => share.join(installed_name()),
    };
    Ok(Firmware { program, memory })
}

/// Returns the file name of the firmware installed by `cargo xtask install`.
fn installed_name() -> String {
    format!("qemu-{MACHINE}.elf")
}

fn source() -> Result<Source, FirmwareError> {
    let current = std::env::current_dir().map_err(|error| {
        FirmwareError::NotFound(format!(
            "cannot find the current folder: {error}; change to an existing folder"
        ))
    })?;
    if let Some(project) = project_around(&current) {
        return Ok(Source::Project(project));
    }
    // Follow links to the program, to find the folder of the installation.
    let program = std::env::current_exe().and_then(std::fs::canonicalize);
    let share = program.ok().and_then(|program| share_beside(&program));
    share.map(Source::Share).ok_or_else(|| {
        FirmwareError::NotFound(
            "no firmware for emulated nodes: this folder is not in the project, and no firmware is \
             installed alongside this program; give --firmware ELF and --memory MEMORY.X, change to the \
             project's folder, or run `cargo xtask install` there"
                .to_owned(),
        )
    })
}

/// Returns the project that contains `folder`.
fn project_around(folder: &Path) -> Option<PathBuf> {
    let is_project = |folder: &&Path| {
        let files = ["Cargo.toml", "memory.x", "firmware-template/Cargo.toml", "xtask/Cargo.toml"];
        files.iter().all(|file| folder.join(file).is_file())
    };
    folder.ancestors().find(is_project).map(Path::to_owned)
}

/// Returns the folder of the files installed with the program at this path, if any.
fn share_beside(program: &Path) -> Option<PathBuf> {
    let share = program.parent()?.parent()?.join("share").join("host-sim");
    let is_complete = share.join(installed_name()).is_file() && share.join("memory.x").is_file();
    is_complete.then_some(share)
}

/// Builds the project's firmware.
fn build(
    project: &Path,
    key: Option<&PublicKey>,
    say: fn(&str),
    stop: &Stop,
) -> Result<PathBuf, FirmwareError> {
    let mut line = format!("cargo xtask firmware --board qemu-{MACHINE}");
    if let Some(key) = key {
        line += " --public-key ";
        line.extend(key.as_bytes().iter().map(|byte| format!("{byte:02x}")));
    }
    let failed = |what: String| {
        FirmwareError::Build(format!("`{line}` {what}; fix that, or give --firmware ELF"))
    };
    say(&format!("building the firmware in {}: {line}", project.display()));
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut build = Command::new(cargo)
        .args(line.split(' ').skip(1))
        .current_dir(project)
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        // In a separate process group, so that a stop also reaches the compilers.
        .process_group(0)
        .spawn()
        .map_err(|error| failed(format!("cannot be started: {error}")))?;
    let output = build.stdout.take();
    let reader = std::thread::spawn(move || {
        let mut firmware = None;
        for line in output.into_iter().flat_map(|output| BufReader::new(output).lines()) {
            let Ok(line) = line else { break };
            match line.strip_prefix("firmware: ") {
                Some(path) => firmware = Some(PathBuf::from(path)),
                None => say(&line),
            }
        }
        firmware
    });
    let status = wait(&mut build, stop)?;
    let firmware = reader.join().ok().flatten();
    if !status.success() {
        return Err(failed(format!("failed ({status})")));
    }
    let firmware = firmware.map(|path| project.join(path));
    firmware.ok_or_else(|| failed("did not report the path of the firmware".to_owned()))
}

/// Waits for the build to finish, and ends it if a stop is requested.
fn wait(build: &mut Child, stop: &Stop) -> Result<std::process::ExitStatus, FirmwareError> {
    loop {
        let ended = build.try_wait().map_err(|error| {
            FirmwareError::Build(format!("cannot wait for the firmware build: {error}; try again"))
        })?;
        if let Some(status) = ended {
            return Ok(status);
        }
        if stop.is_requested() {
            if let Ok(group) = i32::try_from(build.id()) {
                // It may just have exited.
                let _ = killpg(Pid::from_raw(group), Signal::SIGTERM);
            }
            let _ = build.wait();
            return Err(FirmwareError::Interrupted);
        }
        std::thread::sleep(Duration::from_millis(20));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn touch(path: &Path) {
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, "").unwrap();
    }

    #[test]
    fn a_project_is_found_only_from_inside() {
        let folder = tempfile::tempdir().unwrap();
        let project = folder.path().join("project");
        for file in ["Cargo.toml", "memory.x", "firmware-template/Cargo.toml"] {
            touch(&project.join(file));
        }
        std::fs::create_dir_all(project.join("tests/deep")).unwrap();
        assert_eq!(project_around(&project), None, "incomplete project");
        touch(&project.join("xtask/Cargo.toml"));
        assert_eq!(project_around(&project.join("tests/deep")), Some(project.clone()));
        assert_eq!(project_around(folder.path()), None);
    }

    #[test]
    fn installed_files_are_found_beside_the_program() {
        let folder = tempfile::tempdir().unwrap();
        let share = folder.path().join("share/host-sim");
        let program = folder.path().join("bin/host-sim");
        touch(&share.join("memory.x"));
        assert_eq!(share_beside(&program), None, "incomplete installation");
        touch(&share.join("qemu-mps2-an386.elf"));
        assert_eq!(share_beside(&program), Some(share));
    }

    #[test]
    fn given_files_need_neither() {
        let folder = tempfile::tempdir().unwrap();
        let (program, memory) = (folder.path().join("node.elf"), folder.path().join("memory.x"));
        let error = find(Some(&program), Some(&memory), None, |_| {}, &Stop::default())
            .unwrap_err()
            .to_string();
        assert!(error.contains("node.elf: no such file"), "{error}");
        touch(&program);
        let found = find(Some(&program), Some(&memory), None, |_| {}, &Stop::default()).unwrap();
        assert_eq!(found, Firmware { program, memory });
    }
}
