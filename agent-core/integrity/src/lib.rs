//! What handles every byte of frames and messages: a checksum, a keyed hash and a cipher.
//!
//! A crate of its own, so that firmware compiles it at an optimisation level of its own, at which these loops are
//! fast, and no path that panics remains in the cipher.
#![no_std]

mod checksum;
#[cfg(feature = "seals")]
mod seals;

pub use checksum::Checksum;
#[cfg(feature = "seals")]
pub use seals::{LENGTH, decrypt, encrypt, hash};
