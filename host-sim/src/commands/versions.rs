//! Package versions: choosing the next one without races between commands.

use std::fs::{File, TryLockError};
use std::path::Path;
use std::time::{Duration, Instant};

use agent_core::package::Serial;

use super::CommandError;
use super::package_format::{PackageFormat, unfit};
use crate::files::output::OutputFile;
use crate::offline::version_after;
use crate::packages::PackageBytes;
use crate::signing::OperatorKey;

/// How long to wait for a folder that another command has locked. A training holds it only to write
/// its package, but a run holds it until its end.
const LOCK_WAIT: Duration = Duration::from_secs(2);

/// Writes `package`, in this format and signed with `key`, to `out`, and returns it as written. If a package of the
/// same or a later version is there by now, the version is increased, unless the user has `chosen`
/// one.
///
/// # Errors
/// Same as [`OutputFile::write`] and [`after`], or if the format cannot hold the package.
pub(super) fn save(
    mut package: PackageBytes,
    chosen: Option<u32>,
    format: PackageFormat,
    key: Option<&OperatorKey>,
    out: &Path,
    output: OutputFile,
) -> Result<PackageBytes, CommandError> {
    let _lock = lock(out)?;
    // An empty file, as created by `mktemp`, has no version.
    let nonempty = std::fs::metadata(out).is_ok_and(|there| there.is_file() && there.len() > 0);
    if chosen.is_none() && nonempty {
        let there = PackageBytes::load(out)?;
        let (there, own) = (there.package().serial(), package.package().serial());
        if there >= own {
            let serial = Serial { epoch: there.epoch, version: version_after(there, out)? };
            package = package.with_serial(serial).map_err(|error| unfit(error, out))?;
        }
    }
    package = format.apply(&package, out)?;
    if let Some(key) = key {
        package = package.signed(key);
    }
    output.write(|file| file.write_all(package.as_bytes()))?;
    Ok(package)
}

/// Locks the folder that contains `path` against other training runs until the returned file is dropped. Returns
/// `None` on file systems that cannot lock folders.
///
/// # Errors
/// [`ErrorCode::FolderInUse`](super::ErrorCode) if another command holds the lock for longer than
/// [`LOCK_WAIT`].
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
    fn waiting_for_a_locked_folder_ends_with_an_error() {
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
