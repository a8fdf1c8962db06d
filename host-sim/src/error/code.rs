//! The codes of errors, with the exit code that goes with each.

use serde::{Serialize, Serializer};

/// Declares the codes, each with its name in JSON and the exit code that goes with it.
macro_rules! error_codes {
    ($($(#[doc = $doc:literal])* $variant:ident = $name:literal, $exit:literal;)*) => {
        /// The kind of an error. The names are stable; `docs/errors.md` explains each.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        #[non_exhaustive]
        pub enum ErrorCode {
            $($(#[doc = $doc])* $variant,)*
        }

        impl ErrorCode {
            /// Every code.
            pub const ALL: &'static [Self] = &[$(Self::$variant,)*];

            /// Returns the code as it appears in JSON.
            #[must_use]
            pub fn as_str(self) -> &'static str {
                match self {
                    $(Self::$variant => $name,)*
                }
            }

            /// Returns the exit code of a command that fails with it.
            #[must_use]
            pub fn exit(self) -> u8 {
                match self {
                    $(Self::$variant => $exit,)*
                }
            }
        }
    };
}

error_codes! {
    /// The command line is wrong.
    Usage = "usage", 2;
    /// A scenario cannot be read.
    Scenario = "invalid-scenario", 2;
    /// A file is not a valid package.
    Package = "invalid-package", 2;
    /// A node would refuse the package, or has refused it.
    PackageRefused = "package-refused", 2;
    /// A network cannot be packed.
    Network = "invalid-network", 2;
    /// Samples cannot be read.
    Samples = "invalid-samples", 2;
    /// A folder or table of results cannot be read.
    Results = "invalid-results", 2;
    /// A key cannot be read, or is not the node's.
    Key = "invalid-key", 2;
    /// A memory map cannot be read.
    MemoryMap = "invalid-memory-map", 2;
    /// A frame is invalid, or its receiver refuses it.
    Frame = "invalid-frame", 2;
    /// A package does not fit into flash, or into the requested format.
    Image = "invalid-image", 2;
    /// The output path holds something that must not be replaced.
    OutputRefused = "output-refused", 2;
    /// A file cannot be written.
    OutputFailed = "output-failed", 1;
    /// Another command is writing into the same folder.
    FolderInUse = "folder-in-use", 1;
    /// Standard output cannot be written.
    StandardOutput = "stdout-failed", 1;
    /// The system has no random numbers.
    Random = "no-randomness", 1;
    /// Threads cannot be started.
    Threads = "no-threads", 1;
    /// The simulation cannot continue.
    Run = "run-failed", 1;
    /// An expression of the plant or the disturbance is not defined where it was evaluated.
    Expression = "expression-undefined", 1;
    /// The estimates grow without bound, or would in a run.
    Unstable = "unstable", 1;
    /// No gain, or no radius, gives what was requested.
    NoDesign = "no-design", 1;
    /// The plant's state grew without bound.
    Diverged = "plant-diverged", 1;
    /// A network cannot be trained.
    Training = "training-failed", 1;
    /// A trained network explains no more than a constant, so no package was written.
    NotPacked = "not-packed", 1;
    /// A figure cannot be drawn.
    Figure = "figure-failed", 1;
    /// probe-rs is not installed.
    ProbeRs = "probe-rs-missing", 1;
    /// The chip was not flashed, or reads back differently.
    Flash = "flash-failed", 1;
    /// The firmware for emulated nodes cannot be built or found.
    Firmware = "firmware-failed", 1;
    /// A node's steps differ from the simulation.
    Mismatches = "mismatches", 1;
    /// A node cannot continue.
    Node = "node-failed", 1;
    /// A node refuses a request.
    NodeRefused = "node-refused", 2;
    /// Another push to the node is in progress.
    AnotherPush = "another-push", 1;
    /// A node cannot be reached or does not answer.
    Unreachable = "node-unreachable", 1;
    /// A signal interrupted the command.
    Interrupted = "interrupted", 1;
}

impl Serialize for ErrorCode {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.as_str())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_documented_codes_are_complete_and_correct() {
        let text = include_str!("../../../docs/errors.md");
        let row = |line: &str| {
            let mut cells = line.strip_prefix("| `")?.split('|');
            let code = cells.next()?.trim().trim_end_matches('`').to_owned();
            Some((code, cells.next()?.trim().parse().ok()?))
        };
        let listed: Vec<(String, u8)> = text.lines().filter_map(row).collect();
        let codes: Vec<_> =
            ErrorCode::ALL.iter().map(|code| (code.as_str().to_owned(), code.exit())).collect();
        assert_eq!(listed, codes);
        let mut names: Vec<_> = codes.into_iter().map(|(code, _)| code).collect();
        names.sort();
        names.dedup();
        assert_eq!(names.len(), ErrorCode::ALL.len(), "duplicate code");
    }
}
