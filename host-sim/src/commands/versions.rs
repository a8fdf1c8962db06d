//! Versions of packages: which one is next, and that no two commands give the same one away.

use std::fs::{File, TryLockError};
use std::path::Path;
use std::time::{Duration, Instant};

use super::CommandError;
use crate::files::output::OutputFile;
use crate::packages::PackageBytes;
use crate::signing::OperatorKey;

/// How long another training may take to write its package; a run holds its folder to its end.
const LOCK_WAIT: Duration = Duration::from_secs(2);

/// The version after `version`.
///
/// # Errors
/// There is none after the largest.
pub(super) fn after(version: u32, of: &Path) -> Result<u32, CommandError> {
    version.checked_add(1).ok_or_else(|| {
        CommandError::usage(format!(
            "{}: has version {version}, the largest there is; nodes take none after it. Give an \
             older version with --package-version, and sign the package with --replaces {version}",
            of.display()
        ))
        .about(of)
    })
}

/// Writes `package`, signed with `key`, to `out`. If a package has come to lie there since its
/// version was chosen, it gets the next one, unless `chosen` by the user; returns what was written.
///
/// # Errors
/// As [`OutputFile::write`], and versions that are used up.
pub(super) fn save(
    mut package: PackageBytes,
    chosen: Option<u32>,
    key: Option<&OperatorKey>,
    out: &Path,
    output: OutputFile,
) -> Result<PackageBytes, CommandError> {
    let _lock = lock(out)?;
    // An empty file, as `mktemp` makes one, has no version.
    let filled = std::fs::metadata(out).is_ok_and(|there| there.is_file() && there.len() > 0);
    if chosen.is_none() && filled {
        let there = PackageBytes::load(out)?;
        let (there, own) = (there.package().version, package.package().version);
        if there >= own {
            package = package.renumbered(after(there, out)?);
        }
    }
    if let Some(key) = key {
        package = package.signed(key);
    }
    output.write(|file| file.write_all(package.as_bytes()))?;
    Ok(package)
}

/// Keeps other trainings from writing into the folder of `path` while the value lives. Where folders
/// cannot be locked, nothing is.
///
/// # Errors
/// [`ErrorCode::FolderInUse`](super::ErrorCode) if another command does not let go of it in [`LOCK_WAIT`].
fn lock(path: &Path) -> Result<Option<File>, CommandError> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    let folder = folder.unwrap_or(Path::new("."));
    let Ok(file) = File::open(folder) else { return Ok(None) };
    let deadline = Instant::now() + LOCK_WAIT;
    loop {
        match file.try_lock() {
            Ok(()) => return Ok(Some(file)),
            Err(TryLockError::Error(_)) => return Ok(None),
            Err(TryLockError::WouldBlock) if Instant::now() >= deadline => {
                return Err(CommandError::folder_in_use(folder));
            }
            Err(TryLockError::WouldBlock) => std::thread::sleep(Duration::from_millis(10)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_that_another_run_holds_is_told_and_not_waited_for_without_end() {
        let folder = tempfile::tempdir().unwrap();
        let held = File::open(folder.path()).unwrap();
        held.try_lock().unwrap();
        let refused = lock(&folder.path().join("node.weights"));
        assert!(
            matches!(refused, Err(error) if error.code() == crate::commands::ErrorCode::FolderInUse)
        );
        drop(held);
        assert!(lock(&folder.path().join("node.weights")).unwrap().is_some());
    }
}
