//! A node's report on its board: faults, and errors of its sensor and link.

use agent_core::Tick;
use agent_core::health::BoardErrors;
use agent_core::service::{BoardFault, Event, Status};
use serde::Serialize;

use super::health;
use crate::service::Message;

/// Messages about the board received with a status.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct BoardReport {
    faults: Vec<BoardFault>,
    /// Error counts and their tick; `None` without errors, or if the node does not report them.
    errors: Option<(Tick, BoardErrors)>,
}

/// A node's status and board report, for JSON.
#[derive(Serialize)]
pub(super) struct StatusReport<'a> {
    #[serde(flatten)]
    status: &'a Status,
    board_faults: &'a [BoardFault],
    board_errors: BoardErrors,
}

impl StatusReport<'_> {
    /// Returns the status.
    pub(super) fn status(&self) -> &Status {
        self.status
    }
}

impl BoardReport {
    /// Records a message if it is about the board.
    pub(super) fn record(&mut self, message: &Message<'_>) {
        match message {
            // A repeated request is answered twice.
            Message::Event(Event::BoardFault(fault)) if !self.faults.contains(fault) => {
                self.faults.push(*fault);
            }
            Message::BoardErrors { tick, counters } => self.errors = Some((*tick, *counters)),
            _ => {}
        }
    }

    /// Returns messages with the same contents.
    pub(super) fn messages(&self) -> impl Iterator<Item = Message<'static>> {
        let fault = |fault: &BoardFault| Message::Event(Event::BoardFault(*fault));
        let errors = |(tick, counters)| Message::BoardErrors { tick, counters };
        self.faults.iter().map(fault).chain(self.errors.map(errors))
    }

    /// Adds the report to `status`.
    pub(super) fn with<'a>(&'a self, status: &'a Status) -> StatusReport<'a> {
        let board_errors = self.errors.map_or_else(BoardErrors::default, |(_, errors)| errors);
        StatusReport { status, board_faults: &self.faults, board_errors }
    }

    /// Returns lines to append to a status; empty without faults or errors.
    pub(super) fn text(&self) -> String {
        let faults = self.faults.iter().map(|fault| format!("  {}", fault_line(*fault)));
        let errors = self.errors.iter().map(|(_, errors)| format!("  {}", errors_line(errors)));
        faults.chain(errors).collect()
    }
}

/// Formats a fault as a line.
pub(super) fn fault_line(fault: BoardFault) -> String {
    let text = match fault {
        BoardFault::Clock => {
            "the crystal or the PLL did not start; the chip runs from its internal oscillator, which \
             limits the accuracy of sampling periods"
        }
    };
    format!("board fault: {text}\n")
}

/// Formats error counts as a line.
pub(super) fn errors_line(errors: &BoardErrors) -> String {
    format!("board errors: {}\n", health::board_line(errors))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_latest_counts_apply_and_a_fault_is_reported_once() {
        let mut report = BoardReport::default();
        assert_eq!(report.text(), "");
        let fault = Message::Event(Event::BoardFault(BoardFault::Clock));
        for count in [2, 3] {
            let counters = BoardErrors { sensor_bus: count, ..BoardErrors::default() };
            report.record(&fault);
            report.record(&Message::BoardErrors { tick: 7, counters });
        }
        report.record(&Message::Done);
        let counters = BoardErrors { sensor_bus: 3, ..BoardErrors::default() };
        let told: Vec<_> = report.messages().collect();
        assert_eq!(told, [fault, Message::BoardErrors { tick: 7, counters }]);
        let text = report.text();
        assert!(text.starts_with("  board fault: the crystal or the PLL"), "{text}");
        assert!(text.ends_with("  board errors: samples lost on the sensor's bus: 3\n"), "{text}");
    }
}
