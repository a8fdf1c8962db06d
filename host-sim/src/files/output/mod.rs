//! Writes files atomically, without overwriting files of other kinds.
//!
//! | at the path | result |
//! | --- | --- |
//! | nothing, or an empty file | the file is written |
//! | a file of the same kind, by its content | it is replaced, keeping mode and owner |
//! | any other file, a folder, a socket, a block device | refused |
//! | a link | the link is followed and kept; a missing target is created |
//! | a character device (`/dev/null`), a named pipe, a standard stream | written to |
//!
//! [`OutputFile::prepare`] checks all this before the work whose result is to be written. The bytes
//! go to a temporary file in the same folder, which is renamed once they have all been handed to
//! the system, so an interrupted command leaves the previous file (or none), never half of one.
//! Temporary files are removed after an error or a signal ([`temporary`]).

mod kind;
mod place;
pub mod temporary;

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

pub use kind::FileKind;
use place::Place;
use temporary::Temporary;

/// Why a file could not be written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OutputError {
    /// The system reported an error.
    #[error(
        "{}: {error}; check that the folder is writable and the disk is not full",
        path.display()
    )]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's error.
        #[source]
        error: io::Error,
    },
    /// A file of another kind exists.
    #[error("{}: not {kind}; refusing to overwrite; choose another file name", path.display())]
    OtherKind {
        /// The file.
        path: PathBuf,
        /// The kind to be written.
        kind: &'static str,
    },
    /// Something else has the name of a result in a folder for results.
    #[error(
        "{}: not {kind}; refusing to overwrite; move it, or choose another folder with --out",
        path.display()
    )]
    OtherInFolder {
        /// The file.
        path: PathBuf,
        /// The kind to be written.
        kind: &'static str,
    },
    /// A file has the name of a result, but no run or study in its folder wrote it.
    #[error(
        "{}: not from a previous run here; refusing to overwrite; move it, or choose another folder with --out",
        path.display()
    )]
    NotOurs {
        /// The file.
        path: PathBuf,
    },
    /// The path is something that a file cannot replace.
    #[error("{}: is {what}; choose a file name", path.display())]
    NotAFile {
        /// The path.
        path: PathBuf,
        /// What is there.
        what: &'static str,
    },
    /// A file is where a folder should be.
    #[error("{}{} is not a folder; choose another one", place_of(path, file), file.display())]
    NotAFolder {
        /// The folder, or the file in it.
        path: PathBuf,
        /// The file in place of the folder.
        file: PathBuf,
    },
    /// The file belongs to another user.
    #[error(
            "{}: belongs to another user, and a replacement would change the owner; choose another file \
             name, or remove this file first",
        path.display()
    )]
    Owner {
        /// The file.
        path: PathBuf,
    },
    /// A named pipe without a reader.
    #[error("{}: nothing reads from this pipe; start its reader first", path.display())]
    NoReader {
        /// The pipe.
        path: PathBuf,
    },
}

/// Returns the path before what is said of the file on it, unless they are the same.
fn place_of(path: &Path, file: &Path) -> String {
    if path == file { String::new() } else { format!("{}: ", path.display()) }
}

impl OutputError {
    /// Returns the path of the file or folder.
    #[must_use]
    pub fn path(&self) -> &Path {
        match self {
            Self::Write { path, .. }
            | Self::OtherKind { path, .. }
            | Self::OtherInFolder { path, .. }
            | Self::NotOurs { path }
            | Self::NotAFile { path, .. }
            | Self::NotAFolder { path, .. }
            | Self::Owner { path }
            | Self::NoReader { path } => path,
        }
    }

    /// Returns the error of writing the file or folder `path`.
    fn of(path: &Path, error: io::Error) -> Self {
        let path = path.to_owned();
        let file = match error.kind() {
            io::ErrorKind::NotADirectory => file_on(&path),
            _ => None,
        };
        match file {
            Some(file) => Self::NotAFolder { file: file.to_owned(), path },
            None => Self::Write { path, error },
        }
    }

    /// Whether writing was refused because of an existing file, not by the system.
    #[must_use]
    pub fn is_refusal(&self) -> bool {
        matches!(
            self,
            Self::OtherKind { .. }
                | Self::OtherInFolder { .. }
                | Self::NotOurs { .. }
                | Self::NotAFile { .. }
                | Self::Owner { .. }
        )
    }
}

/// Size of the write buffer. \[bytes\]
const BUFFER: usize = 1 << 18;

/// A file that can be written, as far as can be determined in advance.
#[derive(Debug)]
pub struct OutputFile {
    path: PathBuf,
    kind: FileKind,
    target: Target,
}

#[derive(Debug)]
enum Target {
    /// A regular file, or nothing yet.
    File { temporary: Temporary, file: File, place: PathBuf, made: MadeFolders },
    /// A stream to write to.
    Stream(File),
}

impl OutputFile {
    /// Checks that a file of this kind can be written at `path`, and creates a temporary file and
    /// missing folders. They are removed if this is dropped without [`Self::write`].
    ///
    /// # Errors
    /// See [`OutputError`].
    pub fn prepare(path: &Path, kind: FileKind) -> Result<Self, OutputError> {
        Self::prepare_with(path, kind, None)
    }

    /// With a `mode`, the file has that one and belongs to this user, whatever was there before.
    fn prepare_with(path: &Path, kind: FileKind, mode: Option<u32>) -> Result<Self, OutputError> {
        let failed = |error| OutputError::of(path, error);
        let target = match place::find(path)? {
            Place::Stream(file) => Target::Stream(file),
            Place::File(place) => {
                if place.file_name().is_none() {
                    let error = io::Error::new(io::ErrorKind::InvalidInput, "not a file name");
                    return Err(failed(error));
                }
                let before = place::check(path, &place, kind)?;
                let folder = match place.parent() {
                    Some(folder) if !folder.as_os_str().is_empty() => folder,
                    _ => Path::new("."),
                };
                let made = MadeFolders::make(folder).map_err(failed)?;
                let old_mode = before.as_ref().map(place::mode);
                let (temporary, file) =
                    Temporary::file(folder, mode.or(old_mode)).map_err(failed)?;
                if let Some(before) = before.filter(|_| mode.is_none()) {
                    place::copy_attributes(&file, &before)
                        .map_err(|_| OutputError::Owner { path: path.to_owned() })?;
                }
                Target::File { temporary, file, place, made }
            }
        };
        Ok(Self { path: path.to_owned(), kind, target })
    }

    /// Writes the file: `fill` provides its content.
    ///
    /// # Errors
    /// Returns an error of `fill` or of the system, or if a file of another kind has appeared in
    /// the meantime; then the previous content is unchanged.
    pub fn write(
        self,
        fill: impl FnOnce(&mut dyn Write) -> io::Result<()>,
    ) -> Result<(), OutputError> {
        self.finish(fill, true)
    }

    /// With `durable`, the bytes are on the disk before the old file is replaced.
    fn finish(
        self,
        fill: impl FnOnce(&mut dyn Write) -> io::Result<()>,
        durable: bool,
    ) -> Result<(), OutputError> {
        let Self { path, kind, target } = self;
        let failed = |error| OutputError::of(&path, error);
        match target {
            Target::Stream(file) => filled(file, fill).map(drop).map_err(failed),
            Target::File { temporary, file, place, made } => {
                let file = filled(file, fill).map_err(failed)?;
                if durable {
                    // A delayed write may fail; at this point the old file still exists.
                    file.sync_data().map_err(failed)?;
                }
                place::check(&path, &place, kind)?;
                temporary.rename(&place).map_err(failed)?;
                made.keep();
                Ok(())
            }
        }
    }
}

fn filled(file: File, fill: impl FnOnce(&mut dyn Write) -> io::Result<()>) -> io::Result<File> {
    let mut file = BufWriter::with_capacity(BUFFER, file);
    match fill(&mut file).and_then(|()| file.flush()) {
        Ok(()) => file.into_inner().map_err(io::IntoInnerError::into_error),
        Err(error) => {
            // Discard what is left in the buffer.
            drop(file.into_parts());
            Err(error)
        }
    }
}

/// Writes `path` atomically: [`OutputFile::prepare`] followed by [`OutputFile::write`].
///
/// # Errors
/// Same as these.
pub fn write_whole(
    path: &Path,
    kind: FileKind,
    fill: impl FnOnce(&mut dyn Write) -> io::Result<()>,
) -> Result<(), OutputError> {
    OutputFile::prepare(path, kind)?.write(fill)
}

/// Like [`write_whole`], for a new file with secrets, which only its owner can read on systems that have
/// modes.
///
/// # Errors
/// Same as [`write_whole`]; a file that exists and is not empty is never replaced.
pub fn write_secret(
    path: &Path,
    fill: impl FnOnce(&mut dyn Write) -> io::Result<()>,
) -> Result<(), OutputError> {
    OutputFile::prepare_with(path, FileKind::NEW, Some(0o600))?.write(fill)
}

/// Like [`write_whole`], without waiting for the disk: for the many files of a run, which can be
/// regenerated.
///
/// # Errors
/// Same as [`write_whole`].
pub fn write_result(
    path: &Path,
    kind: FileKind,
    fill: impl FnOnce(&mut dyn Write) -> io::Result<()>,
) -> Result<(), OutputError> {
    OutputFile::prepare(path, kind)?.finish(fill, false)
}

/// Resolves links and returns the regular file, existing or not, at `path`; `None` for a stream to
/// write to.
///
/// # Errors
/// See [`OutputError`].
pub fn destination(path: &Path) -> Result<Option<PathBuf>, OutputError> {
    Ok(match place::find(path)? {
        Place::File(place) => Some(place),
        Place::Stream(_) => None,
    })
}

/// Copies mode and owner of the previous file to its replacement.
///
/// # Errors
/// The system's error, usually because the owner is another user.
pub fn copy_attributes(new: &Path, before: &fs::Metadata) -> io::Result<()> {
    place::copy_attributes(&File::open(new)?, before)
}

/// Creates a folder for results, and its parents.
///
/// # Errors
/// The system's error, or a file is where the folder or one above it should be.
pub fn make_folder(folder: &Path) -> Result<(), OutputError> {
    create_folders(folder).map_err(|error| OutputError::of(folder, error))
}

/// Creates a folder and its parents.
///
/// # Errors
/// The system's error; of the kind [`io::ErrorKind::NotADirectory`], with the name of the file, if one is where a
/// folder should be.
pub fn create_folders(folder: &Path) -> io::Result<()> {
    if let Some(file) = file_on(folder) {
        let text = format!("{} is not a folder", file.display());
        return Err(io::Error::new(io::ErrorKind::NotADirectory, text));
    }
    fs::create_dir_all(folder)
}

/// Returns what is not a folder at `path` or above it.
fn file_on(path: &Path) -> Option<&Path> {
    // Without a slash at the end, with which a file is not found.
    let path = path.components().as_path();
    path.ancestors().find(|path| match fs::metadata(path) {
        Ok(found) => !found.is_dir(),
        // A link that leads nowhere.
        Err(_) => fs::symlink_metadata(path).is_ok(),
    })
}

/// Folders created for a file; removed again if it is not written.
#[derive(Debug)]
struct MadeFolders(Vec<PathBuf>);

impl MadeFolders {
    fn make(folder: &Path) -> io::Result<Self> {
        let missing = folder.ancestors().take_while(|ancestor| {
            !ancestor.as_os_str().is_empty() && fs::symlink_metadata(ancestor).is_err()
        });
        // The innermost first.
        let made = Self(missing.map(Path::to_owned).collect());
        create_folders(folder)?;
        Ok(made)
    }

    fn keep(mut self) {
        self.0.clear();
    }
}

impl Drop for MadeFolders {
    fn drop(&mut self) {
        for folder in &self.0 {
            // Only removes empty folders.
            if fs::remove_dir(folder).is_err() {
                break;
            }
        }
    }
}

#[cfg(test)]
mod tests;
