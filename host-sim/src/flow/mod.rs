//! Design of a flow observer: each measured direction of the state spreads outwards, from the
//! agents that measure it (its *roots*) along a tree to all others. With `xi = T x`,
//!
//! ```text
//! root:   d/dt xi_c = f_c + d_c + k_o nu_c                      nu_c = scale y - xi_c
//! others: d/dt xi_c = f_c + d_c + K_c (held_c of the parent - xi_c)
//! ```
//!
//! Everything here is computed before a run, in f64 and in a fixed order of operations:
//!
//! * [`Geometry`]: `T` and the roots, from the output matrices
//! * [`Trees`]: who listens to whom, with and without some agents
//! * [`Statistics`]: what the rules need to know of the plant, from a [`Trajectory`]
//! * [`settings`]: radii, gains and limits for a requested error, or the [`Gate`] that refuses them
//! * [`gains`]: the root's Kalman gains for a disturbance with a harmonic
//! * [`Certificate`], [`ultimate`]: the decay rate of the error for any gains, and its bound

mod certificate;
mod dense;
mod fleet;
mod forest;
mod gate;
mod geometry;
mod kalman;
mod plan;
mod rules;
mod statistics;
mod trajectory;
mod trees;
mod ultimate;

pub use certificate::Certificate;
pub use fleet::{FleetSamples, fleet_packages};
pub use gate::{BadSettings, Gate, Limits};
pub use geometry::{Geometry, NotCovered, Root};
pub use kalman::{DisturbanceGains, gains};
pub use plan::{Plan, PlanError, plant_course};
pub use rules::{DirectionSettings, Settings, Wanted, settings};
pub use statistics::{Model, Statistics};
pub use trajectory::Trajectory;
pub use trees::Trees;
pub use ultimate::{UltimateBound, ultimate};

#[cfg(test)]
mod golden_tests;
#[cfg(test)]
mod testing;
