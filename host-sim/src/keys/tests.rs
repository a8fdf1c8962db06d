//! Tests of key folders.

use tempfile::TempDir;

use super::*;
use crate::signing::{KeyFileError, read_public_key};
use agent_core::wire::secret::Secret;

fn no_passphrase(path: &Path) -> Result<zeroize::Zeroizing<String>, KeyFileError> {
    Err(KeyFileError::PassphraseNeeded { path: path.to_owned() })
}

fn read(path: &Path) -> Result<KeyFolder, KeyFolderError> {
    KeyFolder::read(path, &mut no_passphrase)
}

fn new_folder() -> (TempDir, PathBuf) {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("made/keys");
    KeyFolder::create(&path).unwrap();
    (folder, path)
}

#[test]
fn a_new_folder_round_trips() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("made/keys");
    let (made, operator) = KeyFolder::create(&path).unwrap();
    let found = read(&path).unwrap();
    assert_eq!(found.fleet().port_secret(3), made.fleet().port_secret(3));
    assert_eq!(found.fleet().network_keys(), made.fleet().network_keys());
    assert_eq!(found.fleet().network_keys()[0].number(), 1);
    let read = found.operator(&mut no_passphrase).unwrap();
    assert_eq!(read.public_key(), operator.public_key());
    assert_eq!(&read_public_key(&public_file(&path)).unwrap(), operator.public_key());
    assert!(format!("{found:?}").contains("FleetSecret(..)"));
}

#[cfg(unix)]
#[test]
fn secrets_are_private() {
    use std::os::unix::fs::PermissionsExt;
    let (_folder, path) = new_folder();
    let mode = |path: &Path| fs::metadata(path).unwrap().permissions().mode() & 0o777;
    assert_eq!(mode(&path), 0o700);
    for name in [OPERATOR, SECRET] {
        assert_eq!(mode(&path.join(name)), 0o600, "{name}");
    }
    fs::set_permissions(path.join(SECRET), fs::Permissions::from_mode(0o640)).unwrap();
    let error = read(&path).unwrap_err();
    assert!(matches!(error, KeyFolderError::Key(KeyFileError::Open { .. })), "{error}");
}

#[test]
fn nothing_is_overwritten_or_left_behind() {
    let (_folder, path) = new_folder();
    let before = fs::read(path.join(SECRET)).unwrap();
    let error = KeyFolder::create(&path).unwrap_err();
    assert!(matches!(error, KeyFolderError::Exists { .. }), "{error}");
    assert_eq!(fs::read(path.join(SECRET)).unwrap(), before);
    for name in [OPERATOR, PUBLIC, SECRET] {
        fs::remove_file(path.join(name)).unwrap();
    }
    let error = KeyFolder::create(&path).unwrap_err();
    assert!(error.to_string().contains("network.toml: already exists"), "{error}");
    assert_eq!(fs::read_dir(&path).unwrap().count(), 1);
    fs::write(path.join("file"), "").unwrap();
    let error = KeyFolder::create(&path.join("file/keys")).unwrap_err();
    assert!(matches!(error, KeyFolderError::Create { .. }), "{error}");
}

#[test]
fn different_purposes_and_numbers_give_different_keys() {
    let secret = FleetSecret::new([7; 32]);
    let mut keys: Vec<_> = (0..300).map(|agent| secret.port_secret(agent)).collect();
    keys.extend((1..=255).map(|number| secret.network_secret(number)));
    keys.push(FleetSecret::new([8; 32]).port_secret(0));
    for (index, key) in keys.iter().enumerate() {
        assert!(!keys[..index].contains(key), "{index}");
    }
}

/// Computed with another implementation of HKDF.
#[test]
fn derivation_is_hkdf() {
    let secret = FleetSecret::new(std::array::from_fn(|i| i as u8));
    let port = [
        0xa7, 0x5c, 0xb7, 0x6d, 0xbc, 0xe3, 0xe7, 0xcb, 0xeb, 0x6b, 0x92, 0x53, 0x33, 0x54, 0x88,
        0x7a,
    ];
    let network = [
        0xcc, 0x29, 0x3b, 0x5c, 0x93, 0xd9, 0x75, 0x8c, 0x2f, 0xcb, 0xe2, 0x04, 0x29, 0xcf, 0x71,
        0xfa,
    ];
    assert!(secret.port_secret(2) == Secret::new(port));
    assert!(secret.network_secret(2) == Secret::new(network));
}

#[test]
fn a_rotation_has_three_stages() {
    let (_folder, path) = new_folder();
    let numbers = || read(&path).unwrap().fleet().network_numbers();
    let mut seen = vec![numbers().iter().collect::<Vec<_>>()];
    let mut stages = vec![numbers().stage()];
    for _ in 0..3 {
        let before = numbers();
        let (found, after) = KeyFolder::advance_rotation(&path).unwrap();
        assert_eq!((found, after), (before, numbers()));
        seen.push(after.iter().collect());
        stages.push(after.stage());
    }
    assert_eq!(seen, [vec![1], vec![1, 2], vec![2, 1], vec![2]]);
    assert_eq!(stages, [Stage::One, Stage::NewAccepted, Stage::NewSent, Stage::One]);
    // The last number is followed by the first.
    fs::write(path.join(NETWORK), "network_keys = [255]").unwrap();
    seen.clear();
    for _ in 0..3 {
        seen.push(KeyFolder::advance_rotation(&path).unwrap().1.iter().collect());
    }
    assert_eq!(seen, [vec![255, 1], vec![1, 255], vec![1]]);
}

#[test]
fn invalid_numbers_are_reported_and_not_overwritten() {
    let (_folder, path) = new_folder();
    for (text, problem) in [
        ("network_keys = []", "it lists 0 network keys"),
        ("network_keys = [1, 2, 3]", "it lists 3 network keys"),
        ("network_keys = [0]", "there is no network key 0"),
        ("network_keys = [3, 5]", "3 and 5 do not follow each other"),
        ("network_keys = [4, 4]", "4 and 4 do not follow each other"),
        ("network_keys = [256]", "256"),
        ("network = [1]", "network"),
        ("network_keys = [", "array"),
        ("", "network_keys"),
    ] {
        fs::write(path.join(NETWORK), text).unwrap();
        for error in [read(&path).unwrap_err(), KeyFolder::advance_rotation(&path).unwrap_err()] {
            let told = error.to_string();
            assert!(matches!(error, KeyFolderError::Numbers { .. }), "{text}: {told}");
            assert!(told.contains("network.toml: ") && told.contains(problem), "{text}: {told}");
        }
        assert_eq!(fs::read_to_string(path.join(NETWORK)).unwrap(), text);
    }
    fs::remove_file(path.join(NETWORK)).unwrap();
    let error = read(&path).unwrap_err();
    assert!(error.to_string().contains("created by `host-sim keygen`"), "{error}");
}
