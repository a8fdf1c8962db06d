//! Nodes with keys: whom they believe, and what they do for whom.

#[cfg(unix)]
mod commands;
mod neighbours;
mod port;
pub(crate) mod test_node;
