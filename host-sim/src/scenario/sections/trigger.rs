//! `[trigger]`.

use std::num::NonZeroU32;

use agent_core::observer::trigger::Trigger;

use crate::scenario::error::ScenarioError;
use crate::scenario::reader::Table;

/// When agents broadcast.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum TriggerModel {
    /// The paper's event trigger, with constants from `[design]`.
    #[default]
    Event,
    /// At this period, in steps.
    Periodic {
        /// Steps between broadcasts.
        every: NonZeroU32,
    },
}

impl TriggerModel {
    /// Returns the trigger that simulated agents use instead of the event trigger of their packages;
    /// `None` for the event trigger.
    #[must_use]
    pub fn simulated(self) -> Option<Trigger> {
        match self {
            Self::Event => None,
            Self::Periodic { every } => Some(Trigger::Periodic(every)),
        }
    }

    /// Says when agents broadcast instead of the event trigger's condition; `None` for the event
    /// trigger. The paper's theorems assume the event trigger.
    #[must_use]
    pub fn departure(self) -> Option<String> {
        match self {
            Self::Event => None,
            Self::Periodic { every } => Some(match every.get() {
                1 => "in every step".to_owned(),
                every => format!("every {every} steps"),
            }),
        }
    }
}

/// Reads the keys of one trigger from the table.
type Read = fn(&Table<'_>) -> Result<TriggerModel, ScenarioError>;

/// The triggers by their names.
const KINDS: [(&str, Read); 2] = [("event", event), ("periodic", periodic)];

pub(in crate::scenario) fn trigger(root: &Table<'_>) -> Result<TriggerModel, ScenarioError> {
    let Some(table) = root.get_table("trigger")? else { return Ok(TriggerModel::default()) };
    let read: Read = table.require("kind", "\"event\"")?.choice(&KINDS)?;
    read(&table)
}

fn event(table: &Table<'_>) -> Result<TriggerModel, ScenarioError> {
    table.only(&["kind"])?;
    Ok(TriggerModel::Event)
}

fn periodic(table: &Table<'_>) -> Result<TriggerModel, ScenarioError> {
    table.only(&["kind", "every"])?;
    let value = table.require("every", "10")?;
    let every = NonZeroU32::new(value.integer(1..=u32::MAX)?);
    let every = every.ok_or_else(|| value.wrong("is 0, expected an integer >= 1"))?;
    Ok(TriggerModel::Periodic { every })
}
