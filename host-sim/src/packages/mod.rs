//! Weight packages on the host: creating them, and checking them exactly as a node does.
//!
//! | module | purpose |
//! | --- | --- |
//! | [`bytes`] | a package's bytes, aligned and shared, in memory and in files |
//! | [`node`] | an agent's configuration, owned |
//! | [`parameter`] | the core's parameter errors, in terms of scenario keys |
//! | `encode` | the bytes of a package |
//! | [`draft`] | the content of a package, and creating packages |
//! | [`check`] | the node's own acceptance, for any state dimension |
//! | [`facts`] | what a package contains, as text and JSON |
//! | [`recording`] | recorded samples, in memory and in files |
//! | [`refusal`] | hints for refused packages |
//! | [`summary`] | a one-line summary of a package |
//! | [`recording_source`] | the origin of a recording, noted in its file |
//!
//! Simulated agents load the same bytes as nodes. The format is agent-core's; see `docs/format.md`.

pub mod bytes;
pub mod check;
pub mod draft;
mod encode;
pub mod facts;
pub mod node;
pub mod parameter;
pub mod recording;
pub mod recording_source;
pub mod refusal;
pub mod summary;

pub use bytes::{PackageBytes, PackageFileError};
pub use draft::{Draft, DraftError};
pub use facts::Facts;
pub use node::OwnedAgentConfig;
pub use recording::{Recording, RecordingError, Timing};
pub use recording_source::RecordingSource;
pub use summary::PackageSummary;

/// Calls `$function::<N>($arguments)` for the state dimension `$n`, if it is one of those listed.
macro_rules! match_dimension {
    ([$($dimension:literal)*], $n:expr, $function:ident $arguments:tt, else $otherwise:expr) => {
        match $n {
            $($dimension => $function::<$dimension> $arguments,)*
            _ => $otherwise,
        }
    };
}
pub(crate) use match_dimension;

/// Calls `$function::<N>($arguments)` for the state dimension `$n` of a node, 1 to 12.
#[cfg(not(test))]
macro_rules! with_node_dimension {
    ($n:expr, $function:ident $arguments:tt, else $otherwise:expr) => {
        $crate::packages::match_dimension!(
            [1 2 3 4 5 6 7 8 9 10 11 12],
            $n, $function $arguments, else $otherwise
        )
    };
}

/// As above, for the states of this crate's own tests: most of the time that compiling takes is for the
/// engine, once for each dimension. The tests of the workspace run with all of them.
#[cfg(test)]
macro_rules! with_node_dimension {
    ($n:expr, $function:ident $arguments:tt, else $otherwise:expr) => {
        $crate::packages::match_dimension!(
            [1 2 3 4], $n, $function $arguments, else $otherwise
        )
    };
}
pub(crate) use with_node_dimension;

/// As [`with_node_dimension`], for up to 40.
#[cfg(feature = "wide")]
macro_rules! with_wide_dimension {
    ($n:expr, $function:ident $arguments:tt, else $otherwise:expr) => {
        $crate::packages::match_dimension!(
            [
                1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17 18 19 20
                21 22 23 24 25 26 27 28 29 30 31 32 33 34 35 36 37 38 39 40
            ],
            $n, $function $arguments, else $otherwise
        )
    };
}

// Calls a function for any state dimension that this build simulates.
#[cfg(not(feature = "wide"))]
pub(crate) use with_node_dimension as with_dimension;
#[cfg(feature = "wide")]
pub(crate) use with_wide_dimension as with_dimension;
