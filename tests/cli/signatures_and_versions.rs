//! Signatures and versions of packages: checked, and never replaced or repeated silently.

use std::fs;
use std::process::{Command, Stdio};

use crate::cli::borders::{SAMPLES, TRAIN, json, with_package};
use crate::cli::command_line::{object, texts};

#[test]
fn signatures_are_checked_and_not_replaced_silently() {
    let folder = with_package("signatures");
    for name in ["one", "two"] {
        folder.succeed(&format!("weights keygen --out {name}"));
    }
    let verified = json(&folder, "weights verify node1.weights");
    assert_eq!(
        (&verified["signed"], &verified["signature_checked"]),
        (&false.into(), &false.into())
    );
    let sign = |key: &str| format!("weights sign node1.weights --key {key}.key");
    assert_eq!(json(&folder, &sign("one"))["replaced_signature"], false);
    // Signing again with the same key changes nothing.
    let signed = fs::read(folder.path("node1.weights")).unwrap();
    folder.succeed(&sign("one"));
    assert_eq!(fs::read(folder.path("node1.weights")).unwrap(), signed);
    let text = folder.succeed("weights verify node1.weights");
    assert!(text.contains("NOT checked") && text.contains("--key"), "{text}");
    let text = folder.succeed("weights verify node1.weights --key one.pub");
    assert!(!text.contains("not checked") && text.contains("ok   signature"), "{text}");
    assert_eq!(json(&folder, "weights verify node1.weights")["signature_checked"], false);
    let checked = json(&folder, "weights verify node1.weights --key one.pub");
    assert_eq!(checked["signature_checked"], true);
    let error = folder.fail("weights verify node1.weights --key two.pub", 2);
    assert!(error.contains("the private key that matches the node's public key"), "{error}");
    let error = folder.fail(&sign("two"), 2);
    assert!(
        error.contains("signed with a key other than") && error.contains("--replace-signature"),
        "{error}"
    );
    assert_eq!(fs::read(folder.path("node1.weights")).unwrap(), signed);
    let replaced = json(&folder, &format!("{} --replace-signature", sign("two")));
    assert_eq!(replaced["replaced_signature"], true);
    folder.succeed("weights verify node1.weights --key two.pub");
}

#[test]
fn passphrase_comes_from_a_file_or_a_variable() {
    // Created by `openssl genpkey -algorithm ed25519 -aes256 -pass pass:correct`.
    const KEY: &str = "-----BEGIN ENCRYPTED PRIVATE KEY-----\n\
        MIGbMFcGCSqGSIb3DQEFDTBKMCkGCSqGSIb3DQEFDDAcBAhtHESS55FyrwICCAAw\n\
        DAYIKoZIhvcNAgkFADAdBglghkgBZQMEASoEEPizFlrTFJdYcw3Glu8kJJMEQIbE\n\
        vR+wQh+87IpYq51BWwb4ZZRwkFxQJMs0I0YxGW8u4UNoUVt1WcmAxWt7P2tAsLpv\n\
        GQ9Q2lQY9BS5qknS+9I=\n\
        -----END ENCRYPTED PRIVATE KEY-----\n";
    let folder = with_package("passphrase");
    folder.write("operator.key", KEY);
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        let private = fs::Permissions::from_mode(0o600);
        fs::set_permissions(folder.path("operator.key"), private).unwrap();
    }
    folder.write("right", "correct\r\nanother line\n");
    folder.write("wrong", "wrong\n");
    let sign = "weights sign node1.weights --key operator.key --out signed.weights";
    folder.succeed(&format!("{sign} --passphrase-file right"));
    let error = folder.fail(&format!("{sign} --passphrase-file wrong"), 2);
    assert!(error.contains("operator.key: cannot be decrypted"), "{error}");
    let error = folder.fail(&format!("{sign} --passphrase-file nowhere"), 2);
    assert!(error.contains("nowhere: cannot read the passphrase"), "{error}");
    let error = folder
        .fail(&format!("train {SAMPLES} {TRAIN} --sign operator.key --passphrase-file wrong"), 2);
    assert!(error.contains("cannot be decrypted"), "{error}");
    let cosim = "cosim paper --boards unix:a,unix:b,unix:c --key operator.key --passphrase-file";
    let error = folder.fail(&format!("{cosim} wrong"), 2);
    assert!(error.contains("operator.key: cannot be decrypted"), "{error}");
    // With the right one it gets as far as the nodes.
    let error = folder.fail(&format!("{cosim} right"), 1);
    assert!(error.contains("agent 1 (unix:a)"), "{error}");
    let with = |variable: Option<&str>| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_simulator-under-test"));
        command.args(sign.split(' ')).current_dir(folder.path(".")).stdin(Stdio::null());
        command.env_remove("HOST_SIM_PASSPHRASE");
        if let Some(variable) = variable {
            command.env("HOST_SIM_PASSPHRASE", variable);
        }
        command.output().unwrap()
    };
    assert_eq!(with(Some("correct")).status.code(), Some(0));
    // No terminal to ask.
    let output = with(None);
    let error = texts(&output).1;
    assert_eq!(output.status.code(), Some(2), "{error}");
    assert!(error.contains("--passphrase-file FILE, or set HOST_SIM_PASSPHRASE"), "{error}");
}

#[test]
fn renumbering_keeps_provenance_and_drops_the_signature() {
    let folder = with_package("renumber");
    folder.succeed("weights keygen --out one");
    folder.succeed("weights sign node1.weights --key one.key");
    let before = json(&folder, "weights inspect node1.weights");
    let text = folder.succeed("weights renumber node1.weights --version 7 --out seven.weights");
    assert!(text.contains("version 7 (was 2)") && text.contains("Sign it again"), "{text}");
    let after = json(&folder, "weights inspect seven.weights");
    assert_eq!((&after["version"], &after["signed"]), (&7.into(), &false.into()));
    for (fact, value) in before.as_object().unwrap() {
        if !["version", "signed", "bytes", "overhead_bytes"].contains(&fact.as_str()) {
            assert_eq!(&after[fact], value, "{fact}");
        }
    }
    folder.succeed("weights verify seven.weights --in-use node1.weights");
    let report = json(&folder, "weights renumber seven.weights --version 8");
    assert_eq!(
        (&report["version_before"], &report["signature_dropped"]),
        (&7.into(), &false.into())
    );
    assert_eq!(json(&folder, "weights inspect seven.weights")["version"], 8);
}

#[test]
fn rejects_a_successor_of_the_largest_version() {
    let folder = with_package("largest");
    folder.succeed("weights renumber node1.weights --version 4294967295 --out last.weights");
    folder.succeed("weights export node1.weights --out net.npz");
    for command in [
        format!(
            "train {SAMPLES} --scenario mine.toml --agent 1 --out new.weights --base last.weights"
        ),
        format!("train {SAMPLES} --scenario mine.toml --agent 1 --out last.weights"),
        "weights import net.npz --base last.weights --out new.weights".to_owned(),
    ] {
        let error = folder.fail(&command, 2);
        assert!(
            error.contains("last.weights: version 4294967295 is the largest possible"),
            "{error}"
        );
    }
    assert!(!folder.path("new.weights").exists());
}

#[test]
fn parallel_trainings_to_one_file_get_different_versions() {
    let folder = with_package("shared");
    let children: Vec<_> = (1..=3)
        .map(|seed| {
            Command::new(env!("CARGO_BIN_EXE_simulator-under-test"))
                .args(format!("train {SAMPLES} {TRAIN} --format json --seed {seed}").split(' '))
                .current_dir(folder.path("."))
                .stdout(Stdio::piped())
                .spawn()
                .unwrap()
        })
        .collect();
    let mut versions: Vec<u64> = children
        .into_iter()
        .map(|child| {
            let output = child.wait_with_output().unwrap();
            assert_eq!(output.status.code(), Some(0));
            object(&texts(&output).0)["version"].as_u64().unwrap()
        })
        .collect();
    versions.sort_unstable();
    assert_eq!(versions, [3, 4, 5]);
}
