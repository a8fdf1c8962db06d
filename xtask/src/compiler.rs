//! Finds a compiler for bare metal.
//!
//! This is the active toolchain, if it has the targets. Otherwise it is Debian's compiler, which
//! includes the sources of `core` and `alloc` but not their bare-metal builds: these are built
//! once, into a sysroot in the target folder, and a two-line `rustc` script selects that sysroot
//! and Debian's linker.

use std::{
    env, fs, io,
    path::{Path, PathBuf},
    process::Command,
    time::Instant,
};

use crate::{
    packages,
    step::{Failure, ask, run, target_folder},
};

/// Compiler, cargo, library sources, and linker.
const PACKAGES: [&str; 4] = ["rustc-web", "cargo-web", "rust-web-src", "lld"];
const RUSTC: &str = "/usr/bin/rustc";
const CARGO: &str = "/usr/bin/cargo";
/// Debian's clippy. Called by path, because the active toolchain has one, too.
const CLIPPY: &str = "/usr/bin/clippy-driver";
const CLIPPY_PACKAGE: &str = "rust-web-clippy";
/// Debian's location of the libraries.
const RUSTLIB: &str = "/usr/lib/rustlib";
/// The linker, for which the bare-metal targets use Rust's name.
const LLD: &str = "/usr/bin/lld";
const CRATES: [&str; 3] = ["core", "alloc", "compiler_builtins"];

/// Every target that any task builds for. The sysroot always has all of them, so that no task
/// discards the builds of another.
const TARGETS: [&str; 4] = [
    "thumbv6m-none-eabi",
    "thumbv7em-none-eabihf",
    "thumbv8m.main-none-eabihf",
    "riscv32imac-unknown-none-elf",
];

/// A compiler with all requested targets.
#[derive(Debug)]
pub(crate) struct Compiler {
    rustc: Option<PathBuf>,
}

impl Compiler {
    /// Finds or sets up a compiler for `targets`.
    ///
    /// # Errors
    /// The active toolchain lacks a target, and Debian's compiler is not allowed or cannot be set
    /// up.
    pub(crate) fn find(targets: &[&str], debian: bool) -> Result<Self, Failure> {
        let Some(missing) = install_for(targets, debian)? else {
            println!("compiler: the active toolchain has every target");
            return Ok(Self { rustc: None });
        };
        println!("compiler: the active toolchain lacks {missing}; using Debian's");
        Ok(Self { rustc: Some(sysroot()?) })
    }

    /// Returns a short name of it, for files that it makes.
    pub(crate) fn name(&self) -> &'static str {
        if self.rustc.is_some() { "debian" } else { "active" }
    }

    /// Makes `command`, a call of cargo, use this compiler and a separate target folder, so that
    /// the host's builds are kept.
    pub(crate) fn apply<'command>(&self, command: &'command mut Command) -> &'command mut Command {
        // Flags for the host are not valid for the targets, whose flags are in the workspace.
        command.env_remove("RUSTFLAGS").env_remove("CARGO_ENCODED_RUSTFLAGS");
        if let Some(rustc) = &self.rustc {
            command.env("RUSTC", rustc);
        }
        command.env("CARGO_TARGET_DIR", cross_folder())
    }

    /// Makes `command`, a call of `cargo rustc` for a separate workspace, run clippy in place of the compiler on the
    /// crates of that workspace. Unlike with `cargo clippy`, their dependencies are those that were built for the
    /// firmware.
    ///
    /// # Errors
    /// Debian's clippy is needed and cannot be installed.
    pub(crate) fn apply_clippy<'command>(
        &self,
        command: &'command mut Command,
    ) -> Result<&'command mut Command, Failure> {
        let mut clippy = active_sysroot()?.join("bin/clippy-driver");
        if self.rustc.is_some() {
            // It reads the libraries' metadata, so both are of the same version.
            if packages::version(CLIPPY_PACKAGE) != packages::version(PACKAGES[0]) {
                packages::install(&[CLIPPY_PACKAGE])?;
            }
            clippy = PathBuf::from(CLIPPY);
            command.env("SYSROOT", sysroot_folder()).env_remove("LD_LIBRARY_PATH");
        }
        if !clippy.is_file() {
            return Err(Failure::new(
                format!("{}: there is no clippy", clippy.display()),
                "rustup component add clippy",
            ));
        }
        // As `cargo clippy -- -D warnings` passes it, also to build scripts.
        command.env("CLIPPY_ARGS", "-Dwarnings__CLIPPY_HACKERY__");
        Ok(self.apply(command.env("RUSTC_WORKSPACE_WRAPPER", clippy)))
    }
}

/// Installs Debian's compiler if the active toolchain lacks some of `targets`, and returns which.
///
/// # Errors
/// Same as for [`Compiler::find`].
pub(crate) fn install_for(targets: &[&str], debian: bool) -> Result<Option<String>, Failure> {
    let missing: Vec<&str> =
        targets.iter().copied().filter(|target| !active_toolchain_has(target)).collect();
    if missing.is_empty() {
        return Ok(None);
    }
    let missing = missing.join(" ");
    if !packages::allowed(debian) {
        return Err(Failure::new(
            format!("the active toolchain cannot compile for {missing}"),
            format!("rustup target add {missing}   (or, on Debian: cargo xtask ... --debian)"),
        ));
    }
    install()?;
    Ok(Some(missing))
}

/// Returns the target folder of the cross-builds.
pub(crate) fn cross_folder() -> PathBuf {
    target_folder().join("cross")
}

/// Returns the folder of the active toolchain's own programs: its linker, LLVM's tools.
pub(crate) fn toolchain_programs() -> Option<PathBuf> {
    let library = ask(active_rustc().args(["--print", "target-libdir"]))?;
    Some(Path::new(library.trim()).parent()?.join("bin"))
}

/// Returns the target triple of this machine.
pub(crate) fn host() -> Option<String> {
    let answer = ask(active_rustc().arg("-vV"))?;
    Some(answer.lines().find_map(|line| line.strip_prefix("host: "))?.to_owned())
}

fn active_rustc() -> Command {
    Command::new(env::var_os("RUSTC").unwrap_or_else(|| "rustc".into()))
}

/// Returns whether the active toolchain can compile for `target`.
pub(crate) fn active_toolchain_has(target: &str) -> bool {
    ask(active_rustc().args(["--print", "target-libdir", "--target", target]))
        .is_some_and(|folder| library(Path::new(folder.trim()), "core").is_ok())
}

/// Returns the folder of the active toolchain.
fn active_sysroot() -> Result<PathBuf, Failure> {
    let folder = ask(active_rustc().args(["--print", "sysroot"]));
    folder.map(|folder| PathBuf::from(folder.trim())).ok_or_else(|| {
        Failure::new(
            "rustc does not report its folder",
            "check the output of `rustc --print sysroot`",
        )
    })
}

/// Returns the compiled library with that name in `folder`.
fn library(folder: &Path, name: &str) -> io::Result<PathBuf> {
    let start = format!("lib{name}-");
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        let file = path.file_name().unwrap_or_default().to_string_lossy();
        if file.starts_with(&start) && file.ends_with(".rlib") {
            return Ok(path);
        }
    }
    Err(io::Error::new(
        io::ErrorKind::NotFound,
        format!("no {start}*.rlib in {}", folder.display()),
    ))
}

fn install() -> Result<(), Failure> {
    let complete = PACKAGES.iter().all(|package| packages::version(package).is_some());
    if !complete || release().is_none_or(|(_, numbers)| numbers < needed()) {
        packages::install(&PACKAGES)?;
    }
    match release() {
        Some((_, numbers)) if numbers >= needed() => Ok(()),
        found => Err(Failure::new(
            format!(
                "{RUSTC} is {}, this workspace needs {}",
                found.map_or("missing".into(), |(text, _)| text),
                env!("CARGO_PKG_RUST_VERSION")
            ),
            "add Debian's security updates to the package sources",
        )),
    }
}

/// Returns the version of Debian's compiler, as text and as numbers.
fn release() -> Option<(String, Vec<u32>)> {
    let answer = ask(Command::new(RUSTC).arg("-vV"))?;
    let text = answer.lines().find_map(|line| line.strip_prefix("release: "))?;
    Some((text.to_owned(), numbers(text)))
}

fn needed() -> Vec<u32> {
    numbers(env!("CARGO_PKG_RUST_VERSION"))
}

fn numbers(version: &str) -> Vec<u32> {
    version.split('.').map_while(|part| part.parse().ok()).collect()
}

/// Returns the folder of the sysroot for Debian's compiler.
pub(crate) fn sysroot_folder() -> PathBuf {
    let (version, _) = release().unwrap_or_default();
    target_folder().join(format!("sysroot-{version}"))
}

/// Builds the sysroot, unless it exists, and returns its `rustc`.
fn sysroot() -> Result<PathBuf, Failure> {
    let start = Instant::now();
    let prefix = sysroot_folder();
    let rustc = prefix.join("bin/rustc");
    let stamp = prefix.join("stamp");
    let package_versions = PACKAGES.map(|name| packages::version(name).unwrap_or_default());
    let wanted = format!("with a linker\n{}\n{}\n", package_versions.join(" "), TARGETS.join(" "));
    if fs::read_to_string(&stamp).is_ok_and(|found| found == wanted) {
        let seconds = start.elapsed().as_secs_f64();
        println!("compiler: {} is up to date, {seconds:.1} s", prefix.display());
        return Ok(rustc);
    }

    let failed = |error: io::Error| {
        Failure::new(
            format!("sysroot {}: {error}", prefix.display()),
            "delete the target folder and try again; check that the disk has 1 GB free",
        )
    };
    // Artifacts built with an older sysroot do not match the new one.
    for stale in [&prefix, &cross_folder()] {
        match fs::remove_dir_all(stale) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(failed(error)),
            _ => {}
        }
    }
    let scratch = prefix.join("build");
    write_scratch_crate(&scratch).map_err(failed)?;
    run(
        "core and alloc for bare metal",
        &mut build_command(&scratch),
        "see the compiler's error; all of Debian's Rust packages must have the same version",
    )?;
    lay_out(&prefix, &scratch).map_err(failed)?;
    fs::write(&stamp, wanted).map_err(failed)?;
    Ok(rustc)
}

/// Writes an empty crate, because cargo builds `core` only as a dependency.
fn write_scratch_crate(folder: &Path) -> io::Result<()> {
    fs::create_dir_all(folder.join("src"))?;
    fs::write(folder.join("src/lib.rs"), "#![no_std]\n")?;
    fs::write(
        folder.join("Cargo.toml"),
        "[package]\nname = \"empty\"\nversion = \"0.0.0\"\nedition = \"2024\"\n\n[workspace]\n",
    )
}

fn build_command(scratch: &Path) -> Command {
    let vendored = format!("source.debian.directory=\"{RUSTLIB}/src/rust/library/vendor\"");
    let mut command = Command::new(CARGO);
    command
        .current_dir(scratch)
        // This program runs inside the active toolchain's cargo, whose settings do not apply.
        .env_remove("CARGO_ENCODED_RUSTFLAGS")
        .env_remove("LD_LIBRARY_PATH")
        .env("RUSTC", RUSTC)
        // Only to build core itself, which stable compilers otherwise refuse.
        .env("RUSTC_BOOTSTRAP", "1")
        // The firmware's link-time optimisation reads the bitcode.
        .env("RUSTFLAGS", "-Cembed-bitcode=yes")
        .env("CARGO_PROFILE_RELEASE_CODEGEN_UNITS", "1")
        .env("CARGO_TARGET_DIR", scratch.join("target"))
        .args(["build", "--quiet", "--offline", "--release", "-Zbuild-std=core,alloc"])
        .args(["--config", "source.crates-io.replace-with=\"debian\"", "--config", &vendored]);
    for target in TARGETS {
        command.args(["--target", target]);
    }
    command
}

/// Moves the built libraries to where rustc looks for them, and links the rest of Debian's files.
fn lay_out(prefix: &Path, scratch: &Path) -> io::Result<()> {
    let rustlib = prefix.join("lib/rustlib");
    for target in TARGETS {
        let folder = rustlib.join(target).join("lib");
        fs::create_dir_all(&folder)?;
        let built = scratch.join("target").join(target).join("release/deps");
        for name in CRATES {
            let path = library(&built, name)?;
            fs::rename(&path, folder.join(path.file_name().unwrap_or_default()))?;
        }
    }
    fs::remove_dir_all(scratch)?;
    // The host's own libraries are needed too, for build scripts and procedural macros.
    for entry in fs::read_dir(RUSTLIB)? {
        let entry = entry?;
        let link = rustlib.join(entry.file_name());
        if !link.exists() {
            call(Command::new("ln").arg("-s").arg(entry.path()).arg(link))?;
        }
    }
    let programs = prefix.join("bin");
    fs::create_dir_all(&programs)?;
    call(Command::new("ln").args(["-s", LLD]).arg(programs.join("rust-lld")))?;
    let rustc = programs.join("rustc");
    let call_rustc = format!("exec {RUSTC} --sysroot \"${{0%/*}}/..\" \"$@\"");
    fs::write(&rustc, format!("#!/bin/sh\nPATH=\"${{0%/*}}:$PATH\" {call_rustc}\n"))?;
    call(Command::new("chmod").arg("755").arg(rustc))
}

/// Runs a command without output.
fn call(command: &mut Command) -> io::Result<()> {
    if command.status()?.success() {
        return Ok(());
    }
    Err(io::Error::other(format!("{} failed", command.get_program().display())))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn versions_compare_as_numbers() {
        assert!(numbers("1.100.0") > numbers("1.89"));
        assert!(numbers("1.89.0") >= numbers("1.89"));
        assert!(numbers("1.85.0") < numbers("1.89"));
    }
}
