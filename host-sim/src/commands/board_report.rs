//! What a node tells about its board: what does not work there, and what its sensor and its link have
//! reported.

use agent_core::Tick;
use agent_core::health::BoardErrors;
use agent_core::service::{BoardFault, Event, Status};
use serde::Serialize;

use super::health;
use crate::service::Message;

/// What has been heard since a status was asked for.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct BoardReport {
    faults: Vec<BoardFault>,
    /// When, and what has failed; `None` if nothing has, or the node does not tell.
    errors: Option<(Tick, BoardErrors)>,
}

/// A node's status with what it tells about its board, for programs.
#[derive(Serialize)]
pub(super) struct StatusReport<'a> {
    #[serde(flatten)]
    status: &'a Status,
    board_faults: &'a [BoardFault],
    board_errors: BoardErrors,
}

impl BoardReport {
    /// Takes notice of a message, if it is about the board.
    pub(super) fn hear(&mut self, message: &Message<'_>) {
        match message {
            // A request that was repeated is answered twice.
            Message::Event(Event::BoardFault(fault)) if !self.faults.contains(fault) => {
                self.faults.push(*fault);
            }
            Message::BoardErrors { tick, counters } => self.errors = Some((*tick, *counters)),
            _ => {}
        }
    }

    /// The messages that say the same.
    pub(super) fn messages(&self) -> impl Iterator<Item = Message<'static>> {
        let fault = |fault: &BoardFault| Message::Event(Event::BoardFault(*fault));
        let errors = |(tick, counters)| Message::BoardErrors { tick, counters };
        self.faults.iter().map(fault).chain(self.errors.map(errors))
    }

    /// Together with `status`.
    pub(super) fn with<'a>(&'a self, status: &'a Status) -> StatusReport<'a> {
        let board_errors = self.errors.map_or_else(BoardErrors::default, |(_, errors)| errors);
        StatusReport { status, board_faults: &self.faults, board_errors }
    }

    /// Lines to follow those of a status; none if all is well.
    pub(super) fn text(&self) -> String {
        let faults = self.faults.iter().map(|fault| format!("  {}", fault_line(*fault)));
        let errors = self.errors.iter().map(|(_, errors)| format!("  {}", errors_line(errors)));
        faults.chain(errors).collect()
    }
}

/// What does not work, as a line.
pub(super) fn fault_line(fault: BoardFault) -> String {
    let text = match fault {
        BoardFault::Clock => {
            "the crystal or the PLL did not start; the chip runs from its internal oscillator, and \
             sampling periods are only as accurate as that"
        }
    };
    format!("board fault: {text}\n")
}

/// What has failed, as a line.
pub(super) fn errors_line(errors: &BoardErrors) -> String {
    format!("board errors: {}\n", health::board_line(errors))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_last_counts_count_and_a_fault_is_told_once() {
        let mut report = BoardReport::default();
        assert_eq!(report.text(), "");
        let fault = Message::Event(Event::BoardFault(BoardFault::Clock));
        for count in [2, 3] {
            let counters = BoardErrors { sensor_bus: count, ..BoardErrors::default() };
            report.hear(&fault);
            report.hear(&Message::BoardErrors { tick: 7, counters });
        }
        report.hear(&Message::Done);
        let counters = BoardErrors { sensor_bus: 3, ..BoardErrors::default() };
        let told: Vec<_> = report.messages().collect();
        assert_eq!(told, [fault, Message::BoardErrors { tick: 7, counters }]);
        let text = report.text();
        assert!(text.starts_with("  board fault: the crystal or the PLL"), "{text}");
        assert!(text.ends_with("  board errors: samples lost on the sensor's bus: 3\n"), "{text}");
    }
}
