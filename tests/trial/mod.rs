//! Trials of packages that look valid: harmful ones are refused or go back by themselves, and good
//! ones stay.

mod bench;
pub(crate) mod mutants;
mod verdicts;

pub(crate) use verdicts::harmful_packages;
