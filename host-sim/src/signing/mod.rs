//! The operator's keys for signing weight packages.
//!
//! The operator keeps the private key in a file, PKCS#8 in PEM as OpenSSL writes and reads it, with
//! or without encryption by a passphrase; the nodes store the public key. Signing is deterministic
//! (RFC 8032): the same key and message give the same bytes everywhere, so a signed package can be
//! reproduced. Verification uses the nodes' own [`agent_core::package::signature::verify`].
//!
//! OpenSSL's keys can be used: `openssl genpkey -algorithm ed25519 -out operator.pem`.
//!
//! A private key that other users can read is rejected, as in OpenSSH.

mod error;
mod pair;
mod pem;

use std::fs::{self, OpenOptions};
use std::io::{self, Write};
use std::path::Path;

use agent_core::package::signature::{PUBLIC_KEY_LENGTH, PublicKey, SIGNATURE_LENGTH};
use ed25519_dalek::pkcs8::spki::der::pem::LineEnding;
use ed25519_dalek::pkcs8::{EncodePrivateKey, EncodePublicKey, KeypairBytes, PublicKeyBytes};
use ed25519_dalek::{SECRET_KEY_LENGTH, Signer, SigningKey};
use sha2::{Digest, Sha256};
use zeroize::Zeroizing;

pub use error::KeyFileError;
pub use pair::KeyPair;

use crate::files::input::read_limited;
use crate::files::output::{FileKind, create_folders, write_whole};

/// Size limit of a key file. \[bytes\]
const FILE_MAX: u64 = 64 << 10;

/// Asks for the passphrase of the key in a file.
pub type AskPassphrase<'a> = dyn FnMut(&Path) -> Result<Zeroizing<String>, KeyFileError> + 'a;

/// The private key of an operator, wiped from memory when dropped.
pub struct OperatorKey {
    signer: SigningKey,
    public: PublicKey,
}

impl OperatorKey {
    /// Creates a new key from the operating system's randomness.
    ///
    /// # Errors
    /// [`KeyFileError::Random`].
    pub fn generate() -> Result<Self, KeyFileError> {
        let mut secret = Zeroizing::new([0; SECRET_KEY_LENGTH]);
        getrandom::fill(secret.as_mut()).map_err(KeyFileError::Random)?;
        Ok(Self::from_signer(SigningKey::from_bytes(&secret)))
    }

    /// Reads the private key in the file `path`, which must not be encrypted.
    ///
    /// # Errors
    /// Same as [`Self::read_encrypted`]; [`KeyFileError::PassphraseNeeded`] for an encrypted key.
    pub fn read(path: &Path) -> Result<Self, KeyFileError> {
        let none = |path: &Path| Err(KeyFileError::PassphraseNeeded { path: path.to_owned() });
        Self::read_encrypted(path, &mut { none })
    }

    /// Reads the private key in the file `path`; asks for the `passphrase` if it is encrypted.
    ///
    /// # Errors
    /// If the file cannot be read, is readable by other users, or contains something else; if the
    /// passphrase is missing or wrong.
    pub fn read_encrypted(
        path: &Path,
        passphrase: &mut AskPassphrase<'_>,
    ) -> Result<Self, KeyFileError> {
        refuse_open(path)?;
        let text = read_text(path)?;
        pem::private_key(path, &text, passphrase).map(Self::from_signer)
    }

    fn from_signer(signer: SigningKey) -> Self {
        let public = PublicKey::from_bytes(signer.verifying_key().as_bytes())
            // The private scalar is a multiple of 8 from 2^254 up to 2^255, but not a multiple of 8
            // times the group's order (above 2^252), so the point is never of small order.
            .expect("a private key gives a valid public key");
        Self { signer, public }
    }

    /// Writes the private key to a new file that only its owner can read (mode 0600, on systems
    /// that have modes). Creates missing folders.
    ///
    /// # Errors
    /// [`KeyFileError::Exists`] or [`KeyFileError::Write`]; no file is left behind.
    pub fn write_new(&self, path: &Path) -> Result<(), KeyFileError> {
        let failed = |error| KeyFileError::Write { path: path.to_owned(), error };
        // Without the public key, because OpenSSL 3.0 rejects the newer form that includes it.
        let pem = KeypairBytes { secret_key: self.signer.to_bytes(), public_key: None }
            .to_pkcs8_pem(LineEnding::LF)
            .map_err(|error| failed(io::Error::other(error.to_string())))?;
        if let Some(folder) = path.parent().filter(|folder| !folder.as_os_str().is_empty()) {
            create_folders(folder).map_err(failed)?;
        }
        let mut options = OpenOptions::new();
        options.write(true).create_new(true);
        #[cfg(unix)]
        std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
        let mut file = options.open(path).map_err(|error| match error.kind() {
            io::ErrorKind::AlreadyExists => KeyFileError::Exists { path: path.to_owned() },
            _ => failed(error),
        })?;
        file.write_all(pem.as_bytes()).and_then(|()| file.sync_all()).map_err(|error| {
            // Best effort: the first error is reported.
            let _ = fs::remove_file(path);
            failed(error)
        })
    }

    /// Writes the public key, for the nodes and for anyone who verifies signatures.
    ///
    /// # Errors
    /// [`KeyFileError::WritePublic`]; the previous file is then unchanged.
    pub fn write_public(&self, path: &Path) -> Result<(), KeyFileError> {
        write_whole(path, FileKind::NEW, |file| {
            let pem = PublicKeyBytes(self.public_key_bytes())
                .to_public_key_pem(LineEnding::LF)
                .map_err(|error| io::Error::other(error.to_string()))?;
            file.write_all(pem.as_bytes())
        })?;
        Ok(())
    }

    /// Returns the private key's bytes.
    pub(crate) fn secret_bytes(&self) -> Zeroizing<[u8; SECRET_KEY_LENGTH]> {
        Zeroizing::new(self.signer.to_bytes())
    }

    /// Returns the public key.
    #[must_use]
    pub fn public_key(&self) -> &PublicKey {
        &self.public
    }

    /// Returns the public key as the nodes store it.
    #[must_use]
    pub fn public_key_bytes(&self) -> [u8; PUBLIC_KEY_LENGTH] {
        *self.public.as_bytes()
    }

    /// Signs `message`; the signature is deterministic.
    #[must_use]
    pub fn sign(&self, message: &[u8]) -> [u8; SIGNATURE_LENGTH] {
        self.signer.sign(message).to_bytes()
    }
}

/// The private or the public half of an operator's keys.
#[derive(Debug)]
pub enum EitherKey {
    /// The private half, which has the public one in it.
    Private(Box<OperatorKey>),
    /// The public half.
    Public(PublicKey),
}

impl EitherKey {
    /// The key in the file `path`, which is read once; `passphrase` is asked if it is a private one
    /// and encrypted. A file with both is a public key.
    ///
    /// # Errors
    /// Same as [`OperatorKey::read_encrypted`]; [`KeyFileError::Refused`] for a public key that no node
    /// accepts.
    pub fn read(path: &Path, passphrase: &mut AskPassphrase<'_>) -> Result<Self, KeyFileError> {
        let text = read_text(path)?;
        if let Ok(bytes) = pem::public_key(path, &text) {
            return public_key(path, &bytes).map(Self::Public);
        }
        refuse_open(path)?;
        let private = pem::private_key(path, &text, passphrase)?;
        Ok(Self::Private(Box::new(OperatorKey::from_signer(private))))
    }
}

/// Omits the private key, which must not appear in logs.
impl std::fmt::Debug for OperatorKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "OperatorKey({})", fingerprint(&self.public))
    }
}

/// Reads the public key in the file `path`.
///
/// # Errors
/// [`KeyFileError::Read`], [`KeyFileError::NotPublic`] or [`KeyFileError::Refused`].
pub fn read_public_key(path: &Path) -> Result<PublicKey, KeyFileError> {
    public_key(path, &pem::public_key(path, &read_text(path)?)?)
}

fn public_key(path: &Path, bytes: &[u8; PUBLIC_KEY_LENGTH]) -> Result<PublicKey, KeyFileError> {
    PublicKey::from_bytes(bytes)
        .map_err(|error| KeyFileError::Refused { path: path.to_owned(), error })
}

/// Returns a short name of a key for people to compare: the first 8 bytes of the SHA-256 of its 32
/// bytes, in hexadecimal. Programs must compare the keys.
#[must_use]
pub fn fingerprint(key: &PublicKey) -> String {
    Sha256::digest(key.as_bytes()).iter().take(8).map(|byte| format!("{byte:02x}")).collect()
}

/// Returns the file as text, wiped when dropped; bytes that are not text become characters that no
/// key contains.
fn read_text(path: &Path) -> Result<Zeroizing<String>, KeyFileError> {
    let bytes = read_limited(path, FILE_MAX)
        .map(Zeroizing::new)
        .map_err(|error| KeyFileError::Read { path: path.to_owned(), error })?;
    // Windows editors write UTF-16.
    let unit: fn([u8; 2]) -> u16 = match bytes.as_slice() {
        [0xFF, 0xFE, ..] => u16::from_le_bytes,
        [0xFE, 0xFF, ..] => u16::from_be_bytes,
        _ => return Ok(Zeroizing::new(String::from_utf8_lossy(&bytes).into_owned())),
    };
    let units: Zeroizing<Vec<u16>> =
        Zeroizing::new(bytes.as_chunks().0.iter().map(|&pair| unit(pair)).collect());
    Ok(Zeroizing::new(String::from_utf16_lossy(&units)))
}

/// Rejects a private key that other users can read and therefore sign with.
#[cfg(unix)]
fn refuse_open(path: &Path) -> Result<(), KeyFileError> {
    use std::os::unix::fs::MetadataExt;
    let Ok(file) = fs::metadata(path) else { return Ok(()) };
    let mode = file.mode() & 0o777;
    // A key that belongs to another user may be meant for the group of this one.
    let own = file.uid() == nix::unistd::Uid::effective().as_raw();
    let open = mode & 0o007 != 0 || own && mode & 0o070 != 0;
    if file.is_file() && open {
        return Err(KeyFileError::Open { path: path.to_owned(), mode });
    }
    Ok(())
}

/// Other systems do not have such modes.
#[cfg(not(unix))]
fn refuse_open(_: &Path) -> Result<(), KeyFileError> {
    Ok(())
}

#[cfg(test)]
mod tests;
