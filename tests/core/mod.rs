//! agent-core against its oracle, its laws, and what it refuses.

mod against_oracle;
pub(crate) mod bits;
pub(crate) mod health;
pub(crate) mod oracle;
mod properties;
pub(crate) mod random_network;
mod refusals;
pub(crate) mod watched_ring;
