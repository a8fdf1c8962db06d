//! How often what happened.

use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// Counts since the node began; each stays at `u32::MAX` once it is there.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
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

/// How many there are.
const COUNTERS: usize = 15;

impl HealthCounters {
    /// All of them, in their order.
    #[inline]
    #[must_use]
    pub fn to_array(&self) -> [u32; COUNTERS] {
        [
            self.outside_box,
            self.implausible,
            self.projection_active,
            self.diverged,
            self.measurements_not_finite,
            self.steps_refused,
            self.skipped_ticks,
            self.early_broadcasts,
            self.frames_not_finite,
            self.frames_implausible,
            self.frames_refused,
            self.frames_stale,
            self.fall_backs,
            self.returns,
            self.restarts,
        ]
    }

    /// Whether any counter differs. In a node's every turn, where `==` on fields or arrays would call
    /// a `memcmp` that takes byte by byte: 5 instructions a byte, not 5 a counter.
    #[inline]
    pub(super) fn differ_from(&self, other: &Self) -> bool {
        let pairs = self.to_array().into_iter().zip(other.to_array());
        pairs.fold(0, |difference, (one, other)| difference | one ^ other) != 0
    }

    /// The counters with these values, in their order.
    #[must_use]
    pub fn from_array(values: [u32; COUNTERS]) -> Self {
        let [
            outside_box,
            implausible,
            projection_active,
            diverged,
            measurements_not_finite,
            steps_refused,
            skipped_ticks,
            early_broadcasts,
            frames_not_finite,
            frames_implausible,
            frames_refused,
            frames_stale,
            fall_backs,
            returns,
            restarts,
        ] = values;
        Self {
            outside_box,
            implausible,
            projection_active,
            diverged,
            measurements_not_finite,
            steps_refused,
            skipped_ticks,
            early_broadcasts,
            frames_not_finite,
            frames_implausible,
            frames_refused,
            frames_stale,
            fall_backs,
            returns,
            restarts,
        }
    }
}

// By way of the array: a loop takes a fifth of the code that one field after another does.
impl Serialize for HealthCounters {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        self.to_array().serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for HealthCounters {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        <[u32; COUNTERS]>::deserialize(deserializer).map(Self::from_array)
    }
}
