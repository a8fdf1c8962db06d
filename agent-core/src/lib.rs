//! One agent.
#![no_std]
#![forbid(unsafe_code)]

pub mod activation;
pub mod network;
