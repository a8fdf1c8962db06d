//! Arithmetic that gives the same bits on every target: ordered sums, activations, symmetric
//! matrices, and the ranges of parameters.
//!
//! Knows nothing of the rest of the crate.

pub mod activation;
pub mod numeric;
pub mod parameter;
pub mod symmetric;
