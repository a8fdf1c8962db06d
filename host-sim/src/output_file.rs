//! Files that are either whole or not there.
//!
//! A file is written under a temporary name beside its place and renamed into it once every
//! byte has been handed to the system, so that an interrupted run leaves the file of the run before
//! (or none), never half of one.

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

/// A result file could not be written.
#[derive(Debug, thiserror::Error)]
#[error("{}: {error}; make sure that the folder can be written to and the disk is not full", path.display())]
pub struct OutputError {
    /// The file.
    pub path: PathBuf,
    /// What the system says.
    #[source]
    pub error: io::Error,
}

/// Bytes that are gathered before they go to the system.
const BUFFER: usize = 1 << 18;

/// Writes `path` whole: `write` fills a temporary file that then takes the place of `path`.
/// Folders that do not exist yet are made.
///
/// # Errors
/// What `write` or the system says; `path` is then as it was before.
pub fn write_whole(
    path: &Path,
    write: impl FnOnce(&mut dyn Write) -> io::Result<()>,
) -> Result<(), OutputError> {
    let named = |error| OutputError { path: path.to_owned(), error };
    let temporary = temporary_beside(path).map_err(named)?;
    let written = write_and_rename(path, &temporary, write);
    if written.is_err() {
        // Best effort: the error that is reported is the first one.
        let _ = fs::remove_file(&temporary);
    }
    written.map_err(named)
}

fn write_and_rename(
    path: &Path,
    temporary: &Path,
    write: impl FnOnce(&mut dyn Write) -> io::Result<()>,
) -> io::Result<()> {
    if let Some(folder) = path.parent().filter(|folder| !folder.as_os_str().is_empty()) {
        fs::create_dir_all(folder)?;
    }
    let mut file = BufWriter::with_capacity(BUFFER, File::create(temporary)?);
    write(&mut file)?;
    file.into_inner().map_err(io::IntoInnerError::into_error)?;
    fs::rename(temporary, path)
}

/// A hidden name in the same folder (renaming across file systems fails), of this process only.
fn temporary_beside(path: &Path) -> io::Result<PathBuf> {
    let name = path
        .file_name()
        .ok_or_else(|| io::Error::new(io::ErrorKind::InvalidInput, "not the name of a file"))?;
    let mut hidden = std::ffi::OsString::from(".");
    hidden.push(name);
    hidden.push(format!(".{}.partial", std::process::id()));
    Ok(path.with_file_name(hidden))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_failed_write_leaves_the_old_file_and_no_other() {
        let folder = std::env::temp_dir().join(format!("output-file-{}", std::process::id()));
        let path = folder.join("made/on/the/way/result.csv");
        write_whole(&path, |file| file.write_all(b"whole")).unwrap();
        let failed = write_whole(&path, |file| {
            file.write_all(b"half")?;
            Err(io::Error::other("the power went"))
        });
        let message = failed.unwrap_err().to_string();
        assert!(message.contains("result.csv") && message.contains("the power went"), "{message}");
        assert_eq!(fs::read(&path).unwrap(), b"whole");
        let siblings = fs::read_dir(path.parent().unwrap()).unwrap().count();
        assert_eq!(siblings, 1, "a temporary file was left behind");
        fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn a_path_without_a_file_name_is_refused() {
        let error = write_whole(Path::new("/"), |_| Ok(())).unwrap_err();
        assert_eq!(error.error.kind(), io::ErrorKind::InvalidInput);
    }
}
