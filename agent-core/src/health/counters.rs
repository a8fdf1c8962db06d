//! How often what happened.

use serde::{Deserialize, Serialize};

/// Counts since the node began; each stays at `u32::MAX` once it is there.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct HealthCounters {
    /// Steps that led to an estimate outside the box of trained inputs.
    pub outside_box: u32,
    /// Steps that led to an estimate outside the plausible region, and so outside the box.
    pub implausible: u32,
    /// Steps with the network after which the projection acts on the outer weights.
    pub projection_active: u32,
    /// Steps that were refused because a result would not have been finite.
    pub diverged: u32,
    /// Steps that were refused because a measurement was not finite.
    pub measurements_not_finite: u32,
    /// Steps that were refused for any other reason.
    pub steps_refused: u32,
    /// Ticks between two attempts at a step.
    pub skipped_ticks: u32,
    /// Broadcasts that came sooner after the last one than Theorem 2 allows.
    pub early_broadcasts: u32,
    /// Frames that were refused because their estimate was not finite.
    pub frames_not_finite: u32,
    /// Frames that were refused because their estimate was outside the plausible region.
    pub frames_implausible: u32,
    /// Frames that were refused for any other reason.
    pub frames_refused: u32,
    /// Frames that a step dropped because the receiver already held something as new.
    pub frames_stale: u32,
    /// How often the inner network was left out.
    pub fall_backs: u32,
    /// How often it was used again.
    pub returns: u32,
    /// How often the agent began anew.
    pub restarts: u32,
}
