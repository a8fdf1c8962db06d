//! TOML tables and values that know their file, line and path, so that whatever is wrong with
//! one can be said in full.
//!
//! A value is asked for what it should be; a value of another type, shape or range answers
//! with a finished [`ScenarioError`].

use core::fmt::Display;
use core::ops::RangeInclusive;

use toml::Spanned;
use toml::de::{DeArray, DeTable, DeValue};

use super::error::{ScenarioError, closest};

/// File name and text; turns places in the text into lines.
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
    /// Empty for the file itself.
    path: String,
    /// Where its head or opening brace stands.
    offset: usize,
    entries: &'a DeTable<'a>,
}

/// A value, and what could stand in its place.
#[derive(Clone, Debug)]
pub(super) struct Value<'a> {
    source: &'a Source<'a>,
    path: String,
    /// `write key = example`.
    hint: String,
    value: &'a Spanned<DeValue<'a>>,
}

impl<'a> Table<'a> {
    pub(super) fn root(source: &'a Source<'a>, entries: &'a DeTable<'a>) -> Self {
        Self { source, path: String::new(), offset: 0, entries }
    }

    /// An error about this table as a whole.
    pub(super) fn error(&self, problem: impl Display, hint: impl Display) -> ScenarioError {
        let key = (!self.path.is_empty()).then(|| self.path.clone());
        self.source.error(Some(self.source.line(self.offset)), key, problem, hint)
    }

    /// Refuses every key that is not one of `known`.
    pub(super) fn only(&self, known: &[&str]) -> Result<(), ScenarioError> {
        let stranger = |key: &&Spanned<_>| !known.contains(&name(key));
        let first = self.entries.keys().filter(stranger).min_by_key(|key| key.span().start);
        let Some(key) = first else { return Ok(()) };
        let hint = match closest(name(key), known.iter().copied()) {
            Some(closest) => format!("write {closest}"),
            None => format!("the keys that can stand here are {}", known.join(", ")),
        };
        let line = self.source.line(key.span().start);
        Err(self.source.error(Some(line), Some(self.path_of(name(key))), "unknown key", hint))
    }

    /// The value of `key`, if there is one. `example` is what could stand after `key =`.
    pub(super) fn get(&self, key: &str, example: &str) -> Option<Value<'a>> {
        self.get_with_mend(key, format!("write {key} = {example}"))
    }

    /// The value of `key`.
    pub(super) fn require(&self, key: &str, example: &str) -> Result<Value<'a>, ScenarioError> {
        self.get(key, example).ok_or_else(|| self.missing(key, format!("write {key} = {example}")))
    }

    /// The table `[key]`, if there is one.
    pub(super) fn get_table(&self, key: &str) -> Result<Option<Table<'a>>, ScenarioError> {
        let hint = format!("write a table [{}]", self.path_of(key));
        self.get_with_mend(key, hint).map(|value| value.table()).transpose()
    }

    /// The table `[key]`.
    pub(super) fn require_table(&self, key: &str) -> Result<Table<'a>, ScenarioError> {
        let missing = || self.missing(key, format!("write a table [{}]", self.path_of(key)));
        self.get_table(key)?.ok_or_else(missing)
    }

    /// The tables `[[key]]`; empty if there are none.
    pub(super) fn get_tables(&self, key: &str) -> Result<Vec<Table<'a>>, ScenarioError> {
        let hint = format!("write tables [[{}]]", self.path_of(key));
        let Some(list) = self.get_with_mend(key, hint) else { return Ok(Vec::new()) };
        list.list(&list.hint)?.iter().map(Value::table).collect()
    }

    /// All keys with their values, in the order of the file.
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

    fn get_with_mend(&self, key: &str, hint: String) -> Option<Value<'a>> {
        let value = self.entries.get(key)?;
        Some(Value { source: self.source, path: self.path_of(key), hint, value })
    }

    fn path_of(&self, key: &str) -> String {
        if self.path.is_empty() { key.to_owned() } else { format!("{}.{key}", self.path) }
    }
}

/// The text of a key.
fn name<S: AsRef<str>>(key: &Spanned<S>) -> &str {
    key.get_ref().as_ref()
}

impl<'a> Value<'a> {
    pub(super) fn error(&self, problem: impl Display, hint: impl Display) -> ScenarioError {
        let line = self.source.line(self.value.span().start);
        self.source.error(Some(line), Some(self.path.clone()), problem, hint)
    }

    /// An error of `whole`, of which this is the part where the problem lies.
    pub(super) fn error_of(
        &self,
        whole: &Self,
        problem: impl Display,
        hint: impl Display,
    ) -> ScenarioError {
        Value { path: whole.path.clone(), ..self.clone() }.error(problem, hint)
    }

    /// `problem`, with the key's example as hint.
    pub(super) fn wrong(&self, problem: impl Display) -> ScenarioError {
        self.error(problem, &self.hint)
    }

    /// The same value with another hint.
    pub(super) fn with_mend(&self, hint: &str) -> Self {
        Self { hint: hint.to_owned(), ..self.clone() }
    }

    fn wrong_type(&self, expected: &str) -> ScenarioError {
        let found = match self.value.get_ref() {
            DeValue::String(_) => "a text",
            DeValue::Integer(_) => "an integer",
            DeValue::Float(_) => "a number",
            DeValue::Boolean(_) => "true or false",
            DeValue::Datetime(_) => "a date",
            DeValue::Array(_) => "a list",
            DeValue::Table(_) => "a table",
        };
        self.wrong(format_args!("is {found}, expected {expected}"))
    }

    /// A finite number, small enough for the agents' single precision.
    pub(super) fn number(&self) -> Result<f64, ScenarioError> {
        if let Some(number) = plain_number(self.value.get_ref()) {
            return Ok(number);
        }
        if !matches!(self.value.get_ref(), DeValue::Integer(_) | DeValue::Float(_)) {
            return Err(self.wrong_type("a number"));
        }
        let problem = "expected a finite number that fits into single precision";
        Err(self.wrong(format_args!("is {}, {problem}", self.written())))
    }

    /// A number for which `holds`.
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
        self.number_in("a number, 0 or above", |number| number >= 0.0)
    }

    pub(super) fn integer(&self, range: RangeInclusive<u32>) -> Result<u32, ScenarioError> {
        let DeValue::Integer(written) = self.value.get_ref() else {
            return Err(self.wrong_type("an integer"));
        };
        let integer = integer_value(written).and_then(|integer| u32::try_from(integer).ok());
        integer.filter(|integer| range.contains(integer)).ok_or_else(|| {
            let (low, high) = (*range.start(), *range.end());
            let range = match high {
                u32::MAX => format!(", {low} or above"),
                _ => format!(" from {low} to {high}"),
            };
            self.wrong(format_args!("is {written}, expected an integer{range}"))
        })
    }

    pub(super) fn boolean(&self) -> Result<bool, ScenarioError> {
        self.value.get_ref().as_bool().ok_or_else(|| self.wrong_type("true or false"))
    }

    pub(super) fn text(&self) -> Result<&'a str, ScenarioError> {
        match self.value.get_ref() {
            DeValue::String(text) => Ok(text),
            _ => Err(self.wrong_type("a text")),
        }
    }

    /// One of a few texts, each standing for something.
    pub(super) fn choice<T: Copy>(&self, choices: &[(&str, T)]) -> Result<T, ScenarioError> {
        let text = self.text()?;
        if let Some((_, meaning)) = choices.iter().find(|(name, _)| *name == text) {
            return Ok(*meaning);
        }
        let names: Vec<_> = choices.iter().map(|(name, _)| *name).collect();
        let hint = match closest(text, names.iter().copied()) {
            Some(closest) => format!("write \"{closest}\""),
            None => format!("write one of {}", names.join(", ")),
        };
        Err(self.error(format_args!("`{text}` is unknown here"), hint))
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

    /// The entries of a list; `hint` is what to do about one that is wrong.
    pub(super) fn list(&self, hint: &str) -> Result<Vec<Value<'a>>, ScenarioError> {
        let entry = |(index, value)| self.entry(index, value, hint);
        Ok(self.array()?.iter().enumerate().map(entry).collect())
    }

    /// Entry `index`, from 0; counted from 1 in its path.
    fn entry(&self, index: usize, value: &'a Spanned<DeValue<'a>>, hint: &str) -> Value<'a> {
        let path = format!("{}[{}]", self.path, index + 1);
        Value { source: self.source, path, hint: hint.to_owned(), value }
    }

    /// A list of numbers.
    pub(super) fn numbers(&self) -> Result<Vec<f64>, ScenarioError> {
        // Only a number that is refused needs its path.
        let number = |(index, value): (usize, &'a Spanned<DeValue<'a>>)| {
            let refused = || self.entry(index, value, "write a finite number").number();
            plain_number(value.get_ref()).map_or_else(refused, Ok)
        };
        self.array()?.iter().enumerate().map(number).collect()
    }

    /// As many numbers as `owner` has: `numbers_of(3, "the state has")`.
    pub(super) fn numbers_of(&self, count: usize, owner: &str) -> Result<Vec<f64>, ScenarioError> {
        let found = self.array()?.len();
        if found != count {
            let problem = format!("{}, {owner} {count}", has(found, "entry", "entries"));
            return Err(self.error(problem, format_args!("give it {count}")));
        }
        self.numbers()
    }

    /// A matrix by rows; every row as long as `owner` asks for. At least one row.
    pub(super) fn matrix(
        &self,
        columns: usize,
        owner: &str,
    ) -> Result<nalgebra::DMatrix<f64>, ScenarioError> {
        let rows = self.list("write every row as a list of numbers")?;
        if rows.is_empty() {
            return Err(self.wrong("has no row"));
        }
        let mut entries = Vec::with_capacity(rows.len() * columns);
        for (index, row) in rows.iter().enumerate() {
            let found = row.array()?.len();
            if found != columns {
                let found = has(found, "entry", "entries");
                let problem = format!("row {} {found}, {owner} {columns}", index + 1);
                let hint = format_args!("give every row {}", counted(columns, "entry", "entries"));
                return Err(row.error_of(self, problem, hint));
            }
            entries.extend(row.numbers()?);
        }
        Ok(nalgebra::DMatrix::from_row_slice(rows.len(), columns, &entries))
    }

    /// A number as it stands in the file.
    pub(super) fn written(&self) -> String {
        self.source.text.get(self.value.span()).unwrap_or_default().to_owned()
    }
}

/// `has 1 entry`, `has 2 entries`.
pub(super) fn has(count: usize, one: &str, many: &str) -> String {
    format!("has {}", counted(count, one, many))
}

/// `1 entry`, `2 entries`.
pub(super) fn counted(count: usize, one: &str, many: &str) -> String {
    format!("{count} {}", if count == 1 { one } else { many })
}

/// The number that `value` is, if it is one that an agent can hold.
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
