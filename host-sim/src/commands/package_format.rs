//! The option `--package-format` of the commands that write packages.

use std::path::Path;

use agent_core::package::{EncodeError, Format};
use clap::Args;

use super::CommandError;
use crate::packages::PackageBytes;
use crate::terminal;
use crate::warning::{Warning, WarningCode};

/// The format to write.
#[derive(Clone, Copy, Debug, Args)]
pub(super) struct PackageFormat {
    /// Format of the packages to write: 2, or 1 for nodes whose firmware reads nothing else
    #[arg(long, value_name = "FORMAT", default_value = "2", value_parser = parse)]
    package_format: Format,
}

impl PackageFormat {
    /// Returns the package in this format. Prints a warning if it loses the limits of its trial.
    ///
    /// # Errors
    /// If format 1 cannot hold the package, which is to be written to `out`.
    pub(super) fn apply(
        self,
        package: &PackageBytes,
        out: &Path,
    ) -> Result<PackageBytes, CommandError> {
        convert(package, self.package_format, out)
    }
}

/// Returns the package in another format; see [`PackageFormat::apply`].
///
/// # Errors
/// If format 1 cannot hold the package, which is to be written to `out`.
pub(super) fn convert(
    package: &PackageBytes,
    format: Format,
    out: &Path,
) -> Result<PackageBytes, CommandError> {
    let converted = package.converted(format).map_err(|error| unfit(error, out))?;
    if format == Format::One && package.package().trial.is_some() {
        terminal::warning(Warning::new(
            WarningCode::TrialLimitsDropped,
            format!(
                "{}: format 1 has no limits for the trial, so a node uses only those of its settings; \
                 write format 2 unless the node's firmware is older",
                out.display()
            ),
        ));
    }
    Ok(converted)
}

/// Returns the error of a package that a format cannot hold.
pub(super) fn unfit(error: EncodeError, about: &Path) -> CommandError {
    CommandError::usage(format!("{}: {error}", about.display())).about(about)
}

/// Parses a format.
pub(super) fn parse(text: &str) -> Result<Format, String> {
    match text {
        "1" => Ok(Format::One),
        "2" => Ok(Format::Two),
        _ => Err("expected 1 or 2".to_owned()),
    }
}
