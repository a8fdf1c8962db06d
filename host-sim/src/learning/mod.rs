//! From scenarios and recorded samples to weight packages.
//!
//! | module | purpose |
//! | --- | --- |
//! | [`agent_config`] | an agent's configuration, from a scenario |
//! | [`cleaning`] | recorded samples prepared for training |
//! | [`judgement`] | warnings about samples and trained networks |
//! | [`quality`] | how well a trained network fits the samples |
//! | [`trained`] | the whole way: from recorded samples to a package |
//!
//! A learning cycle of the simulator and the command `train` both go this way.

pub mod agent_config;
pub mod cleaning;
pub mod judgement;
pub mod quality;
pub mod trained;

pub use agent_config::agent_config;
