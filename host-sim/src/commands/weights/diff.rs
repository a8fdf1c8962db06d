//! `weights diff`: compares two packages.

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;
use serde_json::Value;

use crate::commands::{CommandError, Format, print_json, print_text};
use crate::number::{counted, significant};
use crate::packages::{Facts, PackageBytes};
use crate::terminal;

/// Arguments of `weights diff`.
#[derive(Debug, Args)]
pub(in crate::commands) struct Arguments {
    /// First package
    first: PathBuf,
    /// Second package
    second: PathBuf,
    /// Output format
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

#[derive(Serialize)]
struct Report {
    first: String,
    second: String,
    identical: bool,
    /// Fields that differ.
    differences: Vec<Difference>,
    /// Change of the inner parameters, if both packages have the same number.
    inner_parameters: Option<Change>,
}

#[derive(Serialize)]
struct Difference {
    fact: String,
    first: Value,
    second: Value,
}

/// Difference between two sequences of numbers.
#[derive(Serialize)]
struct Change {
    changed: usize,
    of: usize,
    largest: f32,
    root_mean_square: f64,
}

pub(super) fn execute(arguments: &Arguments) -> Result<(), CommandError> {
    let first = PackageBytes::load(&arguments.first)?;
    let second = PackageBytes::load(&arguments.second)?;
    let report = Report {
        first: arguments.first.display().to_string(),
        second: arguments.second.display().to_string(),
        identical: first.as_bytes() == second.as_bytes(),
        differences: differences(&Facts::new(&first), &Facts::new(&second))?,
        inner_parameters: change(
            first.package().network.parameters(),
            second.package().network.parameters(),
        ),
    };
    match arguments.format {
        Format::Json => print_json(&report),
        Format::Text => print_text(&text(&report)),
    }
}

fn differences(first: &Facts, second: &Facts) -> Result<Vec<Difference>, CommandError> {
    let value = |facts: &Facts| {
        serde_json::to_value(facts).map_err(|error| CommandError::Output(error.into()))
    };
    let (first, second) = (value(first)?, value(second)?);
    let facts = first.as_object().into_iter().flatten();
    let differences = facts.filter_map(|(fact, first)| {
        let second = &second[fact];
        let (first, second) = (first.clone(), second.clone());
        (first != second).then(|| Difference { fact: fact.clone(), first, second })
    });
    Ok(differences.collect())
}

fn change(first: &[f32], second: &[f32]) -> Option<Change> {
    if first.len() != second.len() {
        return None;
    }
    let pairs = || first.iter().zip(second);
    let squares = pairs().map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2));
    let changed = pairs().filter(|(a, b)| a.to_bits() != b.to_bits()).count();
    (changed > 0).then(|| Change {
        changed,
        of: first.len(),
        largest: pairs().fold(0.0, |most, (a, b)| most.max((a - b).abs())),
        root_mean_square: (squares.fold(0.0, |sum, square| sum + square) / first.len() as f64)
            .sqrt(),
    })
}

/// Longest list of numbers that is shown as it is.
const SHOWN: usize = 4;

/// Returns what changed between two values of a fact with this name, one entry for each number, word or list.
fn changes(name: &str, first: &Value, second: &Value) -> Vec<(String, String)> {
    match (first, second) {
        (Value::Object(first), Value::Object(second)) => {
            let both = first.iter().filter_map(|(key, value)| Some((key, value, second.get(key)?)));
            let changed = both.filter(|(_, first, second)| first != second);
            changed
                .flat_map(|(key, first, second)| {
                    changes(&format!("{name}, {}", heading(key)), first, second)
                })
                .collect()
        }
        (Value::Array(first), Value::Array(second)) if first.len() == second.len() => {
            let pairs = || first.iter().zip(second);
            let numbers = || pairs().filter_map(|(a, b)| Some((a.as_f64()?, b.as_f64()?)));
            if numbers().count() == first.len() && first.len() > SHOWN {
                let changed = numbers().filter(|(a, b)| a != b).count();
                let largest = numbers().fold(0.0f64, |most, (a, b)| most.max((a - b).abs()));
                let change = format!(
                    "{changed} of {} numbers changed, by up to {}",
                    first.len(),
                    significant(largest, 4)
                );
                return vec![(name.to_owned(), change)];
            }
            if first.iter().all(Value::is_object) {
                let one = name.strip_suffix('s').unwrap_or(name);
                let entries = (1..).zip(pairs()).filter(|(_, (a, b))| a != b);
                return entries
                    .flat_map(|(at, (a, b))| changes(&format!("{one} {at}"), a, b))
                    .collect();
            }
            vec![(name.to_owned(), format!("{} -> {}", list(first), list(second)))]
        }
        _ => {
            let in_words = |value: &Value| match (value, name) {
                (Value::Null, "exchange" | "observer") => "the paper's".to_owned(),
                _ => in_words(value),
            };
            let (mut before, mut after) = (in_words(first), in_words(second));
            if before == after {
                // They differ beyond the digits that are shown.
                (before, after) = (first.to_string(), second.to_string());
            }
            vec![(name.to_owned(), format!("{before} -> {after}"))]
        }
    }
}

/// Returns a key in words, with its unit if it ends in one.
fn heading(key: &str) -> String {
    match key.strip_suffix("_s") {
        Some(name) => format!("{} [s]", name.replace('_', " ")),
        None => key.replace('_', " "),
    }
}

fn in_words(value: &Value) -> String {
    match value {
        Value::Null => "none".to_owned(),
        Value::Bool(true) => "yes".to_owned(),
        Value::Bool(false) => "no".to_owned(),
        Value::Number(number) => match (number.is_f64(), number.as_f64()) {
            // As written in a scenario, since most are of single precision.
            (true, Some(number)) if (1e-4..1e6).contains(&number.abs()) => {
                (number as f32).to_string()
            }
            (true, Some(number)) => significant(number, 6),
            _ => number.to_string(),
        },
        Value::String(text) => terminal::one_line(text).into_owned(),
        Value::Array(entries) => list(entries),
        Value::Object(entries) => {
            let present = entries.iter().filter(|(_, value)| !value.is_null());
            let entries =
                present.map(|(key, value)| format!("{} {}", heading(key), in_words(value)));
            entries.collect::<Vec<_>>().join(", ")
        }
    }
}

/// Returns a short list as it is, and of a longer one its length.
fn list(entries: &[Value]) -> String {
    if entries.len() > SHOWN || entries.iter().any(Value::is_object) {
        return counted(entries.len() as u64, "entry", "entries");
    }
    format!("[{}]", entries.iter().map(in_words).collect::<Vec<_>>().join(", "))
}

fn text(report: &Report) -> String {
    if report.identical {
        return format!("{} and {} are identical\n", report.first, report.second);
    }
    let mut text = format!("{} -> {}\n", report.first, report.second);
    for Difference { fact, first, second } in &report.differences {
        for (name, change) in changes(&heading(fact), first, second) {
            text += &format!("  {name}: {change}\n");
        }
    }
    if let Some(change) = &report.inner_parameters {
        text += &format!(
            "  inner parameters: {} of {} changed, by up to {:.4}, root mean square {:.4}\n",
            change.changed, change.of, change.largest, change.root_mean_square
        );
    } else if report.differences.is_empty() {
        text += "  only the test vectors or the signature differ\n";
    }
    text
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn changes_are_named_by_their_place() {
        let found = |first: Value, second: Value| {
            let changes = changes("observer", &first, &second).into_iter();
            changes.map(|(name, change)| format!("{name}: {change}")).collect::<Vec<_>>()
        };
        let directions =
            |radius: f32| json!({ "directions": [{ "radius": 0.5 }, { "radius": radius }] });
        assert_eq!(
            found(directions(0.06), directions(0.08)),
            ["observer, direction 2, radius: 0.06 -> 0.08"]
        );
        assert_eq!(
            found(json!({ "gap_s": null }), json!({ "gap_s": 0.5 })),
            ["observer, gap [s]: none -> 0.5"]
        );
        assert_eq!(found(json!(true), json!(false)), ["observer: yes -> no"]);
        assert_eq!(found(json!([1, 2]), json!([1, 3])), ["observer: [1, 2] -> [1, 3]"]);
        assert_eq!(
            found(json!([0.0, 0.0, 0.0, 0.0, 1.0]), json!([0.0, 0.0, 0.0, 0.0, 3.0])),
            ["observer: 1 of 5 numbers changed, by up to 2.000"]
        );
        assert_eq!(
            found(json!(null), json!({ "heartbeat_s": 1.5, "gap_s": null })),
            ["observer: the paper's -> heartbeat [s] 1.5"]
        );
        assert_eq!(found(json!([{}, {}]), json!([{}])), ["observer: 2 entries -> 1 entry"]);
    }
}
