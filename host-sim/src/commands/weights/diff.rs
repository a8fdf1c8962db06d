//! `weights diff`: compares two packages.

use std::path::PathBuf;

use clap::Args;
use serde::Serialize;
use serde_json::Value;

use crate::commands::{CommandError, Format, print_json, print_text};
use crate::packages::{Facts, PackageBytes};

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

fn text(report: &Report) -> String {
    if report.identical {
        return format!("{} and {} are identical\n", report.first, report.second);
    }
    let mut text = format!("{} -> {}\n", report.first, report.second);
    for Difference { fact, first, second } in &report.differences {
        text += &format!("  {:24} {first} -> {second}\n", fact.replace('_', " "));
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
