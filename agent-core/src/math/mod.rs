//! Arithmetic that gives the same bits on every target: ordered sums, activations, symmetric
//! matrices, and range checks.
//!
//! Depends on no other module of the crate.

#[cfg(feature = "field")]
pub mod half;
pub mod numeric;
pub mod parameter;
pub mod symmetric;

pub use inner_network::activation;
