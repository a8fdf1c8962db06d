//! Files that are either whole or not there, and that take the place of nothing else.
//!
//! | what is at the path | what happens |
//! | --- | --- |
//! | nothing, or an empty file | the file is written |
//! | a file of the same kind, by its content | it is replaced; mode and owner stay |
//! | any other file, a folder, a socket, a block device | refused |
//! | a link | its target is treated so, and the link stays; a target that is not there is made |
//! | a character device (`/dev/null`), a named pipe, a standard stream | written into |
//!
//! All of this is found out by [`OutputFile::prepare`], before the work whose result is to be
//! written. The bytes go to a temporary file beside the place, which is renamed into it once every
//! byte has been handed to the system, so that an interrupted command leaves the file of the one
//! before (or none), never half of one. A temporary file is removed by an error and by a signal
//! ([`temporary`]).

mod kind;
mod place;
pub mod temporary;

use std::fs::{self, File};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

pub use kind::FileKind;
use place::Place;
use temporary::Temporary;

/// A file could not be written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OutputError {
    /// The system reports an error.
    #[error(
        "{}: {error}; make sure that the folder can be written to and the disk is not full",
        path.display()
    )]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system says.
        #[source]
        error: io::Error,
    },
    /// There is a file of another kind.
    #[error("{}: exists and is not {kind}; refusing to overwrite it; name another file", path.display())]
    OtherKind {
        /// The file.
        path: PathBuf,
        /// What would be written.
        kind: &'static str,
    },
    /// There is something that cannot be replaced by a file.
    #[error("{}: is {what}; name a file", path.display())]
    NotAFile {
        /// The path.
        path: PathBuf,
        /// What it is.
        what: &'static str,
    },
    /// The file belongs to another user.
    #[error(
        "{}: belongs to another user, and a new file in its place could not; name another file, or \
         remove this one first",
        path.display()
    )]
    Owner {
        /// The file.
        path: PathBuf,
    },
    /// A named pipe that is not read from.
    #[error("{}: nothing reads from this pipe; start its reader first", path.display())]
    NoReader {
        /// The pipe.
        path: PathBuf,
    },
}

impl OutputError {
    /// The file or the folder.
    #[must_use]
    pub fn path(&self) -> &Path {
        match self {
            Self::Write { path, .. }
            | Self::OtherKind { path, .. }
            | Self::NotAFile { path, .. }
            | Self::Owner { path }
            | Self::NoReader { path } => path,
        }
    }

    /// Whether writing was refused for what is there, not by the system.
    #[must_use]
    pub fn is_refusal(&self) -> bool {
        matches!(self, Self::OtherKind { .. } | Self::NotAFile { .. } | Self::Owner { .. })
    }
}

/// Bytes that are gathered before they go to the system.
const BUFFER: usize = 1 << 18;

/// A file that can be written, as far as can be known before its content is there.
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
    /// Something that is written into.
    Stream(File),
}

impl OutputFile {
    /// Finds out whether a file of this kind can be written at `path`, and makes room for it: a
    /// temporary file, and folders that do not exist yet. Dropped without [`Self::write`], it leaves
    /// nothing behind.
    ///
    /// # Errors
    /// See [`OutputError`].
    pub fn prepare(path: &Path, kind: FileKind) -> Result<Self, OutputError> {
        let failed = |error| OutputError::Write { path: path.to_owned(), error };
        let target = match place::find(path)? {
            Place::Stream(file) => Target::Stream(file),
            Place::File(place) => {
                if place.file_name().is_none() {
                    let error = io::Error::new(io::ErrorKind::InvalidInput, "not a file's name");
                    return Err(failed(error));
                }
                let before = place::check(path, &place, kind)?;
                let folder = match place.parent() {
                    Some(folder) if !folder.as_os_str().is_empty() => folder,
                    _ => Path::new("."),
                };
                let made = MadeFolders::make(folder).map_err(failed)?;
                let mode = before.as_ref().map(place::mode);
                let (temporary, file) = Temporary::file(folder, mode).map_err(failed)?;
                if let Some(before) = &before {
                    place::resemble(&file, before)
                        .map_err(|_| OutputError::Owner { path: path.to_owned() })?;
                }
                Target::File { temporary, file, place, made }
            }
        };
        Ok(Self { path: path.to_owned(), kind, target })
    }

    /// Writes the file: `fill` gives its content.
    ///
    /// # Errors
    /// What `fill` or the system says, or a file of another kind has appeared meanwhile; what was there
    /// is then there as before.
    pub fn write(
        self,
        fill: impl FnOnce(&mut dyn Write) -> io::Result<()>,
    ) -> Result<(), OutputError> {
        self.finish(fill, true)
    }

    /// `durable`: the bytes are on the disk before the old file is gone.
    fn finish(
        self,
        fill: impl FnOnce(&mut dyn Write) -> io::Result<()>,
        durable: bool,
    ) -> Result<(), OutputError> {
        let Self { path, kind, target } = self;
        let failed = |error| OutputError::Write { path: path.clone(), error };
        match target {
            Target::Stream(file) => filled(file, fill).map(drop).map_err(failed),
            Target::File { temporary, file, place, made } => {
                let file = filled(file, fill).map_err(failed)?;
                if durable {
                    // What a system writes later may fail later: the old file is still there now.
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
            // What is left in the buffer is of no use any more.
            drop(file.into_parts());
            Err(error)
        }
    }
}

/// Writes `path` whole, or leaves what was there: [`OutputFile::prepare`] and
/// [`OutputFile::write`] in one.
///
/// # Errors
/// As these.
pub fn write_whole(
    path: &Path,
    kind: FileKind,
    fill: impl FnOnce(&mut dyn Write) -> io::Result<()>,
) -> Result<(), OutputError> {
    OutputFile::prepare(path, kind)?.write(fill)
}

/// As [`write_whole`], without waiting for the disk: for the many files of a run, which can be made
/// again.
///
/// # Errors
/// As [`write_whole`].
pub fn write_result(
    path: &Path,
    kind: FileKind,
    fill: impl FnOnce(&mut dyn Write) -> io::Result<()>,
) -> Result<(), OutputError> {
    OutputFile::prepare(path, kind)?.finish(fill, false)
}

/// The regular file, there or not yet, that `path` stands for when links are followed; `None` if that
/// is something to be written into.
///
/// # Errors
/// See [`OutputError`].
pub fn destination(path: &Path) -> Result<Option<PathBuf>, OutputError> {
    Ok(match place::find(path)? {
        Place::File(place) => Some(place),
        Place::Stream(_) => None,
    })
}

/// Gives a new file mode and owner of the one that it will replace.
///
/// # Errors
/// What the system says, in most cases that the owner is another user.
pub fn resemble(new: &Path, before: &fs::Metadata) -> io::Result<()> {
    place::resemble(&File::open(new)?, before)
}

/// Makes a folder for results, with those above it.
///
/// # Errors
/// What the system says.
pub fn make_folder(folder: &Path) -> Result<(), OutputError> {
    fs::create_dir_all(folder)
        .map_err(|error| OutputError::Write { path: folder.to_owned(), error })
}

/// Folders that were made for a file; removed again if it is not written.
#[derive(Debug)]
struct MadeFolders(Vec<PathBuf>);

impl MadeFolders {
    fn make(folder: &Path) -> io::Result<Self> {
        let missing = folder.ancestors().take_while(|ancestor| {
            !ancestor.as_os_str().is_empty() && fs::symlink_metadata(ancestor).is_err()
        });
        // The innermost first.
        let made = Self(missing.map(Path::to_owned).collect());
        fs::create_dir_all(folder)?;
        Ok(made)
    }

    fn keep(mut self) {
        self.0.clear();
    }
}

impl Drop for MadeFolders {
    fn drop(&mut self) {
        for folder in &self.0 {
            // Only an empty folder is removed by this.
            if fs::remove_dir(folder).is_err() {
                break;
            }
        }
    }
}

#[cfg(test)]
mod tests;
