//! Key errors.

use std::io;
use std::path::{Path, PathBuf};

use agent_core::package::signature::PublicKeyError;

use crate::files::output::OutputError;

/// Why a key could not be created, written or read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum KeyFileError {
    /// The operating system provides no random numbers.
    #[error("no random numbers from the operating system: {0}; create the key on another machine")]
    Random(#[source] getrandom::Error),
    /// The private key's file already exists.
    #[error(
        "{}: already exists, and private keys are never overwritten; choose another name or move the file",
        path.display()
    )]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// The private key could not be written.
    #[error("{}: {error}; check that the folder is writable and the disk is not full", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// The system's error.
        #[source]
        error: io::Error,
    },
    /// The public key could not be written.
    #[error(transparent)]
    WritePublic(#[from] OutputError),
    /// The file could not be read.
    #[error("{}: cannot read the key: {error}; check that the file exists and is readable", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's error.
        #[source]
        error: io::Error,
    },
    /// Other users can read the private key.
    #[error(
        "{0}: refusing a private key that other users can read (mode {mode:04o}); run `chmod 600 {0}`, \
             and create a new key if others may have read it",
        path.display()
    )]
    Open {
        /// The file.
        path: PathBuf,
        /// Its mode.
        mode: u32,
    },
    /// The file does not contain a private key of this kind.
    #[error(
        "{}: contains {found}, expected an Ed25519 private key (PEM, PKCS#8); {hint}",
        path.display()
    )]
    NotPrivate {
        /// The file.
        path: PathBuf,
        /// What it contains.
        found: String,
        /// What to do.
        hint: &'static str,
    },
    /// The private key is encrypted, and there is no passphrase.
    #[error(
        "{}: is encrypted, and there is no terminal to ask for the passphrase; pass \
         --passphrase-file FILE, or set HOST_SIM_PASSPHRASE",
        path.display()
    )]
    PassphraseNeeded {
        /// The file.
        path: PathBuf,
    },
    /// The passphrase could not be read.
    #[error("{}: cannot read the passphrase: {error}; pass a file with the passphrase on its first line", path.display())]
    PassphraseUnread {
        /// The source of the passphrase.
        path: PathBuf,
        /// The system's error.
        #[source]
        error: io::Error,
    },
    /// The passphrase is wrong.
    #[error("{}: cannot be decrypted ({problem}); check the passphrase, or use a key encrypted by OpenSSL 1.1 or later", path.display())]
    Passphrase {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        problem: String,
    },
    /// The file does not contain a public key of this kind.
    #[error("{}: contains {found}, expected an Ed25519 public key (PEM); {hint}", path.display())]
    NotPublic {
        /// The file.
        path: PathBuf,
        /// What it contains.
        found: String,
        /// What to do.
        hint: &'static str,
    },
    /// The file contains a public key that nodes reject.
    #[error("{}: {error}; ask the key's owner for the correct file", path.display())]
    Refused {
        /// The file.
        path: PathBuf,
        /// What is wrong with the key.
        #[source]
        error: PublicKeyError,
    },
}

impl KeyFileError {
    /// Returns the path of the file.
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
