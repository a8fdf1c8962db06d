//! Tests of the keys as files.

use std::path::PathBuf;

use agent_core::package::signature::verify;

use super::*;

/// The first private and public key of RFC 8032, section 7.1, as OpenSSL writes them.
const PRIVATE: &str = "-----BEGIN PRIVATE KEY-----\n\
    MC4CAQAwBQYDK2VwBCIEIJ1hsZ3v/VpguoRK9JLsLMREScVpezJpGXA7rAMcrn9g\n\
    -----END PRIVATE KEY-----\n";
const PUBLIC: &str = "-----BEGIN PUBLIC KEY-----\n\
    MCowBQYDK2VwAyEA11qYAYKxCrfVS/7TyWQHOg7hcvPapiMlrwIaaPcHURo=\n\
    -----END PUBLIC KEY-----\n";

/// A separate folder for a test, removed at its end.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let folder = std::env::temp_dir().join(format!("signing-{name}-{}", std::process::id()));
        fs::create_dir_all(&folder).unwrap();
        Self(folder)
    }

    fn file(&self, name: &str, text: &str) -> PathBuf {
        self.bytes(name, text.as_bytes())
    }

    /// Creates a file that only its owner can read.
    fn bytes(&self, name: &str, bytes: &[u8]) -> PathBuf {
        let path = self.0.join(name);
        let mut options = OpenOptions::new();
        options.write(true).create(true).truncate(true);
        #[cfg(unix)]
        std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
        options.open(&path).unwrap().write_all(bytes).unwrap();
        path
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

#[test]
fn new_key_round_trips_through_files() {
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
fn files_match_openssl() {
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
fn does_not_overwrite_a_private_key() {
    let folder = Folder::new("overwrite");
    let path = folder.file("key.pem", PRIVATE);
    let error = OperatorKey::generate().unwrap().write_new(&path).unwrap_err();
    assert!(matches!(error, KeyFileError::Exists { .. }), "{error}");
    assert!(error.to_string().contains("key.pem"), "{error}");
    assert_eq!(fs::read_to_string(path).unwrap(), PRIVATE);
}

#[cfg(unix)]
#[test]
fn private_key_is_readable_by_its_owner_only() {
    use std::os::unix::fs::PermissionsExt;
    let folder = Folder::new("mode");
    let path = folder.0.join("key.pem");
    OperatorKey::generate().unwrap().write_new(&path).unwrap();
    assert_eq!(fs::metadata(path).unwrap().permissions().mode() & 0o777, 0o600);
}

#[cfg(unix)]
#[test]
fn rejects_a_private_key_readable_by_others() {
    use std::os::unix::fs::PermissionsExt;
    let folder = Folder::new("open");
    let path = folder.file("key.pem", PRIVATE);
    for (mode, accepted) in
        [(0o600, true), (0o400, true), (0o644, false), (0o640, false), (0o604, false)]
    {
        fs::set_permissions(&path, fs::Permissions::from_mode(mode)).unwrap();
        match OperatorKey::read(&path) {
            Ok(_) => assert!(accepted, "{mode:o}"),
            Err(error) => {
                let message = error.to_string();
                let said = format!("mode {mode:04o}");
                assert!(!accepted && message.contains(&said), "{message}");
                assert!(message.contains("chmod 600"), "{message}");
            }
        }
    }
    fs::set_permissions(&path, fs::Permissions::from_mode(0o644)).unwrap();
    let public = folder.file("key.pub.pem", PUBLIC);
    fs::set_permissions(&public, fs::Permissions::from_mode(0o644)).unwrap();
    assert!(read_public_key(&public).is_ok(), "a public key may be readable");
}

#[test]
fn rejects_an_endless_file() {
    #[cfg(unix)]
    for error in [
        OperatorKey::read(Path::new("/dev/zero")).unwrap_err(),
        read_public_key(Path::new("/dev/zero")).unwrap_err(),
    ] {
        assert!(error.to_string().contains("larger than 65536 bytes"), "{error}");
    }
}

#[test]
fn accepts_whitespace_marks_and_surrounding_text() {
    let folder = Folder::new("space");
    let utf16 = |text: &str, unit: fn(u16) -> [u8; 2]| -> Vec<u8> {
        format!("\u{feff}{text}").encode_utf16().flat_map(unit).collect()
    };
    let wrapped = PRIVATE.replace("BAgIwBQ", "").replacen("MC4C", "MC\n4C\n", 1);
    for (name, private, public) in [
        ("newline", format!("{PRIVATE}\n\n"), format!("\n{PUBLIC}\n")),
        ("mark", format!("\u{feff}{PRIVATE}"), format!("\u{feff}{PUBLIC}")),
        ("crlf", PRIVATE.replace('\n', "\r\n"), PUBLIC.replace('\n', "\r\n")),
        ("cr", PRIVATE.replace('\n', "\r"), PUBLIC.replace('\n', "\r")),
        ("line", PRIVATE.replace('\n', ""), PUBLIC.replace('\n', "")),
        ("spaces", PRIVATE.replace('\n', "  \n\t"), PUBLIC.replace('\n', " ")),
        ("wrapped", wrapped, PUBLIC.replace("MCow", "MCo\nw")),
        ("comment", format!("my key\n{PRIVATE}"), format!("# mine\n{PUBLIC}the end\n")),
        ("both", format!("{PUBLIC}{PRIVATE}"), format!("{PRIVATE}{PUBLIC}")),
    ] {
        for (text, end) in [
            (private.clone().into_bytes(), ".pem"),
            (utf16(&private, u16::to_le_bytes), ".16le.pem"),
            (utf16(&private, u16::to_be_bytes), ".16be.pem"),
        ] {
            let path = folder.bytes(&format!("{name}{end}"), &text);
            let key = OperatorKey::read(&path).unwrap_or_else(|error| panic!("{error}"));
            assert_eq!(fingerprint(key.public_key()), "21fe31dfa154a261", "{name}");
        }
        let path = folder.file(&format!("{name}.pub"), &public);
        let key = read_public_key(&path).unwrap_or_else(|error| panic!("{error}"));
        assert_eq!(fingerprint(&key), "21fe31dfa154a261", "{name}");
    }
}

/// The same key encrypted by `openssl pkey -aes256 -passout pass:correct` of OpenSSL 3.0.
const ENCRYPTED: &str = "-----BEGIN ENCRYPTED PRIVATE KEY-----\n\
    MIGbMFcGCSqGSIb3DQEFDTBKMCkGCSqGSIb3DQEFDDAcBAhtHESS55FyrwICCAAw\n\
    DAYIKoZIhvcNAgkFADAdBglghkgBZQMEASoEEPizFlrTFJdYcw3Glu8kJJMEQIbE\n\
    vR+wQh+87IpYq51BWwb4ZZRwkFxQJMs0I0YxGW8u4UNoUVt1WcmAxWt7P2tAsLpv\n\
    GQ9Q2lQY9BS5qknS+9I=\n\
    -----END ENCRYPTED PRIVATE KEY-----\n";

#[test]
fn reads_an_encrypted_key_with_its_passphrase() {
    let folder = Folder::new("encrypted");
    let path = folder.file("key.pem", ENCRYPTED);
    let with = |passphrase: &'static str| {
        let mut asked = 0;
        let read = OperatorKey::read_encrypted(&path, &mut |_| {
            asked += 1;
            Ok(Zeroizing::new(passphrase.to_owned()))
        });
        assert_eq!(asked, 1);
        read
    };
    assert_eq!(fingerprint(with("correct").unwrap().public_key()), "21fe31dfa154a261");
    let error = with("wrong").unwrap_err();
    assert!(matches!(error, KeyFileError::Passphrase { .. }), "{error}");
    assert!(error.to_string().contains("key.pem"), "{error}");
    let error = OperatorKey::read(&path).unwrap_err();
    assert!(matches!(error, KeyFileError::PassphraseNeeded { .. }), "{error}");
    // An unencrypted key needs no passphrase.
    let plain = folder.file("plain.pem", PRIVATE);
    let unasked = OperatorKey::read_encrypted(&plain, &mut |_| panic!("asked"));
    assert!(unasked.is_ok());
}

#[test]
fn either_key_is_read_once_and_with_its_passphrase() {
    let folder = Folder::new("either");
    let ask = &mut |_: &Path| Ok(Zeroizing::new("correct".to_owned()));
    for (name, text) in [("plain.pem", PRIVATE), ("encrypted.pem", ENCRYPTED)] {
        match EitherKey::read(&folder.file(name, text), ask).unwrap() {
            EitherKey::Private(key) => {
                assert_eq!(fingerprint(key.public_key()), "21fe31dfa154a261");
            }
            EitherKey::Public(_) => panic!("{name}"),
        }
    }
    let public = EitherKey::read(&folder.file("key.pub", PUBLIC), ask).unwrap();
    assert!(matches!(public, EitherKey::Public(_)));
    let error = EitherKey::read(&folder.file("text.pem", "hello"), ask).unwrap_err();
    assert!(matches!(error, KeyFileError::NotPrivate { .. }), "{error}");
}

/// What comes through a pipe can be read once only.
#[cfg(target_os = "linux")]
#[test]
fn a_key_may_come_through_a_pipe() {
    use std::os::fd::AsRawFd;
    let (reader, mut writer) = io::pipe().unwrap();
    writer.write_all(PRIVATE.as_bytes()).unwrap();
    drop(writer);
    let path = PathBuf::from(format!("/proc/self/fd/{}", reader.as_raw_fd()));
    let key = EitherKey::read(&path, &mut |_| panic!("asked")).unwrap();
    assert!(matches!(key, EitherKey::Private(_)));
}

#[test]
fn messages_name_the_file_what_it_holds_and_the_hint() {
    let folder = Folder::new("messages");
    // The object identifier of Ed25519 is 1.3.101.112, that of X25519 1.3.101.110.
    let x25519 = PRIVATE.replace("K2Vw", "K2Vu");
    // Created by `openssl genpkey -algorithm EC -pkeyopt ec_paramgen_curve:P-256`.
    let elliptic = "-----BEGIN PRIVATE KEY-----\n\
        MIGHAgEAMBMGByqGSM49AgEGCCqGSM49AwEHBG0wawIBAQQgBq/kHdP4bMkWdXYK\n\
        12NYKbXZ37MtWnRLwyV4OGssRmGhRANCAASWl2SZzCBeGBAHcSqDwdAPEWNE7NlY\n\
        eiPOin5o64wq1GPxgYNYnfHXc2lZAe4TOMKA+CEPA9RZNJ19n2xcWOrL\n\
        -----END PRIVATE KEY-----\n";
    let openssh = PRIVATE.replace("PRIVATE", "OPENSSH PRIVATE");
    for (name, text, found, hint) in [
        ("public.pem", PUBLIC, "a public key", "the file with the private key"),
        ("short.pem", &PRIVATE[..60], "PEM text without an END line", "copy the whole file"),
        ("letters.pem", &PRIVATE.replace("MC4C", "MC4*"), "malformed", "copy the whole"),
        ("cut.pem", &PRIVATE.replace("7rAMcrn9g", ""), "malformed", "copy the whole"),
        ("x25519.pem", &x25519, "an X25519 private key", "weights keygen"),
        ("p256.pem", elliptic, "an elliptic-curve (ECDSA) private key", "weights keygen"),
        ("ssh.pem", &openssh, "an OpenSSH private key", "weights keygen"),
        ("rsa.pem", &PRIVATE.replace("PRIVATE", "RSA PRIVATE"), "an RSA private key", "keygen"),
        ("ssh.pub", "ssh-ed25519 AAAAC3 me@here", "an OpenSSH public key", "the private key"),
        ("none.pem", "", "an empty file", "weights keygen"),
        ("text.pem", "hello", "text that is not PEM", "weights keygen"),
        ("key.der", "0.\u{2}\u{1}\0", "binary data", "openssl pkey -inform DER"),
    ] {
        let message = OperatorKey::read(&folder.file(name, text)).unwrap_err().to_string();
        for part in [name, found, hint] {
            assert!(message.contains(part), "{name}, {part}: {message}");
        }
        assert!(!message.contains("MC4C"), "message contains a key: {message}");
    }
    for (name, text, expected) in [
        ("private.pem", PRIVATE, "a private key, which must stay secret"),
        ("encrypted.pem", ENCRYPTED, "an encrypted private key"),
        ("x25519.pub.pem", &PUBLIC.replace("K2Vw", "K2Vu"), "an X25519 public key"),
        ("ssh2.pub", "ssh-ed25519 AAAAC3 me@here", "an OpenSSH public key"),
        ("cut.pub.pem", &PUBLIC.replace("URo=", ""), "malformed"),
        // The neutral element, for which anyone can create signatures.
        (
            "weak.pem",
            &PUBLIC.replace(
                "11qYAYKxCrfVS/7TyWQHOg7hcvPapiMlrwIaaPcHURo",
                "AQAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA",
            ),
            "anyone could forge signatures",
        ),
    ] {
        let message = read_public_key(&folder.file(name, text)).unwrap_err().to_string();
        assert!(message.contains(name) && message.contains(expected), "{message}");
    }
    let missing = OperatorKey::read(&folder.0.join("missing.pem")).unwrap_err().to_string();
    assert!(missing.contains("missing.pem") && missing.contains("exists"), "{missing}");
}
