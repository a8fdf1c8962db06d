//! Changes of individual keys in the text of a scenario: `design.epsilon=500`.
//!
//! A change replaces or adds one value before the text is read, so the loader checks the result as a
//! whole and the scenario's hash covers it. Comments stay, and so does every line that is not changed.
//!
//! A key is a dotted path. Entries of lists count from 1: `agents.2.sensor.noise` for the second
//! `[[agents]]`, `plant.initial_state.1` for a number in a list. Tables on the way are created. A
//! value is TOML; what is not TOML is taken as a string, so `observer.preset=field` needs no quotes.
//!
//! `design.gain.scale` and `outer_law.gain.scale` also work on a plain gain, which then becomes
//! `{ values = ..., scale = ... }`; `plant.initial_state.random` replaces a given state, and
//! `observer.preset=paper` all keys of `[observer]`, which are those of another observer.

use core::fmt;

use toml_edit::{Array, DocumentMut, InlineTable, Item, Key, Table, TableLike, Value};

use super::error::ScenarioError;
use crate::number::counted;

/// Plain values that become a table when one of its keys is set, with the key for the old value, if
/// it is kept.
const EXPANDED: [(&str, &str, Option<&str>); 3] = [
    ("design.gain", "scale", Some("values")),
    ("outer_law.gain", "scale", Some("values")),
    ("plant.initial_state", "random", None),
];

/// A new value for one key of a scenario.
#[derive(Clone, Debug)]
pub struct Change {
    /// Where it comes from, such as `--set`.
    origin: &'static str,
    key: String,
    path: Vec<String>,
    value: Value,
}

impl Change {
    /// Creates a change of `key`, with a value in TOML or a string without quotes. `origin` is named in
    /// errors.
    ///
    /// # Errors
    /// If `key` is not a dotted path, or the value is empty.
    pub fn new(origin: &'static str, key: &str, value: &str) -> Result<Self, ChangeError> {
        let (key, value) = (key.trim(), value.trim());
        let parts = Key::parse(key).map_err(|_| ChangeError::Key)?;
        if value.is_empty() {
            return Err(ChangeError::Empty);
        }
        let path = parts.iter().map(|part| part.get().to_owned()).collect();
        Ok(Self { origin, key: key.to_owned(), path, value: parsed(value) })
    }

    /// Creates a change from `KEY=VALUE`.
    ///
    /// # Errors
    /// Same as [`Change::new`], and if there is no `=`.
    pub fn parse(origin: &'static str, text: &str) -> Result<Self, ChangeError> {
        let (key, value) = text.split_once('=').ok_or(ChangeError::NoValue)?;
        Self::new(origin, key, value)
    }

    /// Returns the key as it was written.
    #[must_use]
    pub fn key(&self) -> &str {
        &self.key
    }

    /// Returns the value as tables show it: a string without quotes, anything else as TOML.
    #[must_use]
    pub fn shown(&self) -> String {
        match &self.value {
            Value::String(text) => text.value().clone(),
            other => other.to_string().trim().to_owned(),
        }
    }

    /// Returns `KEY=VALUE`, as [`Change::parse`] reads it.
    #[must_use]
    pub fn argument(&self) -> String {
        let shown = self.shown();
        let is_same = match (&self.value, parsed(&shown)) {
            (Value::String(own), Value::String(read)) => own.value() == read.value(),
            (Value::String(_), _) => false,
            _ => true,
        };
        let is_same = is_same && shown.trim() == shown && !shown.is_empty();
        let value = if is_same { shown } else { self.value.to_string().trim().to_owned() };
        format!("{}={value}", self.key)
    }

    /// Whether both set the same key.
    #[must_use]
    pub fn is_about_same_key(&self, other: &Self) -> bool {
        self.path == other.path
    }

    fn is_preset(&self) -> bool {
        self.path == ["observer", "preset"]
    }

    /// Whether it selects the paper's observer, which has none of the other keys of `[observer]`.
    fn is_papers_preset(&self) -> bool {
        self.is_preset() && self.value.as_str() == Some("paper")
    }

    /// Whether the key of an error, such as `agents[2].sensor`, is the changed key, contains it, or is
    /// inside it.
    fn concerns(&self, key: &str) -> bool {
        let normal = |part: &str| part.trim_end_matches(']').to_owned();
        let key: Vec<String> = key.split(['.', '[']).map(normal).collect();
        key.iter().zip(&self.path).all(|(one, other)| one == other)
    }
}

impl fmt::Display for Change {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}={}", self.origin, self.key, self.shown())
    }
}

/// Why a text is not a change.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ChangeError {
    /// There is no `=`.
    #[error("has no value; write KEY=VALUE, such as design.epsilon=500")]
    NoValue,
    /// There is nothing after `=`.
    #[error(
        "has an empty value; write KEY=VALUE, such as design.epsilon=500, or KEY='\"\"' for an empty string"
    )]
    Empty,
    /// The key is not a dotted path.
    #[error("invalid key; write a dotted path such as design.epsilon or agents.2.sensor.noise")]
    Key,
}

/// Reads TOML, a number as other programs write it (`.5`), or else a string.
fn parsed(text: &str) -> Value {
    if let Ok(value) = text.parse::<Value>() {
        return value;
    }
    let is_number = text.starts_with(|c: char| c.is_ascii_digit() || matches!(c, '.' | '+' | '-'));
    match text.parse::<f64>() {
        Ok(number) if is_number && number.is_finite() => number.into(),
        _ => text.into(),
    }
}

/// Applies changes, in order, to the text of a scenario; `None` if the text is not TOML. `file` is the
/// name used in errors.
pub(super) fn applied(
    file: &str,
    text: &str,
    changes: &[Change],
) -> Option<Result<String, ScenarioError>> {
    let mut document: DocumentMut = text.parse().ok()?;
    let preset = changes.iter().rev().find(|change| change.is_preset());
    let is_paper = preset.is_some_and(Change::is_papers_preset);
    for change in changes {
        let refused = |(problem, hint): Refusal| ScenarioError {
            file: file.to_owned(),
            line: None,
            key: Some(change.to_string()),
            problem,
            hint,
        };
        if is_paper && change.path[0] == "observer" && change.path.len() > 1 && !change.is_preset()
        {
            let problem = "has no effect with observer.preset=paper".to_owned();
            return Some(Err(refused((problem, "leave one of them out".to_owned()))));
        }
        if change.is_preset() && !preset.is_some_and(|last| std::ptr::eq(last, change)) {
            continue; // Another one follows.
        }
        let place = Place { change, depth: 0 };
        if let Err(refusal) = place.in_table(document.as_table_mut(), false) {
            return Some(Err(refused(refusal)));
        }
    }
    Some(Ok(document.to_string()))
}

/// Completes an error found in the changed text: names the changes that may have caused it, and drops
/// the line number if the user's file has no such line.
pub(super) fn blamed(
    mut error: ScenarioError,
    changes: &[Change],
    lines_moved: bool,
) -> ScenarioError {
    let concerned = |change: &&Change| error.key.as_ref().is_some_and(|key| change.concerns(key));
    let named: Vec<&Change> = match changes.iter().rev().find(concerned) {
        Some(change) => vec![change],
        None => changes.iter().collect(),
    };
    // The changed key is not in the file, or not with this value.
    if lines_moved || changes.iter().any(|change| concerned(&change)) {
        error.line = None;
    }
    let named: Vec<String> = named.into_iter().map(Change::to_string).collect();
    let named = named.join(", ");
    error.key = Some(match error.key {
        Some(key) => format!("{named}: {key}"),
        None => named,
    });
    error
}

/// Problem and hint.
type Refusal = (String, String);

/// A part of the path of a change: `change.path[depth]` is looked up next.
#[derive(Clone, Copy)]
struct Place<'c> {
    change: &'c Change,
    depth: usize,
}

impl Place<'_> {
    fn part(&self) -> &str {
        &self.change.path[self.depth]
    }

    fn is_last(&self) -> bool {
        self.depth + 1 == self.change.path.len()
    }

    fn next(self) -> Self {
        Self { depth: self.depth + 1, ..self }
    }

    /// Returns the path up to here.
    fn above(&self) -> String {
        self.change.path[..self.depth].join(".")
    }

    fn in_table(self, table: &mut dyn TableLike, is_inline: bool) -> Result<(), Refusal> {
        let part = self.part();
        if self.is_last() && self.change.is_papers_preset() {
            table.clear();
        }
        match table.get_mut(part) {
            Some(item) if self.is_last() => replace(item, &self.change.value),
            Some(item) => self.next().in_item(item)?,
            None if self.is_last() => {
                table.insert(part, Item::Value(self.change.value.clone()));
            }
            None if is_inline => {
                let mut inner = InlineTable::new();
                self.next().in_table(&mut inner, true)?;
                table.insert(part, Item::Value(inner.into()));
            }
            None => {
                let mut inner = Table::new();
                self.next().in_table(&mut inner, false)?;
                table.insert(part, Item::Table(inner));
            }
        }
        Ok(())
    }

    fn in_item(self, item: &mut Item) -> Result<(), Refusal> {
        match item {
            Item::Table(table) => self.in_table(table, false),
            Item::Value(value) => self.in_value(value),
            Item::ArrayOfTables(tables) => {
                let count = tables.len();
                let table = self.index(count).and_then(|index| tables.get_mut(index));
                let table = table.ok_or_else(|| self.no_entry(count))?;
                if self.is_last() {
                    let hint = format!("set one of its keys, such as {}.key", self.change.key);
                    return Err(("this is a table".to_owned(), hint));
                }
                self.next().in_table(table, false)
            }
            Item::None => {
                *item = Item::Table(Table::new());
                self.in_item(item)
            }
        }
    }

    fn in_value(self, value: &mut Value) -> Result<(), Refusal> {
        match value {
            Value::InlineTable(table) => self.in_table(table, true),
            _ if self.expands().is_some() => {
                let mut table = InlineTable::new();
                if let Some(Some(kept)) = self.expands() {
                    let mut old = value.clone();
                    old.decor_mut().clear();
                    table.insert(kept, old);
                }
                table.insert(self.part(), self.change.value.clone());
                let decor = value.decor().clone();
                *value = table.into();
                *value.decor_mut() = decor;
                Ok(())
            }
            Value::Array(array) => self.in_array(array),
            other => {
                let problem = format!("{} is {}, not a table", self.above(), kind(other));
                Err((problem, format!("set {} itself", self.above())))
            }
        }
    }

    fn in_array(self, array: &mut Array) -> Result<(), Refusal> {
        let count = array.len();
        let entry = self.index(count).and_then(|index| array.get_mut(index));
        let entry = entry.ok_or_else(|| self.no_entry(count))?;
        if !self.is_last() {
            return self.next().in_value(entry);
        }
        let decor = entry.decor().clone();
        *entry = self.change.value.clone();
        *entry.decor_mut() = decor;
        Ok(())
    }

    /// Returns the index, from 0, that this part is the number of.
    fn index(&self, count: usize) -> Option<usize> {
        let number: usize = self.part().parse().ok()?;
        number.checked_sub(1).filter(|&index| index < count)
    }

    fn no_entry(&self, count: usize) -> Refusal {
        let above = self.above();
        let entries = counted(count as u64, "entry", "entries");
        let problem =
            format!("{above} is a list with {entries}, and {:?} is not one of them", self.part());
        let hint = match count {
            0 => format!("set {above} itself"),
            _ => format!("write the number of an entry, {above}.1 to {above}.{count}"),
        };
        (problem, hint)
    }

    /// Returns how a plain value here becomes a table, if it does.
    fn expands(&self) -> Option<Option<&'static str>> {
        let above = self.above();
        let found = EXPANDED
            .iter()
            .find(|(key, part, _)| self.is_last() && *key == above && *part == self.part());
        found.map(|&(_, _, kept)| kept)
    }
}

/// Replaces a value; blanks and the comment after it stay.
pub(super) fn replace(item: &mut Item, value: &Value) {
    let mut value = value.clone();
    if let Some(old) = item.as_value() {
        *value.decor_mut() = old.decor().clone();
    }
    *item = Item::Value(value);
}

fn kind(value: &Value) -> &'static str {
    match value {
        Value::String(_) => "a string",
        Value::Integer(_) | Value::Float(_) => "a number",
        Value::Boolean(_) => "a boolean",
        Value::Datetime(_) => "a date",
        Value::Array(_) => "a list",
        Value::InlineTable(_) => "a table",
    }
}

#[cfg(test)]
mod tests;
