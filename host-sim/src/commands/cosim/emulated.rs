//! What emulated nodes of `cosim` have besides their firmware: a key, and flash that outlives them.

use std::fs::File;
use std::path::{Path, PathBuf};

use agent_core::package::signature::PublicKey;
use tempfile::TempDir;

use crate::analysis::TriggerConstants;
use crate::commands::CommandError;
use crate::commands::key::Passphrase;
use crate::cosim::qemu::Qemu;
use crate::files::output::OutputError;
use crate::learning::agent_config;
use crate::scenario::Scenario;
use crate::signing::{EitherKey, OperatorKey};

/// What the nodes' firmware asks of packages.
pub(super) enum Signing {
    /// Nothing.
    None,
    /// Signatures, which co-simulation makes itself.
    Private(Box<OperatorKey>),
    /// Signatures that only the holder of the private key can make: nodes wait for their first package.
    Public(PublicKey),
}

impl Signing {
    /// With the key in this file, if there is one: a private or a public one.
    pub(super) fn read(path: Option<&Path>, passphrase: &Passphrase) -> Result<Self, CommandError> {
        let Some(path) = path else { return Ok(Self::None) };
        Ok(match passphrase.either_key(path)? {
            EitherKey::Public(key) => Self::Public(key),
            EitherKey::Private(key) => Self::Private(key),
        })
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

    /// Whether nodes begin without a package.
    pub(super) fn is_public_only(&self) -> bool {
        matches!(self, Self::Public(_))
    }
}

/// The flash of each node, a file each.
pub(super) struct FlashFolder {
    folder: PathBuf,
    /// Removed at the end, if it is not to be kept.
    temporary: Option<TempDir>,
    /// Keeps other runs out.
    _lock: Option<File>,
}

impl FlashFolder {
    /// A folder that is gone after the run.
    pub(super) fn temporary() -> Result<Self, CommandError> {
        let made = tempfile::Builder::new().prefix("host-sim-flash-").tempdir();
        let made =
            made.map_err(|error| OutputError::Write { path: std::env::temp_dir(), error })?;
        Ok(Self { folder: made.path().to_owned(), temporary: Some(made), _lock: None })
    }

    /// A folder that stays, and may be there already.
    pub(super) fn kept(folder: &Path) -> Result<Self, CommandError> {
        let failed = |error| OutputError::Write { path: folder.to_owned(), error };
        std::fs::create_dir_all(folder).map_err(failed)?;
        let lock = File::open(folder).map_err(failed)?;
        if lock.try_lock().is_err() {
            return Err(CommandError::usage(format!(
                "{}: another run uses the flash in this folder; wait for its end, or name another \
                 folder with --keep",
                folder.display()
            ))
            .about(folder));
        }
        Ok(Self { folder: folder.to_owned(), temporary: None, _lock: Some(lock) })
    }

    /// The flash of an agent, from 0.
    pub(super) fn file(&self, index: usize) -> PathBuf {
        self.folder.join(format!("agent-{}.flash", index + 1))
    }

    /// What is to be removed if this process is killed.
    pub(super) fn removed(&self) -> Option<&Path> {
        self.temporary.as_ref().map(TempDir::path)
    }

    /// Lets simulated agents start with the packages that their nodes have kept.
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
                usage(format!("{error}; name another folder with --keep, or remove this file"))
            })?;
            let Some(package) = found else { continue };
            let node = agent_config(scenario, &TriggerConstants::new(scenario), index);
            if let Some(parameter) = node.first_difference(&package.package().node) {
                return Err(usage(format!(
                    "the package in it has another {parameter} than agent {} of scenario {}; run the \
                     scenario that it was kept from, name another folder with --keep, or remove this \
                     file",
                    index + 1,
                    scenario.name
                )));
            }
            scenario.agents[index].package = Some(package);
        }
        Ok(())
    }
}
