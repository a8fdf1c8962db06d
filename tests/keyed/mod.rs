//! Nodes with keys: whom they believe, and what they do for whom.

#[cfg(unix)]
mod commands;
mod flood_fixture;
#[cfg(unix)]
mod image;
mod neighbours;
mod operators;
mod port;
pub(crate) mod test_node;
