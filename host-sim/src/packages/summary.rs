//! A one-line summary of a package.

use std::fmt;

use agent_core::AgentId;
use serde::Serialize;

use super::PackageBytes;

/// Identifies a package in reports.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct PackageSummary {
    /// Length of the package, signature included. \[bytes\]
    pub bytes: usize,
    /// The agent that it is for, from 1.
    pub agent: AgentId,
    /// Its epoch.
    pub epoch: u32,
    /// Its version.
    pub version: u32,
}

impl PackageSummary {
    /// Summarises a package.
    #[must_use]
    pub fn new(package: &PackageBytes) -> Self {
        let bytes = package.as_bytes().len();
        let package = package.package();
        Self { bytes, agent: package.node.agent, epoch: package.epoch, version: package.version }
    }
}

impl fmt::Display for PackageSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "agent {}, ", self.agent)?;
        if self.epoch > 0 {
            write!(f, "package epoch {}, ", self.epoch)?;
        }
        write!(f, "version {}, {} bytes", self.version, self.bytes)
    }
}
