//! Versions of packages: which one is next, and that no two commands give the same one away.

use std::fs::File;
use std::path::Path;

use super::CommandError;
use crate::output_file::OutputFile;
use crate::packages::PackageBytes;
use crate::signing::OperatorKey;

/// The version after `version`.
///
/// # Errors
/// There is none after the largest.
pub(super) fn after(version: u32, of: &Path) -> Result<u32, CommandError> {
    version.checked_add(1).ok_or_else(|| {
        CommandError::Usage(format!(
            "{}: has version {version}, the largest there is; nodes take none after it. Give an \
             older version with --package-version, and sign the package with --replaces {version}",
            of.display()
        ))
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
    let _lock = lock(out);
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

/// Keeps other commands from writing into the folder of `path` while the value lives. Where folders
/// cannot be locked, nothing is.
fn lock(path: &Path) -> Option<File> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    let folder = File::open(folder.unwrap_or(Path::new("."))).ok()?;
    folder.lock().ok()?;
    Some(folder)
}
