//! Epoch and version of a package.

use serde::{Deserialize, Serialize};

/// Epoch and version of a package, ordered by epoch, then by version.
///
/// ```
/// use agent_core::package::Serial;
///
/// let newest = Serial { epoch: 0, version: 9 };
/// assert!(Serial { epoch: 1, version: 4 } > newest);
/// assert!(Serial { epoch: 0, version: 8 } < newest);
/// ```
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
)]
pub struct Serial {
    /// Increased to go back to an older version; 0 in packages of format 1.
    pub epoch: u32,
    /// Increases with every package of the same epoch.
    pub version: u32,
}

impl core::fmt::Display for Serial {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(f, "version {} of package epoch {}", self.version, self.epoch)
    }
}

impl Serial {
    /// Returns the first serial after all versions up to `newest` of epoch 0.
    pub(super) const fn after_exception(newest: u32) -> Self {
        match newest.checked_add(1) {
            Some(version) => Self { epoch: 0, version },
            None => Self { epoch: 1, version: 0 },
        }
    }
}
