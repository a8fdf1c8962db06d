//! Counters of run-time faults.
//!
//! The tables below are the one place that lists the counters: their order is that of the messages,
//! their names are the keys in JSON. A new one goes to the end, and changes
//! [`PROTOCOL_VERSION`](crate::service::PROTOCOL_VERSION).

use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// Makes a struct of counters, their number, their arrays, and the table of their names of one list.
macro_rules! counters {
    (
        $(#[doc = $about:literal])+
        $counters:ident, $count:ident:
        $($(#[doc = $doc:literal])+ $name:ident: $text:literal,)+
    ) => {
        $(#[doc = $about])+
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
        pub struct $counters {
            $($(#[doc = $doc])+ pub $name: u32,)+
        }

        /// How many there are.
        const $count: usize = [$(stringify!($name)),+].len();

        impl $counters {
            /// The name of each, and what it counts in a few words, in their order.
            pub const TABLE: [(&'static str, &'static str); $count] =
                [$((stringify!($name), $text)),+];

            /// Returns the counters in order.
            #[inline]
            #[must_use]
            pub fn to_array(&self) -> [u32; $count] {
                [$(self.$name),+]
            }

            /// Returns the names of the counters that have reached `u32::MAX`, and therefore no longer
            /// count.
            pub fn saturated(&self) -> impl Iterator<Item = &'static str> {
                Self::TABLE
                    .into_iter()
                    .zip(self.to_array())
                    .filter(|(_, count)| *count == u32::MAX)
                    .map(|((name, _), _)| name)
            }

            /// Creates the counters from their values in order.
            #[must_use]
            pub fn from_array(values: [u32; $count]) -> Self {
                let [$($name),+] = values;
                Self { $($name),+ }
            }
        }

        // On the wire via the array, because a loop takes a fifth of the code that serialising field
        // by field does; for people and programs with a name each.
        impl Serialize for $counters {
            fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                let counts = self.to_array();
                if serializer.is_human_readable() {
                    let named = Self::TABLE.into_iter().zip(counts);
                    return serializer.collect_map(named.map(|((name, _), count)| (name, count)));
                }
                counts.serialize(serializer)
            }
        }

        impl<'de> Deserialize<'de> for $counters {
            fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
                <[u32; $count]>::deserialize(deserializer).map(Self::from_array)
            }
        }
    };
}

counters! {
    /// Counts since the node began; each stays at `u32::MAX` once it is there.
    HealthCounters, COUNTERS:
    /// Steps that led to an estimate outside the box of trained inputs.
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
    steps_refused: "steps refused for their tick or measurement",
    /// Ticks between two attempted steps.
    skipped_ticks: "ticks skipped",
    /// Broadcasts sooner after the previous one than Theorem 2 allows.
    early_broadcasts: "broadcasts sooner than Theorem 2 allows",
    /// Frames refused because their estimate was not finite.
    frames_not_finite: "frames not finite",
    /// Frames refused because their estimate was outside the plausible region.
    frames_implausible: "implausible frames",
    /// Frames refused for any other reason.
    frames_refused: "frames damaged, repeated or from strangers",
    /// Frames dropped by a step because the held sample was at least as new.
    frames_stale: "frames out of date",
    /// Number of fallbacks to running without the inner network.
    fall_backs: "fallbacks to feedback alone",
    /// Number of returns to the inner network.
    returns: "returns to the network",
    /// Number of restarts of the agent.
    restarts: "restarts",
}

counters! {
    /// How often a node's sensor and link have failed since the node began, by kind; each stays at
    /// `u32::MAX` once it is there. docs/service.md says what to do about each.
    BoardErrors, BOARD_ERRORS:
    /// Samples without an acknowledgement from the sensor.
    sensor_no_answer: "samples without an answer from the sensor",
    /// Samples that were lost on the sensor's bus.
    sensor_bus: "samples lost on the sensor's bus",
    /// Samples that the sensor did not have yet.
    sensor_not_ready: "samples that were not ready",
    /// Samples outside the sensor's range.
    sensor_out_of_range: "samples out of range",
    /// Samples that are missing for any other reason.
    sensor_other: "samples missing for other reasons",
    /// Frames that could not be handed over for sending.
    link_not_sent: "frames not sent",
    /// Frames that arrived damaged.
    link_damaged: "frames that arrived damaged",
    /// Frames that arrived and for which there was no room.
    link_overflow: "frames dropped because the receive buffer was full",
    /// Failures of the link's receiver.
    link_receiver: "failures of the link's receiver",
}

impl BoardErrors {
    /// Whether nothing has failed.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.to_array().iter().fold(0, |any, count| any | count) == 0
    }
}
