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

/// Calls `$function::<N>($arguments)` for the state dimension `$n`, 1 to 12.
macro_rules! with_dimension {
    ($n:expr, $function:ident($($argument:expr),* $(,)?), else $otherwise:expr) => {
        match $n {
            1 => $function::<1>($($argument),*),
            2 => $function::<2>($($argument),*),
            3 => $function::<3>($($argument),*),
            4 => $function::<4>($($argument),*),
            5 => $function::<5>($($argument),*),
            6 => $function::<6>($($argument),*),
            7 => $function::<7>($($argument),*),
            8 => $function::<8>($($argument),*),
            9 => $function::<9>($($argument),*),
            10 => $function::<10>($($argument),*),
            11 => $function::<11>($($argument),*),
            12 => $function::<12>($($argument),*),
            _ => $otherwise,
        }
    };
}
pub(crate) use with_dimension;
