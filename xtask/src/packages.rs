//! Installs Debian packages, on machines that have them.

use std::{
    fs::{self, File},
    io,
    path::Path,
    process::Command,
};

use crate::step::{Failure, ask, in_ci, on_path, run, target_folder};

/// Whether packages may be installed without asking: with `--debian`, in continuous integration, or
/// as root on Debian.
pub(crate) fn allowed(debian: bool) -> bool {
    on_path("apt-get")
        && (debian || in_ci() || (Path::new("/etc/debian_version").exists() && is_root()))
}

/// Returns the installed version of a package.
pub(crate) fn version(package: &str) -> Option<String> {
    let format = "--showformat=${db:Status-Status} ${Version}";
    let answer = ask(Command::new("dpkg-query").args(["--show", format, package]))?;
    answer.strip_prefix("installed ").map(str::to_owned)
}

/// Installs the newest available versions of `packages`.
///
/// # Errors
/// Not run as root, or apt-get failed.
pub(crate) fn install(packages: &[&str]) -> Result<(), Failure> {
    if !is_root() {
        return Err(Failure::new(
            format!("packages are missing: {}", packages.join(" ")),
            format!(
                "sudo apt-get update && sudo apt-get install --no-install-recommends {}",
                packages.join(" ")
            ),
        ));
    }
    // Tasks run at the same time.
    let lock = target_folder().join("packages.lock");
    let held = fs::create_dir_all(target_folder()).and_then(|()| File::create(&lock));
    let held = held.and_then(|file| wait_for(&file).map(|()| file)).map_err(|error| {
        Failure::new(format!("{}: {error}", lock.display()), "check that the file is writable")
    })?;
    let hint = "see the output of apt-get; the packages are in Debian 12 with its security updates";
    // An old list may offer a compiler that is too old, so it is always updated.
    run("package list", apt_get().args(["update"]), hint)?;
    run(
        "packages",
        apt_get().args(["install", "--yes", "--no-install-recommends"]).args(packages),
        hint,
    )?;
    drop(held);
    Ok(())
}

/// Locks the file, and says so if that takes time.
fn wait_for(file: &File) -> io::Result<()> {
    match file.try_lock() {
        Ok(()) => Ok(()),
        Err(_) => {
            println!("waiting for another task that installs packages");
            file.lock()
        }
    }
}

fn apt_get() -> Command {
    let mut command = Command::new("apt-get");
    command.env("DEBIAN_FRONTEND", "noninteractive").arg("-qq").arg("-oDpkg::Use-Pty=0");
    command
}

fn is_root() -> bool {
    ask(Command::new("id").arg("-u")).is_some_and(|user| user.trim() == "0")
}
