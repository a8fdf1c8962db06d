//! Counters of run-time faults.
//!
//! The table below is the only list of the counters: it defines their order in messages and their
//! keys in JSON. Add new counters at the end, and change
//! [`PROTOCOL_VERSION`](crate::service::PROTOCOL_VERSION).

use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// Generates the struct, its array conversions and [`HealthCounters::TABLE`] from one list.
macro_rules! counters {
    ($($(#[doc = $doc:literal])+ $name:ident: $text:literal,)+) => {
        /// Counts since the node started; each saturates at `u32::MAX`.
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
        pub struct HealthCounters {
            $($(#[doc = $doc])+ pub $name: u32,)+
        }

        /// Number of counters.
        const COUNTERS: usize = [$(stringify!($name)),+].len();

        impl HealthCounters {
            /// Name and short description of each counter, in order.
            pub const TABLE: [(&'static str, &'static str); COUNTERS] =
                [$((stringify!($name), $text)),+];

            /// Returns the counters in order.
            #[inline]
            #[must_use]
            pub fn to_array(&self) -> [u32; COUNTERS] {
                [$(self.$name),+]
            }

            /// Creates the counters from their values in order.
            #[must_use]
            pub fn from_array(values: [u32; COUNTERS]) -> Self {
                let [$($name),+] = values;
                Self { $($name),+ }
            }
        }
    };
}

counters! {
    /// Steps whose estimate was outside the box of trained inputs.
    outside_box: "steps outside the trained box",
    /// Steps whose estimate was outside the plausible region, and therefore outside the box.
    implausible: "of these implausible",
    /// Steps with the network after which the projection acted on the outer weights.
    projection_active: "steps with an active projection",
    /// Steps refused because a result would not have been finite.
    diverged: "steps that would have overflowed",
    /// Steps refused because a measurement was not finite.
    measurements_not_finite: "measurements not finite",
    /// Steps refused for any other reason.
    steps_refused: "steps refused for other reasons",
    /// Ticks between two attempted steps.
    skipped_ticks: "ticks skipped",
    /// Broadcasts sooner after the previous one than Theorem 2 allows.
    early_broadcasts: "broadcasts sooner than Theorem 2 allows",
    /// Frames refused because their estimate was not finite.
    frames_not_finite: "frames not finite",
    /// Frames refused because their estimate was outside the plausible region.
    frames_implausible: "implausible frames",
    /// Frames refused for any other reason.
    frames_refused: "frames refused for other reasons",
    /// Frames dropped by a step because the held sample was at least as new.
    frames_stale: "frames out of date",
    /// Number of fallbacks to running without the inner network.
    fall_backs: "fallbacks to feedback alone",
    /// Number of returns to the inner network.
    returns: "returns to the network",
    /// Number of restarts of the agent.
    restarts: "restarts",
}

impl HealthCounters {
    /// Returns whether any counter differs. Called in every turn of a node, where `==` on fields or
    /// arrays would call a bytewise `memcmp`: 5 instructions per byte instead of 5 per counter.
    #[inline]
    pub(super) fn differ_from(&self, other: &Self) -> bool {
        let pairs = self.to_array().into_iter().zip(other.to_array());
        pairs.fold(0, |difference, (one, other)| difference | one ^ other) != 0
    }
}

// Via the array: a loop takes a fifth of the code that serialising field by field does.
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
