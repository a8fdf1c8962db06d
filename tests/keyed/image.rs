//! Images for blank boards: a node that starts from one is provisioned.

use std::fs;
use std::os::unix::fs::PermissionsExt as _;

use agent_core::service::{Problem, Request};
use host_sim::keys::{KeyFolder, epoch_now};
use host_sim::service::Message;
use host_sim::signing::read_public_key;

use super::test_node::{Off, TestNode, package, seal};
use crate::cli::command_line::{Folder, object};
use crate::cli::image::read_hex;
use crate::store::packages::new_flash;

const MEMORY: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../memory.x");

/// A folder with keys and the signed package of agent 2.
fn folder(name: &str) -> Folder {
    let folder = Folder::new(name);
    folder.succeed("keygen keys");
    package(2, 3).save(&folder.path("node.weights")).unwrap();
    folder.succeed("weights sign node.weights --keys keys");
    folder
}

fn image(rest: &str) -> String {
    format!("weights image node.weights --memory {MEMORY} --keys keys {rest}")
}

/// A 32-bit ELF program for Arm that loads these bytes.
fn elf(segments: &[(u32, &[u8])]) -> Vec<u8> {
    const HEADER: usize = 52;
    const ENTRY: usize = 32;
    let mut file = vec![0; HEADER + ENTRY * segments.len()];
    file[..7].copy_from_slice(&[0x7f, b'E', b'L', b'F', 1, 1, 1]);
    (file[16], file[18], file[20]) = (2, 40, 1);
    (file[28], file[40], file[42], file[44]) =
        (HEADER as u8, HEADER as u8, ENTRY as u8, segments.len() as u8);
    for (index, &(address, bytes)) in segments.iter().enumerate() {
        let (offset, length) = (file.len() as u32, bytes.len() as u32);
        // Only the address for loading counts.
        let entry = [1, offset, 0x2000_0000, address, length, length, 5, 4];
        let start = HEADER + ENTRY * index;
        file[start..start + ENTRY].copy_from_slice(&entry.map(u32::to_le_bytes).concat());
        file.extend(bytes);
    }
    file
}

#[test]
fn a_node_that_starts_from_an_image_is_provisioned() {
    for (slot, offset) in [("a", 0), ("b", 0x7000)] {
        let folder = folder(&format!("node-image-{slot}"));
        let before = epoch_now();
        let report = object(&folder.succeed(&image(&format!(
            "--slot {slot} --key keys/operator.pub.pem --format bin,json"
        ))));
        assert_eq!(report["notes"].to_string().matches("WARNING").count(), 1, "{report}");
        let file = folder.path("node.node.bin");
        assert_eq!(fs::metadata(&file).unwrap().permissions().mode() & 0o777, 0o600);
        let mut flash = new_flash();
        flash.overwrite(offset, &fs::read(file).unwrap());

        let key = read_public_key(&folder.path("keys/operator.pub.pem")).unwrap();
        let mut node = TestNode::with_flash(flash, Some(key));
        let fleet = KeyFolder::read(&folder.path("keys"), &mut |_| unreachable!()).unwrap();
        let port_key = fleet.fleet().port_keys().of(2);
        let request = Request::StartAt { estimate: [0.5, 0.5].into_iter().collect() };
        for _ in 0..2 {
            let package = node.status().package.unwrap();
            assert_eq!((package.agent, package.version, package.trial), (2, 3, None));
            let Message::Session(Some(session)) = node.ask(&Request::Session) else {
                panic!("not provisioned")
            };
            assert_eq!((session.agent, session.network_keys), (2, [Some(1), None]));
            let epoch = session.epoch.unwrap();
            assert!(epoch >= before);
            assert_eq!(session.proof, port_key.proof(&session));
            assert_eq!(node.ask(&request), Message::Refused(Problem::NotSealed));
            assert_eq!(node.send(&seal(&port_key, epoch, 1, &request)), Message::Done);
            // Its hello is of version 2, with the network key of the folder.
            let sent = node.step([]);
            assert!(!sent.is_empty());
            node.restart(Off::Power);
        }
        assert!(
            node.flash()
                .windows(16)
                .any(|bytes| bytes == fleet.fleet().network_keys()[0].to_bytes().split_at(1).1)
        );
    }
}

#[test]
fn an_image_for_a_blank_board_holds_its_firmware() {
    let folder = folder("node-image-firmware");
    let (vectors, code) = ([1_u8; 0x40], [2_u8; 0x100]);
    // In one erase unit, and the initial values of variables in the next one but one.
    let program = elf(&[(0x100, &code), (0, &vectors), (0x2000, &[3; 5])]);
    fs::write(folder.path("node.elf"), program).unwrap();
    let text = folder.succeed(&image("--slot a --node node.elf"));
    assert!(text.contains("the firmware") && text.contains("holds the keys of agent 2"), "{text}");
    let memory = read_hex(&fs::read(folder.path("node.node.hex")).unwrap());
    let bytes = |start: u64, length: u64| -> Vec<u8> {
        (start..start + length).filter_map(|address| memory.get(&address).copied()).collect()
    };
    assert_eq!(bytes(0, 0x40), vectors);
    assert_eq!(bytes(0x40, 0xc0), [0xff; 0xc0]);
    assert_eq!(bytes(0x100, 0x100), code);
    assert!(bytes(0x200, 0x1e00).is_empty());
    assert_eq!(bytes(0x2000, 0x100), [3; 5]);
    let package = fs::read(folder.path("node.weights")).unwrap();
    assert_eq!(bytes(0x2100_0000, package.len() as u64), package);
    assert_eq!(bytes(0x2100_e000, 0x2000).len(), 0x2000);
    let uf2 = folder.succeed(&image("--slot a --node node.elf --family 17 --out node.uf2"));
    assert!(uf2.contains("node.uf2"), "{uf2}");

    // Secrets are not overwritten, not even by other secrets.
    let error = folder.fail(&image("--slot a --node node.elf"), 2);
    assert!(error.contains("refusing to overwrite"), "{error}");
    // Half a gigabyte of blanks.
    let error = folder.fail(&image("--slot a --node node.elf --out node.bin"), 2);
    assert!(error.contains("use the hex format"), "{error}");
}

#[test]
fn firmware_that_does_not_fit_the_image_is_refused() {
    let folder = folder("node-image-refused");
    for (name, program, said) in [
        ("text", b"not a program".to_vec(), "not a 32-bit ELF program"),
        ("empty", elf(&[]), "it loads nothing"),
        ("weights", elf(&[(0x2100_6000, &[1; 4])]), "overlap WEIGHTS"),
        ("border", elf(&[(0x20ff_fffe, &[1; 4])]), "overlap WEIGHTS"),
        ("twice", elf(&[(0, &[1; 9]), (8, &[1; 9])]), "other bytes of the firmware"),
        ("end", elf(&[(u32::MAX - 2, &[1; 4])]), "overlap WEIGHTS"),
    ] {
        fs::write(folder.path(name), program).unwrap();
        let error = folder.fail(&image(&format!("--slot a --node {name} --out node.hex")), 2);
        assert!(error.contains(said), "{name}: {error}");
    }
    let error = folder.fail(&image("--slot a --node missing.elf"), 2);
    assert!(error.contains("missing.elf") && error.contains("ELF file"), "{error}");
    let error = folder
        .fail(&format!("weights image node.weights --memory {MEMORY} --slot a --node text"), 2);
    assert!(error.contains("--keys"), "{error}");
    assert!(!folder.path("node.hex").exists() && !folder.path("node.node.hex").exists());

    // A journal that a node with keys would fill.
    let map = fs::read_to_string(MEMORY).unwrap();
    let small = map
        .replace("_weights_erase_size = 4K", "_weights_erase_size = 512")
        .replace("_weights_commit_length = 8K", "_weights_commit_length = 1K");
    folder.write("small.x", &small);
    let image = "weights image node.weights --memory small.x --slot a";
    folder.succeed(image);
    let error = folder.fail(&format!("{image} --keys keys"), 2);
    assert!(error.contains("512 bytes") && error.contains("896"), "{error}");
}

#[test]
fn an_unsigned_package_is_told() {
    let folder = folder("node-image-unsigned");
    package(1, 2).save(&folder.path("node.weights")).unwrap();
    let text = folder.succeed(&image("--slot a"));
    assert!(text.contains("not signed with an operator key of keys"), "{text}");
}
