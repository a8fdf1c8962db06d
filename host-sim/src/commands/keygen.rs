//! `keygen`: creates a key folder, or advances the rotation of its network key or operator key.

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;

use super::{CommandError, Format, print_json, print_text};
use crate::keys::{KeyFolder, NetworkNumbers, OperatorStage, Operators, Stage, public_file};
use crate::shell::shell_word;
use crate::signing::fingerprint;

/// Arguments of `keygen`.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Key folder
    folder: PathBuf,
    /// Advance the rotation of the network key by one of its three stages
    #[arg(long)]
    rotate: bool,
    /// Advance the rotation of the operator key by one of its three stages
    #[arg(long, conflicts_with = "rotate")]
    rotate_operator: bool,
    /// Output format
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

#[derive(Serialize)]
struct Created {
    folder: String,
    public_key: String,
    fingerprint: String,
    public_key_bytes: [u8; 32],
    network_keys: Vec<u8>,
}

#[derive(Serialize)]
struct Rotated {
    folder: String,
    network_keys_before: Vec<u8>,
    network_keys: Vec<u8>,
    /// Stage that has been reached, 1 to 3.
    stage: u8,
}

pub(super) fn execute(arguments: &Arguments) -> Result<(), CommandError> {
    match (arguments.rotate, arguments.rotate_operator) {
        (true, _) => rotate(arguments),
        (_, true) => rotate_operator(arguments),
        _ => create(arguments),
    }
}

fn create(arguments: &Arguments) -> Result<(), CommandError> {
    let (keys, operator) = KeyFolder::create(&arguments.folder)?;
    let report = Created {
        folder: arguments.folder.display().to_string(),
        public_key: public_file(&arguments.folder).display().to_string(),
        fingerprint: fingerprint(operator.public_key()),
        public_key_bytes: operator.public_key_bytes(),
        network_keys: keys.fleet().network_numbers().iter().collect(),
    };
    if arguments.format == Format::Json {
        return print_json(&report);
    }
    let hex: String = report.public_key_bytes.iter().map(|byte| format!("{byte:02x}")).collect();
    print_text(&format!(
        "Key folder: {} (keep it secret and back it up; without it, provisioned nodes cannot be managed any more)\n\
         \x20 operator.pem      signs packages and first keys\n\
         \x20 operator.pub.pem  its public key, for nodes and for `weights verify --key`\n\
         \x20 secret.pem        the keys of all nodes and of the network are derived from it\n\
         \x20 network.toml      numbers of the network keys in use\n\
         Fingerprint: {}\n\
         For firmware (NODE_PUBLIC_KEY, or cargo xtask firmware --public-key): {hex}\n\
         Next: build the firmware with the public key, and provision each node on a line that only you \
         can read:\n\
         \x20 host-sim node ENDPOINT provision --keys {} --agent N\n",
        report.folder,
        report.fingerprint,
        shell_word(&arguments.folder)
    ))
}

fn rotate(arguments: &Arguments) -> Result<(), CommandError> {
    let (before, after) = KeyFolder::advance_rotation(&arguments.folder)?;
    let report = Rotated {
        folder: arguments.folder.display().to_string(),
        network_keys_before: before.iter().collect(),
        network_keys: after.iter().collect(),
        stage: match after.stage() {
            Stage::NewAccepted => 1,
            Stage::NewSent => 2,
            Stage::One => 3,
        },
    };
    if arguments.format == Format::Json {
        return print_json(&report);
    }
    let folder = shell_word(&arguments.folder);
    let then = match after.stage() {
        Stage::One => "Then the rotation is complete.".to_owned(),
        _ => format!("When all nodes have it, run `host-sim keygen {folder} --rotate` again."),
    };
    print_text(&format!(
        "Stage {} of 3: {}\n\
         Next: for every node, run\n\
         \x20 host-sim node ENDPOINT rotate --keys {folder}\n\
         {then}\n",
        report.stage,
        described(after)
    ))
}

fn rotate_operator(arguments: &Arguments) -> Result<(), CommandError> {
    #[derive(Serialize)]
    struct Rotated {
        folder: String,
        /// Stage that has been reached, 1 to 3.
        stage: u8,
        /// Fingerprints of the public keys that nodes accept.
        operator_keys: Vec<String>,
    }
    let mut operators = Operators::read(&arguments.folder)?;
    let stage = operators.advance()?;
    let report = Rotated {
        folder: arguments.folder.display().to_string(),
        stage: stage.into(),
        operator_keys: operators.valid_keys()?.iter().map(fingerprint).collect(),
    };
    if arguments.format == Format::Json {
        return print_json(&report);
    }
    let folder = shell_word(&arguments.folder);
    let again = format!("run `host-sim keygen {folder} --rotate-operator` again.");
    let (told, then) = match stage {
        OperatorStage::NextAccepted => (
            "nodes also accept the new key operator.next.pem; operator.pem still signs",
            format!("When all nodes have it, {again}"),
        ),
        OperatorStage::NextSigns => (
            "operator.next.pem signs; nodes still accept both",
            format!(
                "Sign a package for every node with it (`weights sign --keys {folder}`), and push it. When \
                 all nodes use one, {again}"
            ),
        ),
        OperatorStage::NextOnly => (
            "nodes accept only the new key, now operator.pem; the old one is operator.old.pem",
            "Then the rotation is complete. Build new firmware with the new public key before the next \
             rotation, and for nodes that are blank."
                .to_owned(),
        ),
    };
    print_text(&format!(
        "Stage {} of 3: {told}\n\
         Next: for every node, run\n\
         \x20 host-sim node ENDPOINT rotate --keys {folder}\n\
         {then}\n",
        report.stage
    ))
}

/// Says what nodes do in a stage.
fn described(numbers: NetworkNumbers) -> String {
    let all: Vec<_> = numbers.iter().collect();
    match (numbers.stage(), all.as_slice()) {
        (Stage::NewAccepted, [old, new]) => {
            format!("nodes also accept network key {new}, and still send with {old}")
        }
        (Stage::NewSent, [new, old]) => {
            format!("nodes send with network key {new}, and still accept {old}")
        }
        _ => format!("nodes use network key {} only", all.first().copied().unwrap_or_default()),
    }
}
