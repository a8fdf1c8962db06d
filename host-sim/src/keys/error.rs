//! Errors of key folders.

use std::io;
use std::path::{Path, PathBuf};

use crate::files::output::OutputError;
use crate::signing::KeyFileError;

/// Why a key folder could not be created, read or changed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum KeyFolderError {
    /// A private key or the secret could not be created, written or read.
    #[error(transparent)]
    Key(#[from] KeyFileError),
    /// A file of the folder already exists.
    #[error("{}: already exists, and keys are never overwritten; choose another folder", path.display())]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// The folder could not be created.
    #[error("{}: cannot create the folder: {error}; check that the folder above it is writable", path.display())]
    Create {
        /// The folder.
        path: PathBuf,
        /// The system's error.
        #[source]
        error: io::Error,
    },
    /// The numbers of the network keys could not be read.
    #[error(
        "{}: cannot read the numbers of the network keys: {error}; check that the folder was created by \
         `host-sim keygen`",
        path.display()
    )]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's error.
        #[source]
        error: io::Error,
    },
    /// The file does not contain numbers of network keys.
    #[error(
        "{}: {problem}; expected a line such as `network_keys = [1]` or `network_keys = [1, 2]`: numbers \
         from 1 to 255, two only during a rotation, the one for sending first",
        path.display()
    )]
    Numbers {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        problem: String,
    },
    /// The stage of the operator keys' rotation could not be read.
    #[error(
        "{}: {problem}; expected a line such as `stage = 1`, from 1 to 3: the stage that the rotation of the \
         operator keys has reached",
        path.display()
    )]
    Stage {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        problem: String,
    },
    /// A key of another rotation is in the way.
    #[error("{}: left over from another rotation; move it out of the folder, and try again", path.display())]
    Leftover {
        /// The file.
        path: PathBuf,
    },
    /// A key could not be renamed.
    #[error("{}: cannot be renamed: {error}; check that the folder is writable, and try again", path.display())]
    Rename {
        /// The file.
        path: PathBuf,
        /// The system's error.
        #[source]
        error: io::Error,
    },
    /// The numbers of the network keys, or the stage, could not be written.
    #[error(transparent)]
    Write(#[from] OutputError),
}

impl KeyFolderError {
    /// Returns the path of the file or folder.
    #[must_use]
    pub fn path(&self) -> Option<&Path> {
        match self {
            Self::Key(error) => error.path(),
            Self::Write(error) => Some(error.path()),
            Self::Exists { path }
            | Self::Create { path, .. }
            | Self::Read { path, .. }
            | Self::Numbers { path, .. }
            | Self::Stage { path, .. }
            | Self::Leftover { path }
            | Self::Rename { path, .. } => Some(path),
        }
    }
}
