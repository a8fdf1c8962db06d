//! What goes wrong around the agent: counted by kind, and reported in moderation.
//!
//! Memory: 64 bytes.

use agent_core::Tick;
use agent_core::health::BoardErrors;

use super::count;
use crate::board::{LinkErrorKind, SensorErrorKind};

/// What a node counts that its agent's health does not know of.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Counts {
    pub(super) messages_damaged: u32,
    pub(super) measurements_missing: u32,
    pub(super) broadcasts_lost: u32,
    pub(super) errors: BoardErrors,
    /// Whether an error has occurred since the last report.
    is_changed: bool,
    last_report: Option<Tick>,
}

impl Counts {
    /// Counts a missing sample.
    #[cold]
    #[inline(never)]
    pub(super) fn sensor(&mut self, kind: SensorErrorKind) {
        count(&mut self.measurements_missing);
        let errors = &mut self.errors;
        count(match kind {
            SensorErrorKind::NoAnswer => &mut errors.sensor_no_answer,
            SensorErrorKind::Bus => &mut errors.sensor_bus,
            SensorErrorKind::NotReady => &mut errors.sensor_not_ready,
            SensorErrorKind::OutOfRange => &mut errors.sensor_out_of_range,
            SensorErrorKind::Other => &mut errors.sensor_other,
        });
        self.is_changed = true;
    }

    /// Counts a frame that could not be sent.
    pub(super) fn not_sent(&mut self, kind: LinkErrorKind) {
        count(&mut self.broadcasts_lost);
        self.link(kind);
    }

    /// Counts an error of the link.
    #[cold]
    #[inline(never)]
    pub(super) fn link(&mut self, kind: LinkErrorKind) {
        let errors = &mut self.errors;
        count(match kind {
            LinkErrorKind::NotSent => &mut errors.link_not_sent,
            LinkErrorKind::Damaged => &mut errors.link_damaged,
            LinkErrorKind::Overflow => &mut errors.link_overflow,
            LinkErrorKind::Receiver => &mut errors.link_receiver,
        });
        self.is_changed = true;
    }

    /// The errors, if they are to be reported at `tick`: there are new ones, and the last report is at
    /// least `interval` ticks old.
    #[inline]
    pub(super) fn due(&mut self, tick: Tick, interval: u32) -> Option<BoardErrors> {
        let early =
            self.last_report.is_some_and(|last| tick.saturating_sub(last) < Tick::from(interval));
        if early || !self.is_changed {
            return None;
        }
        (self.is_changed, self.last_report) = (false, Some(tick));
        Some(self.errors)
    }
}
