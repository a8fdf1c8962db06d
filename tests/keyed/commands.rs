//! The commands of an operator with a key folder, and a node at a socket.

use std::io::{Read as _, Write as _};
use std::os::unix::net::UnixListener;
use std::path::{Path, PathBuf};

use agent_core::package::signature::PublicKey;
use agent_core::wire::cobs::Decoder;
use serde_json::{Value, json};

use super::test_node::{TestNode, package};
use crate::cli::command_line::{Folder, object, texts};

/// Serves a blank node at this socket, to one client after another.
fn serve(socket: PathBuf, public_key: Option<PublicKey>) {
    let listener = UnixListener::bind(socket).unwrap();
    std::thread::spawn(move || {
        let mut node = TestNode::with_public_key(public_key);
        while let Ok((mut client, _)) = listener.accept() {
            let (mut decoder, mut bytes) = (Decoder::<256>::new(), [0; 512]);
            while let Ok(length @ 1..) = client.read(&mut bytes) {
                for &byte in &bytes[..length] {
                    if let Some(Ok(request)) = decoder.push(byte) {
                        // The client may have gone.
                        let _ = client.write_all(&node.converse(request));
                    }
                }
            }
        }
    });
}

fn public_key(file: &Path) -> PublicKey {
    host_sim::signing::read_public_key(file).unwrap()
}

fn keys(folder: &Folder) -> Value {
    object(&folder.succeed("node node status --format json"))["keys"].clone()
}

#[test]
fn an_operator_provisions_pushes_rotates_and_takes_the_keys_away() {
    let folder = Folder::new("keyed-commands");
    folder.succeed("keygen keys");
    folder.succeed("keygen others");
    serve(folder.path("node"), Some(public_key(&folder.path("keys/operator.pub.pem"))));
    package(1, 2).save(&folder.path("node.weights")).unwrap();
    folder.succeed("weights sign node.weights --keys keys");
    let none = json!({ "provisioned": false, "agent": null, "epoch": null, "network_keys": [] });
    assert_eq!(keys(&folder), none);
    for action in ["rotate", "factory-reset"] {
        let error = folder.fail(&format!("node node {action} --keys keys"), 2);
        assert!(error.contains("provision --keys FOLDER"), "{error}");
    }

    // Only the owner of the firmware's public key gives it its first keys.
    let (_, error) = texts(&folder.run("node node provision --keys others --agent 1"));
    assert!(error.contains("must be signed with the operator key"), "{error}");
    let (told, error) = texts(&folder.run("node node provision --keys keys --agent 2"));
    assert!(told.contains("provisioned as agent 2"), "{told}{error}");
    assert!(error.contains("in the clear"), "{error}");
    let told = folder.succeed("node node provision --keys keys --agent 1");
    assert!(told.contains("provisioned as agent 1"), "{told}");
    assert_eq!((&keys(&folder)["agent"], &keys(&folder)["network_keys"]), (&json!(1), &json!([1])));

    let error = folder.fail("push node node.weights", 2);
    assert!(error.contains("--keys FOLDER"), "{error}");
    let error = folder.fail("push node node.weights --keys others", 2);
    assert!(error.contains("does not match the key folder"), "{error}");
    let told = folder.succeed("push node node.weights --keys keys --confirm");
    assert!(told.contains("in use and confirmed"), "{told}");
    for action in ["confirm", "reset"] {
        folder.fail(&format!("node node {action}"), 2);
    }
    folder.succeed("node node reset --keys keys");

    for (stage, numbers) in [(1, json!([1, 2])), (2, json!([2, 1])), (3, json!([2]))] {
        let told = object(&folder.succeed("keygen keys --rotate --format json"));
        assert_eq!((&told["stage"], &told["network_keys"]), (&json!(stage), &numbers));
        folder.succeed("node node rotate --keys keys");
        assert_eq!(keys(&folder)["network_keys"], numbers);
    }

    folder.fail("node node factory-reset --keys others", 2);
    let told = folder.succeed("node node factory-reset --keys keys");
    assert!(told.contains("not provisioned") && told.contains("no package in use"), "{told}");
    assert_eq!(keys(&folder), none);
}

#[test]
fn an_operator_rotates_the_key_that_signs() {
    let folder = Folder::new("operator-rotation");
    folder.succeed("keygen keys");
    serve(folder.path("node"), Some(public_key(&folder.path("keys/operator.pub.pem"))));
    let push = |version: u32, key: &str| {
        let name = format!("{version}.weights");
        package(1, version).save(&folder.path(&name)).unwrap();
        folder.succeed(&format!("weights sign {name} {key}"));
        folder.run(&format!("push node {name} --keys keys --confirm")).status.success()
    };
    let rotate = |stage: u8, valid: usize| {
        let told = object(&folder.succeed("keygen keys --rotate-operator --format json"));
        let keys = told["operator_keys"].as_array().unwrap();
        assert_eq!((&told["stage"], keys.len()), (&json!(stage), valid));
    };
    let (_, error) = texts(&folder.run("node node provision --keys keys --agent 1"));
    assert!(error.contains("in the clear"), "{error}");
    assert!(push(1, "--keys keys"));

    rotate(1, 2);
    assert!(!push(2, "--key keys/operator.next.pem"));
    folder.succeed("node node rotate --keys keys");
    assert!(push(2, "--key keys/operator.next.pem"));
    assert!(push(3, "--keys keys"));

    rotate(2, 2);
    folder.succeed("node node rotate --keys keys");
    rotate(3, 1);
    // The package in use still has the old signature.
    let error = folder.fail("node node rotate --keys keys", 2);
    assert!(error.contains("push a package signed with the new key"), "{error}");
    assert!(push(4, "--keys keys"));
    folder.succeed("node node rotate --keys keys");
    assert!(!push(5, "--key keys/operator.old.pem"));
    folder.succeed("node node reset --keys keys");
    assert!(push(5, "--keys keys --replace-signature"));

    // The firmware of a blank node knows only the old key.
    folder.succeed("node node factory-reset --keys keys");
    let (_, error) = texts(&folder.run("node node provision --keys keys --agent 1"));
    assert!(error.contains("must be signed with the operator key"), "{error}");
}

#[test]
fn a_blank_node_gets_its_first_keys_during_a_rotation() {
    let folder = Folder::new("operator-rotation-blank");
    folder.succeed("keygen keys");
    serve(folder.path("node"), Some(public_key(&folder.path("keys/operator.pub.pem"))));
    for _ in 0..2 {
        folder.succeed("keygen keys --rotate-operator");
    }
    let (told, error) = texts(&folder.run("node node provision --keys keys --agent 1"));
    assert!(told.contains("provisioned as agent 1"), "{told}{error}");
    package(1, 1).save(&folder.path("node.weights")).unwrap();
    folder.succeed("weights sign node.weights --keys keys");
    folder.succeed("push node node.weights --keys keys --confirm");
}
