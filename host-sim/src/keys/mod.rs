//! An operator's folder of keys.
//!
//! | file | content | who else needs it |
//! | --- | --- | --- |
//! | `operator.pem` | Ed25519 private key that signs packages and first keys | |
//! | `operator.pub.pem` | its public key | the nodes' firmware |
//! | `secret.pem` | 32 random bytes, in the form of an Ed25519 private key | |
//! | `network.toml` | numbers of the network keys in use | |
//! | `operator.next.pem`, `operator.toml` and others | a rotation of the operator's keys: [`Operators`] | |
//!
//! The keys of all nodes and networks are derived from the one secret ([`FleetSecret`]), so a fleet of any
//! size needs no list of keys, and a backup made once stays complete. The secret has the form of a
//! private key so that a passphrase can protect it like one: `openssl pkcs8 -topk8`.
//!
//! Like private keys, the secret is rejected if other users can read it.

mod error;
mod fleet;
mod network_numbers;
mod operators;
mod secret;

use std::fs;
use std::path::{Path, PathBuf};

pub use error::KeyFolderError;
pub use fleet::{FleetKeys, epoch_now};
pub use network_numbers::{NetworkNumbers, Stage};
pub use operators::{OperatorStage, Operators};
pub use secret::{FleetSecret, PortKeys};

use crate::files::output::create_folders;
use crate::signing::{AskPassphrase, OperatorKey};

const OPERATOR: &str = "operator.pem";
const PUBLIC: &str = "operator.pub.pem";
const SECRET: &str = "secret.pem";
const NETWORK: &str = "network.toml";

/// Returns the path of the operator's private key in a new key folder.
fn operator_file(folder: &Path) -> PathBuf {
    folder.join(OPERATOR)
}

/// Returns the path of the operator's public key in a new key folder.
#[must_use]
pub fn public_file(folder: &Path) -> PathBuf {
    folder.join(PUBLIC)
}

/// A key folder: its secret, the numbers of the network keys, and which operator keys it has.
#[derive(Debug)]
pub struct KeyFolder {
    path: PathBuf,
    fleet: FleetKeys,
    operators: Operators,
}

impl KeyFolder {
    /// Creates a folder with new keys, and missing folders above it. Also returns the operator's key.
    ///
    /// # Errors
    /// [`KeyFolderError::Exists`] if one of the files already exists; otherwise if one cannot be
    /// written. No file is left behind.
    pub fn create(path: &Path) -> Result<(Self, OperatorKey), KeyFolderError> {
        let files = [OPERATOR, PUBLIC, SECRET, NETWORK].map(|name| path.join(name));
        let mut all = files.iter().cloned().chain(Operators::files_of_rotation(path));
        if let Some(path) = all.find(|file| file.symlink_metadata().is_ok()) {
            return Err(KeyFolderError::Exists { path });
        }
        create_folder(path)
            .map_err(|error| KeyFolderError::Create { path: path.to_owned(), error })?;
        Self::fill(path).inspect_err(|_| {
            // Best effort: the first error is reported.
            for file in files {
                let _ = fs::remove_file(file);
            }
        })
    }

    fn fill(path: &Path) -> Result<(Self, OperatorKey), KeyFolderError> {
        let (operator, secret) = (OperatorKey::generate()?, OperatorKey::generate()?);
        secret.write_new(&path.join(SECRET))?;
        operator.write_new(&operator_file(path))?;
        operator.write_public(&public_file(path))?;
        let numbers = NetworkNumbers::FIRST;
        numbers.write(&path.join(NETWORK))?;
        let secret = FleetSecret::from_key(&secret);
        let (fleet, operators) = (FleetKeys::new(secret, numbers), Operators::new(path));
        Ok((Self { path: path.to_owned(), fleet, operators }, operator))
    }

    /// Reads the folder `path`; asks for the `passphrase` if its secret is encrypted. The operator's
    /// key is read by [`Self::operator`] only.
    ///
    /// # Errors
    /// If a file is missing, invalid or readable by other users; if the passphrase is missing or
    /// wrong.
    pub fn read(path: &Path, passphrase: &mut AskPassphrase<'_>) -> Result<Self, KeyFolderError> {
        let numbers = NetworkNumbers::read(&path.join(NETWORK))?;
        let secret = OperatorKey::read_encrypted(&path.join(SECRET), passphrase)?;
        let secret = FleetSecret::from_key(&secret);
        let fleet = FleetKeys::new(secret, numbers);
        Ok(Self { path: path.to_owned(), fleet, operators: Operators::read(path)? })
    }

    /// Advances the rotation of the network keys in the folder `path` by one stage. Returns the
    /// numbers before and after.
    ///
    /// # Errors
    /// If `network.toml` cannot be read or written; it is then unchanged.
    pub fn advance_rotation(
        path: &Path,
    ) -> Result<(NetworkNumbers, NetworkNumbers), KeyFolderError> {
        let file = path.join(NETWORK);
        let before = NetworkNumbers::read(&file)?;
        let after = before.advanced();
        after.write(&file)?;
        Ok((before, after))
    }

    /// Returns the path of the folder.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns which operator keys the folder has.
    #[must_use]
    pub fn operators(&self) -> &Operators {
        &self.operators
    }

    /// Reads the operator's private key that signs packages; asks for the `passphrase` if it is encrypted.
    ///
    /// # Errors
    /// See [`OperatorKey::read_encrypted`].
    pub fn operator(
        &self,
        passphrase: &mut AskPassphrase<'_>,
    ) -> Result<OperatorKey, KeyFolderError> {
        Ok(OperatorKey::read_encrypted(&self.operators.signing_file(), passphrase)?)
    }

    /// Returns the keys of the fleet.
    #[must_use]
    pub fn fleet(&self) -> &FleetKeys {
        &self.fleet
    }
}

/// Creates a folder that only its owner can open, on systems that have modes.
fn create_folder(path: &Path) -> std::io::Result<()> {
    if path.is_dir() {
        return Ok(());
    }
    if let Some(above) = path.parent().filter(|above| !above.as_os_str().is_empty()) {
        create_folders(above)?;
    }
    #[cfg_attr(not(unix), expect(unused_mut, reason = "there are no modes to set"))]
    let mut folder = fs::DirBuilder::new();
    #[cfg(unix)]
    std::os::unix::fs::DirBuilderExt::mode(&mut folder, 0o700);
    folder.create(path).or_else(|error| match error.kind() {
        // Names what is there.
        std::io::ErrorKind::AlreadyExists => create_folders(path),
        _ => Err(error),
    })
}

#[cfg(all(test, unix))]
mod tests;
