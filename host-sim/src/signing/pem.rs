//! Parses keys in PEM, tolerating the changes that editors and tools make.
//!
//! White space, line endings, a byte order mark and text around the PEM are ignored. Errors name
//! the kind of key found.

use std::path::Path;

use agent_core::package::signature::PUBLIC_KEY_LENGTH;
use ed25519_dalek::SigningKey;
use ed25519_dalek::pkcs8::{DecodePrivateKey, DecodePublicKey, PublicKeyBytes};
use pkcs8::der::asn1::ObjectIdentifier;
use pkcs8::der::pem::PemLabel;
use pkcs8::der::{SecretDocument, zeroize::Zeroizing};
use pkcs8::spki::SubjectPublicKeyInfoRef;
use pkcs8::{EncryptedPrivateKeyInfoRef, PrivateKeyInfoRef};

use super::{AskPassphrase, KeyFileError};

const PRIVATE: &str = "PRIVATE KEY";
const ENCRYPTED: &str = "ENCRYPTED PRIVATE KEY";
const PUBLIC: &str = "PUBLIC KEY";

const COPY: &str = "copy the whole file again from its source";
const MAKE: &str = "`host-sim weights keygen` creates a key pair";
const GIVE_PRIVATE: &str = "pass the file with the private key, which you keep";
const GIVE_PUBLIC: &str = "`openssl pkey -in PRIVATE -pubout` derives it from the private key";

/// Reads the private key in `text`; asks for the `passphrase` if it is encrypted.
pub(super) fn private_key(
    path: &Path,
    text: &str,
    passphrase: &mut AskPassphrase<'_>,
) -> Result<SigningKey, KeyFileError> {
    let wrong =
        |found: String, hint| KeyFileError::NotPrivate { path: path.to_owned(), found, hint };
    let block = Block::find(text, &[PRIVATE, ENCRYPTED]).map_err(|found| {
        let hint = match found {
            Missing::Label(PUBLIC) | Missing::Ssh => GIVE_PRIVATE,
            Missing::Unclosed => COPY,
            Missing::Binary => "`openssl pkey -inform DER -in FILE -out PEM` converts DER to PEM",
            _ => MAKE,
        };
        wrong(found.named(), hint)
    })?;
    let der = block.decode().ok_or_else(|| wrong(block.malformed(), COPY))?;
    let plain = if block.label == ENCRYPTED {
        let encrypted = EncryptedPrivateKeyInfoRef::try_from(der.as_bytes())
            .map_err(|_| wrong(block.malformed(), COPY))?;
        let given = passphrase(path)?;
        encrypted.decrypt(given.as_bytes()).map_err(|error| KeyFileError::Passphrase {
            path: path.to_owned(),
            problem: error.to_string(),
        })?
    } else {
        der
    };
    SigningKey::from_pkcs8_der(plain.as_bytes()).map_err(|_| {
        match PrivateKeyInfoRef::try_from(plain.as_bytes()) {
            Ok(other) => match algorithm(other.algorithm.oid) {
                Some(algorithm) => wrong(format!("{algorithm} private key"), MAKE),
                None => wrong(block.malformed(), COPY),
            },
            Err(_) => wrong(block.malformed(), COPY),
        }
    })
}

/// Reads the bytes of the public key in `text`.
pub(super) fn public_key(path: &Path, text: &str) -> Result<[u8; PUBLIC_KEY_LENGTH], KeyFileError> {
    let wrong =
        |found: String, hint| KeyFileError::NotPublic { path: path.to_owned(), found, hint };
    let block = Block::find(text, &[PUBLIC]).map_err(|found| {
        let hint = if matches!(found, Missing::Unclosed) { COPY } else { GIVE_PUBLIC };
        wrong(found.named(), hint)
    })?;
    let der = block.decode().ok_or_else(|| wrong(block.malformed(), COPY))?;
    let key = PublicKeyBytes::from_public_key_der(der.as_bytes());
    key.map(|key| key.0).map_err(|_| {
        let other = SubjectPublicKeyInfoRef::try_from(der.as_bytes());
        match other.ok().and_then(|other| algorithm(other.algorithm.oid)) {
            Some(algorithm) => wrong(format!("{algorithm} public key"), GIVE_PUBLIC),
            None => wrong(block.malformed(), COPY),
        }
    })
}

/// One block of PEM.
struct Block<'t> {
    label: &'t str,
    body: &'t str,
}

/// What was found instead of a block.
#[derive(Clone, Copy)]
enum Missing<'t> {
    Nothing,
    Label(&'t str),
    Unclosed,
    Ssh,
    Binary,
    Text,
}

impl Missing<'_> {
    fn named(self) -> String {
        match self {
            Self::Nothing => "nothing (an empty file)".to_owned(),
            Self::Label(PRIVATE) => "a private key, which must stay secret".to_owned(),
            Self::Label(ENCRYPTED) => "an encrypted private key, which must stay secret".to_owned(),
            Self::Label(PUBLIC) => "a public key".to_owned(),
            Self::Label("OPENSSH PRIVATE KEY") => "an OpenSSH private key".to_owned(),
            Self::Label("RSA PRIVATE KEY") => "an RSA private key".to_owned(),
            Self::Label("EC PRIVATE KEY") => "an elliptic-curve (ECDSA) private key".to_owned(),
            Self::Label(label) => format!("PEM of another kind ({label})"),
            Self::Unclosed => "PEM text without an END line".to_owned(),
            Self::Ssh => "an OpenSSH public key".to_owned(),
            Self::Binary => "binary data".to_owned(),
            Self::Text => "text that is not PEM".to_owned(),
        }
    }
}

impl<'t> Block<'t> {
    /// Returns the first block with one of these labels, or what was found instead.
    fn find(text: &'t str, labels: &[&str]) -> Result<Self, Missing<'t>> {
        let mut first = None;
        let mut rest = text;
        while let Some((_, begun)) = rest.split_once("-----BEGIN ") {
            let Some((label, content)) = begun.split_once("-----") else { break };
            let Some((body, after)) = content.split_once(&format!("-----END {label}-----")) else {
                return Err(if labels.contains(&label) {
                    Missing::Unclosed
                } else {
                    first.unwrap_or(Missing::Label(label))
                });
            };
            if labels.contains(&label) {
                return Ok(Self { label, body });
            }
            first.get_or_insert(Missing::Label(label));
            rest = after;
        }
        let words = text.trim_start_matches('\u{feff}').trim();
        let not_text = |c: char| c == '\u{fffd}' || c.is_control() && !c.is_whitespace();
        Err(first.unwrap_or(match words {
            "" => Missing::Nothing,
            _ if words.starts_with("ssh-") || words.starts_with("ecdsa-sha2-") => Missing::Ssh,
            _ if words.contains("-----BEGIN") => Missing::Unclosed,
            _ if words.chars().any(not_text) => Missing::Binary,
            _ => Missing::Text,
        }))
    }

    /// Decodes the block. The body is first brought into the strict form of RFC 7468: lines of 64
    /// characters, each ended by a newline.
    fn decode(&self) -> Option<SecretDocument> {
        let mut strict = Zeroizing::new(format!("-----BEGIN {}-----\n", self.label));
        // Reserve the full length, so that growing the buffer does not leave copies of a secret.
        strict.reserve(2 * self.body.len() + 128);
        let content = self.body.chars().filter(|c| !c.is_whitespace() && *c != '\u{feff}');
        for (index, character) in content.enumerate() {
            if index > 0 && index % 64 == 0 {
                strict.push('\n');
            }
            strict.push(character);
        }
        strict.push_str(&format!("\n-----END {}-----\n", self.label));
        SecretDocument::from_pem(&strict).ok().map(|(_, document)| document)
    }

    fn malformed(&self) -> String {
        let what = match self.label {
            EncryptedPrivateKeyInfoRef::PEM_LABEL => "an encrypted private key",
            PRIVATE => "a private key",
            _ => "a public key",
        };
        format!("{what} that is malformed")
    }
}

/// Returns the name of a key algorithm with its article; `None` for Ed25519.
fn algorithm(identifier: ObjectIdentifier) -> Option<String> {
    Some(match identifier.to_string().as_str() {
        "1.3.101.112" => return None,
        "1.3.101.110" => "an X25519".to_owned(),
        "1.3.101.111" => "an X448".to_owned(),
        "1.3.101.113" => "an Ed448".to_owned(),
        "1.2.840.113549.1.1.1" | "1.2.840.113549.1.1.10" => "an RSA".to_owned(),
        "1.2.840.10045.2.1" => "an elliptic-curve (ECDSA)".to_owned(),
        "1.2.840.10040.4.1" => "a DSA".to_owned(),
        other => format!("another (algorithm {other})"),
    })
}
