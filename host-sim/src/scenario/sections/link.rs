//! `[link]`.

use crate::scenario::error::ScenarioError;
use crate::scenario::reader::Table;

/// What happens to frames between agents.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum LinkModel {
    /// Every broadcast reaches all neighbours at once and unharmed, as in the paper.
    #[default]
    Lossless,
}

/// Reads the keys of one model from the table.
type Read = fn(&Table<'_>) -> Result<LinkModel, ScenarioError>;

/// The models by their names.
const KINDS: [(&str, Read); 1] = [("lossless", lossless)];

pub(in crate::scenario) fn link(root: &Table<'_>) -> Result<LinkModel, ScenarioError> {
    let Some(table) = root.get_table("link")? else { return Ok(LinkModel::default()) };
    let read: Read = table.require("kind", "\"lossless\"")?.choice(&KINDS)?;
    read(&table)
}

fn lossless(table: &Table<'_>) -> Result<LinkModel, ScenarioError> {
    table.only(&["kind"])?;
    Ok(LinkModel::Lossless)
}
