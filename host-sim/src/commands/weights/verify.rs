//! `weights verify`: runs all of a node's checks on a package, with the node's own code.

use std::path::PathBuf;

use agent_core::AgentId;
use agent_core::package::{Capacity, Requirements, StepRange};
use clap::Args;
use serde::Serialize;

use crate::commands::{CommandError, Format, print_json, print_outcome, print_text};
use crate::memory_map::MemoryMap;
use crate::packages::check::{check, requirements};
use crate::packages::{PackageBytes, PackageFileError};
use crate::signing::{fingerprint, read_public_key};

/// Arguments of `weights verify`.
#[derive(Debug, Args)]
pub(in crate::commands) struct Arguments {
    /// Weight package
    package: PathBuf,
    /// Public key of the node, which the package's signature must match
    #[arg(long)]
    key: Option<PathBuf>,
    /// Package in use on the node: the new one must be for the same agent and newer
    #[arg(long)]
    in_use: Option<PathBuf>,
    /// Memory map of the board: the package must fit into a slot
    #[arg(long)]
    memory: Option<PathBuf>,
    #[command(flatten)]
    capacity: Sizes,
    /// Output format
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

/// Capacity of the node's firmware; unlimited by default.
#[derive(Debug, Args)]
struct Sizes {
    /// Maximum number of features (nodes of the last inner layer) supported by the firmware
    #[arg(long)]
    features: Option<usize>,
    /// Maximum number of neighbours supported by the firmware
    #[arg(long)]
    neighbours: Option<usize>,
    /// Maximum number of outer gain entries supported by the firmware
    #[arg(long)]
    gain_entries: Option<usize>,
    /// Shortest step that the board can keep [s]
    #[arg(long, default_value_t = StepRange::DEFAULT.min, value_parser = step)]
    step_min: f32,
    /// Longest step that the board can keep [s]
    #[arg(long, default_value_t = StepRange::DEFAULT.max, value_parser = step)]
    step_max: f32,
}

/// Parses a step. \[s\]
fn step(text: &str) -> Result<f32, String> {
    let number = text.parse().ok().filter(|step: &f32| *step > 0.0 && step.is_finite());
    number.ok_or_else(|| "expected a number above 0".to_owned())
}

impl Sizes {
    fn step_range(&self) -> StepRange {
        StepRange { min: self.step_min, max: self.step_max }
    }

    fn capacity(&self) -> Capacity {
        let or_any = |size: Option<usize>| size.unwrap_or(usize::MAX);
        Capacity {
            features: or_any(self.features),
            neighbours: or_any(self.neighbours),
            gain_entries: or_any(self.gain_entries),
            // Nodes have none yet.
            known_inputs: 0,
        }
    }
}

#[derive(Serialize)]
struct Report {
    package: String,
    accepted: bool,
    refusal: Option<String>,
    agent: Option<AgentId>,
    epoch: Option<u32>,
    version: Option<u32>,
    signed: Option<bool>,
    /// Whether the signature was checked against a key (`--key`).
    signature_checked: bool,
    key_fingerprint: Option<String>,
    test_vectors: Option<usize>,
}

pub(super) fn execute(arguments: &Arguments) -> Result<(), CommandError> {
    let report = match examine(arguments)? {
        Ok(report) => report,
        Err(error) if arguments.format == Format::Json => {
            let report = Report {
                package: arguments.package.display().to_string(),
                accepted: false,
                refusal: Some(error.to_string()),
                agent: None,
                epoch: None,
                version: None,
                signed: None,
                signature_checked: arguments.key.is_some(),
                key_fingerprint: None,
                test_vectors: None,
            };
            return print_outcome(&report, Err(error));
        }
        Err(error) => return Err(error),
    };
    match arguments.format {
        Format::Json => print_json(&report),
        Format::Text => print_text(&text(arguments, &report)),
    }
}

/// Checks the package. The inner error is the node's refusal; the outer error means that a file
/// cannot be read.
fn examine(arguments: &Arguments) -> Result<Result<Report, CommandError>, CommandError> {
    let key = arguments.key.as_deref().map(read_public_key).transpose()?;
    let in_use = arguments.in_use.as_deref().map(PackageBytes::load).transpose()?;
    let slot_length = match &arguments.memory {
        Some(memory) => Some(MemoryMap::read(memory)?.weights()?.slot_length),
        None => None,
    };
    let bytes = match PackageBytes::load(&arguments.package) {
        Ok(bytes) => bytes,
        Err(error @ PackageFileError::Package { .. }) => return Ok(Err(error.into())),
        Err(error) => return Err(error.into()),
    };
    let requirements = Requirements {
        capacity: arguments.capacity.capacity(),
        step_range: arguments.capacity.step_range(),
        ..requirements(key.as_slice(), in_use.as_ref())
    };
    let package = match check(&bytes, &requirements) {
        Ok(package) => package,
        Err(refusal) => return Ok(Err(CommandError::refused(&arguments.package, &refusal))),
    };
    let length = bytes.as_bytes().len();
    if let Some(slot) = slot_length.filter(|&slot| length as u64 > u64::from(slot)) {
        return Ok(Err(CommandError::unfit(
            &arguments.package,
            &format!("the package has {length} bytes, but a slot has {slot}"),
            "train a smaller network, or give the node larger slots in memory.x",
        )));
    }
    Ok(Ok(Report {
        package: arguments.package.display().to_string(),
        accepted: true,
        refusal: None,
        agent: Some(package.node.agent),
        epoch: Some(package.epoch),
        version: Some(package.version),
        signed: Some(bytes.is_signed()),
        signature_checked: key.is_some(),
        key_fingerprint: key.as_ref().map(fingerprint),
        test_vectors: Some(package.test_vectors().count()),
    }))
}

fn text(arguments: &Arguments, report: &Report) -> String {
    let mut text = match (report.signature_checked, report.signed) {
        (false, Some(true)) => format!(
            "{}: a node would accept it if the signature is valid, which was NOT checked\n",
            report.package
        ),
        (false, _) => {
            format!("{}: a node without a public key would accept it\n", report.package)
        }
        (true, _) => format!("{}: a node with this key would accept it\n", report.package),
    };
    let mut passed = |what: &str| text += &format!("  ok   {what}\n");
    passed("header, length and checksum");
    if let Some(fingerprint) = &report.key_fingerprint {
        passed(&format!("signature by key {fingerprint}"));
    }
    passed("architecture, sizes and numbers");
    passed("parameters in range, K1 symmetric with a positive diagonal");
    if arguments.in_use.is_some() {
        passed("same agent, newer than the package in use");
    }
    if arguments.memory.is_some() {
        passed("fits into a slot");
    }
    if let Some(count) = report.test_vectors {
        passed(&format!("{count} test vectors, bit for bit"));
    }
    if report.key_fingerprint.is_none() {
        text += match report.signed {
            Some(true) => "  --   signature not checked: give the node's public key with --key\n",
            _ => "  --   not signed: nodes with a public key refuse it\n",
        };
    }
    text
}
