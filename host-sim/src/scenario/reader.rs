//! TOML tables and values that know their file, line and path, so that every error can name all
//! three.
//!
//! A value is asked for an expected type, shape or range; on a mismatch it returns a complete
//! [`ScenarioError`].

use core::fmt::Display;
use core::ops::RangeInclusive;

use toml::Spanned;
use toml::de::{DeArray, DeTable, DeValue};

use super::error::{ScenarioError, closest};
use crate::number::counted;

/// File name and text; maps offsets in the text to lines.
#[derive(Debug)]
pub(super) struct Source<'a> {
    pub(super) file: &'a str,
    pub(super) text: &'a str,
}

impl Source<'_> {
    pub(super) fn line(&self, offset: usize) -> usize {
        let before = &self.text.as_bytes()[..offset.min(self.text.len())];
        before.iter().filter(|&&byte| byte == b'\n').count() + 1
    }

    pub(super) fn error(
        &self,
        line: Option<usize>,
        key: Option<String>,
        problem: impl Display,
        hint: impl Display,
    ) -> ScenarioError {
        let (problem, hint) = (problem.to_string(), hint.to_string());
        ScenarioError { file: self.file.to_owned(), line, key, problem, hint }
    }
}

/// A table.
#[derive(Clone, Debug)]
pub(super) struct Table<'a> {
    source: &'a Source<'a>,
    /// Dotted path; empty for the root table.
    path: String,
    /// Offset of its header or opening brace.
    offset: usize,
    entries: &'a DeTable<'a>,
}

/// A value, with a hint that shows a valid one.
#[derive(Clone, Debug)]
pub(super) struct Value<'a> {
    source: &'a Source<'a>,
    path: String,
    /// Such as `for example key = value`.
    hint: String,
    value: &'a Spanned<DeValue<'a>>,
}

impl<'a> Table<'a> {
    pub(super) fn root(source: &'a Source<'a>, entries: &'a DeTable<'a>) -> Self {
        Self { source, path: String::new(), offset: 0, entries }
    }

    /// Creates an error about the table as a whole.
    pub(super) fn error(&self, problem: impl Display, hint: impl Display) -> ScenarioError {
        let key = (!self.path.is_empty()).then(|| self.path.clone());
        self.source.error(Some(self.source.line(self.offset)), key, problem, hint)
    }

    /// Returns the name of the file, as the user gave it.
    pub(super) fn file(&self) -> &'a str {
        self.source.file
    }

    /// Rejects every key that is not in `known`.
    pub(super) fn only(&self, known: &[&str]) -> Result<(), ScenarioError> {
        let unknown = |key: &&Spanned<_>| !known.contains(&name(key));
        let first = self.entries.keys().filter(unknown).min_by_key(|key| key.span().start);
        let Some(key) = first else { return Ok(()) };
        let hint = match closest(name(key), known.iter().copied()) {
            Some(closest) => format!("did you mean {closest}?"),
            None => format!("valid keys: {}", known.join(", ")),
        };
        let line = self.source.line(key.span().start);
        Err(self.source.error(Some(line), Some(self.path_of(name(key))), "unknown key", hint))
    }

    /// Returns the value of `key`, if present. `example` is a valid value for the hint.
    pub(super) fn get(&self, key: &str, example: &str) -> Option<Value<'a>> {
        self.get_with_hint(key, format!("for example {key} = {example}"))
    }

    /// Returns the value of `key`, or an error if it is missing.
    pub(super) fn require(&self, key: &str, example: &str) -> Result<Value<'a>, ScenarioError> {
        self.get(key, example).ok_or_else(|| self.missing(key, format!("add {key} = {example}")))
    }

    /// Returns the table `[key]`, if present.
    pub(super) fn get_table(&self, key: &str) -> Result<Option<Table<'a>>, ScenarioError> {
        let hint = format!("write it as a table, [{}]", self.path_of(key));
        self.get_with_hint(key, hint).map(|value| value.table()).transpose()
    }

    /// Returns the table `[key]`, or an error if it is missing.
    pub(super) fn require_table(&self, key: &str) -> Result<Table<'a>, ScenarioError> {
        let missing = || self.missing(key, format!("add the [{}] table", self.path_of(key)));
        self.get_table(key)?.ok_or_else(missing)
    }

    /// Returns the tables `[[key]]`; empty if there are none.
    pub(super) fn get_tables(&self, key: &str) -> Result<Vec<Table<'a>>, ScenarioError> {
        let hint = format!("write [[{}]] tables", self.path_of(key));
        let Some(list) = self.get_with_hint(key, hint) else { return Ok(Vec::new()) };
        list.list(&list.hint)?.iter().map(Value::table).collect()
    }

    /// Returns all keys with their values, in file order.
    pub(super) fn entries(&self, example: &str) -> Vec<(&'a str, Value<'a>)> {
        let mut entries: Vec<_> = self.entries.iter().collect();
        entries.sort_by_key(|(key, _)| key.span().start);
        let value = |key: &'a Spanned<_>| self.get(name(key), example).map(|v| (name(key), v));
        entries.into_iter().filter_map(|(key, _)| value(key)).collect()
    }

    pub(super) fn missing(&self, key: &str, hint: impl Display) -> ScenarioError {
        let line = self.source.line(self.offset);
        self.source.error(Some(line), Some(self.path_of(key)), "missing", hint)
    }

    fn get_with_hint(&self, key: &str, hint: String) -> Option<Value<'a>> {
        let value = self.entries.get(key)?;
        Some(Value { source: self.source, path: self.path_of(key), hint, value })
    }

    fn path_of(&self, key: &str) -> String {
        if self.path.is_empty() { key.to_owned() } else { format!("{}.{key}", self.path) }
    }
}

/// Returns the text of a key.
fn name<S: AsRef<str>>(key: &Spanned<S>) -> &str {
    key.get_ref().as_ref()
}

impl<'a> Value<'a> {
    pub(super) fn error(&self, problem: impl Display, hint: impl Display) -> ScenarioError {
        let line = self.source.line(self.value.span().start);
        self.source.error(Some(line), Some(self.path.clone()), problem, hint)
    }

    /// Creates an error about `whole` at the line of this value, which is a part of it.
    pub(super) fn error_of(
        &self,
        whole: &Self,
        problem: impl Display,
        hint: impl Display,
    ) -> ScenarioError {
        Value { path: whole.path.clone(), ..self.clone() }.error(problem, hint)
    }

    /// Creates an error with the value's own hint.
    pub(super) fn wrong(&self, problem: impl Display) -> ScenarioError {
        self.error(problem, &self.hint)
    }

    /// Returns the same value with another hint.
    pub(super) fn with_hint(&self, hint: &str) -> Self {
        Self { hint: hint.to_owned(), ..self.clone() }
    }

    fn wrong_type(&self, expected: &str) -> ScenarioError {
        let found = match self.value.get_ref() {
            DeValue::String(_) => "a string",
            DeValue::Integer(_) => "an integer",
            DeValue::Float(_) => "a number",
            DeValue::Boolean(_) => "a boolean",
            DeValue::Datetime(_) => "a date",
            DeValue::Array(_) => "a list",
            DeValue::Table(_) => "a table",
        };
        self.wrong(format_args!("is {found}, expected {expected}"))
    }

    /// Returns a finite number that the agents' single precision can represent.
    pub(super) fn number(&self) -> Result<f64, ScenarioError> {
        if let Some(number) = plain_number(self.value.get_ref()) {
            return Ok(number);
        }
        if !matches!(self.value.get_ref(), DeValue::Integer(_) | DeValue::Float(_)) {
            return Err(self.wrong_type("a number"));
        }
        let problem = "expected a finite number in the range of single precision";
        Err(self.wrong(format_args!("is {}, {problem}", self.written())))
    }

    /// Returns a number that satisfies `holds`.
    pub(super) fn number_in(
        &self,
        expected: &str,
        holds: impl Fn(f64) -> bool,
    ) -> Result<f64, ScenarioError> {
        let number = self.number()?;
        if holds(number) {
            return Ok(number);
        }
        Err(self.wrong(format_args!("is {}, expected {expected}", self.written())))
    }

    pub(super) fn positive(&self) -> Result<f64, ScenarioError> {
        self.number_in("a number above 0", |number| number > 0.0)
    }

    pub(super) fn not_negative(&self) -> Result<f64, ScenarioError> {
        self.number_in("a number >= 0", |number| number >= 0.0)
    }

    pub(super) fn probability(&self) -> Result<f64, ScenarioError> {
        self.number_in("a probability, 0 to 1", |number| (0.0..=1.0).contains(&number))
    }

    pub(super) fn integer(&self, range: RangeInclusive<u32>) -> Result<u32, ScenarioError> {
        let DeValue::Integer(written) = self.value.get_ref() else {
            return Err(self.wrong_type("an integer"));
        };
        let integer = integer_value(written).and_then(|integer| u32::try_from(integer).ok());
        integer.filter(|integer| range.contains(integer)).ok_or_else(|| {
            let (low, high) = (*range.start(), *range.end());
            let range = match high {
                u32::MAX => format!(" >= {low}"),
                _ => format!(" from {low} to {high}"),
            };
            self.wrong(format_args!("is {written}, expected an integer{range}"))
        })
    }

    pub(super) fn boolean(&self) -> Result<bool, ScenarioError> {
        self.value.get_ref().as_bool().ok_or_else(|| self.wrong_type("a boolean"))
    }

    pub(super) fn text(&self) -> Result<&'a str, ScenarioError> {
        match self.value.get_ref() {
            DeValue::String(text) => Ok(text),
            _ => Err(self.wrong_type("a string")),
        }
    }

    /// Maps one of a few strings to its value.
    pub(super) fn choice<T: Copy>(&self, choices: &[(&str, T)]) -> Result<T, ScenarioError> {
        let text = self.text()?;
        if let Some((_, meaning)) = choices.iter().find(|(name, _)| *name == text) {
            return Ok(*meaning);
        }
        let names: Vec<_> = choices.iter().map(|(name, _)| *name).collect();
        let hint = match closest(text, names.iter().copied()) {
            Some(closest) => format!("did you mean \"{closest}\"?"),
            None => format!("use one of {}", names.join(", ")),
        };
        Err(self.error(format_args!("unknown value `{text}`"), hint))
    }

    pub(super) fn table(&self) -> Result<Table<'a>, ScenarioError> {
        let DeValue::Table(entries) = self.value.get_ref() else {
            return Err(self.wrong_type("a table"));
        };
        let offset = self.value.span().start;
        Ok(Table { source: self.source, path: self.path.clone(), offset, entries })
    }

    pub(super) fn is_list(&self) -> bool {
        self.value.get_ref().is_array()
    }

    pub(super) fn is_table(&self) -> bool {
        self.value.get_ref().is_table()
    }

    fn array(&self) -> Result<&'a DeArray<'a>, ScenarioError> {
        self.value.get_ref().as_array().ok_or_else(|| self.wrong_type("a list"))
    }

    /// Returns the entries of a list; `hint` says how to fix an invalid one.
    pub(super) fn list(&self, hint: &str) -> Result<Vec<Value<'a>>, ScenarioError> {
        let entry = |(index, value)| self.entry(index, value, hint);
        Ok(self.array()?.iter().enumerate().map(entry).collect())
    }

    /// Entry `index`, from 0; its path counts from 1.
    fn entry(&self, index: usize, value: &'a Spanned<DeValue<'a>>, hint: &str) -> Value<'a> {
        let path = format!("{}[{}]", self.path, index + 1);
        Value { source: self.source, path, hint: hint.to_owned(), value }
    }

    /// Returns a list of numbers.
    pub(super) fn numbers(&self) -> Result<Vec<f64>, ScenarioError> {
        // Build the path only for a number that is refused.
        let number = |(index, value): (usize, &'a Spanned<DeValue<'a>>)| {
            let refused = || self.entry(index, value, "write a finite number").number();
            plain_number(value.get_ref()).map_or_else(refused, Ok)
        };
        self.array()?.iter().enumerate().map(number).collect()
    }

    /// Returns `count` numbers; `owner` says where the count comes from: `numbers_of(3, "the
    /// dimension of the state")`.
    pub(super) fn numbers_of(&self, count: usize, owner: &str) -> Result<Vec<f64>, ScenarioError> {
        let found = self.array()?.len();
        if found != count {
            let problem = format!("{}, expected {count} ({owner})", has(found, "entry", "entries"));
            return Err(self.error(problem, format_args!("write {count} numbers")));
        }
        self.numbers()
    }

    /// Returns one number >= 0 for all components of a state of dimension `n`, or one for each.
    pub(super) fn not_negative_for_each(&self, n: usize) -> Result<Vec<f64>, ScenarioError> {
        let numbers =
            if self.is_list() { self.numbers_of(n, STATE)? } else { vec![self.number()?; n] };
        if numbers.iter().any(|&number| number < 0.0) {
            return Err(self.wrong("is negative"));
        }
        Ok(numbers)
    }

    /// Returns a matrix given by its rows: at least one row, each of length `columns`.
    pub(super) fn matrix(
        &self,
        columns: usize,
        owner: &str,
    ) -> Result<nalgebra::DMatrix<f64>, ScenarioError> {
        let rows = self.list("write each row as a list of numbers")?;
        if rows.is_empty() {
            return Err(self.wrong("has no rows"));
        }
        let mut entries = Vec::with_capacity(rows.len() * columns);
        for (index, row) in rows.iter().enumerate() {
            let found = row.array()?.len();
            if found != columns {
                let found = has(found, "entry", "entries");
                let problem = format!("row {} {found}, expected {columns} ({owner})", index + 1);
                let hint = format_args!(
                    "write {} in every row",
                    counted(columns as u64, "entry", "entries")
                );
                return Err(row.error_of(self, problem, hint));
            }
            entries.extend(row.numbers()?);
        }
        Ok(nalgebra::DMatrix::from_row_slice(rows.len(), columns, &entries))
    }

    /// Returns the number as written in the file.
    pub(super) fn written(&self) -> String {
        self.source.text.get(self.value.span()).unwrap_or_default().to_owned()
    }
}

/// Where the length of a state vector comes from, for [`Value::numbers_of`] and [`Value::matrix`].
pub(super) const STATE: &str = "the dimension of the state";

/// `has 1 entry`, `has 2 entries`.
pub(super) fn has(count: usize, one: &str, many: &str) -> String {
    format!("has {}", counted(count as u64, one, many))
}

/// Returns the number if an agent can represent it.
fn plain_number(value: &DeValue<'_>) -> Option<f64> {
    let number = match value {
        DeValue::Integer(integer) => integer_value(integer)? as f64,
        DeValue::Float(float) => float.as_str().parse().ok()?,
        _ => return None,
    };
    (number.abs() <= f64::from(f32::MAX)).then_some(number)
}

fn integer_value(integer: &toml::de::DeInteger<'_>) -> Option<i64> {
    i64::from_str_radix(integer.as_str(), integer.radix()).ok()
}
