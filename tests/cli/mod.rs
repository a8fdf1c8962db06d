//! The command line: what it reads, writes, prints and refuses.

mod baselines;
mod borders;
mod check;
pub(crate) mod command_line;
mod design;
mod documentation;
mod endings;
mod files;
mod flash;
mod fleet;
pub(crate) mod image;
mod json_documented;
pub(crate) mod memory_map;
#[cfg(unix)]
pub(crate) mod node_commands;
mod report;
mod signatures_and_versions;
mod sweep;
mod weights_commands;
