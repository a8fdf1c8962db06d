//! Every test that needs more than one module or crate, in one binary; a folder for each subject.

mod attacks;
mod cli;
mod core;
#[cfg(unix)]
mod cosim;
mod keyed;
mod sim;
#[cfg(unix)]
mod soak;
mod store;
mod trial;
