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
        ("network_keys = [0]", "network keys are numbered from 1"),
        ("network_keys = [3, 5]", "network keys 3 and 5 are not consecutive"),
        ("network_keys = [4, 4]", "network keys 4 and 4 are not consecutive"),
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

#[test]
fn a_rotation_of_the_operator_key_has_three_stages() {
    let (_folder, path) = new_folder();
    let old = read_public_key(&path.join(PUBLIC)).unwrap();
    let signing = || read(&path).unwrap().operator(&mut no_passphrase).unwrap();
    let mut operators = Operators::read(&path).unwrap();
    assert_eq!((operators.stage(), operators.for_nodes().unwrap()), (None, None));
    assert_eq!(operators.valid_keys().unwrap(), [old]);

    assert_eq!(operators.advance().unwrap(), OperatorStage::NextAccepted);
    let new = read_public_key(&path.join("operator.next.pub.pem")).unwrap();
    assert_ne!(new, old);
    let overlap = Some([&[1][..], new.as_bytes()].concat());
    for (stage, signs) in [(OperatorStage::NextAccepted, old), (OperatorStage::NextSigns, new)] {
        let found = read(&path).unwrap().operators().clone();
        assert_eq!(found.stage(), Some(stage));
        assert_eq!(found.for_nodes().unwrap(), overlap);
        assert_eq!(found.valid_keys().unwrap(), [old, new]);
        assert_eq!(signing().public_key(), &signs);
        operators.advance().unwrap();
    }
    let found = Operators::read(&path).unwrap();
    assert_eq!(found.stage(), Some(OperatorStage::NextOnly));
    assert_eq!(found.for_nodes().unwrap(), Some([&[0][..], new.as_bytes()].concat()));
    assert_eq!(found.valid_keys().unwrap(), [new]);
    assert_eq!(signing().public_key(), &new);
    let file = |name: &str| path.join(name);
    let kept = crate::signing::OperatorKey::read(&file("operator.old.pem")).unwrap();
    assert_eq!(kept.public_key(), &old);
    assert!(!file("operator.next.pem").exists() && !file("operator.next.pub.pem").exists());

    // The old private key is not overwritten by another rotation.
    let error = operators.advance().unwrap_err();
    assert!(
        error.to_string().contains("operator.old.pem: left over from another rotation"),
        "{error}"
    );
    for name in ["operator.old.pem", "operator.old.pub.pem"] {
        fs::remove_file(file(name)).unwrap();
    }
    assert_eq!(operators.advance().unwrap(), OperatorStage::NextAccepted);
    assert_eq!(signing().public_key(), &new);
}

#[test]
fn the_last_stage_can_be_interrupted_at_any_file() {
    let names = ["operator.pem", "operator.next.pem", "operator.pub.pem", "operator.next.pub.pem"];
    let targets = ["operator.old.pem", "operator.pem", "operator.old.pub.pem", "operator.pub.pem"];
    for renamed in 0..=names.len() {
        let (_folder, path) = new_folder();
        let mut operators = Operators::read(&path).unwrap();
        operators.advance().unwrap();
        operators.advance().unwrap();
        let new = read_public_key(&path.join("operator.next.pub.pem")).unwrap();
        for (name, target) in names.iter().zip(targets).take(renamed) {
            fs::rename(path.join(name), path.join(target)).unwrap();
        }
        let mut operators = Operators::read(&path).unwrap();
        assert_eq!(operators.advance().unwrap(), OperatorStage::NextOnly, "{renamed}");
        assert_eq!(operators.valid_keys().unwrap(), [new]);
        let signing = read(&path).unwrap().operator(&mut no_passphrase).unwrap();
        assert_eq!(signing.public_key(), &new);
    }
}

#[test]
fn invalid_stages_are_reported_and_not_overwritten() {
    let (_folder, path) = new_folder();
    let file = path.join("operator.toml");
    for (text, problem) in [
        ("stage = 0", "there is no stage 0"),
        ("stage = 4", "there is no stage 4"),
        ("stage = \"one\"", "string"),
        ("step = 1", "step"),
        ("", "stage"),
    ] {
        fs::write(&file, text).unwrap();
        let error = read(&path).unwrap_err().to_string();
        assert!(error.contains("operator.toml: ") && error.contains(problem), "{text}: {error}");
    }
    let error = KeyFolder::create(&path.join("other")).map(|_| ());
    assert!(error.is_ok());
    fs::write(path.join("other/operator.toml"), "stage = 1").unwrap();
    for name in [OPERATOR, PUBLIC, SECRET, NETWORK] {
        fs::remove_file(path.join("other").join(name)).unwrap();
    }
    let error = KeyFolder::create(&path.join("other")).unwrap_err();
    assert!(matches!(error, KeyFolderError::Exists { .. }), "{error}");
}
