//! `weights renumber`: gives a package a new version.

use std::path::{Path, PathBuf};

use agent_core::package::{self, Serial};
use clap::Args;
use serde::Serialize;

use crate::commands::package_format::{self, convert, unfit};
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
    /// New package epoch: nodes accept any version of a higher one, so this is the way back to an older
    /// network [default: that of the package]
    #[arg(long)]
    epoch: Option<u32>,
    /// Format of the package to write, 1 or 2 [default: that of the package, but 2 if it needs an
    /// epoch]
    #[arg(long, value_name = "FORMAT", value_parser = package_format::parse)]
    package_format: Option<package::Format>,
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
    let out = arguments.out.as_ref().unwrap_or(&arguments.package);
    let serial = Serial {
        epoch: arguments.epoch.unwrap_or(before.package().epoch),
        version: arguments.version,
    };
    let package = in_epoch(&before, serial, arguments.package_format, out)?;
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
            let PackageSummary { bytes, agent, epoch, version } = report.summary;
            let epoch = if epoch > 0 { format!("package epoch {epoch}, ") } else { String::new() };
            let mut text = format!(
                "Written to {}: agent {agent}, {epoch}version {version} (was {}), {bytes} bytes, not \
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

/// Returns the package with this epoch and version, unsigned, in this format or its own. A package of
/// format 1 that gets an epoch becomes one of format 2, unless the format was chosen.
///
/// # Errors
/// If the format cannot hold the package, which is to be written to `out`.
pub(super) fn in_epoch(
    package: &PackageBytes,
    serial: Serial,
    format: Option<package::Format>,
    out: &Path,
) -> Result<PackageBytes, CommandError> {
    let needed = if serial.epoch > 0 { package::Format::Two } else { package.format() };
    let format = format.unwrap_or(needed);
    let converted =
        if format > package.format() { convert(package, format, out)? } else { package.clone() };
    let moved = converted.with_serial(serial).map_err(|error| unfit(error, out))?;
    convert(&moved, format, out)
}
