//! Creates weight packages from scenarios and recorded samples.
//!
//! | module | purpose |
//! | --- | --- |
//! | [`mod@agent_config`] | an agent's configuration, from a scenario |
//! | [`cleaning`] | recorded samples prepared for training |
//! | [`judgement`] | warnings about samples and trained networks |
//! | [`harmonic`] | the harmonic in what a network leaves of the samples |
//! | [`promise`] | what a package promises for its trial |
//! | [`quality`] | how well a trained network fits the samples |
//! | [`trained`] | training a package from recorded samples |
//!
//! Shared by the simulator's learning cycles and the command `train`.

pub mod agent_config;
pub mod cleaning;
pub mod harmonic;
pub mod judgement;
pub mod promise;
pub mod quality;
pub mod trained;

pub use agent_config::agent_config;
