//! `weights`: inspecting, verifying, signing, converting and placing packages.

mod convert;
mod diff;
mod evaluate;
mod image;
mod renumber;
mod verify;

use std::path::{Path, PathBuf};

use agent_core::package::Serial;
use clap::{Args, Subcommand};
use serde::Serialize;

use super::key::Passphrase;
use super::{CommandError, Format, package_format, print_json, print_text};
use crate::keys::Operators;
use crate::packages::check::{check_signature_before, signed};
use crate::packages::{Facts, PackageBytes};
use crate::signing::{KeyPair, fingerprint};

pub(super) use image::{FlashArguments, flash};

/// Subcommands of `weights`.
#[derive(Debug, Subcommand)]
pub(super) enum Command {
    /// Show the contents of a package
    Inspect(Inspect),
    /// Check a package as a node would
    Verify(verify::Arguments),
    /// Compare two packages
    Diff(diff::Arguments),
    /// Evaluate a package on a recording, before pushing it
    Evaluate(evaluate::Arguments),
    /// Give a package a new version
    Renumber(renumber::Arguments),
    /// Sign a package
    Sign(Sign),
    /// Generate a key pair for signing
    Keygen(Keygen),
    /// Create a package from a network trained elsewhere (.npz or .safetensors)
    Import(convert::Import),
    /// Export a package's network for other tools (.npz or .safetensors)
    Export(convert::Export),
    /// Create a flash image of a package, for any flashing tool
    Image(image::Arguments),
}

/// Arguments of `weights inspect`.
#[derive(Debug, Args)]
pub(super) struct Inspect {
    /// Weight package
    package: PathBuf,
    /// Output format
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

/// Arguments of `weights sign`.
#[derive(Debug, Args)]
pub(super) struct Sign {
    /// Weight package
    package: PathBuf,
    /// Private key, as written by `weights keygen` or OpenSSL
    #[arg(long, required_unless_present = "keys", conflicts_with = "keys")]
    key: Option<PathBuf>,
    /// Key folder with the private key, as created by `keygen`
    #[arg(long, value_name = "FOLDER")]
    keys: Option<PathBuf>,
    #[command(flatten)]
    passphrase: Passphrase,
    /// Replace an existing signature made with a different key
    #[arg(long)]
    replace_signature: bool,
    /// Give the package this package epoch: for going back to an earlier network, because nodes accept
    /// any version of a higher one. A package of format 1 becomes one of format 2
    #[arg(long)]
    epoch: Option<u32>,
    /// Let a package of format 1 replace any version up to this one once, even if it is older; in
    /// format 2, use --epoch
    #[arg(long, value_name = "VERSION", conflicts_with = "epoch")]
    replaces: Option<u32>,
    /// File to write [default: overwrite the package]
    #[arg(long)]
    out: Option<PathBuf>,
    /// Output format
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

/// Arguments of `weights keygen`.
#[derive(Debug, Args)]
pub(super) struct Keygen {
    /// Write the private key to OUT.key, which must not exist, and the public key to OUT.pub
    #[arg(long)]
    out: PathBuf,
    /// Output format
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

pub(super) fn execute(command: &Command) -> Result<(), CommandError> {
    match command {
        Command::Inspect(arguments) => inspect(arguments),
        Command::Verify(arguments) => verify::execute(arguments),
        Command::Diff(arguments) => diff::execute(arguments),
        Command::Evaluate(arguments) => evaluate::execute(arguments),
        Command::Renumber(arguments) => renumber::execute(arguments),
        Command::Sign(arguments) => sign(arguments),
        Command::Keygen(arguments) => keygen(arguments),
        Command::Import(arguments) => convert::import(arguments),
        Command::Export(arguments) => convert::export(arguments),
        Command::Image(arguments) => image::execute(arguments),
    }
}

fn inspect(arguments: &Inspect) -> Result<(), CommandError> {
    let bytes = PackageBytes::load(&arguments.package)?;
    let facts = Facts::new(&bytes);
    match arguments.format {
        Format::Json => print_json(&facts),
        Format::Text => print_text(&facts.text(&arguments.package)),
    }
}

fn sign(arguments: &Sign) -> Result<(), CommandError> {
    #[derive(Serialize)]
    struct Report {
        package: String,
        bytes: usize,
        epoch: u32,
        version: u32,
        key_fingerprint: String,
        /// Whether a signature made with a different key was replaced.
        replaced_signature: bool,
    }
    let mut bytes = PackageBytes::load(&arguments.package)?;
    let key = match (&arguments.key, &arguments.keys) {
        (Some(file), _) => arguments.passphrase.key(file)?,
        (None, Some(folder)) => {
            arguments.passphrase.key(&Operators::read(folder)?.signing_file())?
        }
        (None, None) => {
            return Err(CommandError::usage("no key; pass --key FILE or --keys FOLDER"));
        }
    };
    let package = &arguments.package;
    let replaced_signature =
        check_signature_before(package, &bytes, &key, arguments.replace_signature)?;
    let out = arguments.out.as_ref().unwrap_or(&arguments.package);
    if let Some(newest) = arguments.replaces {
        let replacing = bytes.replacing(newest);
        bytes = replacing.map_err(|error| package_format::unfit(error, &arguments.package))?;
    }
    if let Some(epoch) = arguments.epoch {
        let serial = Serial { epoch, ..bytes.package().serial() };
        bytes = renumber::in_epoch(&bytes, serial, None, out)?;
    }
    let signed = signed(package, &bytes, &key)?;
    signed.save(out)?;
    let report = Report {
        package: out.display().to_string(),
        bytes: signed.as_bytes().len(),
        epoch: signed.package().epoch,
        version: signed.package().version,
        key_fingerprint: fingerprint(key.public_key()),
        replaced_signature,
    };
    match arguments.format {
        Format::Json => print_json(&report),
        Format::Text => print_text(&format!(
            "Signed with key {}{}: {}, {} bytes\n",
            report.key_fingerprint,
            if replaced_signature { " in place of another" } else { "" },
            report.package,
            report.bytes
        )),
    }
}

fn keygen(arguments: &Keygen) -> Result<(), CommandError> {
    #[derive(Serialize)]
    struct Report {
        private_key: String,
        public_key: String,
        fingerprint: String,
        public_key_bytes: [u8; 32],
    }
    let KeyPair { key, private, public } = KeyPair::write(&arguments.out)?;
    let report = Report {
        private_key: private.display().to_string(),
        public_key: public.display().to_string(),
        fingerprint: fingerprint(key.public_key()),
        public_key_bytes: key.public_key_bytes(),
    };
    match arguments.format {
        Format::Json => print_json(&report),
        Format::Text => print_text(&format!(
            "Private key: {} (keep it secret and back it up)\n\
             Public key:  {} (for nodes and for `weights verify --key`)\n\
             Fingerprint: {}\n\
             For firmware (cargo xtask firmware --public-key): {}\n",
            report.private_key,
            report.public_key,
            report.fingerprint,
            report.public_key_bytes.iter().map(|byte| format!("{byte:02x}")).collect::<String>()
        )),
    }
}

/// Replaces the extension of a file name: `node1.weights` and `.slot-a.bin` give
/// `node1.slot-a.bin`.
fn renamed(path: &Path, ending: &str) -> PathBuf {
    let mut name = path.with_extension("").into_os_string();
    name.push(ending);
    PathBuf::from(name)
}
