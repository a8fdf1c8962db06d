//! Files and folders that only exist while something is written: known to the whole process, so that
//! a signal can remove them.
//!
//! Making one, and renaming it, holds the lock of the list. So a signal that removes them
//! comes before or after that, never in between, and nothing new is made behind it.

use std::fs::{self, File, OpenOptions};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};

static LIST: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());

/// How the names of all of them begin and end.
const BEGINNING: &str = ".host-sim-";
const ENDING: &str = ".partial";

fn list() -> MutexGuard<'static, Vec<PathBuf>> {
    // A list is whole at any moment, also after a panic while it was locked.
    LIST.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A name that nothing has in `folder`, hidden, of this process.
fn name_in(folder: &Path) -> PathBuf {
    static COUNT: AtomicU32 = AtomicU32::new(0);
    let count = COUNT.fetch_add(1, Ordering::Relaxed);
    folder.join(format!("{BEGINNING}{}-{count}{ENDING}", std::process::id()))
}

/// Whether a file's name is one of those that are given here.
#[must_use]
pub fn is_temporary(name: &str) -> bool {
    let middle = name.strip_prefix(BEGINNING).and_then(|name| name.strip_suffix(ENDING));
    middle.is_some_and(|middle| {
        !middle.is_empty() && middle.chars().all(|c| c.is_ascii_digit() || c == '-')
    })
}

/// Makes something under a new name in `folder`.
fn make<T>(folder: &Path, make: impl Fn(&Path) -> io::Result<T>) -> io::Result<(Temporary, T)> {
    let mut list = list();
    loop {
        let path = name_in(folder);
        match make(&path) {
            // Left by a process that was killed and had this one's number.
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
            made => {
                let made = made?;
                list.push(path.clone());
                return Ok((Temporary { path }, made));
            }
        }
    }
}

/// A temporary file or folder; it is removed when this is dropped.
#[derive(Debug)]
pub struct Temporary {
    path: PathBuf,
}

impl Temporary {
    /// A new, empty file in `folder`, open for writing; with this mode, where systems have modes.
    ///
    /// # Errors
    /// What the system says.
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

    /// A new, empty folder in `folder`.
    ///
    /// # Errors
    /// What the system says.
    pub fn folder(folder: &Path) -> io::Result<Self> {
        Ok(make(folder, |path| fs::create_dir(path))?.0)
    }

    /// Where it is.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Puts it in the place of `path`, in the same file system.
    ///
    /// # Errors
    /// What the system says; it is then removed.
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

/// Best effort: an error here must not hide the one that led here.
fn remove(path: &Path) {
    let _ = fs::remove_file(path).or_else(|_| fs::remove_dir_all(path));
}

/// Does something that no signal may interrupt, like putting several files in their places.
pub(crate) fn uninterrupted<T>(work: impl FnOnce() -> T) -> T {
    let list = list();
    let done = work();
    drop(list);
    done
}

/// Removes all of them, since the process ends; none can be made afterwards.
pub(crate) fn remove_all() {
    let list = list();
    list.iter().for_each(|path| remove(path));
    // Kept for good: see above.
    std::mem::forget(list);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_told_apart_from_those_of_others() {
        let name = name_in(Path::new("out"));
        assert!(is_temporary(name.file_name().unwrap().to_str().unwrap()));
        for other in [".host-sim-.partial", ".host-sim-mine.partial", "traces.csv", ".host-sim-1-2"]
        {
            assert!(!is_temporary(other), "{other}");
        }
    }

    #[test]
    fn what_is_dropped_is_removed_with_all_in_it() {
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
