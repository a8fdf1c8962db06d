//! The signing key and the persistent flash of emulated nodes.

use std::fs::File;
use std::path::{Path, PathBuf};

use agent_core::package::signature::PublicKey;
use tempfile::TempDir;

use crate::analysis::TriggerConstants;
use crate::commands::CommandError;
use crate::commands::key::Passphrase;
use crate::cosim::qemu::Qemu;
use crate::files::output::{OutputError, make_folder};
use crate::keys::KeyFolder;
use crate::learning::agent_config;
use crate::scenario::Scenario;
use crate::signing::{EitherKey, OperatorKey};

/// Whether the nodes' firmware requires signed packages.
pub(super) enum Signing {
    /// Signatures are not required.
    None,
    /// Signatures are required, and co-simulation signs packages itself.
    Private(Box<OperatorKey>),
    /// Signatures are required, and only the public key is known: nodes wait for their first
    /// package.
    Public(PublicKey),
}

impl Signing {
    /// Reads the private or public key from `path`, if given.
    pub(super) fn read(path: Option<&Path>, passphrase: &Passphrase) -> Result<Self, CommandError> {
        let Some(path) = path else { return Ok(Self::None) };
        Ok(match passphrase.either_key(path)? {
            EitherKey::Public(key) => Self::Public(key),
            EitherKey::Private(key) => Self::Private(key),
        })
    }

    /// Reads the operator's private key of a key folder.
    pub(super) fn of_folder(
        folder: &KeyFolder,
        passphrase: &Passphrase,
    ) -> Result<Self, CommandError> {
        let operator = folder.operator(&mut |path| passphrase.ask(path))?;
        Ok(Self::Private(Box::new(operator)))
    }

    pub(super) fn signer(&self) -> Option<&OperatorKey> {
        match self {
            Self::Private(key) => Some(key),
            Self::None | Self::Public(_) => None,
        }
    }

    pub(super) fn public_key(&self) -> Option<&PublicKey> {
        match self {
            Self::None => None,
            Self::Private(key) => Some(key.public_key()),
            Self::Public(key) => Some(key),
        }
    }

    /// Returns whether nodes start without a package.
    pub(super) fn is_public_only(&self) -> bool {
        matches!(self, Self::Public(_))
    }
}

/// A folder with one flash file per node.
pub(super) struct FlashFolder {
    folder: PathBuf,
    /// Set if the folder is removed at the end.
    temporary: Option<TempDir>,
    /// Locks the folder against other runs.
    _lock: Option<File>,
}

impl FlashFolder {
    /// Creates a folder that is removed after the run.
    pub(super) fn temporary() -> Result<Self, CommandError> {
        let made = tempfile::Builder::new().prefix("host-sim-flash-").tempdir();
        let made =
            made.map_err(|error| OutputError::Write { path: std::env::temp_dir(), error })?;
        Ok(Self { folder: made.path().to_owned(), temporary: Some(made), _lock: None })
    }

    /// Opens a folder that is kept, and creates it if necessary.
    pub(super) fn kept(folder: &Path) -> Result<Self, CommandError> {
        let failed = |error| OutputError::Write { path: folder.to_owned(), error };
        make_folder(folder)?;
        let lock = File::open(folder).map_err(failed)?;
        if lock.try_lock().is_err() {
            return Err(CommandError::usage(format!(
                "{}: another run is using the flash in this folder; wait for it to finish, or \
                 choose another folder with --keep",
                folder.display()
            ))
            .about(folder));
        }
        Ok(Self { folder: folder.to_owned(), temporary: None, _lock: Some(lock) })
    }

    /// Returns the flash file of the agent with this index, from 0.
    pub(super) fn file(&self, index: usize) -> PathBuf {
        self.folder.join(format!("agent-{}.flash", index + 1))
    }

    /// Returns the folder to remove if this process is killed.
    pub(super) fn removed(&self) -> Option<&Path> {
        self.temporary.as_ref().map(TempDir::path)
    }

    /// Gives simulated agents the packages stored in their nodes' flash.
    pub(super) fn take_over(
        &self,
        scenario: &mut Scenario,
        qemu: &Qemu,
        key: Option<&PublicKey>,
        is_emulated: impl Fn(usize) -> bool,
    ) -> Result<(), CommandError> {
        for index in (0..scenario.agents.len()).filter(|&index| is_emulated(index)) {
            let file = self.file(index);
            if !file.exists() {
                continue;
            }
            let usage = |problem: String| {
                CommandError::usage(format!("{}: {problem}", file.display())).about(&file)
            };
            let found = qemu.package_in(&file, key).map_err(|error| {
                usage(format!("{error}; choose another folder with --keep, or remove this file"))
            })?;
            let Some(package) = found else { continue };
            let node = agent_config(scenario, &TriggerConstants::new(scenario), index);
            if let Some(parameter) = node.first_difference(&package.package().node) {
                return Err(usage(format!(
                    "the {parameter} of its package differs from that of agent {} in scenario {}; run the \
                     scenario it was created with, choose another folder with --keep, or remove \
                     this file",
                    index + 1,
                    scenario.name
                )));
            }
            scenario.agents[index].package = Some(package);
        }
        Ok(())
    }
}
