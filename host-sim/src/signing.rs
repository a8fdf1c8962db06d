//! The operator's keys: who may give weights to the nodes.
//!
//! The private key stays in a file of the operator, PKCS#8 in PEM as OpenSSL writes and reads
//! it; the nodes hold the public key. Signing is deterministic (RFC 8032): the same key and
//! message give the same bytes everywhere, so that a signed package can be reproduced.
//! Verification is the nodes' own, [`agent_core::signature::verify`].
//!
//! Keys of OpenSSL will do: `openssl genpkey -algorithm ed25519 -out operator.pem`.

use std::fs::{self, OpenOptions};
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use agent_core::signature::{PUBLIC_KEY_LENGTH, PublicKey, PublicKeyError, SIGNATURE_LENGTH};
use ed25519_dalek::pkcs8::spki::der::pem::LineEnding;
use ed25519_dalek::pkcs8::{
    self, DecodePrivateKey, DecodePublicKey, EncodePrivateKey, EncodePublicKey, KeypairBytes,
    PublicKeyBytes,
};
use ed25519_dalek::{SECRET_KEY_LENGTH, Signer, SigningKey};
use sha2::{Digest, Sha256};
use zeroize::Zeroizing;

use crate::output_file::{FileKind, OutputError, write_whole};

/// A key could not be made, written or read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum KeyFileError {
    /// There is no randomness to make a key of.
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
    #[error("{}: {error}; make sure that the file is there and that you may read it", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system says.
        #[source]
        error: io::Error,
    },
    /// The file holds no private key of this kind.
    #[error(
        "{}: holds {found}, expected an Ed25519 private key (PEM, PKCS#8, not encrypted); {mend}",
        path.display()
    )]
    NotPrivate {
        /// The file.
        path: PathBuf,
        /// What is there instead.
        found: String,
        /// What to do.
        mend: &'static str,
    },
    /// The file holds no public key of this kind.
    #[error(
        "{}: holds {found}, expected an Ed25519 public key (PEM); `openssl pkey -in PRIVATE -pubout` writes it from the private one",
        path.display()
    )]
    NotPublic {
        /// The file.
        path: PathBuf,
        /// What is there instead.
        found: String,
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

/// The private key of an operator, wiped from memory when dropped.
pub struct OperatorKey {
    signer: SigningKey,
    public: PublicKey,
}

impl OperatorKey {
    /// A new key, from the operating system's randomness.
    ///
    /// # Errors
    /// [`KeyFileError::Random`].
    pub fn generate() -> Result<Self, KeyFileError> {
        let mut secret = Zeroizing::new([0; SECRET_KEY_LENGTH]);
        getrandom::fill(secret.as_mut()).map_err(KeyFileError::Random)?;
        Ok(Self::from_signer(SigningKey::from_bytes(&secret)))
    }

    /// The private key in the file `path`.
    ///
    /// # Errors
    /// [`KeyFileError::Read`] or [`KeyFileError::NotPrivate`].
    pub fn read(path: &Path) -> Result<Self, KeyFileError> {
        let text = read_text(path)?;
        let signer = SigningKey::from_pkcs8_pem(&text).map_err(|error| {
            let label = pem_label(&text);
            let mend = match label {
                Some("ENCRYPTED PRIVATE KEY") => "`openssl pkey -in FILE -out PLAIN` decrypts it",
                Some("PUBLIC KEY") => "give the file with the private key, which stays with you",
                _ => "`openssl genpkey -algorithm ed25519 -out FILE` makes one",
            };
            KeyFileError::NotPrivate { path: path.to_owned(), found: found(label, &error), mend }
        })?;
        Ok(Self::from_signer(signer))
    }

    fn from_signer(signer: SigningKey) -> Self {
        let public = PublicKey::from_bytes(signer.verifying_key().as_bytes())
            // The private scalar is a multiple of 8 from 2^254 up to 2^255, and no multiple of
            // 8 times the group's order (above 2^252) is: the point is never of small order.
            .expect("a private key gives a valid public key");
        Self { signer, public }
    }

    /// Writes the private key into a new file that only its owner may read (mode 0600, on
    /// systems that have modes). Folders that do not exist yet are made.
    ///
    /// # Errors
    /// [`KeyFileError::Exists`] or [`KeyFileError::Write`]; no file is left behind.
    pub fn write_new(&self, path: &Path) -> Result<(), KeyFileError> {
        let failed = |error| KeyFileError::Write { path: path.to_owned(), error };
        // Without the public key in it: OpenSSL 3.0 refuses the newer form that has it.
        let pem = KeypairBytes { secret_key: self.signer.to_bytes(), public_key: None }
            .to_pkcs8_pem(LineEnding::LF)
            .map_err(|error| failed(io::Error::other(error.to_string())))?;
        if let Some(folder) = path.parent().filter(|folder| !folder.as_os_str().is_empty()) {
            fs::create_dir_all(folder).map_err(failed)?;
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
            // Best effort: the error that is reported is the first one.
            let _ = fs::remove_file(path);
            failed(error)
        })
    }

    /// Writes the public key, for the nodes and whoever else verifies.
    ///
    /// # Errors
    /// [`KeyFileError::WritePublic`]; the file is then as it was before.
    pub fn write_public(&self, path: &Path) -> Result<(), KeyFileError> {
        write_whole(path, FileKind::NEW, |file| {
            let pem = PublicKeyBytes(self.public_key_bytes())
                .to_public_key_pem(LineEnding::LF)
                .map_err(|error| io::Error::other(error.to_string()))?;
            file.write_all(pem.as_bytes())
        })?;
        Ok(())
    }

    /// The public half.
    #[must_use]
    pub fn public_key(&self) -> &PublicKey {
        &self.public
    }

    /// The public half as the nodes store it.
    #[must_use]
    pub fn public_key_bytes(&self) -> [u8; PUBLIC_KEY_LENGTH] {
        *self.public.as_bytes()
    }

    /// The signature of `message`; always the same one.
    #[must_use]
    pub fn sign(&self, message: &[u8]) -> [u8; SIGNATURE_LENGTH] {
        self.signer.sign(message).to_bytes()
    }
}

/// The private half is not for logs.
impl std::fmt::Debug for OperatorKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "OperatorKey({})", fingerprint(&self.public))
    }
}

/// The public key in the file `path`.
///
/// # Errors
/// [`KeyFileError::Read`], [`KeyFileError::NotPublic`] or [`KeyFileError::Refused`].
pub fn read_public_key(path: &Path) -> Result<PublicKey, KeyFileError> {
    let text = read_text(path)?;
    let bytes =
        PublicKeyBytes::from_public_key_pem(&text).map_err(|error| KeyFileError::NotPublic {
            path: path.to_owned(),
            found: found(pem_label(&text), &pkcs8::Error::PublicKey(error)),
        })?;
    PublicKey::from_bytes(&bytes.0)
        .map_err(|error| KeyFileError::Refused { path: path.to_owned(), error })
}

/// A short name of a key for people to compare: the first 8 bytes of the SHA-256 of its 32
/// bytes, hexadecimal. Not for machines, which compare keys.
#[must_use]
pub fn fingerprint(key: &PublicKey) -> String {
    Sha256::digest(key.as_bytes()).iter().take(8).map(|byte| format!("{byte:02x}")).collect()
}

/// The file as text, wiped when dropped; bytes that are no text become something no key has.
fn read_text(path: &Path) -> Result<Zeroizing<String>, KeyFileError> {
    let bytes = fs::read(path)
        .map(Zeroizing::new)
        .map_err(|error| KeyFileError::Read { path: path.to_owned(), error })?;
    Ok(Zeroizing::new(String::from_utf8_lossy(&bytes).into_owned()))
}

/// What a PEM file says that it holds.
fn pem_label(text: &str) -> Option<&str> {
    let (label, _) = text.split_once("-----BEGIN ")?.1.split_once("-----")?;
    Some(label)
}

fn found(label: Option<&str>, error: &pkcs8::Error) -> String {
    match label {
        None => "no PEM".to_owned(),
        Some(label @ ("PRIVATE KEY" | "PUBLIC KEY")) => format!("another {label} ({error})"),
        Some(label) => label.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use agent_core::signature::verify;

    /// The first private and public key of RFC 8032, section 7.1, as OpenSSL writes them.
    const PRIVATE: &str = "-----BEGIN PRIVATE KEY-----\n\
        MC4CAQAwBQYDK2VwBCIEIJ1hsZ3v/VpguoRK9JLsLMREScVpezJpGXA7rAMcrn9g\n\
        -----END PRIVATE KEY-----\n";
    const PUBLIC: &str = "-----BEGIN PUBLIC KEY-----\n\
        MCowBQYDK2VwAyEA11qYAYKxCrfVS/7TyWQHOg7hcvPapiMlrwIaaPcHURo=\n\
        -----END PUBLIC KEY-----\n";

    /// A folder of its own for a test, removed at its end.
    struct Folder(PathBuf);

    impl Folder {
        fn new(name: &str) -> Self {
            let folder =
                std::env::temp_dir().join(format!("signing-{name}-{}", std::process::id()));
            fs::create_dir_all(&folder).unwrap();
            Self(folder)
        }

        fn file(&self, name: &str, text: &str) -> PathBuf {
            let path = self.0.join(name);
            fs::write(&path, text).unwrap();
            path
        }
    }

    impl Drop for Folder {
        fn drop(&mut self) {
            let _ = fs::remove_dir_all(&self.0);
        }
    }

    #[test]
    fn a_new_key_signs_for_the_nodes_before_and_after_its_files() {
        let folder = Folder::new("round-trip");
        let (private, public) = (folder.0.join("made/key.pem"), folder.0.join("key.pub.pem"));
        let key = OperatorKey::generate().unwrap();
        key.write_new(&private).unwrap();
        key.write_public(&public).unwrap();
        let signature = key.sign(b"weights");
        let known = read_public_key(&public).unwrap();
        assert_eq!(verify(&known, b"weights", &signature), Ok(()));
        let read = OperatorKey::read(&private).unwrap();
        assert_eq!(read.public_key(), &known);
        assert_eq!(read.sign(b"weights"), signature);
        let other = OperatorKey::generate().unwrap();
        assert_ne!(other.public_key_bytes(), key.public_key_bytes());
        assert!(verify(&known, b"weights", &other.sign(b"weights")).is_err());
    }

    #[test]
    fn files_are_those_of_openssl() {
        let folder = Folder::new("openssl");
        let key = OperatorKey::read(&folder.file("key.pem", PRIVATE)).unwrap();
        let (private, public) = (folder.0.join("again.pem"), folder.0.join("again.pub.pem"));
        key.write_new(&private).unwrap();
        key.write_public(&public).unwrap();
        assert_eq!(fs::read_to_string(private).unwrap(), PRIVATE);
        assert_eq!(fs::read_to_string(public).unwrap(), PUBLIC);
        // RFC 8032, section 7.1, signature of the empty message.
        assert_eq!(key.sign(b"")[..4], [0xe5, 0x56, 0x43, 0x00]);
        assert_eq!(fingerprint(key.public_key()), "21fe31dfa154a261");
        assert_eq!(format!("{key:?}"), "OperatorKey(21fe31dfa154a261)");
    }

    #[test]
    fn a_private_key_is_never_overwritten() {
        let folder = Folder::new("overwrite");
        let path = folder.file("key.pem", PRIVATE);
        let error = OperatorKey::generate().unwrap().write_new(&path).unwrap_err();
        assert!(matches!(error, KeyFileError::Exists { .. }), "{error}");
        assert!(error.to_string().contains("key.pem"), "{error}");
        assert_eq!(fs::read_to_string(path).unwrap(), PRIVATE);
    }

    #[cfg(unix)]
    #[test]
    fn only_the_owner_may_read_a_private_key() {
        use std::os::unix::fs::PermissionsExt;
        let folder = Folder::new("mode");
        let path = folder.0.join("key.pem");
        OperatorKey::generate().unwrap().write_new(&path).unwrap();
        assert_eq!(fs::metadata(path).unwrap().permissions().mode() & 0o777, 0o600);
    }

    #[test]
    fn messages_name_the_file_what_it_holds_and_the_mend() {
        let folder = Folder::new("messages");
        let encrypted = PRIVATE.replace("PRIVATE", "ENCRYPTED PRIVATE");
        // The identifier of Ed25519 is 1.3.101.112; of X25519, 1.3.101.110.
        let x25519 = PRIVATE.replace("K2Vw", "K2Vu");
        for (name, text, expected) in [
            ("public.pem", PUBLIC, "the file with the private key"),
            ("encrypted.pem", &encrypted, "openssl pkey"),
            ("short.pem", &PRIVATE[..60], "openssl genpkey"),
            ("x25519.pem", &x25519, "another PRIVATE KEY"),
            ("none.pem", "", "no PEM"),
        ] {
            let path = folder.file(name, text);
            let message = OperatorKey::read(&path).unwrap_err().to_string();
            assert!(message.contains(name) && message.contains(expected), "{message}");
            assert!(!message.contains("MC4C"), "a key in a message: {message}");
        }
        for (name, text, expected) in [
            ("private.pem", PRIVATE, "PRIVATE KEY"),
            ("x25519.pub.pem", &PUBLIC.replace("K2Vw", "K2Vu"), "another PUBLIC KEY"),
            // The neutral element, for which everybody can sign.
            (
                "weak.pem",
                &PUBLIC.replace(
                    "11qYAYKxCrfVS/7TyWQHOg7hcvPapiMlrwIaaPcHURo",
                    "AQAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA",
                ),
                "anyone could sign",
            ),
        ] {
            let message = read_public_key(&folder.file(name, text)).unwrap_err().to_string();
            assert!(message.contains(name) && message.contains(expected), "{message}");
        }
        let missing = OperatorKey::read(&folder.0.join("missing.pem")).unwrap_err().to_string();
        assert!(missing.contains("missing.pem") && missing.contains("is there"), "{missing}");
    }
}
