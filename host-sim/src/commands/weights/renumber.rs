//! `weights renumber`: gives a package a new version.

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;

use crate::commands::{CommandError, Format, print_json, print_text};
use crate::packages::{PackageBytes, PackageSummary};
use crate::shell::shell_word;

/// Arguments of `weights renumber`.
#[derive(Debug, Args)]
pub(in crate::commands) struct Arguments {
    /// Weight package
    package: PathBuf,
    /// New version; nodes accept it if it is above that of the package in use
    #[arg(long, visible_alias = "package-version")]
    version: u32,
    /// File to write [default: overwrite the package]
    #[arg(long)]
    out: Option<PathBuf>,
    /// Output format
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

#[derive(Serialize)]
struct Report {
    package: String,
    #[serde(flatten)]
    summary: PackageSummary,
    version_before: u32,
    /// Whether the package had a signature, which is valid only for the old version.
    signature_dropped: bool,
}

pub(super) fn execute(arguments: &Arguments) -> Result<(), CommandError> {
    let before = PackageBytes::load(&arguments.package)?;
    let package = before.renumbered(arguments.version);
    let out = arguments.out.as_ref().unwrap_or(&arguments.package);
    package.save(out)?;
    let report = Report {
        package: out.display().to_string(),
        summary: PackageSummary::new(&package),
        version_before: before.package().version,
        signature_dropped: before.is_signed(),
    };
    match arguments.format {
        Format::Json => print_json(&report),
        Format::Text => {
            let PackageSummary { bytes, agent, version } = report.summary;
            let mut text = format!(
                "Written to {}: agent {agent}, version {version} (was {}), {bytes} bytes, not \
                 signed\n",
                report.package, report.version_before
            );
            if report.signature_dropped {
                text += &format!(
                    "Its signature was for version {}. Sign it again: host-sim weights sign {} --key KEY\n",
                    report.version_before,
                    shell_word(out)
                );
            }
            print_text(&text)
        }
    }
}
