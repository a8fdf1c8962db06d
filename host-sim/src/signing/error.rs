//! Why a key cannot be used.

use std::io;
use std::path::{Path, PathBuf};

use agent_core::package::signature::PublicKeyError;

use crate::files::output::OutputError;

/// A key could not be made, written or read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum KeyFileError {
    /// The system has no random numbers to make a key from.
    #[error("no random numbers from the operating system: {0}; make the key on another machine")]
    Random(#[source] getrandom::Error),
    /// There is a file where the private key should go.
    #[error(
        "{}: exists already, and a private key is never overwritten; choose another name or move the file away",
        path.display()
    )]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// The private key could not be written.
    #[error("{}: {error}; make sure that the folder can be written to and the disk is not full", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system says.
        #[source]
        error: io::Error,
    },
    /// The public key could not be written.
    #[error(transparent)]
    WritePublic(#[from] OutputError),
    /// The file cannot be read.
    #[error("{}: cannot be read as a key: {error}; make sure that the file is there and that you may read it", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system says.
        #[source]
        error: io::Error,
    },
    /// Others may read the private key.
    #[error(
        "{0}: a private key that others may read (mode {mode:04o}) is not used; `chmod 600 {0}` keeps \
         it to you, and if others may have read it, make a new key",
        path.display()
    )]
    Open {
        /// The file.
        path: PathBuf,
        /// Its mode.
        mode: u32,
    },
    /// The file holds no private key of this kind.
    #[error(
        "{}: holds {found}, expected an Ed25519 private key (PEM, PKCS#8); {hint}",
        path.display()
    )]
    NotPrivate {
        /// The file.
        path: PathBuf,
        /// What is there instead.
        found: String,
        /// What to do.
        hint: &'static str,
    },
    /// The private key is encrypted, and there is no passphrase.
    #[error(
        "{}: is encrypted, and there is no terminal to ask for its passphrase; give \
         --passphrase-file FILE, or set HOST_SIM_PASSPHRASE",
        path.display()
    )]
    PassphraseNeeded {
        /// The file.
        path: PathBuf,
    },
    /// The passphrase cannot be read.
    #[error("{}: the passphrase cannot be read: {error}; name a file with the passphrase on its first line", path.display())]
    PassphraseUnread {
        /// Where from.
        path: PathBuf,
        /// What the system says.
        #[source]
        error: io::Error,
    },
    /// The passphrase does not fit.
    #[error("{}: cannot be decrypted ({problem}); give its passphrase, or a key encrypted by OpenSSL 1.1 or later", path.display())]
    Passphrase {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        problem: String,
    },
    /// The file holds no public key of this kind.
    #[error("{}: holds {found}, expected an Ed25519 public key (PEM); {hint}", path.display())]
    NotPublic {
        /// The file.
        path: PathBuf,
        /// What is there instead.
        found: String,
        /// What to do.
        hint: &'static str,
    },
    /// The file holds a public key that no node takes.
    #[error("{}: {error}; ask its owner for the right file", path.display())]
    Refused {
        /// The file.
        path: PathBuf,
        /// What is wrong with the key.
        #[source]
        error: PublicKeyError,
    },
}

impl KeyFileError {
    /// The file that it is about.
    #[must_use]
    pub fn path(&self) -> Option<&Path> {
        match self {
            Self::Random(_) => None,
            Self::WritePublic(error) => Some(error.path()),
            Self::Exists { path }
            | Self::Write { path, .. }
            | Self::Read { path, .. }
            | Self::Open { path, .. }
            | Self::NotPrivate { path, .. }
            | Self::PassphraseNeeded { path }
            | Self::PassphraseUnread { path, .. }
            | Self::Passphrase { path, .. }
            | Self::NotPublic { path, .. }
            | Self::Refused { path, .. } => Some(path),
        }
    }
}
