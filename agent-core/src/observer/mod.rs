//! The equations of the observer, one file each: network (`Phi func`), feedback (`Observer i`),
//! adaptation (`What_i Dot`) with its projection, and trigger (`Trigger`).
//!
//! Depends on [`math`](crate::math) and, for announcements, [`wire`](crate::wire). Every function is pure or changes only the state passed
//! to it.

pub mod features;
pub mod feedback;
#[cfg(feature = "field")]
pub mod field;
pub mod outer_law;
pub mod projection;
pub mod trigger;

pub use inner_network::network;
