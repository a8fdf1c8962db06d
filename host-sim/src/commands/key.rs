//! Keys given on the command line, and the passphrases of encrypted ones.

use std::io::IsTerminal;
use std::path::{Path, PathBuf};

use clap::Args;
use zeroize::Zeroizing;

use super::CommandError;
use crate::files::input::read_limited;
use crate::keys::KeyFolder;
#[cfg(unix)]
use crate::signing::EitherKey;
use crate::signing::{KeyFileError, OperatorKey};
use crate::terminal::one_line;

/// Environment variable that holds the passphrase.
const VARIABLE: &str = "HOST_SIM_PASSPHRASE";

/// Maximum size of a passphrase file. \[byte\]
const FILE_MAX: u64 = 64 << 10;

/// Source of the passphrase of an encrypted private key.
#[derive(Debug, Args)]
pub(super) struct Passphrase {
    /// File whose first line is the passphrase of an encrypted private key [default: the
    /// environment variable HOST_SIM_PASSPHRASE, else a prompt]
    #[arg(long, value_name = "FILE")]
    passphrase_file: Option<PathBuf>,
}

impl Passphrase {
    /// Reads the private key in the file `path`.
    pub(super) fn key(&self, path: &Path) -> Result<OperatorKey, CommandError> {
        Ok(OperatorKey::read_encrypted(path, &mut |path| self.ask(path))?)
    }

    /// Reads the key folder `path`.
    pub(super) fn folder(&self, path: &Path) -> Result<KeyFolder, CommandError> {
        Ok(KeyFolder::read(path, &mut |path| self.ask(path))?)
    }

    /// Reads the private or public key in the file `path`.
    #[cfg(unix)]
    pub(super) fn either_key(&self, path: &Path) -> Result<EitherKey, CommandError> {
        Ok(EitherKey::read(path, &mut |path| self.ask(path))?)
    }

    /// Returns the passphrase of the key in this file.
    pub(super) fn ask(&self, key: &Path) -> Result<Zeroizing<String>, KeyFileError> {
        if let Some(file) = &self.passphrase_file {
            return first_line(file)
                .map_err(|error| KeyFileError::PassphraseUnread { path: file.clone(), error });
        }
        if let Ok(passphrase) = std::env::var(VARIABLE) {
            return Ok(Zeroizing::new(passphrase));
        }
        if !std::io::stdin().is_terminal() {
            return Err(KeyFileError::PassphraseNeeded { path: key.to_owned() });
        }
        rpassword::prompt_password(format!(
            "Passphrase of {}: ",
            one_line(&key.display().to_string())
        ))
        .map(Zeroizing::new)
        .map_err(|_| KeyFileError::PassphraseNeeded { path: key.to_owned() })
    }
}

/// A key folder for a provisioned node.
#[cfg(unix)]
#[derive(Debug, Args)]
pub(super) struct NodeKeys {
    /// Key folder of a provisioned node, as created by `keygen`
    #[arg(long, value_name = "FOLDER")]
    keys: Option<PathBuf>,
    #[command(flatten)]
    pub(super) passphrase: Passphrase,
}

#[cfg(unix)]
impl NodeKeys {
    /// Reads the key folder, if one is given.
    pub(super) fn read(&self) -> Result<Option<KeyFolder>, CommandError> {
        let Some(folder) = &self.keys else { return Ok(None) };
        Ok(Some(self.passphrase.folder(folder)?))
    }
}

fn first_line(path: &Path) -> std::io::Result<Zeroizing<String>> {
    let bytes = Zeroizing::new(read_limited(path, FILE_MAX)?);
    let line = bytes.split(|&byte| byte == b'\n').next().unwrap_or_default();
    let line = line.strip_suffix(b"\r").unwrap_or(line);
    let text = std::str::from_utf8(line).map_err(|_| std::io::Error::other("not valid UTF-8"))?;
    Ok(Zeroizing::new(text.to_owned()))
}
