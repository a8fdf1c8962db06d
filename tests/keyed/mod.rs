//! Nodes with keys: whom they believe, and what they do for whom.

mod neighbours;
mod port;
pub(crate) mod test_node;
