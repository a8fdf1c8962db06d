//! Temporary files and folders, listed for the whole process so that a signal can remove them.
//!
//! Creating and renaming hold the lock of the list, so a signal handler runs before or after them,
//! and nothing new can be created once the files are removed.

use std::fs::{self, File, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

static LIST: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

/// Prefix and suffix of all their names.
const BEGINNING: &str = ".host-sim-";
const ENDING: &str = ".partial";

fn list() -> MutexGuard<'static, Vec<PathBuf>> {
    // The list is valid at any time, even after a panic while it was locked.
    LIST.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Returns an unused, hidden name in `folder` with this process's id.
fn name_in(folder: &Path) -> PathBuf {
    static COUNT: AtomicU32 = AtomicU32::new(0);
    let count = COUNT.fetch_add(1, Ordering::Relaxed);
    folder.join(format!("{BEGINNING}{}-{count}{ENDING}", std::process::id()))
}

/// Whether a file name has the form of a temporary name.
#[must_use]
pub fn is_temporary(name: &str) -> bool {
    let middle = name.strip_prefix(BEGINNING).and_then(|name| name.strip_suffix(ENDING));
    middle.is_some_and(|middle| {
        !middle.is_empty() && middle.chars().all(|c| c.is_ascii_digit() || c == '-')
    })
}

/// Creates an entry with a new name in `folder`.
fn make<T>(folder: &Path, make: impl Fn(&Path) -> io::Result<T>) -> io::Result<(Temporary, T)> {
    let mut list = list();
    loop {
        let path = name_in(folder);
        match make(&path) {
            // Left by a killed process with the same id.
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
            made => {
                let made = made?;
                list.push(path.clone());
                return Ok((Temporary { path }, made));
            }
        }
    }
}

/// A temporary file or folder, removed when dropped.
#[derive(Debug)]
pub struct Temporary {
    path: PathBuf,
}

impl Temporary {
    /// Creates an empty file in `folder`, open for writing, and sets its mode on systems that
    /// have modes.
    ///
    /// # Errors
    /// The system's error.
    pub fn file(folder: &Path, mode: Option<u32>) -> io::Result<(Self, File)> {
        make(folder, |path| {
            let mut options = OpenOptions::new();
            options.write(true).create_new(true);
            #[cfg(unix)]
            if let Some(mode) = mode {
                std::os::unix::fs::OpenOptionsExt::mode(&mut options, mode);
            }
            #[cfg(not(unix))]
            let _ = mode;
            options.open(path)
        })
    }

    /// Creates an empty folder in `folder`.
    ///
    /// # Errors
    /// The system's error.
    pub fn folder(folder: &Path) -> io::Result<Self> {
        Ok(make(folder, |path| fs::create_dir(path))?.0)
    }

    /// Returns its path.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Renames it to `path` in the same file system.
    ///
    /// # Errors
    /// The system's error; it is then removed.
    pub fn rename(self, path: &Path) -> io::Result<()> {
        let mut list = list();
        fs::rename(&self.path, path)?;
        list.retain(|known| *known != self.path);
        drop(list);
        std::mem::forget(self);
        Ok(())
    }
}

impl Drop for Temporary {
    fn drop(&mut self) {
        let mut list = list();
        remove(&self.path);
        list.retain(|known| *known != self.path);
    }
}

/// Best effort: an error here must not hide the original one.
fn remove(path: &Path) {
    let _ = fs::remove_file(path).or_else(|_| fs::remove_dir_all(path));
}

/// Runs `work` without interruption by signals, for example to move several files into place.
pub(crate) fn uninterrupted<T>(work: impl FnOnce() -> T) -> T {
    let list = list();
    let done = work();
    drop(list);
    done
}

/// Removes all of them because the process is ending; no more can be created afterwards.
pub(crate) fn remove_all() {
    let list = list();
    list.iter().for_each(|path| remove(path));
    // Never unlocked, see above.
    std::mem::forget(list);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn recognises_only_its_own_names() {
        let name = name_in(Path::new("out"));
        assert!(is_temporary(name.file_name().unwrap().to_str().unwrap()));
        for other in [".host-sim-.partial", ".host-sim-mine.partial", "traces.csv", ".host-sim-1-2"]
        {
            assert!(!is_temporary(other), "{other}");
        }
    }

    #[test]
    fn drop_removes_files_and_folders() {
        let folder = std::env::temp_dir();
        let (file, _) = Temporary::file(&folder, None).unwrap();
        let inner = Temporary::folder(&folder).unwrap();
        fs::write(inner.path().join("half"), "done").unwrap();
        let paths = [file.path().to_owned(), inner.path().to_owned()];
        assert!(paths.iter().all(|path| path.exists()));
        drop((file, inner));
        assert!(!paths.iter().any(|path| path.exists()));
    }
}
