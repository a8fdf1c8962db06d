//! How often what happened.
//!
//! The table below is the one place that lists the counters: their order is that of the messages,
//! their names are the keys in JSON. A new one goes to the end, and changes
//! [`PROTOCOL_VERSION`](crate::service::PROTOCOL_VERSION).

use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// Makes the struct, its arrays, and [`HealthCounters::TABLE`] of one list.
macro_rules! counters {
    ($($(#[doc = $doc:literal])+ $name:ident: $text:literal,)+) => {
        /// Counts since the node began; each stays at `u32::MAX` once it is there.
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
        pub struct HealthCounters {
            $($(#[doc = $doc])+ pub $name: u32,)+
        }

        /// How many there are.
        const COUNTERS: usize = [$(stringify!($name)),+].len();

        impl HealthCounters {
            /// The name of each, and what it counts in a few words, in their order.
            pub const TABLE: [(&'static str, &'static str); COUNTERS] =
                [$((stringify!($name), $text)),+];

            /// All of them, in their order.
            #[inline]
            #[must_use]
            pub fn to_array(&self) -> [u32; COUNTERS] {
                [$(self.$name),+]
            }

            /// The counters with these values, in their order.
            #[must_use]
            pub fn from_array(values: [u32; COUNTERS]) -> Self {
                let [$($name),+] = values;
                Self { $($name),+ }
            }
        }
    };
}

counters! {
    /// Steps that led to an estimate outside the box of trained inputs.
    outside_box: "steps outside the trained box",
    /// Steps that led to an estimate outside the plausible region, and so outside the box.
    implausible: "of them implausible",
    /// Steps with the network after which the projection acts on the outer weights.
    projection_active: "steps with an active projection",
    /// Steps that were refused because a result would not have been finite.
    diverged: "steps that would have overflowed",
    /// Steps that were refused because a measurement was not finite.
    measurements_not_finite: "measurements not finite",
    /// Steps that were refused for any other reason.
    steps_refused: "steps refused for other reasons",
    /// Ticks between two attempts at a step.
    skipped_ticks: "ticks skipped",
    /// Broadcasts that came sooner after the last one than Theorem 2 allows.
    early_broadcasts: "broadcasts sooner than Theorem 2 allows",
    /// Frames that were refused because their estimate was not finite.
    frames_not_finite: "frames not finite",
    /// Frames that were refused because their estimate was outside the plausible region.
    frames_implausible: "implausible frames",
    /// Frames that were refused for any other reason.
    frames_refused: "frames refused for other reasons",
    /// Frames that a step dropped because the receiver already held something as new.
    frames_stale: "frames out of date",
    /// How often the inner network was left out.
    fall_backs: "times the network was left out",
    /// How often it was used again.
    returns: "times it was used again",
    /// How often the agent began anew.
    restarts: "times begun anew",
}

impl HealthCounters {
    /// Whether any counter differs. In a node's every turn, where `==` on fields or arrays would call
    /// a `memcmp` that takes byte by byte: 5 instructions a byte, not 5 a counter.
    #[inline]
    pub(super) fn differ_from(&self, other: &Self) -> bool {
        let pairs = self.to_array().into_iter().zip(other.to_array());
        pairs.fold(0, |difference, (one, other)| difference | one ^ other) != 0
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
