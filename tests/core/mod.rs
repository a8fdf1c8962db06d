//! Compares agent-core with its oracle, and checks its properties and refusals.

mod against_oracle;
pub(crate) mod bits;
mod field_oracle;
pub(crate) mod health;
pub(crate) mod oracle;
mod properties;
pub(crate) mod random_network;
mod refusals;
mod study_oracle;
pub(crate) mod watched_ring;
